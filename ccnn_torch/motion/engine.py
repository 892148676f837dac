"""Diagnose a motion: which effects make the gap between model and machine, where, and how much of it."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import torch
from torch import Tensor

from ccnn_torch.diagnosis.progress import at_step
from ccnn_torch.diagnosis.verdict.text import verdict_text
from ccnn_torch.motion.content import effects_of, floor_of, notes_of, where_is
from ccnn_torch.motion.effects import motion_effects
from ccnn_torch.motion.effects.own_parameter import OWN
from ccnn_torch.motion.held_names import how_many_hold, in_order, none_of, only, reduced, singles
from ccnn_torch.motion.held_out import Spread, held_out, shrink_of
from ccnn_torch.motion.judge import AxisVerdict, judge_axes
from ccnn_torch.motion.log import Log
from ccnn_torch.motion.next_motion import Motion, next_motions
from ccnn_torch.motion.nominal import Nominal
from ccnn_torch.motion.problem import Problem
from ccnn_torch.motion.search import Search, search
from ccnn_torch.motion.setting import problem_of

__all__ = ["MotionDiagnosis", "diagnose_motion"]

# Searches about a simulator's parameters as found.
_RECENTRED = 2
# Marginal probability from which something is there even where no names hold, which are then no surer than that.
_CONFIRMED = 0.5


@dataclass(frozen=True)
class MotionDiagnosis:
    """Which effect, where, how far.

    Attributes:
        content: of `diagnosis.json`.
        problem: the data and the library.
        found: what was fitted.
        verdicts: of each axis.
        before, after: residuals held out, with nothing and with the verdict's effects, `n x b x s` [rad or m].
        proposed: the motions of `next_measurements`.
    """

    content: dict[str, Any]
    problem: Problem = field(repr=False)
    found: Search = field(repr=False)
    verdicts: Sequence[AxisVerdict] = field(repr=False)
    before: Tensor = field(repr=False)
    after: Tensor = field(repr=False)
    proposed: Sequence[Motion] = field(repr=False)

    def to_json(self) -> Mapping[str, Any]:
        """The form of `diagnosis.json` (schema `diagnosis`)."""
        return self.content


@torch.no_grad()
def diagnose_motion(
    logs: Sequence[Log],
    nominal: Nominal,
    effects: Sequence[str] | None = None,
    noise: float | None = None,
    seed: int = 0,
) -> MotionDiagnosis:
    """Diagnose logs of a machine in motion.

    Args:
        logs: runs; folds of the held-out figures are whole runs where there are two or more.
        nominal: the model.
        effects: candidates by name; None = all.
        noise: standard deviation of the position [rad or m]; None = estimated from what the best model leaves.
        seed: of resampling.

    Raises:
        InputError: the logs cannot be diagnosed.
    """
    at_step("searching the effects")
    problem = problem_of(logs, nominal, [*motion_effects(effects), *nominal.own_effects])
    nothing = problem.residual(torch.zeros(1, len(nominal.axes), problem.library.size, dtype=torch.float64))[0]
    found = _searched(problem, logs, nominal)
    problem = found.problem
    verdicts = judge_axes(found)
    at_step("judging on held-out rows")
    library, data = problem.library, problem.data
    alone = singles(found)
    none = [none_of(library) for _ in verdicts]
    whole = [v.best.spec for v in verdicts]
    names = in_order(problem, verdicts)
    steps = [
        [only(library, s, [library.names.index(m) for m in names[: k + 1]]) for s in whole] for k in range(len(names))
    ]
    sets = [none, *steps, *alone.values()]
    residuals = held_out(problem, found.whitening, sets)
    # Of the model itself, also where it was linearised elsewhere.
    residuals[0] = nothing
    spread = Spread(problem, seed)
    squares = [spread.squares(r) for r in residuals]
    floor = noise**2 * len(whole) if noise else floor_of(problem, found, verdicts)
    total = shrink_of(spread, squares[0], squares[len(steps)], floor)
    outside = any(v.driver is not None for v in verdicts)
    probability = math.prod(v.probability for v in verdicts)
    kept = how_many_hold(squares[: len(steps) + 1]) if names else 0
    helped = min((float(v.sum()) for v in squares[1 : len(steps) + 1]), default=math.inf) < float(squares[0].sum())
    seen = any(m > _CONFIRMED for v in verdicts for m in v.marginal.values())
    unconfirmed = not kept and seen and helped and not outside
    if unconfirmed:
        # More is seen than chance, and what it takes away elsewhere is little: the names that take most.
        kept = 1 + min(range(len(names)), key=lambda k: float(squares[k + 1].sum()))
    dropped = names[kept:]
    if dropped:
        # A name has to take something away on runs that no fit saw.
        verdicts = [reduced(library, found.found[i], v, names[:kept]) for i, v in enumerate(verdicts)]
        names, steps = names[:kept], steps[:kept]
        probability = math.prod(v.probability for v in verdicts)
        total = shrink_of(spread, squares[0], squares[kept], floor)
    probability = min(probability, _CONFIRMED) if unconfirmed else probability
    unit = data.units[0]
    drivers = list(dict.fromkeys(v.driver for v in verdicts if v.driver))
    after = residuals[len(names)]
    each = dict(zip(alone, squares[-len(alone) :], strict=True))
    every = effects_of(problem, found, verdicts, spread, squares[0], each, floor)
    at_step("next measurements")
    wanted, proposed = next_motions(found, verdicts)
    verdict: dict[str, Any] = {
        "effects": names,
        "probability": probability,
        "shrink": total[2],
        "shrink_ci95": total[3],
        "none": not names and not outside,
        "outside_library": outside,
        "driver": drivers[0] if drivers else None,
        "drivers": drivers,
        "text": "",
    }
    before2, floor_rms = total[0] ** 2, math.sqrt(floor)
    content: dict[str, Any] = {
        "motion": True,
        "mechanism": {
            "name": nominal.name,
            "joints": [f"q{i + 1}" for i in range(len(data.units))],
            "gravity": [0.0, 0.0, -9.80665],
        },
        "noise": "given" if noise else "estimated",
        "gap": {
            "unit": unit,
            "before": total[0],
            "after": total[1],
            "noise_floor": floor_rms,
            "reducible_share": max(0.0, 1 - floor / before2) if before2 else 0.0,
        },
        "gap_rotation": None,
        **where_is(problem, residuals[0], spread),
        "effects": every,
        "in_order": [
            {"name": name, "gap_after": own[1], "shrink": own[2], "shrink_ci95": own[3]}
            for name, own in (
                (name, shrink_of(spread, squares[0], squares[k + 1], floor)) for k, name in enumerate(names)
            )
        ],
        "by_block": None,
        "network": None,
        "verdict": verdict,
        "next_measurements": wanted,
        "missing_covariates": [],
        "not_seen": {n: why for n, why in zip(library.names, library.lacking, strict=True) if why},
        "rows_set_aside": [],
        "why_set_aside": [],
        "cautions": [],
        "notes": notes_of(problem, nominal, found, floor_rms, noise, dropped),
    }
    verdict["text"] = verdict_text(content)
    return MotionDiagnosis(content, problem, found, verdicts, residuals[0], after, proposed)


def _searched(problem: Problem, logs: Sequence[Log], nominal: Nominal) -> Search:
    """The search; a simulator is linearised in its own parameters, and so again about those that were found."""
    found = search(problem)
    for _ in range(_RECENTRED):
        about = _own_values(found)
        if not about:
            break
        driven = nominal.driven(logs, problem.data, about)
        found = search(replace(problem, followed=driven.followed, own=driven.own))
    return found


def _own_values(found: Search) -> dict[str, float]:
    """What is added to a simulator's own parameters: the mean over the axes whose best set has them."""
    theta = torch.stack([fits[0].spec.theta for fits in found.found])
    values = {n: v[v != 0] for n, v in found.problem.library.parameters(theta).items() if n.startswith(OWN)}
    return {name.removeprefix(OWN): float(v.mean()) for name, v in values.items() if len(v)}
