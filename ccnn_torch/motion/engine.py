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
from ccnn_torch.diagnosis.shrink.held_out import INTERVAL
from ccnn_torch.diagnosis.verdict.text import listed, unseen_text, verdict_text
from ccnn_torch.display import number_text
from ccnn_torch.errors import InputError
from ccnn_torch.motion.effects import Facts, MotionEffect, motion_effects
from ccnn_torch.motion.effects.own_parameter import OWN
from ccnn_torch.motion.fit import Fit, Spec
from ccnn_torch.motion.held_out import Spread, folds_of, held_out, resampled, shrink_of
from ccnn_torch.motion.judge import AxisVerdict, judge_axes
from ccnn_torch.motion.library import Library, library_of
from ccnn_torch.motion.log import Log
from ccnn_torch.motion.next_motion import Motion, next_motions
from ccnn_torch.motion.nominal import Nominal
from ccnn_torch.motion.numbers import parameters_of
from ccnn_torch.motion.phases import PHASES, phases_of
from ccnn_torch.motion.problem import Problem
from ccnn_torch.motion.search import Search, search, without
from ccnn_torch.motion.stretches import Stretches, cut_stretches

__all__ = ["MotionDiagnosis", "diagnose_motion", "problem_of"]

# Seconds over which samples are averaged before they are judged.
_POOLED = 0.02
# Quantile of what counts as nearly the largest.
_NEARLY = 0.98
# Names are added as long as they take the held-out gap to less than this share of itself; a verdict that loses one is
# no surer than the second number.
_NEARLY_LEAST, _DOUBTED = 1.02, 0.9
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


def problem_of(
    logs: Sequence[Log], nominal: Nominal, effects: Sequence[MotionEffect], most: int | None = None
) -> Problem:
    """Logs and a nominal model as what is fitted.

    Raises:
        InputError: the logs cannot show any of the effects, or cannot be used.
    """
    data = cut_stretches(logs) if most is None else cut_stretches(logs, most=most)
    driven = nominal.driven(logs, data)
    supply = torch.zeros_like(data.time)
    if "supply" in data.beside:
        usual = nominal.supply or float(data.beside["supply"][data.judged].median())
        supply = data.beside["supply"] / usual - 1 if usual else supply
    warm = torch.zeros_like(data.time)
    if "temperature" in data.beside:
        warm = data.beside["temperature"] - data.beside["temperature"][data.judged].min()
    facts = [_facts(data, i, nominal, driven.followed, supply, warm) for i in range(len(data.units))]
    library = library_of(effects, facts)
    if all(library.lacking):
        need = "; ".join(f"{name} needs {why}" for name, why in zip(library.names, library.lacking, strict=True))
        raise InputError(f"effects: these logs can show none of the candidates: {need}")
    step = float(data.time.diff(dim=-1).median())
    pool = max(round(_POOLED / step), 1)
    return Problem(data, library, driven.followed, supply, warm, pool, driven.torque, driven.simulated, driven.own)


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
    found = search(problem)
    for _ in range(_RECENTRED):
        about = _own_values(found)
        if not about:
            break
        # A simulator is linearised in its own parameters: about those that were found.
        driven = nominal.driven(logs, problem.data, about)
        problem = replace(problem, followed=driven.followed, own=driven.own)
        found = search(problem)
    verdicts = judge_axes(found)
    at_step("judging on held-out rows")
    library, data = problem.library, problem.data
    singles = _singles(found)
    none = [_none(library) for _ in verdicts]
    whole = [v.best.spec for v in verdicts]
    names = _in_order(problem, verdicts)
    steps = [
        [_only(library, s, [library.names.index(m) for m in names[: k + 1]]) for s in whole] for k in range(len(names))
    ]
    sets = [none, *steps, *singles.values()]
    residuals = held_out(problem, found.whitening, sets)
    # Of the model itself, also where it was linearised elsewhere.
    residuals[0] = nothing
    spread = Spread(problem, seed)
    squares = [spread.squares(r) for r in residuals]
    floor = noise**2 * len(whole) if noise else _floor(problem, found, verdicts)
    total = shrink_of(spread, squares[0], squares[len(steps)], floor)
    outside = any(v.driver is not None for v in verdicts)
    probability = math.prod(v.probability for v in verdicts)
    kept = _kept(squares[: len(steps) + 1]) if names else 0
    helped = min((float(v.sum()) for v in squares[1 : len(steps) + 1]), default=math.inf) < float(squares[0].sum())
    seen = any(m > _CONFIRMED for v in verdicts for m in v.marginal.values())
    unconfirmed = not kept and seen and helped and not outside
    if unconfirmed:
        # More is seen than chance, and what it takes away elsewhere is little: the names that take most.
        kept = 1 + min(range(len(names)), key=lambda k: float(squares[k + 1].sum()))
    dropped = [] if outside else names[kept:]
    if kept < len(names) and not outside:
        # A name has to take something away on runs that no fit saw.
        verdicts = [_reduced(library, found.found[i], v, names[:kept]) for i, v in enumerate(verdicts)]
        names, steps = names[:kept], steps[:kept]
        probability = math.prod(v.probability for v in verdicts)
        total = shrink_of(spread, squares[0], squares[kept], floor)
    probability = min(probability, _CONFIRMED) if unconfirmed else probability
    unit = data.units[0]
    drivers = list(dict.fromkeys(v.driver for v in verdicts if v.driver))
    after = residuals[len(names)]
    every = _effects(
        problem, found, verdicts, spread, squares[0], dict(zip(singles, squares[-len(singles) :], strict=True)), floor
    )
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
        **_where(problem, residuals[0], spread),
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
        "notes": _notes(problem, nominal, found, floor_rms, noise, dropped),
    }
    verdict["text"] = verdict_text(content)
    return MotionDiagnosis(content, problem, found, verdicts, residuals[0], after, proposed)


def _own_values(found: Search) -> dict[str, float]:
    """What is added to a simulator's own parameters: the mean over the axes whose best set has them."""
    theta = torch.stack([fits[0].spec.theta for fits in found.found])
    values = {n: v[v != 0] for n, v in found.problem.library.parameters(theta).items() if n.startswith(OWN)}
    return {name.removeprefix(OWN): float(v.mean()) for name, v in values.items() if len(v)}


def _facts(data: Stretches, i: int, nominal: Nominal, followed: Tensor, supply: Tensor, warm: Tensor) -> Facts:
    judged = data.judged
    step = data.time.diff(dim=-1)
    speed = data.speed[i]
    rise = speed.diff(dim=-1) / step

    def nearly(values: Tensor) -> float:
        kept = values.abs().flatten()
        return float(torch.quantile(kept[:: max(len(kept) // 100_000, 1)], _NEARLY))

    most = nearly(speed[judged]) or 1.0
    span = float(data.command[i][judged].max() - data.command[i][judged].min())
    return Facts(
        unit=data.units[i],
        nominal=nominal.axes[i],
        gain=nominal.gains[i],
        length=nominal.lengths[i],
        weight=nominal.weights[i] if nominal.weights else None,
        span=span or 1.0,
        speed=most,
        acceleration=nearly(rise[judged[:, 1:]]) or 1.0,
        error=nearly((followed[i] - data.position[i])[judged]) or 1e-6,
        supply=float(supply[judged].abs().max()) if "supply" in data.beside else 0.0,
        temperature=_within_runs(data, warm),
    )


def _within_runs(data: Stretches, warm: Tensor) -> float:
    """The largest change of the temperature in one run: between runs other things change as well."""
    own = [warm[data.run == run][data.judged[data.run == run]] for run in set(data.run.tolist())]
    return max(float(v.max() - v.min()) for v in own)


def _none(library: Library) -> Spec:
    return Spec((), torch.zeros(library.size, dtype=torch.float64), (), 0.0)


def _only(library: Library, spec: Spec, members: Sequence[int]) -> Spec:
    """The set with these members alone."""
    while extra := [k for k, m in enumerate(spec.members) if m not in members]:
        spec = without(library, spec, extra[0])
    return spec


def _singles(found: Search) -> dict[str, list[Spec]]:
    """Of each effect alone its fit on every axis; an axis that cannot show it has none."""
    library = found.problem.library
    alone = [{f.members[0]: f.spec for f in fits if len(f.members) == 1} for fits in found.found]
    return {
        name: [own.get(e, _none(library)) for own in alone]
        for e, name in enumerate(library.names)
        if any(e in own for own in alone)
    }


def _kept(squares: Sequence[Tensor]) -> int:
    """How many of the names, added one after the other, still take something away where nothing was fitted."""
    left = [float(s.sum()) for s in squares]
    return next(k for k, value in enumerate(left) if value <= _NEARLY_LEAST**2 * min(left))


def _reduced(library: Library, fits: Sequence[Fit], verdict: AxisVerdict, names: Sequence[str]) -> AxisVerdict:
    """The verdict with these names alone, as probable as what is left of it."""
    members = tuple(m for m in verdict.best.members if library.names[m] in names)
    best = next((f for f in fits if f.members == members), None)
    if best is None:
        old, spec = verdict.best, _only(library, verdict.best.spec, members)
        place = [old.spec.flat.index(j) for j in spec.flat]
        best = old._replace(spec=spec, mean=old.mean[place], covariance=old.covariance[place][:, place])
    like = {m: verdict.classes[m] for m in members}
    each = [verdict.marginal.get(m, 1.0) for m in members] or [1 - max(verdict.marginal.values(), default=0.0)]
    return AxisVerdict(best, min([verdict.probability, _DOUBTED, *each]), verdict.marginal, like, verdict.driver)


def _in_order(problem: Problem, verdicts: Sequence[AxisVerdict]) -> list[str]:
    """Names of the verdict, the one without which most is left first."""
    names = problem.library.names
    there = list(dict.fromkeys(m for v in verdicts for m in v.best.members))
    if not there:
        return []
    specs = [[_only(problem.library, v.best.spec, [m for m in there if m != e]) for v in verdicts] for e in there]
    left = problem.residual(torch.stack([torch.stack([s.theta for s in row]) for row in specs]))
    size = (left.square() * problem.data.judged).sum((1, 2, 3))
    return [names[there[k]] for k in torch.argsort(size, descending=True).tolist()]


def _floor(problem: Problem, found: Search, verdicts: Sequence[AxisVerdict]) -> float:
    """Mean square of what the best sets leave, or the richest fit where it leaves less, summed over the axes."""
    theta = torch.stack([v.best.spec.theta for v in verdicts])[None]
    judged = problem.data.judged
    left = problem.residual(theta)[0]
    each = torch.stack([left[:, judged].square().mean(-1), found.rich[:, judged].square().mean(-1)])
    return float(each.amin(0).sum())


def _where(problem: Problem, before: Tensor, spread: Spread) -> dict[str, Any]:
    """`where` and `where_ci95`: shares of the gap by joint and by phase of the motion."""
    data = problem.data
    squares = before.square() * data.judged
    joints = {f"q{i + 1}": squares[i].sum(-1) for i in range(len(squares))}
    phase = phases_of(data)
    phases = {name: (squares * (phase == k)).sum((0, -1)) for k, name in enumerate(PHASES)}
    whole = squares.sum((0, -1))

    def shares(parts: Mapping[str, Tensor]) -> dict[str, float]:
        return {name: float(v.sum() / whole.sum().clamp_min(1e-300)) for name, v in parts.items()}

    def ends(parts: Mapping[str, Tensor]) -> dict[str, list[float]]:
        drawn = resampled(spread, whole).clamp_min(1e-300)
        q = torch.tensor(INTERVAL, dtype=torch.float64)
        return {name: torch.quantile(resampled(spread, v) / drawn, q).clamp(0, 1).tolist() for name, v in parts.items()}

    samples = {name: float(((phase == k) & data.judged).double().mean()) for k, name in enumerate(PHASES)}
    all_ = sum(samples.values()) or 1.0
    empty: dict[str, Any] = {"outputs": {}, "legs": {}, "regions": [], "covariates": {}}
    return {
        "where": empty
        | {
            "joints": shares(joints),
            "phases": {n: {"share": s, "samples": samples[n] / all_} for n, s in shares(phases).items()},
        },
        "where_ci95": empty | {"joints": ends(joints), "phases": ends(phases)},
    }


def _effects(
    problem: Problem,
    found: Search,
    verdicts: Sequence[AxisVerdict],
    spread: Spread,
    before: Tensor,
    alone: Mapping[str, Tensor],
    floor: float,
) -> list[dict[str, Any]]:
    library = problem.library
    rows = []
    for name, squares in alone.items():
        e = library.names.index(name)
        own = shrink_of(spread, before, squares, floor)
        like = dict.fromkeys(library.names[o] for v in verdicts for o in v.classes.get(e, ()))
        parameters: dict[str, Any] = {}
        for i, v in enumerate(verdicts):
            fit = v.best if e in v.best.members else _alone(found.found[i], e)
            if fit is not None and (e in v.best.members or not any(e in w.best.members for w in verdicts)):
                parameters |= parameters_of(library, i, fit, e)
        rows.append(
            {
                "name": name,
                "probability": 1 - math.prod(1 - v.marginal.get(e, 0.0) for v in verdicts),
                "parameters": parameters,
                "gap_before": own[0],
                "gap_after": own[1],
                "shrink": own[2],
                "shrink_ci95": own[3],
                "indistinguishable_from": list(like),
                "signatures": {},
            }
        )
    return sorted(rows, key=lambda e: (-e["probability"], e["gap_after"], e["name"]))


def _alone(fits: Sequence[Fit], effect: int) -> Fit | None:
    return next((f for f in fits if f.members == (effect,)), None)


def _notes(
    problem: Problem, nominal: Nominal, found: Search, floor: float, noise: float | None, dropped: Sequence[str]
) -> list[str]:
    data = problem.data
    notes = [*data.notes, *nominal.notes]
    library = problem.library
    notes += [unseen_text(n, why) for n, why in zip(library.names, library.lacking, strict=True) if why]
    if dropped:
        notes.append(
            f"{listed(dropped)} fit these runs as well, and take nothing away on runs that were not fitted: not named"
        )
    runs = len(set(data.run.tolist()))
    folds = int(folds_of(problem).max()) + 1
    if runs > 1:
        notes.append(f"held out were whole runs, {runs} of them in {folds} folds")
    else:
        notes.append(f"there is one run: its {folds} parts were held out in turn; record a second motion to be surer")
    step = _resolution(data)
    if noise is None and step and floor > 3 * step:
        notes.append(
            f"what the best model leaves is {number_text(floor / step, 2)} times the encoder's step of "
            f"{number_text(step, 2)} {data.units[0]}: most of it is no noise of the encoder"
        )
    order = found.whitening.coefficients.shape[1]
    notes.append(
        f"residuals of a closed loop are correlated: they were whitened by an autoregressive model of order {order}, "
        f"on means over {problem.pool * float(data.time.diff(dim=-1).median()) * 1e3:.0f} ms"
    )
    return notes


def _resolution(data: Stretches) -> float:
    """The encoder's step: the smallest change that is no rounding; 0 where every sample differs."""
    values = np.unique(data.position[0][data.judged].numpy())
    steps = np.diff(values)
    steps = steps[steps > 1e-9]
    if len(values) > 0.5 * int(data.judged.sum()) or not len(steps):
        return 0.0
    return float(np.quantile(steps, 0.1))
