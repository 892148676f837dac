"""Seconds of a diagnosis, and its evidence against scikit-learn's: `python benchmarks/diagnosis.py [ROWS ...]`.

First, machine by machine, how long the verdict and its shrink take, and how long with all that is told beside them
(where the gap lies, blocks of rows, what to measure next; not the network), for a single cause, two and none, from
records in memory. Then what most of the search is made of: the evidence of every candidate by itself, by
`BayesianRidge` with its score (the same model: one scale of the coefficients, one of the noise), one candidate after
the other, and by ours, all side by side. Both get the same whitened columns and one thread, and both must find the same
candidate the most probable.
"""

from __future__ import annotations

import statistics
import sys
import time
from collections.abc import Callable
from typing import Any

import torch
from sklearn.linear_model import BayesianRidge

from ccnn_torch.diagnosis import diagnose_rows, engine
from ccnn_torch.diagnosis.evidence.single_groups import fit_single_groups, own_products
from ccnn_torch.effects import Situation, default_gravity
from ccnn_torch.simulation.job import simulate_records

_MACHINES = ("five_bar", "delta", "tripod", "stewart")
_CAUSES = ((), ("thermal",), ("compliance",), ("backlash", "joint_gain"), ("frame", "friction"))
# What is told beside the verdict and its shrink.
_BESIDE = ("where", "by_block", "next_measurements")
_NOISE = 1e-5
_REPEATS = 3


def rows_of(machine: str, causes: tuple[str, ...], rows: int) -> tuple[Situation, torch.Tensor]:
    """Rows with these causes at sizes drawn at random, and the measured poses."""
    made = simulate_records(machine, causes, rows, _NOISE, seed=1)
    situation = Situation(
        made.mechanism, made.joints, made.covariates, default_gravity(made.mechanism), None, made.pose
    )
    return situation, made.pose


def seconds(machine: str, rows: int) -> tuple[list[float], list[float]]:
    """Of the verdict with its shrink, and of the whole diagnosis, cause by cause, each the best of a few."""
    found = []
    for causes in _CAUSES:
        taken = []
        for _ in range(_REPEATS):
            situation, pose = rows_of(machine, causes, rows)
            spent.clear()
            start = time.perf_counter()
            diagnose_rows(situation, pose)
            whole = time.perf_counter() - start
            taken.append((whole - sum(spent), whole))
        found.append(min(taken))
    verdicts, wholes = zip(*found, strict=True)
    return [*verdicts], [*wholes]


spent: list[float] = []


def timed(function: Callable[..., Any]) -> Callable[..., Any]:
    """The same, its seconds added to `spent`."""

    def call(*given: Any) -> Any:
        start = time.perf_counter()
        try:
            return function(*given)
        finally:
            spent.append(time.perf_counter() - start)

    return call


def against_ridge(machine: str, rows: int) -> None:
    """Time the evidence of all candidates with columns of their own."""
    situation, pose = rows_of(machine, ("compliance",), rows)
    analysis = diagnose_rows(situation, pose).analysis
    x, y = analysis.dictionary.columns, analysis.y
    own = [(i, x[..., g].contiguous()) for i, g in analysis.dictionary.groups.items()]
    start = time.perf_counter()
    evidence = fit_single_groups(
        [own_products(c, y) for _, c in own], y.square().sum(), float(y.numel()), 0.0
    ).log_evidence
    ours = time.perf_counter() - start
    start = time.perf_counter()
    plain = []
    for _, columns in own:
        ridge = BayesianRidge(fit_intercept=False, compute_score=True)
        ridge.fit(columns.flatten(0, 1).numpy(), y.flatten().numpy())
        plain.append(float(ridge.scores_[-1]))
    theirs = time.perf_counter() - start
    names = [analysis.dictionary.atoms[i].name for i, _ in own]
    best = names[int(evidence.argmax())], names[max(range(len(plain)), key=plain.__getitem__)]
    assert best[0] == best[1], best
    print(f"{machine}, {rows} rows: evidence of {len(own)} candidates, {x.shape[-1]} columns, {y.numel()} values")
    print(f"  side by side   {ours * 1e3:8.1f} ms")
    print(f"  BayesianRidge  {theirs * 1e3:8.1f} ms; ratio {theirs / ours:.1f}")


def main(counts: list[int]) -> None:
    """Measure and print."""
    torch.set_num_threads(1)
    for name in _BESIDE:
        setattr(engine, name, timed(getattr(engine, name)))
    seconds("five_bar", 60)
    print(f"seconds of verdict and shrink, and of all that is told: median [least, most] of {len(_CAUSES)} causes")
    for rows in counts:
        for machine in _MACHINES:
            told = (f"{statistics.median(t):.2f} [{min(t):.2f}, {max(t):.2f}]" for t in seconds(machine, rows))
            print(f"  {rows:6d} rows  {machine:9s} {'   '.join(told)}")
    for machine in ("five_bar", "stewart"):
        against_ridge(machine, counts[0])


if __name__ == "__main__":
    main([int(count) for count in sys.argv[1:]] or [400, 10000])
