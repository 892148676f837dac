"""Diagnose a motion: which effects make the gap between model and machine, where, and how much of it."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ccnn_torch.diagnosis.progress import at_step
from ccnn_torch.diagnosis.result import Said, content_of, effect_block, gap_block, order_block, verdict_block
from ccnn_torch.diagnosis.verdict.text import listed, unseen_text
from ccnn_torch.display import number_text
from ccnn_torch.effects.words import words_of
from ccnn_torch.evidence.shrink import INTERVAL, Draws, Gap, draws
from ccnn_torch.motion.effects import Facts, Number, motion_effects
from ccnn_torch.motion.fit import ALONE, deviations
from ccnn_torch.motion.held_out import best_to_follow, gap_of, held_out, in_order, only, singles
from ccnn_torch.motion.judge import AxisVerdict, judge_axes, no_worse
from ccnn_torch.motion.known import TIME, allowed_text, share_of
from ccnn_torch.motion.library import Library
from ccnn_torch.motion.linearised import searched
from ccnn_torch.motion.log import Log
from ccnn_torch.motion.next_motion import Motion, next_motions
from ccnn_torch.motion.nominal import Nominal
from ccnn_torch.motion.problem import Problem
from ccnn_torch.motion.search import Search
from ccnn_torch.motion.setting import problem_of
from ccnn_torch.motion.spec import Fit, Spec
from ccnn_torch.motion.stretches import PHASES, Stretches, phases_of
from ccnn_torch.units import STANDARD_GRAVITY


@dataclass(frozen=True)
class MotionDiagnosis(Said):
    """Which effect, where, how far, from logs of a motion.

    Attributes:
        problem: the data and the library.
        found: what was fitted.
        verdicts: of each axis.
        before, after: residuals held out, with nothing and with the verdict's effects, `n x b x s` [rad or m].
        followed, left: the set of each axis by which commands are made, and what it leaves so, `n x b x s` [rad or m].
        proposed: the motions of `next_measurements`.
        nominal: the model.
    """

    problem: Problem = field(repr=False)
    found: Search = field(repr=False)
    verdicts: Sequence[AxisVerdict] = field(repr=False)
    before: Tensor = field(repr=False)
    after: Tensor = field(repr=False)
    followed: Sequence[Spec] = field(repr=False)
    left: Tensor = field(repr=False)
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
    found = _diagnosed(logs, nominal, effects, noise, seed)
    apart = _apart(found)
    if apart is None:
        return found
    number, times = apart
    caution = (
        f"{logs[number].name} leaves {times:.2g} times as much as any other run and was left out: what acts there "
        "alone (a contact, a load) would hide what all share; diagnose it by itself"
    )
    others = _diagnosed([*logs[:number], *logs[number + 1 :]], nominal, effects, noise, seed, [caution])
    return others if others.content["verdict"]["effects"] else found


def _apart(found: MotionDiagnosis) -> tuple[int, float] | None:
    """The run that leaves far more of some joint than any other, and how much more."""
    data, runs = found.problem.data, sorted(set(found.problem.data.run.tolist()))
    if len(runs) < _FEWEST_RUNS:
        return None
    for own in found.after.square():
        left = torch.stack([own[(data.run == r)[:, None] & data.judged].mean() for r in runs]).sqrt()
        second, first = left.sort().values[-2:].tolist()
        if first > _APART * second:
            return runs[int(left.argmax())], first / second
    return None


def _diagnosed(
    logs: Sequence[Log],
    nominal: Nominal,
    effects: Sequence[str] | None,
    noise: float | None,
    seed: int,
    cautions: Sequence[str] = (),
) -> MotionDiagnosis:
    """As `diagnose_motion`, of all logs; cautions: beside those of the verdict."""
    at_step("searching the effects")
    candidates = motion_effects(effects)
    problem = problem_of(logs, nominal, [*candidates, *nominal.own_effects])
    nothing = problem.residual(problem.nothing, problem.axes)
    found = searched(problem, logs, nominal, lambda: problem_of(logs, nominal, candidates))
    problem = found.problem
    judged = judge_axes(found)
    at_step("judging on held-out rows")
    library, data = problem.library, problem.data
    alone, names = singles(found), in_order(problem, judged)
    members = [library.names.index(name) for name in names]
    steps = [[only(v.best.spec, members[:k]) for v in judged] for k in range(len(names) + 1)]
    # Where an effect acts in one run alone the others do not tell its numbers.
    folded = replace(problem, parted=any(v.best.once > ALONE for v in judged))
    residuals = held_out(folded, found.whitening, [*steps, *alone.values()])
    # Of the model itself, also where it was linearised elsewhere.
    residuals[0] = nothing
    verdicts, fewer = no_worse(found, judged, tuple(members), residuals[: len(steps)])
    for i, k in fewer.items():
        residuals[k : len(steps), i] = residuals[k, i].clone()
    named = {m for v in verdicts for m in v.best.members}
    kept = [0, *(k + 1 for k, m in enumerate(members) if m in named)]
    names = [names[k - 1] for k in kept[1:]]
    residuals = torch.cat([residuals[kept], residuals[len(steps) :]])
    floor = noise**2 * len(verdicts) if noise else _floor_of(problem, found, verdicts)
    drawn = draws(len(data.run), seed)
    gaps = [gap_of(problem, nothing, left, floor, noise is not None, drawn) for left in residuals]
    total, in_steps = gaps[len(names)], gaps[1 : len(names) + 1]
    drivers = list(dict.fromkeys(v.driver for v in verdicts if v.driver))
    each = dict(zip(alone, gaps[len(kept) :], strict=True))
    every = _effects_of(problem, found, verdicts, each)
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
        **_where_is(problem, nothing, drawn),
        effects=every,
        in_order=order_block(names, in_steps),
        verdict=verdict_block(names, min(v.probability for v in verdicts), total, bool(drivers), drivers),
        joints=_joints_of(problem, verdicts, nothing, residuals[len(names)]),
        next_measurements=wanted,
        not_seen={n: why for n, why in zip(library.names, library.lacking, strict=True) if why},
        cautions=[*cautions, *_worse_of(library, judged, verdicts), *_hidden_of(problem, verdicts)],
        notes=_notes_of(folded, nominal, found, verdicts, total.floor, noise),
    )
    after = residuals[len(names)]
    followed = best_to_follow(folded, found, verdicts, after)
    return MotionDiagnosis(content, problem, found, verdicts, nothing, after, *followed, proposed, nominal)


# A run is apart that leaves so many times as much as any other, of so many at least.
_APART, _FEWEST_RUNS = 4.0, 3
# Of shapes that are no speed.
_SHAPE_UNITS = {"cogging_order": "order", "lead_order": "order", "play_friction": "acceleration"} | dict.fromkeys(
    ("flexible_damping", "play_loaded", "encoder_at_motor", "cascade"), "1"
)
# A limit that is so far away is none.
_TINY = 1e-9


def _floor_of(problem: Problem, found: Search, verdicts: Sequence[AxisVerdict]) -> float:
    """Mean square of what the best sets leave, or the largest model where it leaves less, summed over the axes."""
    judged = problem.data.judged
    best = problem.residual(torch.stack([v.best.spec.theta for v in verdicts]), problem.axes)
    return float(torch.stack([best, found.largest])[..., judged].square().mean(-1).amin(0).sum())


def _where_is(problem: Problem, before: Tensor, draws: Draws) -> dict[str, Any]:
    """`where` and `where_ci95`, shares of the gap by joint and by phase of the motion; and the encoder's step."""
    data, phase = problem.data, phases_of(problem.data)
    squares, names = before.square() * data.judged, [f"q{i + 1}" for i in range(len(before))]
    each = torch.stack([*squares.sum(-1), *((squares * (phase == k)).sum((0, -1)) for k in range(len(PHASES)))])
    whole, q = squares.sum((0, -1)), torch.tensor(INTERVAL, dtype=torch.float64)
    shares = (each.sum(-1) / whole.sum().clamp_min(1e-300)).tolist()
    drawn = draws.counts @ each.mT / (draws.counts @ whole).clamp_min(1e-300)[:, None]
    ends = torch.quantile(drawn, q, 0).clamp(0, 1).mT.tolist()
    time = [float((phase == k)[:, data.judged].double().mean()) for k in range(len(PHASES))]
    by_phase = zip(PHASES, shares[len(names) :], time, strict=True)
    empty: dict[str, Any] = {"outputs": {}, "legs": {}, "regions": [], "covariates": {}}
    return {
        "where": empty
        | {
            "joints": dict(zip(names, shares, strict=False)),
            "phases": {name: {"share": share, "samples": samples} for name, share, samples in by_phase},
        },
        "where_ci95": empty
        | {
            "joints": dict(zip(names, ends, strict=False)),
            "phases": dict(zip(PHASES, ends[len(names) :], strict=True)),
        },
        "encoder_step": _resolution(data) or None,
    }


def _effects_of(
    problem: Problem, found: Search, verdicts: Sequence[AxisVerdict], alone: Mapping[str, Gap]
) -> list[dict[str, Any]]:
    """`effects`; alone: the gap with each effect alone in the model."""
    library = problem.library
    named = {m for v in verdicts for m in v.best.members}
    # The fits that tell the numbers of each effect: of the verdict, or of the effect alone where none has it.
    shown: list[tuple[int, int, int, Fit]] = []
    for e in map(library.names.index, alone):
        tried = library.twins.get(e, e)
        for i, v in enumerate(verdicts):
            single = () if tried in named else (f for f in found.found[i] if f.members == (tried,))
            fit = v.best if tried in v.best.members else next(iter(single), None)
            shown += [] if fit is None else [(e, tried, i, fit)]
    noises = [found.found[i][0].noise + found.form[i] for *_, i, _ in shown]
    spread = deviations([fit for *_, fit in shown], found.nuisance.shape[1], noises)
    parameters: dict[int, dict[str, Any]] = {}
    for (e, tried, i, fit), own in zip(shown, spread, strict=True):
        parameters.setdefault(e, {}).update(_parameters(library, i, fit, e, tried, own))
    rows = []
    for name, gap in alone.items():
        e = library.names.index(name)
        tried = library.twins.get(e, e)
        like = dict.fromkeys(library.names[o] for v in verdicts for o in (tried, *v.classes.get(tried, ())) if o != e)
        probability = 1 - math.prod(1 - v.marginal.get(e, 0.0) for v in verdicts)
        rows.append(effect_block(name, probability, parameters.get(e, {}), gap, like, {}))
    return sorted(rows, key=lambda e: (-e["probability"], e["gap_after"], e["name"]))


def _joints_of(
    problem: Problem, verdicts: Sequence[AxisVerdict], before: Tensor, after: Tensor
) -> list[dict[str, Any]]:
    """`joints`, the verdict on each; before, after: residuals held out."""
    names, judged = problem.library.names, problem.data.judged
    sizes = [left[:, judged].square().mean(-1).sqrt().tolist() for left in (before, after)]
    return [
        {
            "joint": f"q{i + 1}",
            "effects": [names[m] for m in v.best.members],
            "classes": {names[m]: [names[o] for o in v.classes.get(m, ())] for m in v.best.members},
            "probability": v.probability,
            "driver": v.driver,
            "gap_before": first,
            "gap_after": last,
        }
        for i, (v, first, last) in enumerate(zip(verdicts, *sizes, strict=True))
    ]


def _worse_of(library: Library, judged: Sequence[AxisVerdict], verdicts: Sequence[AxisVerdict]) -> list[str]:
    """Cautions on joints of which something is not named for that reason, a sentence each without a full stop."""
    found = []
    for i, (before, after) in enumerate(zip(judged, verdicts, strict=True)):
        named = {*after.best.members}
        if lost := [words_of(library.names[m]).cause for m in before.best.members if m not in named]:
            found.append(
                f"q{i + 1}: {listed(lost)} fits the logs best{' beside what is named' * bool(named)}, but leaves more "
                f"of runs not used for fitting than {'that alone' if named else 'the model'} does, and is not named: "
                "the runs differ in what they have"
            )
    return found


def _hidden_of(problem: Problem, verdicts: Sequence[AxisVerdict]) -> list[str]:
    """Cautions where nothing is named although a set leaves clearly less, a sentence each without a full stop."""
    names, shares = problem.library.names, {**problem.unsure, TIME: share_of(problem.known, TIME)}
    allowed = allowed_text(shares)
    # Where each value was told no form of the model is allowed for beside them.
    wanted = listed([key for key in problem.unsure if key not in problem.known] or ["the others"])
    return [
        f"q{i + 1} errs by more than the noise, most like {words_of(names[v.hidden]).cause}, but by less than the form "
        f"of a model{f' and its values ({allowed})' * bool(allowed)} are known to: say with exact=… or known=… "
        f"how far to trust {wanted}, or record motions that show it more"
        for i, v in enumerate(verdicts)
        if v.hidden is not None
    ]


def _only_ratios(library: Library, verdicts: Sequence[AxisVerdict]) -> list[str]:
    """Where a gain is named, and what else it may be; a sentence each without a full stop."""
    notes = []
    for i, verdict in enumerate(verdicts):
        parameters = library.parameters(verdict.best.spec.theta[None], torch.tensor([i]))
        gain = float(parameters.get("gain", torch.ones(1))[0])
        if library.facts[i].nominal.get("inertia") and gain != 1:
            notes.append(
                f"q{i + 1}: the logs tell torques over the gain alone: a gain {gain:.3g} times that of the model is "
                f"the same as inertia, friction and weight {1 / gain:.3g} times theirs"
            )
    return notes


def _notes_of(
    problem: Problem,
    nominal: Nominal,
    found: Search,
    verdicts: Sequence[AxisVerdict],
    floor: float,
    noise: float | None,
) -> list[str]:
    data = problem.data
    notes = [*data.notes, *nominal.notes]
    held = [f"q{i + 1}" for i, asked in enumerate(data.command[:, data.judged]) if bool((asked == asked[0]).all())]
    notes += [f"no log moves {listed(held)}: of such joints little can be told"] if held else []
    library = problem.library
    notes += [unseen_text(n, why) for n, why in zip(library.names, library.lacking, strict=True) if why]
    notes += _only_ratios(library, verdicts)
    runs, folds = len(set(data.run.tolist())), int(problem.fold.max()) + 1
    if problem.parted and runs > 1:
        notes.append(f"what is named acts in one run alone: {folds} parts of the runs were held out in turn")
    elif runs > 1:
        notes.append(f"held out were whole runs, {runs} of them in {folds} folds")
    else:
        notes.append(f"there is one run: its {folds} parts were held out in turn; record a second motion to be surer")
    step = _resolution(data)
    if noise is None and step and not step < floor <= 3 * step:
        what = "most of it is no noise of the encoder" if floor > step else "rounding alone leaves 0.29 times the step"
        notes.append(
            f"what the best model leaves is {number_text(floor / step, 2)} times the encoder's step of "
            f"{number_text(step, 2)} {data.units[0]}{' (all joints together)' if len(data.units) > 1 else ''}: {what}"
        )
    order = found.whitening.coefficients.shape[1]
    notes.append(
        f"residuals of a closed loop are correlated: they were whitened by an autoregressive model of order {order}, "
        f"on means over {problem.pool * float(data.time.diff(dim=-1).median()) * 1e3:.0f} ms"
    )
    return notes


def _resolution(data: Stretches) -> float:
    """Steps of the encoders that move, the smallest changes of which nearly all are multiples, root of their summed
    squares, as the floor is of all joints; 0 where one has none."""
    found = []
    for position in data.position[:, data.judged].numpy():
        steps = np.diff(np.unique(position))
        steps = steps[steps > 1e-9]
        if len(steps):
            times = steps / steps.min()
            found.append(float(steps.min()) if (np.abs(times - np.round(times)) < 0.1).mean() > 0.9 else 0.0)
    return math.hypot(*found) if all(found) else 0.0


def _unit(unit: str, axis: Facts) -> tuple[str, float]:
    """The unit of a number in words of the axis, and the factor to it: torques by the gain, where it is known."""
    gain, turns = axis.gain or 1.0, axis.unit == "rad"
    force = "N*m" if turns else "N"
    known = {
        "joint": (axis.unit, 1.0),
        "order": ("1" if turns else "rad/m", 1.0),
        "speed": (f"{axis.unit}/s", 1.0),
        "acceleration": (f"{axis.unit}/s^2", 1.0),
        "torque": (force if axis.gain else axis.unit, gain),
        "inertia": ("kg*m^2" if turns else "kg", gain) if axis.gain else ("s^2", 1.0),
        "viscous": (f"{force}*s/{axis.unit}", gain) if axis.gain else ("s", 1.0),
    }
    return known.get(unit, (unit, 1.0))


def _parameters(
    library: Library, axis: int, fit: Fit, effect: int, tried: int, deviation: Tensor
) -> dict[str, dict[str, Any]]:
    """The numbers of one effect of a fit, as `parameters` of diagnosis.json; value: the difference to the model.

    tried: the effect itself, or one that does the same and was fitted; deviation: of the fit's numbers, in plausible
    sizes.
    """
    facts, theta, found = library.facts[axis], fit.spec.theta.tolist(), dict[str, dict[str, Any]]()

    def told(name: str, value: float, sd: float | None, of: str, more: Mapping[str, float]) -> None:
        unit, factor = _unit(of, facts)
        size = {"value": value * factor, "sd": None if sd is None else sd * factor}
        found[f"q{axis + 1} {name}"] = {**size, "unit": unit, "part": f"joint {axis + 1}", **more}

    flat, variant = fit.spec.flat, next(v for v in fit.spec.variants if v.effect == tried)
    for j in variant.active:
        number: Number = library.numbers[axis][library.places[effect][library.places[tried].index(j)]]
        value, sd = theta[j] * number.scale, float(deviation[flat.index(j)]) * number.scale
        if number.inverse:
            value += facts.nominal.get(number.acts[0].parameter, 0.0)
            if value < _TINY:
                continue
            value, sd = 1 / value, sd / value**2
        if all(act.how == "factor" for act in number.acts):
            sd, value = sd * math.exp(value), math.expm1(value)
        told(number.name, value, sd, number.unit, {} if number.model is None else {"nominal": number.model})
    for name, place in library.held.items():
        if place in variant.held and theta[place]:
            told(name, theta[place], None, _SHAPE_UNITS.get(name, "speed"), {})
    return found
