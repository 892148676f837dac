"""Diagnosis of simulated records in memory, and the evidence of single candidates beside scikit-learn's.

`BayesianRidge` with its score is the same model (one scale of the coefficients, one of the noise), one candidate after
the other; ours has all side by side. Both get the same whitened columns, and must find the same candidate the best.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from pathlib import Path

import torch
from sklearn.linear_model import BayesianRidge

from benchmarks.measure import Row, compare
from ccnn_torch.diagnosis import diagnose_rows
from ccnn_torch.effects import Situation, default_gravity
from ccnn_torch.evidence.marginal_likelihood import Prior, fit_single_groups, own_products
from ccnn_torch.simulation.job import simulate_records

NOISE = 1e-5


def run(quick: bool, model: Path | None = None) -> Iterator[Row]:
    """A cause alone and two, from hundreds to thousands of rows; then the evidence by itself."""
    for machine in ("five_bar",) if quick else ("five_bar", "delta", "tripod", "stewart"):
        for causes in (("compliance",), ("backlash", "joint_gain"))[: 1 if quick else 2]:
            for rows in (100, 200, 400) if quick else (400, 2000, 10_000):
                given = rows_of(machine, causes, rows)
                task = f"diagnose a {machine}: {', '.join(causes)}"
                yield from compare(task, rows, "rows", partial(diagnose_rows, *given), rounds=1 if quick else 3)
    for machine in ("five_bar",) if quick else ("five_bar", "stewart"):
        yield from against_ridge(machine, 400)


def rows_of(machine: str, causes: tuple[str, ...], rows: int) -> tuple[Situation, torch.Tensor]:
    """Rows with these causes at sizes drawn at random, and the measured poses."""
    made = simulate_records(machine, causes, rows, NOISE, seed=1)
    situation = Situation(
        made.mechanism, made.joints, made.covariates, default_gravity(made.mechanism), None, made.pose
    )
    return situation, made.pose


def against_ridge(machine: str, rows: int) -> list[Row]:
    """The evidence of all candidates with columns of their own."""
    analysis = diagnose_rows(*rows_of(machine, ("compliance",), rows)).analysis
    x, y = analysis.dictionary.columns, analysis.dictionary.y
    own = [x[..., g].contiguous() for g in analysis.dictionary.groups.values()]

    def ours() -> torch.Tensor:
        products = [own_products(c, y) for c in own]
        return fit_single_groups(products, y.square().sum(), Prior(float(y.numel()), 0.0))[0].log_evidence

    def ridge() -> list[float]:
        plain = [BayesianRidge(fit_intercept=False, compute_score=True) for _ in own]
        flat = y.flatten().numpy()
        return [float(r.fit(c.flatten(0, 1).numpy(), flat).scores_[-1]) for r, c in zip(plain, own, strict=True)]

    theirs = ridge()
    assert int(ours().argmax()) == max(range(len(theirs)), key=theirs.__getitem__)
    task = f"evidence of {len(own)} candidates of a {machine}"
    return compare(task, rows, "rows", ours, {"scikit-learn BayesianRidge": ridge}, rounds=3)
