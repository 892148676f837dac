"""Candidates per second in pose planning: `python benchmarks/planning.py [CANDIDATES] [POSES]`.

A step of active calibration asks of every candidate what the determinant of the information would become if it took a
chosen pose's place. Ours updates determinant and inverse; the plain loop builds the information with each candidate and
takes its determinant anew, one candidate after the other in numpy, as textbook code does. Both get the same rows and
one thread, and both must name the same best candidate. The rows are those of a five-bar: one leg (6 parameters, 1
equation a pose) and both legs (12 parameters, 2 equations).
"""

from __future__ import annotations

import sys
import time

import numpy as np
import torch

from ccnn_torch.identification import inverse_problem, split_by_leg
from ccnn_torch.mechanisms import load_mechanism
from ccnn_torch.planning import draw_candidates
from ccnn_torch.planning.candidates import common_coordinates, identification_rows
from ccnn_torch.planning.design import Design, _exchange_gain, add_best, exchange, make_design
from ccnn_torch.planning.small_matrices import log_determinant, small_cholesky

# Candidates that the plain loop is timed on; all 100,000 would take it half a minute a step.
_PLAIN = 5000


def all_gains(design: Design, old: int) -> torch.Tensor:
    """What every candidate in place of `old` adds to the determinant's logarithm."""
    factor = small_cholesky(design.spread + torch.eye(len(design.spread), dtype=torch.float64)[:, :, None])
    everyone = torch.arange(design.rows.shape[-1])
    return _exchange_gain(design, old, everyone, factor, log_determinant(factor))


def plain_gains(rows: np.ndarray, chosen: list[int], old: int) -> np.ndarray:
    """The same by a loop that computes each determinant anew."""
    whole = sum(rows[i].T @ rows[i] for i in chosen)
    left = whole - rows[old].T @ rows[old]
    base = np.linalg.slogdet(whole)[1]
    return np.array([np.linalg.slogdet(left + row.T @ row)[1] - base for row in rows])


def measure(name: str, rows: torch.Tensor, poses: int) -> None:
    """Time one step of each kind, and a whole plan."""
    count = len(rows)
    held = torch.zeros(rows.shape[-1], dtype=torch.float64)
    even = rows @ common_coordinates(rows, held, [])
    start = time.perf_counter()
    design = make_design(even)
    for _ in range(poses):
        add_best(design)
    design.prior = torch.zeros_like(design.prior)
    design.refresh()
    added = time.perf_counter() - start
    old = design.chosen[0]
    all_gains(design, old)
    start = time.perf_counter()
    for _ in range(5):
        gains = all_gains(design, old)
    step = (time.perf_counter() - start) / 5
    part = even[:_PLAIN].numpy()
    shifted = np.concatenate([part, even[design.chosen].numpy()])
    chosen = list(range(len(part), len(shifted)))
    start = time.perf_counter()
    plain = plain_gains(shifted, chosen, chosen[0])[: len(part)]
    loop = (time.perf_counter() - start) / len(shifted)
    assert int(plain.argmax()) == int(gains[: len(part)].argmax())
    assert np.allclose(plain, gains[: len(part)].numpy(), atol=1e-7)
    start = time.perf_counter()
    settled = exchange(design)
    exchanged = time.perf_counter() - start
    print(f"{name}: {count} candidates, {poses} poses, {rows.shape[1]} x {rows.shape[2]} rows")
    print(f"  updates      {count / step:12.3g} candidates a second")
    print(f"  plain loop   {1 / loop:12.3g} candidates a second; ratio {count / step * loop:.0f}")
    print(f"  whole plan   {added:.2f} s adding, {exchanged:.2f} s exchanging{'' if settled else ' (not settled)'}")


def main(count: int, poses: int) -> None:
    """Measure and print."""
    torch.set_num_threads(1)
    mechanism = load_mechanism("five_bar")
    start = time.perf_counter()
    found = draw_candidates(mechanism, count)
    problem = inverse_problem(mechanism, found.joints, found.pose, pose_noise=1e-4, per_leg=True)
    leg = identification_rows(split_by_leg(problem)[0])
    common = identification_rows(inverse_problem(mechanism, found.joints, found.pose, pose_noise=1e-4))
    print(f"{count} candidates drawn, their rows differentiated: {time.perf_counter() - start:.1f} s")
    measure("one leg", leg, poses)
    measure("both legs", common, 2 * poses)


if __name__ == "__main__":
    main(*(int(word) for word in (sys.argv[1:] + ["100000", "18"][len(sys.argv) - 1 :])))
