"""Diagnose a motion: which effects make the gap between model and machine, where, and how much of it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from ccnn_torch.diagnosis.progress import at_step
from ccnn_torch.diagnosis.result import Said, content_of, gap_block, order_block, verdict_block
from ccnn_torch.evidence.shrink import draws
from ccnn_torch.motion.content import effects_of, floor_of, hidden_of, notes_of, where_is
from ccnn_torch.motion.effects import motion_effects
from ccnn_torch.motion.effects.bodies import STANDARD_GRAVITY
from ccnn_torch.motion.fit import ALONE
from ccnn_torch.motion.held_out import gap_of, held_out, in_order, only, singles
from ccnn_torch.motion.judge import AxisVerdict, judge_axes
from ccnn_torch.motion.linearised import searched
from ccnn_torch.motion.log import Log
from ccnn_torch.motion.next_motion import Motion, next_motions
from ccnn_torch.motion.nominal import Nominal
from ccnn_torch.motion.problem import Problem
from ccnn_torch.motion.search import Search
from ccnn_torch.motion.setting import problem_of


@dataclass(frozen=True)
class MotionDiagnosis(Said):
    """Which effect, where, how far, from logs of a motion.

    Attributes:
        problem: the data and the library.
        found: what was fitted.
        verdicts: of each axis.
        before, after: residuals held out, with nothing and with the verdict's effects, `n x b x s` [rad or m].
        proposed: the motions of `next_measurements`.
        nominal: the model.
    """

    problem: Problem = field(repr=False)
    found: Search = field(repr=False)
    verdicts: Sequence[AxisVerdict] = field(repr=False)
    before: Tensor = field(repr=False)
    after: Tensor = field(repr=False)
    proposed: Sequence[Motion] = field(repr=False)
    nominal: Nominal = field(repr=False)


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
    candidates = motion_effects(effects)
    problem = problem_of(logs, nominal, [*candidates, *nominal.own_effects])
    nothing = problem.residual(torch.zeros(len(nominal.axes), problem.library.size, dtype=torch.float64), problem.axes)
    found = searched(problem, logs, nominal, lambda: problem_of(logs, nominal, candidates))
    problem = found.problem
    verdicts = judge_axes(found)
    at_step("judging on held-out rows")
    library, data = problem.library, problem.data
    alone, names = singles(found), in_order(problem, verdicts)
    members = [library.names.index(name) for name in names]
    steps = [[only(library, v.best.spec, members[:k]) for v in verdicts] for k in range(len(names) + 1)]
    # Where an effect acts in one run alone the others do not tell its numbers.
    folded = replace(problem, parted=any(v.best.once > ALONE for v in verdicts))
    residuals = held_out(folded, found.whitening, [*steps, *alone.values()])
    # Of the model itself, also where it was linearised elsewhere.
    residuals[0] = nothing
    floor = noise**2 * len(verdicts) if noise else floor_of(problem, found, verdicts)
    drawn = draws(len(data.run), seed)
    gaps = [gap_of(problem, nothing, left, floor, noise is not None, drawn) for left in residuals]
    total, in_steps = gaps[len(names)], gaps[1 : len(names) + 1]
    drivers = list(dict.fromkeys(v.driver for v in verdicts if v.driver))
    each = dict(zip(alone, gaps[len(steps) :], strict=True))
    every = effects_of(problem, found, verdicts, each)
    at_step("next measurements")
    wanted, proposed = next_motions(found, verdicts)
    content = content_of(
        motion=True,
        mechanism={
            "name": nominal.name,
            "joints": [f"q{i + 1}" for i in range(len(data.units))],
            "gravity": [0.0, 0.0, -STANDARD_GRAVITY],
        },
        noise="given" if noise else "estimated",
        gap=gap_block(total, data.units[0]),
        **where_is(problem, nothing, drawn),
        effects=every,
        in_order=order_block(names, in_steps),
        verdict=verdict_block(names, math.prod(v.probability for v in verdicts), total, bool(drivers), drivers),
        next_measurements=wanted,
        not_seen={n: why for n, why in zip(library.names, library.lacking, strict=True) if why},
        cautions=hidden_of(problem, verdicts),
        notes=notes_of(folded, nominal, found, total.floor, noise),
    )
    return MotionDiagnosis(content, problem, found, verdicts, nothing, residuals[len(names)], proposed, nominal)
