"""The next motion to record: the one on which the most probable models differ most, or that sharpens the only one."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import torch
from torch import Tensor

from ccnn_torch.motion.descent import sensitivities
from ccnn_torch.motion.judge import AxisVerdict
from ccnn_torch.motion.library import Library
from ccnn_torch.motion.nominal import Driven
from ccnn_torch.motion.problem import Problem
from ccnn_torch.motion.search import Search
from ccnn_torch.motion.spec import Fit
from ccnn_torch.motion.whiten import Whitening

# Seconds of a proposed motion, its sampling, and the lead that is not judged.
_SECONDS, _STEP, _LEAD = 8.0, 0.01, 0.3
# So many are proposed.
_PROPOSED = 4
# Alternatives to a verdict that a motion has to distinguish.
_RIVALS = 3
# Directions of a model's numbers with less than this share of the largest one are rounding.
_DIGITS = 1e-9


class Motion(NamedTuple):
    """A motion of one joint about a middle.

    Attributes:
        kind: its name.
        text: how to make it, without a full stop.
        time, command: `s` [s], `s` [rad or m].
        gain: factor on the proportional gain while it is recorded.
        load: torque of a load that is added, per gain [rad or m].
    """

    kind: str
    text: str
    time: Tensor
    command: Tensor
    gain: float = 1.0
    load: float = 0.0


def motions(middle: float, amplitude: float, speed: float, unit: str) -> list[Motion]:
    """Motions that are within what was recorded: amplitude [rad or m], speed [per s]."""
    t = torch.arange(0, _SECONDS, _STEP, dtype=torch.float64)

    def triangle(rate: float) -> Tensor:
        period = 4 * amplitude / rate
        return amplitude * (2 / math.pi) * torch.asin(torch.sin(2 * math.pi * t / period))

    slow = triangle(max(0.08 * speed, 6 * amplitude / _SECONDS * 0.5))
    high = min(max(speed / (2 * math.pi * 0.25 * amplitude), 0.5), 5.0)
    chirp = 0.25 * amplitude * torch.sin(2 * math.pi * (0.2 * t + 0.5 * (high - 0.2) * t.square() / _SECONDS))
    steps = amplitude * torch.sign(torch.sin(2 * math.pi * t / 4))
    wave = amplitude * torch.sin(2 * math.pi * t / _SECONDS)
    mixed = 0.6 * amplitude * torch.sin(2 * math.pi * 0.3 * t) + 0.25 * amplitude * torch.sin(2 * math.pi * 1.3 * t)
    far, fast = f"{amplitude:.3g} {unit}", f"{high:.2g} Hz"
    plain = [
        Motion("slow reversals", f"a triangle of ±{far}, slow", t, middle + slow),
        Motion("chirp", f"a sine of ±{0.25 * amplitude:.3g} {unit}, from 0.2 to {fast}", t, middle + chirp),
        Motion("steps", f"steps between ±{far}, 2 s each", t, middle + steps),
        Motion("slow wave", f"one sine of ±{far} in {_SECONDS:.0f} s", t, middle + wave),
        Motion("two sines", f"sines of 0.3 and 1.3 Hz within ±{far}", t, middle + mixed),
    ]
    other = [
        m._replace(kind=f"{m.kind}, half the gain", text=f"{m.text}, with half the proportional gain", gain=0.5)
        for m in plain[:2]
    ]
    loaded = [
        m._replace(kind=f"{m.kind}, loaded", text=f"{m.text}, with a load at the end of the axis", load=0.1)
        for m in plain[:2]
        if unit == "rad"
    ]
    return [*plain, *other, *loaded]


def next_motions(found: Search, verdicts: Sequence[AxisVerdict]) -> tuple[list[dict[str, Any]], list[Motion]]:
    """`next_measurements` of diagnosis.json, and the motions themselves; empty where the cause is outside the library.

    `gain` is the expected log odds by which the motion tells the two models apart, the numbers of the other refitted;
    where there is no rival, the information on the numbers of the only model; both in nats.
    """
    entries: list[tuple[dict[str, Any], Motion]] = []
    data, library = found.problem.data, found.problem.library
    for i, verdict in enumerate(verdicts):
        if verdict.driver is not None:
            continue
        position = data.position[i][data.judged]
        middle, amplitude = float(position.mean()), 0.5 * float(position.max() - position.min())
        if not amplitude:
            continue
        rivals, best = _rivals(library, i, found.found[i], verdict), {*verdict.best.members}
        proposed = motions(middle, amplitude, library.facts[i].speed, library.facts[i].unit)
        problem = _problem_of(found.problem, i, proposed)
        whitening = Whitening(found.whitening.coefficients[i].expand(len(proposed), -1))
        others: list[Fit | None] = [*rivals] or [None]
        for rival in others:
            gains = _gains(problem, whitening, verdict.best, rival)
            other = best if rival is None else {*rival.members}
            names = [library.names[e] for e in (*sorted(best - other), *sorted(other - best))]
            for motion, gain in zip(proposed, gains, strict=True):
                entry = {
                    "joints": {f"q{i + 1}": amplitude},
                    "covariates": {},
                    "motion": {
                        "joint": f"q{i + 1}",
                        "kind": motion.kind,
                        "text": motion.text,
                        "seconds": _SECONDS,
                        "gain": motion.gain,
                        "load": motion.load,
                    },
                    "separates": names,
                    "gain": gain,
                }
                entries.append((entry, motion))
    entries = [e for e in entries if math.isfinite(e[0]["gain"])]
    entries.sort(key=lambda e: -e[0]["gain"])
    chosen: list[tuple[dict[str, Any], Motion]] = []
    # The best for each pair first, then what is left.
    for fresh in (True, False):
        for e in entries:
            seen = [c[0]["separates"] for c in chosen]
            if len(chosen) < _PROPOSED and e not in chosen and (e[0]["separates"] not in seen) == fresh:
                chosen.append(e)
    return [c[0] for c in chosen], [c[1] for c in chosen]


def _rivals(library: Library, axis: int, fits: Sequence[Fit], verdict: AxisVerdict) -> list[Fit]:
    """The most probable sets in which a member of the verdict is replaced by one of its class, and acts otherwise."""

    def acts(f: Fit) -> list[Any]:
        return sorted(a for member in f.members for j in library.places[member] for a in library.numbers[axis][j].acts)

    own = {*verdict.best.members}
    sets = [tuple(sorted(own - {m} | {other})) for m, like in verdict.classes.items() for other in like]
    found = [f for wanted in sets for f in fits if f.members == wanted][:_RIVALS]
    # Two effects that do the same to this model are distinguished by no motion.
    return [f for f in found if acts(f) != acts(verdict.best)]


def _problem_of(problem: Problem, axis: int, proposed: Sequence[Motion]) -> Problem:
    """One axis that is commanded by each motion: as many axes as there are motions, of one stretch each."""
    library, count = problem.library, len(proposed)
    command = torch.stack([motion.command for motion in proposed])[:, None]
    still = torch.zeros_like(command[0])
    nominal = {n: v[axis].expand(count) for n, v in library.nominal.items()}
    one = torch.ones(count, dtype=command.dtype)
    nominal["gain"] = nominal.get("gain", one) * one.new_tensor([motion.gain for motion in proposed])
    nominal["gravity_sin"] = nominal.get("gravity_sin", 0 * one) + one.new_tensor([motion.load for motion in proposed])
    changes = tuple((j, name, how, size[axis].expand(count)) for j, name, how, size in library.changes)
    time = proposed[0].time
    data = problem.data._replace(
        time=time[None],
        command=command,
        position=command,
        speed=torch.zeros_like(command),
        judged=(time > _LEAD)[None],
        run=torch.zeros(1, dtype=torch.int64),
        beside={},
        bent=None,
        begin=None,
    )
    step = float(problem.data.time.diff(dim=-1).median()) * problem.pool
    return replace(
        problem,
        data=data,
        library=library._replace(facts=(), numbers=(library.numbers[axis],) * count, nominal=nominal, changes=changes),
        driven=Driven(command, still, still),
        unit=problem.unit[axis].expand(count),
        pool=max(round(step / _STEP), 1),
    )


def _gains(problem: Problem, whitening: Whitening, best: Fit, rival: Fit | None) -> list[float]:
    """Of each motion, in nats."""
    other, count = best if rival is None else rival, len(problem.axes)
    mine = problem.positions(best.spec.theta.expand(count, -1), problem.axes)
    there = replace(problem, data=problem.data._replace(position=mine))
    theta, places = other.spec.theta.expand(count, -1), [other.spec.flat] * count
    difference, columns = sensitivities(there, whitening, theta, problem.axes, places)
    found = []
    for y, x in zip(difference / math.sqrt(best.noise), columns.mT / math.sqrt(best.noise), strict=True):
        if rival is None:
            inner = torch.eye(x.shape[1], dtype=x.dtype) + x.mT @ x @ best.covariance
            found.append(0.5 * float(torch.linalg.slogdet(inner).logabsdet) if x.shape[1] else 0.0)
            continue
        if x.shape[1]:
            u, values, _ = torch.linalg.svd(x, full_matrices=False)
            u = u[:, values > _DIGITS * values[0]]
            y = y - u @ (u.mT @ y)
        found.append(0.5 * float(y.square().sum()))
    return found
