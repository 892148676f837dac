"""Fit of an arm to a constraint of its tool: the tool offset first, then all links with a prior."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from ccnn_torch.config.sizes import size, sizes_by_name
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
from ccnn_torch.identification.config import IdentifyConfig
from ccnn_torch.identification.constrained.rows import ConstraintRows
from ccnn_torch.identification.problems.parameters import Selection, select_parameters
from ccnn_torch.identification.solve import choice_of, solver_of
from ccnn_torch.mechanisms import Mechanism

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
    values = sizes_by_name(given if isinstance(given, dict) else {}, links, key, [one] * len(links)).tolist()
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
