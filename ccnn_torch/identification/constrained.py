"""Identification without a measuring device: sockets of a plate, distances from an anchor, points on a plane."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
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
    scatter,
    socket_problem,
    solve_lm,
    tool_points,
    what_is_known,
)
from ccnn_torch.identification.config import ConstraintConfig, IdentifyConfig
from ccnn_torch.identification.constrained_rows import (
    ConstraintRows,
    Kind,
    machine_in_own_base,
    placed,
    poses_of,
    read_by,
    read_constraint,
    rows_of,
)
from ccnn_torch.identification.judge import drawn_sizes
from ccnn_torch.identification.measured import Kinematics, Measured, Rows
from ccnn_torch.identification.problems.parameters import Selection, select_parameters
from ccnn_torch.identification.problems.poses import forward_problem
from ccnn_torch.identification.problems.problem import joined
from ccnn_torch.identification.result import Found, Known, assemble, known_of
from ccnn_torch.identification.solve import Outcome, choice_of, solver_of
from ccnn_torch.mechanisms import Instrument, Mechanism, PoseError
from ccnn_torch.mechanisms.frames.fit import ROTATION_WEIGHT
from ccnn_torch.mechanisms.frames.instrument import instrument
from ccnn_torch.records.commanded import read_joints
from ccnn_torch.records.load import read_source
from ccnn_torch.verification.promise import configurations, promise_block

# Links and noise are estimated in turn, the noise from this size on [m].
_ROUNDS, _FIRST_NOISE, _LEAST_NOISE = 5, 1e-3, 1e-9
# Prior of the tool's offset around its first fit, and of a plate's extent around what its records say [m].
_TOOL_TOLERANCE, _PLATE_TOLERANCE = 0.05, 1e-4
_LINK_TOLERANCE = {"m": 1e-3, "rad": 1e-2}

Build = Callable[[ParameterChoice, Tensor, float | Mapping[str, float] | None], Problem]


@dataclass(frozen=True)
class State:
    """A geometry `K` [SI] with the problem and its values `1 x p` [SI] that it came from.

    noise: of each of the problem's channels, `c` [SI]; 1 if unknown.
    """

    geometry: Tensor
    problem: Problem
    values: Tensor
    noise: Tensor


@dataclass(frozen=True)
class ConstraintFit:
    """What was found.

    Attributes:
        before: links nominal, the tool's offset fitted.
        after: all fitted.
        selection: the machine's free parameters, which are the first of the problem's.
        knowledge: of all the problem's parameters.
        fit: the last round's.
        beside: of rows of other kinds, one each.
        readings: of each reading where they have noise of their own, by name.
    """

    before: State
    after: State
    selection: Selection
    knowledge: Knowledge
    fit: Fit
    beside: list[dict[str, Any]]
    readings: dict[str, dict[str, Any]]


@dataclass
class _Source:
    """Rows of one kind: what makes their problem, and the noise of an equation, as given or of the last round.

    Attributes:
        noise: of each group of channels that have one, `g` [SI].
        known: which of these were given, `g` bool.
        group: of each channel, by its name; {} where all have one.
    """

    build: Build
    rows: ConstraintRows
    noise: Tensor
    known: Tensor
    group: Mapping[str, int]

    @property
    def sizes(self) -> float | dict[str, float]:
        """As `forward_problem` takes them."""
        values = self.noise.tolist()
        return {name: values[i] for name, i in self.group.items()} if self.group else float(values[0])

    def left(self, problem: Problem, values: Tensor) -> Tensor:
        """Root mean square of the residuals of the rows with weight, `g` [SI]."""
        group = torch.tensor([self.group.get(channel.name, 0) for channel in problem.channels])
        inside = torch.nn.functional.one_hot(group, len(self.noise)).double()
        square, seen = _residual(problem, values)[0].square(), self.rows.measured([c.name for c in problem.channels])
        used = problem.weights[0] > 0
        square, count = (each[used].double().sum(0) @ inside for each in (square, seen))
        return (self.noise * (square / count.clamp_min(1)).sqrt()).clamp_min(_LEAST_NOISE)

    def told(self, problem: Problem, values: Tensor) -> dict[str, Any]:
        """How many rows, and of the first group the noise and what is left [SI]."""
        about = {"rows": len(self.rows.joints), "unit": self.rows.unit}
        before, after = (float(self.left(problem, at)[0]) for at in (problem.start, values))
        return about | {"noise": float(self.noise[0]), "before": before, "after": after}

    def sd(self, problem: Problem) -> Tensor:
        """Noise of each of the problem's channels, `c` [SI]."""
        seen, sizes = self.rows.seen, self.sizes
        if seen is None or isinstance(sizes, dict):
            each = [sizes[c.name] if isinstance(sizes, dict) else sizes for c in problem.channels]
            return torch.tensor(each, dtype=torch.float64)
        return _of_channels(problem, seen, sizes_of_pose(sizes, seen.pose, "noise"))


def fit_constraint(
    config: IdentifyConfig,
    mechanism: Mechanism,
    rows: ConstraintRows,
    progress: Progress | None = None,
    others: Sequence[tuple[Build, ConstraintRows]] = (),
) -> ConstraintFit:
    """Fit the rows that have weight.

    Priors keep the links near nominal; the tool's offset, which no maker knows, is fitted first, with nominal links.
    Where the config names no noise, it is that of the residuals, in five rounds; for the intervals it is raised by the
    equations that the fit used up.

    Args:
        others: what makes the problem of the rows of each other kind, and these, in the order of the config.
    """
    assert config.constraint is not None
    build = _builder(config.constraint, mechanism, rows)
    names = [p.name for p in mechanism.geometry]
    # What an instrument shows has unknown frames fitted to the rows already, and these are free.
    unknown = mechanism.unknown_frames if isinstance(mechanism, Instrument) else ()
    held = [n for n in names if n.startswith(("base_", "tool_r")) and n.partition("_")[0] not in unknown]
    about = choice_of(config, mechanism)
    free = select_parameters(mechanism.geometry, ParameterChoice(about.free, [*about.fixed, *held], about.tied))
    of_machine = [n for group in free.groups for n in group]
    tool = [] if isinstance(mechanism, Instrument) else [n for n in of_machine if n.startswith("tool_")]
    choice = ParameterChoice(of_machine, (), about.tied, {**_priors(config, mechanism, of_machine), **about.prior})
    before = _tool_first(mechanism, rows, build, tool, choice)
    solver = solver_of("lm", config)
    sources = [_source(build, rows, config.noise, "noise")]
    for i, (about_one, other) in enumerate(zip(config.constraint.beside, others, strict=True)):
        sources.append(_source(*other, about_one.noise, f"constraint.beside.{i}.noise"))
    rounds = 1 if all(bool(s.known.all()) for s in sources) else _ROUNDS
    selection = select_parameters(mechanism.geometry, choice, before.geometry)
    shared = len(selection.parameters)
    loss = config.robust or "squared"

    def posed() -> tuple[list[Problem], Problem]:
        """The problems of all rows under the noise as it is known by now, and the one of all of them."""
        parts = [s.build(choice, before.geometry, s.sizes) for s in sources]
        return parts, joined(parts, shared)

    for done in range(rounds):
        parts, whole = posed()
        fit = solver(whole, config.seed)
        values = _values_of(parts, fit.values, shared)
        for source, part, own in zip(sources, parts, values, strict=True):
            source.noise = torch.where(source.known, source.noise, source.left(part, own))
        if progress is not None:
            progress((done + 1) / rounds)
    if rounds > 1:
        parts, whole = posed()
        spared = float(what_is_known(reweighted(whole, fit.values, loss), fit.values).noise)
        for source in sources:
            more = max(1.0, spared) if spared < float("inf") else 1.0
            source.noise = torch.where(source.known, source.noise, source.noise * more)
        parts, whole = posed()
    after = State(selection.full(fit.values[:, :shared])[0], parts[0], values[0], sources[0].sd(parts[0]))
    known = what_is_known(reweighted(whole, fit.values, loss), fit.values)
    beside = [s.told(p, own) for s, p, own in zip(sources[1:], parts[1:], values[1:], strict=True)]
    return ConstraintFit(before, after, selection, known, fit, beside, _readings(sources[0], parts[0], values[0]))


def _source(build: Build, rows: ConstraintRows, noise: Any, key: str) -> _Source:
    """Rows with the noise that is given: one for all, or by name; readings of an instrument in one unit share one."""
    read = [] if rows.seen is None else [*rows.seen.pose[: rows.seen.compared]]
    numbers = rows.seen.noise_groups() if isinstance(rows.seen, Instrument) else [0] * len(read)
    values = torch.full((max(len(read), 1),), math.nan, dtype=torch.float64)
    if isinstance(noise, dict):
        values = sizes_by_name(noise, read, key, values.tolist())
        # What is given by name is of that alone.
        numbers = [n if math.isnan(v) else len(read) + k for k, (n, v) in enumerate(zip(numbers, values, strict=True))]
    elif noise is not None:
        values = torch.full_like(values, size(noise, rows.unit, key))
        values = sizes_of_pose(noise, read, key) if len({*numbers}) > 1 else values
    _require_sizes(values[~values.isnan()].tolist(), key, "remove the key")
    every = sorted({*numbers}) or [0]
    first = [numbers.index(n) if numbers else 0 for n in every]
    group = {c.name: every.index(n) for c, n in zip(read, numbers, strict=True)} if len(every) > 1 else {}
    known = ~values[first].isnan()
    return _Source(build, rows, torch.where(known, values[first], _FIRST_NOISE), known, group)


def _require_sizes(values: Sequence[float], key: str, instead: str) -> None:
    if not all(v > 0 for v in values):
        raise InputError(f"{key}: {min(values):g} is no standard deviation; write a size above 0, or {instead}")


def _readings(source: _Source, problem: Problem, values: Tensor) -> dict[str, dict[str, Any]]:
    """What was read by name where noise is by reading: unit, rows, noise, and RMS before and after [SI]."""
    if not source.group or source.rows.seen is None:
        return {}
    units = {c.name: c.unit for c in source.rows.seen.pose}
    before, after = source.left(problem, problem.start), source.left(problem, values)
    counts = source.rows.measured([*source.group]).sum(0).tolist()
    return {
        name: {
            "unit": units[name],
            "rows": int(rows),
            "noise": float(source.noise[i]),
            "noise_known": bool(source.known[i]),
            "before": float(before[i]),
            "after": float(after[i]),
        }
        for (name, i), rows in zip(source.group.items(), counts, strict=True)
    }


def _values_of(parts: Sequence[Problem], values: Tensor, shared: int) -> list[Tensor]:
    """Of the values of all `1 x p` those of each part."""
    own = torch.split(values[:, shared:], [len(p.parameters) - shared for p in parts], -1)
    return [torch.cat([values[:, :shared], each], -1) for each in own]


def _held_error(mechanism: Mechanism, rows: ConstraintRows, state: State, held: Tensor) -> PoseError:
    """How far the tool of the held-out rows is from where the constraint holds it, `1 x t`; NaN of what was not read.

    In a socket: from the mean of the points that the rows with weight put into the same socket of the same placement,
    which needs no fitted plate. Else |residual| of what was read, of lengths and of angles.
    """
    if rows.seen is None:
        far = scatter(tool_points(mechanism, rows.joints, state.geometry), rows.cell, rows.weights)
        return PoseError(far[None, held], None)
    names, left = [c.name for c in state.problem.channels], _residual(state.problem, state.values)[0] * state.noise
    units, seen = {c.name: c.unit for c in rows.seen.pose}, rows.measured(names)
    parts = []
    for unit in ("m", "rad"):
        mine = [k for k, name in enumerate(names) if units[name] == unit]
        far = left[:, mine].norm(dim=-1)
        parts.append((torch.where(seen[:, mine].any(-1), far, math.nan) if mine else far)[None, held])
    return PoseError(parts[0], parts[1] if "rad" in units.values() else None)


def _builder(about: Kind, mechanism: Mechanism, rows: ConstraintRows) -> Build:
    if about.kind == "sockets":
        several = len(torch.unique(rows.said, dim=0)) > 1
        plate = _PLATE_TOLERANCE if several else 0.0
        if isinstance(about, ConstraintConfig) and about.plate_tolerance is not None:
            plate = size(about.plate_tolerance, "m", "constraint.plate_tolerance")

        def sockets(choice: ParameterChoice, start: Tensor, noise: Any) -> Problem:
            # Without noise there is nothing to weigh the plate's scale against.
            scale = 0.0 if noise is None else plate
            of = rows.joints, rows.group, rows.said
            return socket_problem(mechanism, *of, noise, rows.weights, choice, start, scale)

        return sockets

    @lru_cache(maxsize=1)
    def at(start: tuple[float, ...]) -> Mechanism:
        """The machine and what reads it, where it suits these parameters."""
        seen = read_by(rows, mechanism.with_nominal(torch.tensor(start, dtype=torch.float64)), about).seen
        assert seen is not None
        return seen

    def read(choice: ParameterChoice, start: Tensor, noise: Any) -> Problem:
        seen = at(tuple(start.tolist()))
        # What an instrument adds to the machine's parameters comes behind them.
        own = seen.geometry[len(mechanism.geometry) :]
        if isinstance(noise, dict):
            # What an instrument was pointed at is never compared.
            noise = dict.fromkeys((c.name for c in seen.pose[seen.compared :]), 1.0) | noise
        sizes = None if noise is None else sizes_of_pose(noise, seen.pose, "noise")
        start = torch.cat([start, seen.nominal[len(start) :]])
        choice = replace(choice, free=[*(choice.free or ()), *(p.name for p in own)])
        # Held-out rows are in units of the noise, too.
        problem = forward_problem(seen, rows.joints, rows.said, None, choice, sizes, start=start)
        return replace(problem, weights=rows.weights[None])

    return read


def _beside(config: IdentifyConfig, mechanism: Mechanism) -> list[tuple[Build, ConstraintRows]]:
    """What makes the problem of the rows of each other kind, and these."""
    assert config.constraint is not None
    found: list[tuple[Build, ConstraintRows]] = []
    for about in config.constraint.beside:
        if about.kind == "pose":
            seen = mechanism if about.instrument is None else instrument(mechanism, [about.instrument])
            rows = placed(poses_of(config, about.records, seen)[0])
        else:
            source = read_source(about.records, config.columns)
            table = read_joints(source, mechanism, config.joint_map, config.columns)
            rows = rows_of(table, mechanism, about)
        found.append((_builder(about, mechanism, rows), rows))
    return found


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


def _tool_first(
    mechanism: Mechanism, rows: ConstraintRows, build: Build, tool: list[str], choice: ParameterChoice
) -> State:
    """The tool's offset with nominal links; where it is fixed, the constraint as its builder finds it at nominal."""
    nominal = mechanism.nominal
    if not tool:
        problem = build(choice, nominal, _FIRST_NOISE)
        return State(nominal, problem, problem.start, _sizes(rows, problem, _FIRST_NOISE))
    alone = ParameterChoice(free=tool)
    problem = build(alone, nominal, None)
    values = solve_lm(problem).values
    geometry = select_parameters(mechanism.geometry, alone, nominal).full(values[:, : len(tool)])[0]
    return State(geometry, problem, values, _sizes(rows, problem, None))


def _sizes(rows: ConstraintRows, problem: Problem, noise: float | None) -> Tensor:
    """What the problem's channels `c` are divided by where all have one noise [m], or none [SI]."""
    seen = rows.seen
    if seen is None:
        return torch.full((len(problem.channels),), 1.0 if noise is None else noise, dtype=torch.float64)
    plain = torch.tensor([1 / ROTATION_WEIGHT if c.unit == "rad" else 1.0 for c in seen.pose], dtype=torch.float64)
    return _of_channels(problem, seen, plain if noise is None else sizes_of_pose(noise, seen.pose, "noise"))


def _of_channels(problem: Problem, seen: Mechanism, sizes: Tensor) -> Tensor:
    """Of sizes of all that is read those of the problem's channels, `c`."""
    names = [c.name for c in seen.pose]
    return sizes[[names.index(c.name) for c in problem.channels]]


def _residual(problem: Problem, values: Tensor) -> Tensor:
    """`1 x s x c`, of all rows."""
    return problem.residual(values[:, None], *problem.data).detach()


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
    others = _beside(config, mechanism)
    fit = fit_constraint(config, mechanism, rows, progress, others)
    held = rows.weights == 0
    before, after = (_held_error(mechanism, rows, s, held) for s in (fit.before, fit.after))
    picture = drawn_sizes(mechanism, rows.joints[held], before.position[0], after.position[0], fit.after.geometry)
    if config.fits_again() and bool(held.any()):
        every = replace(rows, weights=torch.ones_like(rows.weights))
        again = fit_constraint(config, mechanism, every, None, others)
        fit = again if bool(again.fit.converged.all()) else fit
    outcome = Outcome(
        machines=torch.arange(1),
        values=fit.after.geometry[None],
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
        start=fit.before.geometry[None],
        data_hash=rows.data_hash,
        notes=notes,
    )
    noise = None if config.noise is None or fit.readings else float(fit.after.noise[0])
    found = Found(outcome, _known(fit), before, after)
    results, arrays = assemble(config, measured, fit.selection, {"lm": found}, noise, _only_by_prior(fit, found.known))
    results["constraint"] = _constraint(config, rows, fit)
    if rows.in_sockets and bool(held.any()):
        # Other constraints show less than a place, to which new positions could not be held.
        first, last = (PoseError(error.position[0], None) for error in (before, after))
        results["promise"] = promise_block(first, last, configurations(rows.joints[held], mechanism.joints))
    return measured, {"lm": outcome}, results, arrays | picture


def _known(fit: ConstraintFit) -> Known:
    """The machine's part of what is known; a parameter that only its prior determines has no interval."""
    knowledge = fit.knowledge
    prior = fit.after.problem.prior_sd
    prior = torch.nn.functional.pad(prior, (0, knowledge.sd.shape[-1] - len(prior)), value=math.inf)
    determined = knowledge.identifiable & (knowledge.sd < _AS_PRIOR * prior)
    noise = knowledge.noise if fit.after.problem.noise_known else torch.ones(1, dtype=torch.float64)
    return known_of(
        [replace(knowledge, sd=torch.where(determined, knowledge.sd, math.inf), noise=noise)], fit.selection
    )


def _only_by_prior(fit: ConstraintFit, known: Known) -> list[str]:
    """A sentence on the parameters that the rows determine no better than their priors."""
    determined = zip(fit.selection.parameters, known.sd[0], fit.knowledge.identifiable[0], strict=False)
    prior = [p.word or p.name for p, sd, seen in determined if bool(seen) and not math.isfinite(sd)]
    return [f"No better known than by the tolerance given: {', '.join(prior)}."] if prior else []


def _constraint(config: IdentifyConfig, rows: ConstraintRows, fit: ConstraintFit) -> dict[str, Any]:
    """What was found of the constraint itself."""
    assert config.constraint is not None
    every = zip(fit.after.problem.parameters, fit.after.values[0].tolist(), fit.knowledge.sd[0].tolist(), strict=False)
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
        "noise": float(fit.after.noise[0]),
        "noise_known": config.noise is not None,
        "beside": [
            {"kind": about.kind, "records": str(about.records), **found}
            for about, found in zip(config.constraint.beside, fit.beside, strict=True)
        ],
        "readings": fit.readings,
    }
