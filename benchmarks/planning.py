"""Gain of every candidate pose in one exchange of a plan, beside a loop over determinants.

A step of active calibration asks of every candidate what the determinant of the information would become if it took a
chosen pose's place. Ours updates determinant and inverse; the plain loop builds the information with each candidate and
takes its determinant anew, one candidate after the other in numpy, as textbook code does. Both get the same rows and
one thread; both must name the same best candidate. The rows are those of a five-bar: one leg (6 parameters, 1
equation a pose) and both legs (12 parameters, 2 equations).
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from pathlib import Path

import numpy as np
import torch

from benchmarks.measure import Row, compare
from ccnn_torch.identification import inverse_problem, split_by_leg
from ccnn_torch.mechanisms import load_mechanism
from ccnn_torch.numerics.designs import log_determinant
from ccnn_torch.planning import draw_candidates
from ccnn_torch.planning.candidates import common_coordinates, identification_rows
from ccnn_torch.planning.design import Design, _exchange_gain, add_best, make_design

# Candidates that the plain loop is timed on; all 100,000 would take it half a minute a step.
PLAIN = 2000


def all_gains(design: Design, old: int) -> torch.Tensor:
    """What every candidate in place of `old` adds to the determinant's logarithm."""
    factor = design.factor
    everyone = torch.arange(design.rows.shape[-1])
    return _exchange_gain(design, old, everyone, factor, log_determinant(factor))


def plain_gains(rows: np.ndarray, chosen: list[int], old: int) -> np.ndarray:
    """The same by a loop that computes each determinant anew."""
    whole = sum(rows[i].T @ rows[i] for i in chosen)
    left = whole - rows[old].T @ rows[old]
    base = np.linalg.slogdet(whole)[1]
    return np.array([np.linalg.slogdet(left + row.T @ row)[1] - base for row in rows])


def run(quick: bool, model: Path | None = None) -> Iterator[Row]:
    """A step of the exchange over many candidates, for one leg and for both."""
    mechanism = load_mechanism("five_bar")
    count, poses = (20_000, 18) if quick else (100_000, 18)
    found = draw_candidates(mechanism, count)
    problem = inverse_problem(mechanism, found.joints, found.pose, pose_noise=1e-4, per_leg=True)
    leg = identification_rows(split_by_leg(problem)[0])
    both = identification_rows(inverse_problem(mechanism, found.joints, found.pose, pose_noise=1e-4))
    for name, rows, many in (("one leg", leg, poses), ("both legs", both, 2 * poses)):
        held = torch.zeros(rows.shape[-1], dtype=torch.float64)
        even = rows @ common_coordinates(rows, held)
        design = make_design(even)
        for _ in range(many):
            add_best(design)
        design.prior = torch.zeros_like(design.prior)
        design.refresh()
        old = design.chosen[0]
        shifted = np.concatenate([even[:PLAIN].numpy(), even[design.chosen].numpy()])
        chosen = list(range(PLAIN, len(shifted)))
        gains, plain = all_gains(design, old)[:PLAIN].numpy(), plain_gains(shifted, chosen, chosen[0])[:PLAIN]
        assert gains.argmax() == plain.argmax()
        np.testing.assert_allclose(plain, gains, atol=1e-7)
        yield from compare(
            f"gain of every candidate pose, {name} of a five-bar",
            count,
            "candidates",
            partial(all_gains, design, old),
            {"numpy loop": (partial(plain_gains, shifted, chosen, chosen[0]), len(shifted) / count)},
            rounds=3,
        )
