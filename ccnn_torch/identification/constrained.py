"""Identification without a measuring device: sockets of a plate, distances from an anchor, points on a plane."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from ccnn_torch.config.sizes import size, sizes_by_name, sizes_of_pose
from ccnn_torch.config.split import Given, held_out_notes
from ccnn_torch.errors import InputError
from ccnn_torch.identification import (
    Fit,
    Knowledge,
    ParameterChoice,
    Problem,
    Progress,
    reweighted,
    solve_lm,
    what_is_known,
)
from ccnn_torch.identification.config import IdentifyConfig
from ccnn_torch.identification.constrained_rows import (
    ConstraintRows,
    machine_in_own_base,
    placed,
    read_constraint,
)
from ccnn_torch.identification.judge import drawn_sizes, scatter
from ccnn_torch.identification.measured import Kinematics, Measured, Rows
from ccnn_torch.identification.problems.parameters import Selection, select_parameters
from ccnn_torch.identification.problems.poses import forward_problem
from ccnn_torch.identification.problems.problem import check_equations
from ccnn_torch.identification.result import Found, Known, assemble, known_of
from ccnn_torch.identification.solve import Outcome, choice_of, solver_of
from ccnn_torch.mechanisms import Instrument, Mechanism, PoseError
from ccnn_torch.mechanisms.frames.part import tool_points
from ccnn_torch.mechanisms.frames.partial import completed
from ccnn_torch.verification.promise import configurations, promise_block

# Links and noise are estimated in turn, the noise from this size on [m].
_ROUNDS, _FIRST_NOISE, _LEAST_NOISE = 5, 1e-3, 1e-9
# Prior of the tool's offset around its first fit [m].
_TOOL_TOLERANCE = 0.05
_LINK_TOLERANCE = {"m": 1e-3, "rad": 1e-2}

Sizes = float | dict[str, float]
"""Noise as `forward_problem` takes it [SI]."""


@dataclass(frozen=True)
class ConstraintFit:
    """What was found.

    Attributes:
        before: the machine and what reads it, links nominal, the tool's offset fitted.
        after: all fitted.
        selection: the machine's free parameters, which are the first of the problem's.
        knowledge: of all the problem's parameters.
        problem, fit: the last round's.
        noise: of the readings.
        readings: of each reading where they have noise of their own, by name.
    """

    before: Mechanism
    after: Mechanism
    selection: Selection
    knowledge: Knowledge
    problem: Problem
    fit: Fit
    noise: _Noise
    readings: dict[str, dict[str, Any]]


@dataclass(frozen=True)
class _Noise:
    """Noise of what is read, as given or of the last round.

    Attributes:
        size: of each group of readings that have one, `g` [SI].
        known: which of these were given, `g` bool.
        group: of each reading, by its name.
    """

    size: Tensor
    known: Tensor
    group: Mapping[str, int]

    @property
    def sizes(self) -> Sizes:
        """As `forward_problem` takes them."""
        values = self.size.tolist()
        return {name: values[i] for name, i in self.group.items()} if len(values) > 1 else float(values[0])

    def of(self, name: str) -> float:
        """Of a reading [SI]."""
        return float(self.size[self.group[name]])

    def grown(self, size: Tensor) -> _Noise:
        """With other sizes `g` [SI] where they were not given."""
        return replace(self, size=torch.where(self.known, self.size, size))

    def left(self, rows: ConstraintRows, problem: Problem, values: Tensor) -> Tensor:
        """Root mean square of the residuals of the rows with weight, `g` [SI]."""
        names = [channel.name for channel in problem.channels]
        group = torch.tensor([self.group[name] for name in names])
        inside = torch.nn.functional.one_hot(group, len(self.size)).double()
        square, used = problem.residual(values[:, None], *problem.data)[0].detach().square(), problem.weights[0] > 0
        square, count = (each[used].double().sum(0) @ inside for each in (square, rows.measured(names)))
        return (self.size * (square / count.clamp_min(1)).sqrt()).clamp_min(_LEAST_NOISE)


def fit_constraint(
    config: IdentifyConfig, mechanism: Mechanism, rows: ConstraintRows, progress: Progress | None = None
) -> ConstraintFit:
    """Fit the rows that have weight.

    Priors keep the links near nominal; the tool's offset, which no maker knows, is fitted first, with nominal links.
    Where the config names no noise, it is that of the residuals, in five rounds; for the intervals it is raised by the
    equations that the fit used up.
    """
    names = [p.name for p in mechanism.geometry]
    # What an instrument shows has unknown frames fitted to the rows already, and these are free.
    unknown = mechanism.unknown_frames if isinstance(mechanism, Instrument) else ()
    held = [n for n in names if n.startswith(("base_", "tool_r")) and n.partition("_")[0] not in unknown]
    about = choice_of(config, mechanism)
    free = select_parameters(mechanism.geometry, ParameterChoice(about.free, [*about.fixed, *held], about.tied))
    of_machine = [n for group in free.groups for n in group]
    tool = [] if isinstance(mechanism, Instrument) else [n for n in of_machine if n.startswith("tool_")]
    choice = ParameterChoice(of_machine, (), about.tied, {**_priors(config, mechanism, of_machine), **about.prior})
    rows = placed(rows, mechanism, exactly=not tool)
    before, count = rows.seen, len(names)
    if tool:
        problem, whole = _problem(rows, count, ParameterChoice(free=tool), None)
        before = before.with_nominal(whole.full(solve_lm(problem).values)[0])
        rows = placed(rows, mechanism.with_nominal(before.nominal[:count]))
    solver, noise = solver_of("lm", config), _noise(config, rows)
    rounds = 1 if bool(noise.known.all()) else _ROUNDS
    selection = select_parameters(mechanism.geometry, choice, before.nominal[:count])
    loss = config.robust or "squared"
    for done in range(rounds):
        problem, whole = _problem(rows, count, choice, noise.sizes)
        fit = solver(problem, config.seed)
        noise = noise.grown(noise.left(rows, problem, fit.values))
        if progress is not None:
            progress((done + 1) / rounds)
    if rounds > 1:
        problem = _problem(rows, count, choice, noise.sizes)[0]
        spared = float(what_is_known(reweighted(problem, fit.values, loss), fit.values).noise)
        noise = noise.grown(noise.size * (max(1.0, spared) if spared < float("inf") else 1.0))
        problem = _problem(rows, count, choice, noise.sizes)[0]
    after = rows.seen.with_nominal(whole.full(fit.values)[0])
    known = what_is_known(reweighted(problem, fit.values, loss), fit.values)
    read = _readings(noise, rows, problem, fit.values)
    return ConstraintFit(before, after, selection, known, problem, fit, noise, read)


def _noise(config: IdentifyConfig, rows: ConstraintRows) -> _Noise:
    """The noise that is given: one for all of a kind, or by name; readings of an instrument in one unit share one."""
    assert config.constraint is not None
    every = [*rows.seen.pose[: rows.seen.compared]]
    names = [c.name for c in every]
    numbers = rows.seen.noise_groups() if isinstance(rows.seen, Instrument) else [0] * len(every)
    values = torch.full((len(every),), math.nan, dtype=torch.float64)
    keys = ["noise", *(f"constraint.beside.{i}.noise" for i in range(len(config.constraint.beside)))]
    given = [config.noise, *(about.noise for about in config.constraint.beside)]
    for key, noise, read in zip(keys, given, rows.read, strict=True):
        mine = [names.index(name) for name in read]
        own = [every[k] for k in mine]
        if isinstance(noise, dict):
            values[mine] = sizes_by_name(noise, own, key, [math.nan] * len(own))
            # What is given by name is of that alone.
            numbers = [len(every) + k if k in mine and not values[k].isnan() else n for k, n in enumerate(numbers)]
        elif noise is not None:
            values[mine] = sizes_of_pose(noise, own, key)
        _require_sizes([v for v in values[mine].tolist() if not math.isnan(v)], key, "remove the key")
    groups = sorted({*numbers})
    first = values[[numbers.index(n) for n in groups]]
    group = {name: groups.index(n) for name, n in zip(names, numbers, strict=True)}
    return _Noise(first.nan_to_num(nan=_FIRST_NOISE), ~first.isnan(), group)


def _require_sizes(values: Sequence[float], key: str, instead: str) -> None:
    if not all(v > 0 for v in values):
        raise InputError(f"{key}: {min(values):g} is no standard deviation; write a size above 0, or {instead}")


def _readings(noise: _Noise, rows: ConstraintRows, problem: Problem, values: Tensor) -> dict[str, dict[str, Any]]:
    """What was read by name where noise is by reading: unit, rows, noise, and RMS before and after [SI]."""
    if len(noise.size) == 1:
        return {}
    units = {c.name: c.unit for c in rows.seen.pose}
    before, after = noise.left(rows, problem, problem.start), noise.left(rows, problem, values)
    counts = rows.measured([*noise.group]).sum(0).tolist()
    return {
        name: {
            "unit": units[name],
            "rows": int(count),
            "noise": noise.of(name),
            "noise_known": bool(noise.known[i]),
            "before": float(before[i]),
            "after": float(after[i]),
        }
        for (name, i), count in zip(noise.group.items(), counts, strict=True)
    }


def _held_error(rows: ConstraintRows, seen: Mechanism, held: Tensor, sockets: bool) -> PoseError:
    """How far the tool of the held-out rows is from where the constraint holds it, `1 x t`; NaN of what was not read.

    In a socket: from the mean of the points that the rows with weight put into the same socket of the same placement,
    which needs no fitted plate. Else the difference of what was read, of lengths and of angles.
    """
    if sockets:
        assert isinstance(seen, Instrument)
        points = tool_points(seen.mechanism, rows.joints)
        return PoseError(scatter(points, rows.cell, rows.weights)[None, held], None)
    joints, said = rows.joints[None, held], rows.said[None, held]
    return seen.pose_error(seen.forward_kinematics(joints, guess=completed(seen, joints, said)), said)


def _problem(
    rows: ConstraintRows, machine: int, choice: ParameterChoice, noise: Sizes | None
) -> tuple[Problem, Selection]:
    """The problem of the rows, and its parameters.

    Args:
        machine: how many parameters are the machine's; those of what reads it come behind them.
        choice: of the machine's parameters; of the others all are free.
    """
    seen = rows.seen
    own = seen.geometry[machine:]
    unknown = seen.unknown_parts if isinstance(seen, Instrument) else ()
    tolerances = {p.name: p.scale for p in own if p.scale and p.name.partition("_")[0] not in unknown}
    # Without noise there is nothing to weigh a tolerance against.
    names = [p.name for p in own if noise is not None or p.name not in tolerances]
    prior = choice.prior if noise is None else {**choice.prior, **tolerances}
    if isinstance(noise, dict):
        # What an instrument was pointed at is never compared.
        noise = dict.fromkeys((c.name for c in seen.pose[seen.compared :]), 1.0) | noise
    sizes = None if noise is None else sizes_of_pose(noise, seen.pose, "noise")
    choice = replace(choice, free=[*(choice.free or ()), *names], prior=prior)
    # Held-out rows are in units of the noise, too.
    problem = forward_problem(seen, rows.joints, rows.said, None, choice, sizes, start=seen.nominal)
    problem = replace(problem, weights=rows.weights[None])
    check_equations(problem)
    return problem, select_parameters(seen.geometry, choice, seen.nominal)


def _priors(config: IdentifyConfig, mechanism: Mechanism, free: list[str]) -> dict[str, float]:
    about = config.constraint
    assert about is not None
    given, key = about.tolerance, "constraint.tolerance"
    unknown = mechanism.unknown_frames if isinstance(mechanism, Instrument) else ()
    links = [p for p in mechanism.geometry if p.name in free and p.name.partition("_")[0] not in ("tool", *unknown)]
    if given is None or isinstance(given, dict):
        usual = [p.scale or _LINK_TOLERANCE.get(p.unit, 0.01) for p in links]
        values = sizes_by_name(given or {}, links, key, usual).tolist()
    else:
        values = [size(given, None, key)] * len(links)
    _require_sizes(values, key, "fix the parameters")
    priors = {p.name: v for p, v in zip(links, values, strict=True)}
    return priors | {n: _TOOL_TOLERANCE for n in free if n.startswith("tool_") and "tool" not in unknown}


# An interval above this share of its prior's is the prior's. Turning machine and plates together turns the residuals,
# too, which the linearised problem takes for a little knowledge.
_AS_PRIOR = 0.9


def identify_by_constraint(
    config: IdentifyConfig, progress: Progress | None = None, given: Given | None = None
) -> tuple[Measured, dict[str, Outcome], dict[str, Any], dict[str, Tensor]]:
    """Identify the machine of a config with a constraint.

    Returns:
        Rows, the outcome of lm, content of `identified.json`, tensors behind the pictures.
    """
    mechanism, notes = machine_in_own_base(config)
    rows = read_constraint(config, mechanism, given)
    if isinstance(mechanism, Instrument) and isinstance(rows.seen, Instrument):
        mechanism = rows.seen
        notes += [mechanism.note] if mechanism.note else []
    begun = time.perf_counter()
    fit = fit_constraint(config, mechanism, rows, progress)
    held, sockets = rows.weights == 0, config.constraint is not None and config.constraint.kind == "sockets"
    before, after = (_held_error(rows, seen, held, sockets) for seen in (fit.before, fit.after))
    count = len(mechanism.geometry)
    sizes = before.position[0], after.position[0]
    picture = drawn_sizes(mechanism, rows.joints[held], *sizes, fit.after.nominal[:count])
    if config.fits_again() and bool(held.any()):
        every = replace(rows, weights=torch.ones_like(rows.weights))
        again = fit_constraint(config, mechanism, every)
        fit = again if bool(again.fit.converged.all()) else fit
    outcome = Outcome(
        machines=torch.arange(1),
        values=fit.after.nominal[None, :count],
        converged=fit.fit.converged,
        evaluations=fit.fit.evaluations,
        seconds=time.perf_counter() - begun,
        message=fit.fit.message,
    )
    notes = [*held_out_notes(config.split, int(held.sum())), *rows.notes, *notes]
    measured = Measured(
        mechanism=mechanism,
        kinematics=Kinematics(mechanism),
        view=mechanism,
        rows=Rows(rows.joints[None, ~held], rows.said[None, ~held]),
        test=Rows(rows.joints[None, held], rows.said[None, held]),
        start=fit.before.nominal[None, :count],
        data_hash=rows.data_hash,
        notes=notes,
    )
    noise = None if config.noise is None or fit.readings else fit.noise.of(rows.read[0][0])
    found = Found(outcome, _known(fit), before, after)
    results, arrays = assemble(config, measured, fit.selection, {"lm": found}, noise, _only_by_prior(fit, found.known))
    results["constraint"] = _constraint(config, rows, fit)
    if sockets and bool(held.any()):
        # Other constraints show less than a place, to which new positions could not be held.
        first, last = (PoseError(error.position[0], None) for error in (before, after))
        results["promise"] = promise_block(first, last, configurations(rows.joints[held], mechanism.joints))
    return measured, {"lm": outcome}, results, arrays | picture


def _known(fit: ConstraintFit) -> Known:
    """The machine's part of what is known; a parameter that only its prior determines has no interval."""
    knowledge = fit.knowledge
    determined = knowledge.identifiable & (knowledge.sd < _AS_PRIOR * fit.problem.prior_sd)
    return known_of([replace(knowledge, sd=torch.where(determined, knowledge.sd, math.inf))], fit.selection)


def _only_by_prior(fit: ConstraintFit, known: Known) -> list[str]:
    """A sentence on the parameters that the rows determine no better than their priors."""
    determined = zip(fit.selection.parameters, known.sd[0], fit.knowledge.identifiable[0], strict=False)
    prior = [p.word or p.name for p, sd, seen in determined if bool(seen) and not math.isfinite(sd)]
    return [f"No better known than by the tolerance given: {', '.join(prior)}."] if prior else []


_BESIDE = ("rows", "unit", "noise", "before", "after")


def _constraint(config: IdentifyConfig, rows: ConstraintRows, fit: ConstraintFit) -> dict[str, Any]:
    """What was found of the constraint itself."""
    assert config.constraint is not None
    every = zip(fit.problem.parameters, fit.fit.values[0].tolist(), fit.knowledge.sd[0].tolist(), strict=False)
    unknowns = {
        parameter.name: {"value": value, "sd": sd if math.isfinite(sd) else None, "unit": parameter.unit}
        for parameter, value, sd in [*every][len(fit.selection.parameters) :]
    }
    return {
        "kind": config.constraint.kind,
        "placements": [
            {"number": number, "columns": label, "rows": int((rows.group == number).sum())}
            for number, label in rows.labels.items()
        ],
        "unknowns": unknowns,
        "unit": rows.unit,
        "noise": fit.noise.of(rows.read[0][0]),
        "noise_known": config.noise is not None,
        "beside": [
            {"kind": one.kind, "records": str(one.records), **{key: fit.readings[read[0]][key] for key in _BESIDE}}
            for one, read in zip(config.constraint.beside, rows.read[1:], strict=True)
        ],
        "readings": fit.readings,
    }
