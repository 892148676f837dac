"""Identification without a measuring device: sockets of a plate, distances from an anchor, points on a plane."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ccnn_torch.config.sizes import size, sizes_by_name
from ccnn_torch.config.split import Given, held_out_notes, rows_of_test_file, split_by, with_test_file
from ccnn_torch.coordinates import Coordinate
from ccnn_torch.errors import InputError
from ccnn_torch.identification import (
    Fit,
    Knowledge,
    ParameterChoice,
    Problem,
    Progress,
    distance_problem,
    plane_problem,
    reweighted,
    scatter,
    socket_problem,
    solve_lm,
    tool_points,
    what_is_known,
)
from ccnn_torch.identification.config import ConstraintConfig, IdentifyConfig
from ccnn_torch.identification.measured import Kinematics, Measured, Rows, nominal_machine
from ccnn_torch.identification.problems.parameters import Selection, select_parameters
from ccnn_torch.identification.result import Found, Known, assemble, known_of
from ccnn_torch.identification.solve import Outcome, choice_of, solver_of
from ccnn_torch.mechanisms import Framed, Mechanism, PoseError, SerialArm
from ccnn_torch.records import Records, Table, stack_columns
from ccnn_torch.records.headers import check_joints
from ccnn_torch.records.joint_map import read_joint_map, with_joints
from ccnn_torch.records.load import read_source

GROUPED_BY = {"sockets": "placement", "distances": "anchor", "plane": "plane"}
"""Column that numbers the groups of each kind, unless the config names others."""
# Joints beyond this are taken for degrees [rad], as in records of poses: 4 turns.
_ANGLE_LIMIT = 8 * np.pi


@dataclass(frozen=True)
class ConstraintRows:
    """The rows that take part.

    Attributes:
        joints: `s x n` [SI].
        said: the constraint's value of each row, `s x o` [m]: the socket's place on the plate (o = 3), the distance,
            or the reading (o = 1).
        group: number of each row's placement, anchor or plane, `s`.
        labels: the meaning of each number: the grouping columns and their values.
        weights: `s` [1]; 1 = row to identify from, 0 = held-out row.
        data_hash: SHA-256 of the records.
    """

    joints: Tensor
    said: Tensor
    group: Tensor
    labels: dict[float, dict[str, float]]
    weights: Tensor
    data_hash: str

    @property
    def cell(self) -> Tensor:
        """Number of the place that each row's tool is held in, `s`: one socket of one placement, or the group."""
        keys = torch.cat([self.group[:, None], self.said], dim=-1) if self.said.shape[-1] == 3 else self.group[:, None]
        number: Tensor = torch.unique(keys, dim=0, return_inverse=True)[1]
        return number


def read_constraint(config: IdentifyConfig, mechanism: Mechanism, given: Given | None = None) -> ConstraintRows:
    """Read, select and split the records of a config with a constraint."""
    about = config.constraint
    assert about is not None and config.records is not None
    source = with_test_file(config.records if given is None else given, config.split)
    if isinstance(source, Records):
        raise InputError("records: a constraint has columns of its own; give the path of its file, or a DataFrame")
    counted = read_joint_map(config.joint_map, mechanism.joints, config.columns)
    table = with_joints(read_source(source, config.columns), counted)
    check_joints(table, mechanism.joints)
    there = _taking_part(table, about.where)
    joints = torch.from_numpy(stack_columns(table, mechanism.joints, _ANGLE_LIMIT))[there]
    group, labels = _groups(table, about, there)
    said = torch.from_numpy(stack_columns(table, _said_columns(table, about)))[there]
    said = said if said.shape[-1] else torch.zeros(len(joints), 1, dtype=torch.float64)
    columns = {name: table.raw(name)[there.numpy()] for name in table.names}
    held = rows_of_test_file(config.split, table.parts)
    nowhere = torch.empty(len(joints), 0, dtype=torch.float64)
    train = split_by(config.split, nowhere, columns, config.seed, 0.0, None if held is None else held[there]).train
    weights = torch.zeros(len(joints), dtype=torch.float64)
    weights[train] = 1.0
    rows = ConstraintRows(joints, said, group, labels, weights, table.data_hash)
    _check_cells(rows, about)
    return rows


def _taking_part(table: Table, where: Mapping[str, float]) -> Tensor:
    """Numbers of the rows that have the values wanted, ascending."""
    chosen = np.ones(len(table), dtype=bool)
    for name, value in where.items():
        if name not in table:
            raise InputError(f"constraint.where: {table.path} has no column '{name}'; it has {', '.join(table.names)}")
        chosen &= table.raw(name) == value
    if not chosen.any():
        wanted = ", ".join(f"{name} = {value:g}" for name, value in where.items())
        raise InputError(f"constraint.where: no row of {table.path} has {wanted}; write values that it contains")
    return torch.from_numpy(np.flatnonzero(chosen))


def _groups(table: Table, about: ConstraintConfig, there: Tensor) -> tuple[Tensor, dict[float, dict[str, float]]]:
    names = about.by or [GROUPED_BY[about.kind]]
    for name in names:
        if name not in table:
            raise InputError(
                f"constraint.by: {table.path} has no column '{name}', which numbers the {GROUPED_BY[about.kind]} of "
                f"each row; add it, or name one of {', '.join(table.names)}"
            )
    values: NDArray[np.float64] = np.stack([table.column(name) for name in names], axis=-1)[there.numpy()]
    if len(names) == 1:
        return torch.from_numpy(values[:, 0].copy()), {v: {names[0]: v} for v in np.unique(values).tolist()}
    each, number = np.unique(values, axis=0, return_inverse=True)
    labels = {float(i): dict(zip(names, row, strict=True)) for i, row in enumerate(each.tolist())}
    return torch.from_numpy(number.reshape(-1).astype(np.float64)), labels


def _said_columns(table: Table, about: ConstraintConfig) -> list[Coordinate]:
    if about.kind == "sockets":
        return [Coordinate(axis, "m") for axis in "xyz"]
    if about.kind == "distances":
        return [Coordinate("distance", "m")]
    return [Coordinate("reading", "m")] if "reading" in table else []


def _check_cells(rows: ConstraintRows, about: ConstraintConfig) -> None:
    """Every place that a held-out row was held in must be known from other rows."""
    cell = rows.cell
    used = torch.zeros(int(cell.max()) + 1, dtype=torch.float64).index_add(0, cell, rows.weights)
    lost = torch.nonzero(used[cell] == 0)
    if len(lost):
        label = rows.labels[float(rows.group[lost[0, 0]])]
        named = ", ".join(f"{name} {value:g}" for name, value in label.items())
        socket = "a socket of " if about.kind == "sockets" and rows.said.shape[-1] == 3 else ""
        raise InputError(
            f"split: {socket}{named} has held-out rows but none to identify from, so these cannot be judged; write "
            "split.kind=random or a smaller split.test, or measure it more often"
        )


# Links and noise are estimated in turn, the noise from this size on [m].
_ROUNDS, _FIRST_NOISE, _LEAST_NOISE = 5, 1e-3, 1e-9
# Prior of the tool's offset around its first fit, and of a plate's extent around what its records say [m].
_TOOL_TOLERANCE, _PLATE_TOLERANCE = 0.05, 1e-4

Build = Callable[[ParameterChoice, Tensor, float | None], Problem]


@dataclass(frozen=True)
class State:
    """A geometry `K` [SI] with the problem and its values `1 x p` [SI] that it came from; noise [m], 1 if unknown."""

    geometry: Tensor
    problem: Problem
    values: Tensor
    noise: float


@dataclass(frozen=True)
class ConstraintFit:
    """What was found.

    Attributes:
        before: links nominal, the tool's offset fitted.
        after: all fitted.
        selection: the machine's free parameters, which are the first of the problem's.
        knowledge: of all the problem's parameters.
        fit: the last round's.
    """

    before: State
    after: State
    selection: Selection
    knowledge: Knowledge
    fit: Fit


def fit_constraint(
    config: IdentifyConfig, mechanism: Mechanism, rows: ConstraintRows, progress: Progress | None = None
) -> ConstraintFit:
    """Fit the rows that have weight.

    Priors keep the links near nominal; the tool's offset, which no maker knows, is fitted first, with nominal links.
    Where the config names no noise, it is that of the residuals, in five rounds; for the intervals it is raised by the
    equations that the fit used up.
    """
    build = _builder(config, mechanism, rows)
    names = [p.name for p in mechanism.geometry]
    held = [n for n in names if n.startswith(("base_", "tool_r"))]
    about = choice_of(config, mechanism)
    free = select_parameters(mechanism.geometry, ParameterChoice(about.free, [*about.fixed, *held], about.tied))
    of_machine = [n for group in free.groups for n in group]
    tool = [n for n in of_machine if n.startswith("tool_")]
    choice = ParameterChoice(of_machine, (), about.tied, {**_priors(config, mechanism, of_machine), **about.prior})
    before = _tool_first(mechanism, build, tool, choice)
    solver = solver_of("lm", config)
    known = None if config.noise is None or isinstance(config.noise, dict) else size(config.noise, "m", "noise")
    if known is not None and not known > 0:
        raise InputError(f"noise: {known:g} is no standard deviation; write a length above 0, or remove the key")
    noise, rounds = known or _FIRST_NOISE, 1 if known else _ROUNDS
    for done in range(rounds):
        problem = build(choice, before.geometry, noise)
        fit = solver(problem, config.seed)
        if known is None:
            noise = _left(problem, fit.values, noise)
        if progress is not None:
            progress((done + 1) / rounds)
    loss = config.robust or "squared"
    if known is None:
        problem = build(choice, before.geometry, noise)
        spared = float(what_is_known(reweighted(problem, fit.values, loss), fit.values).noise)
        if spared < float("inf"):
            noise *= max(1.0, spared)
        problem = build(choice, before.geometry, noise)
    selection = select_parameters(mechanism.geometry, choice, before.geometry)
    geometry = selection.full(fit.values[:, : len(selection.parameters)])[0]
    after = State(geometry, problem, fit.values, noise)
    return ConstraintFit(
        before, after, selection, what_is_known(reweighted(problem, fit.values, loss), fit.values), fit
    )


def held_distance(mechanism: Mechanism, rows: ConstraintRows, state: State) -> Tensor:
    """How far each row's tool is from where the constraint holds it, `s` [m].

    In a socket: from the mean of the points that the rows with weight put into the same socket of the same placement,
    which needs no fitted plate. Else |residual| of the distance or height, with the anchor or plane of the fit.
    """
    if rows.said.shape[-1] == 3:
        return scatter(tool_points(mechanism, rows.joints, state.geometry), rows.cell, rows.weights)
    return _residual(state.problem, state.values)[0, :, 0].abs() * state.noise


def _builder(config: IdentifyConfig, mechanism: Mechanism, rows: ConstraintRows) -> Build:
    about = config.constraint
    assert about is not None
    if about.kind == "sockets":
        several = len(torch.unique(rows.said, dim=0)) > 1
        plate = _PLATE_TOLERANCE if several else 0.0
        if about.plate_tolerance is not None:
            plate = size(about.plate_tolerance, "m", "constraint.plate_tolerance")

        def sockets(choice: ParameterChoice, start: Tensor, noise: float | None) -> Problem:
            # Without noise there is nothing to weigh the plate's scale against.
            scale = 0.0 if noise is None else plate
            return socket_problem(
                mechanism, rows.joints, rows.group, rows.said, noise, rows.weights, choice, start, scale
            )

        return sockets
    make = distance_problem if about.kind == "distances" else plane_problem

    def build(choice: ParameterChoice, start: Tensor, noise: float | None) -> Problem:
        return make(mechanism, rows.joints, rows.group, rows.said[:, 0], noise, rows.weights, choice, start)

    return build


def _priors(config: IdentifyConfig, mechanism: Mechanism, free: list[str]) -> dict[str, float]:
    about = config.constraint
    assert about is not None
    given, key = about.tolerance, "constraint.tolerance"
    one = 0.01 if isinstance(given, dict) else size(given, None, key)
    links = [p for p in mechanism.geometry if p.name in free and not p.name.startswith("tool_")]
    # The default is for lengths and angles, whichever of them there are.
    others = {"m", "rad"} - {p.unit for p in links}
    named = {name: v for name, v in given.items() if name not in others} if isinstance(given, dict) else {}
    values = sizes_by_name(named, links, key, [one] * len(links)).tolist()
    if any(not v > 0 for v in values):
        raise InputError(
            f"{key}: {min(values):g} is no standard deviation; write a size above 0, or fix the parameters"
        )
    priors = {p.name: v for p, v in zip(links, values, strict=True)}
    return priors | {n: _TOOL_TOLERANCE for n in free if n.startswith("tool_")}


def _tool_first(mechanism: Mechanism, build: Build, tool: list[str], choice: ParameterChoice) -> State:
    """The tool's offset with nominal links; where it is fixed, the constraint as its builder finds it at nominal."""
    nominal = mechanism.nominal
    if not tool:
        problem = build(ParameterChoice(choice.free, choice.fixed, choice.tied), nominal, None)
        return State(nominal, problem, problem.start, 1.0)
    alone = ParameterChoice(free=tool)
    problem = build(alone, nominal, None)
    values = solve_lm(problem).values
    geometry = select_parameters(mechanism.geometry, alone, nominal).full(values[:, : len(tool)])[0]
    return State(geometry, problem, values, 1.0)


def _residual(problem: Problem, values: Tensor) -> Tensor:
    """`1 x s x c`, of all rows."""
    return problem.residual(values[:, None], *problem.data).detach()


def _left(problem: Problem, values: Tensor, noise: float) -> float:
    """Root mean square of the residuals of the rows with weight [m]."""
    square = _residual(problem, values).square().mean(-1) * problem.weights
    return max(_LEAST_NOISE, noise * math.sqrt(float(square.sum() / problem.weights.sum())))


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
    mechanism, notes = _machine(config)
    rows = read_constraint(config, mechanism, given)
    begun = time.perf_counter()
    fit = fit_constraint(config, mechanism, rows, progress)
    outcome = Outcome(
        machines=torch.arange(1),
        values=fit.after.geometry[None],
        converged=fit.fit.converged,
        evaluations=fit.fit.evaluations,
        seconds=time.perf_counter() - begun,
        message=fit.fit.message,
    )
    held = rows.weights == 0
    notes = [*held_out_notes(config.split, int(held.sum())), *notes]
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
    before, after = (PoseError(held_distance(mechanism, rows, s)[None, held], None) for s in (fit.before, fit.after))
    noise = None if config.noise is None else fit.after.noise
    found = Found(outcome, _known(fit), before, after)
    results, arrays = assemble(config, measured, fit.selection, {"lm": found}, noise, _only_by_prior(fit, found.known))
    results["constraint"] = _constraint(config, rows, fit)
    return measured, {"lm": outcome}, results, arrays


def _machine(config: IdentifyConfig) -> tuple[Mechanism, list[str]]:
    """The mechanism; of an arm one without frames per group, since the constraint has its own."""
    mechanism = nominal_machine(config)
    if not isinstance(mechanism, SerialArm):
        return (Framed(mechanism, base=False, tool=True) if config.frame.tool else mechanism), []
    if config.frame.tool:
        raise InputError("frame.tool: an arm has a tool offset of its own, which is identified anyway; remove the key")
    ignored = [key for key in ("frame_per", "tool_per") if getattr(mechanism, key)]
    plain = mechanism.with_orientation("none")
    arm = SerialArm(**{**plain.recipe["keys"], "unknown_frames": [], "frame_per": [], "tool_per": []})
    said = f"{' and '.join(ignored)} of the mechanism count for nothing here: the constraint has its own placements."
    return arm.with_nominal(plain.nominal), [said] if ignored else []


def _known(fit: ConstraintFit) -> Known:
    """The machine's part of what is known; a parameter that only its prior determines has no interval."""
    knowledge = fit.knowledge
    determined = knowledge.identifiable & (knowledge.sd < _AS_PRIOR * fit.after.problem.prior_sd)
    noise = knowledge.noise if fit.after.problem.noise_known else torch.ones(1, dtype=torch.float64)
    return known_of(
        [replace(knowledge, sd=torch.where(determined, knowledge.sd, math.inf), noise=noise)], fit.selection
    )


def _only_by_prior(fit: ConstraintFit, known: Known) -> list[str]:
    """A sentence on the parameters that the rows determine no better than their priors."""
    determined = zip(fit.selection.parameters, known.sd[0], fit.knowledge.identifiable[0], strict=False)
    prior = [p.name for p, sd, seen in determined if bool(seen) and not math.isfinite(sd)]
    return [f"No better known than by the tolerance given: {', '.join(prior)}."] if prior else []


def _constraint(config: IdentifyConfig, rows: ConstraintRows, fit: ConstraintFit) -> dict[str, Any]:
    """What was found of the constraint itself."""
    assert config.constraint is not None
    k, knowledge = len(fit.selection.parameters), fit.knowledge
    unknowns = {}
    for i, parameter in enumerate(fit.after.problem.parameters[k:], start=k):
        sd = float(knowledge.sd[0, i])
        unknowns[parameter.name] = {
            "value": float(fit.after.values[0, i]),
            "sd": sd if math.isfinite(sd) else None,
            "unit": parameter.unit,
        }
    return {
        "kind": config.constraint.kind,
        "placements": [
            {"number": number, "columns": label, "rows": int((rows.group == number).sum())}
            for number, label in rows.labels.items()
        ],
        "unknowns": unknowns,
        "noise": fit.after.noise,
        "noise_known": config.noise is not None,
    }
