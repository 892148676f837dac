"""One method on the rows of an identification, jointly or leg by leg, on all machines at once; its checkpoint."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from ccnn_torch.config.sizes import prior_sizes
from ccnn_torch.errors import InputError
from ccnn_torch.identification import (
    Fit,
    ParameterChoice,
    Problem,
    Progress,
    Solver,
    forward_problem,
    inverse_problem,
    split_by_leg,
)
from ccnn_torch.identification.config import PER_LEG, IdentifyConfig, base_method
from ccnn_torch.identification.measured import Measured, Rows
from ccnn_torch.identification.problems.parameters import Selection, select_parameters
from ccnn_torch.identification.problems.poses import compares_poses
from ccnn_torch.identification.problems.problem import WeightedRows, part_of
from ccnn_torch.identification.solvers import get_solver
from ccnn_torch.mechanisms import Framed, Mechanism
from ccnn_torch.mechanisms.frames.judge import OUTLIERS
from ccnn_torch.numerics.outliers import inlying
from ccnn_torch.training import load_checkpoint, save_checkpoint

QUICK = ("lm", "tikhonov")
"""The others are global searches, which take minutes where these take a blink."""
# The noise of a row is carried over at the start, then at what was found; a third time changes nothing that counts.
_ROUNDS = 2


@dataclass(frozen=True)
class Outcome:
    """What one method found.

    Attributes:
        machines: which machines it was run on, `r`, int64.
        values: the whole geometry of each, `r x K` [SI].
        converged: `r`, bool.
        evaluations: residuals of all rows of one machine computed.
        seconds: wall time.
        message: a sentence where not all converged; else empty.
    """

    machines: Tensor
    values: Tensor
    converged: Tensor
    evaluations: int
    seconds: float
    message: str


def choice_of(config: IdentifyConfig, mechanism: Mechanism) -> ParameterChoice:
    """The parameters of a config; its priors in SI."""
    about = config.parameters
    prior = prior_sizes(about.prior, mechanism.geometry, "parameters.prior")
    return ParameterChoice(free=about.free, fixed=about.fixed, tied=about.tied, prior=prior)


def select(measured: Measured, config: IdentifyConfig) -> Selection:
    """The free parameters of all machines."""
    return select_parameters(measured.mechanism.geometry, choice_of(config, measured.mechanism), measured.start)


def pieces_of(
    measured: Measured, config: IdentifyConfig, apart: bool, machines: Tensor, near: Tensor | None = None
) -> list[Problem]:
    """The problems that a method solves.

    Args:
        apart: one for each leg, from that leg's rows where it has its own; else one for all.
        near: geometry at which the noise of the pose is carried over to the residual, `r x K` [SI]; where the search
            begins when None. Near singular poses the difference matters.
    """
    if not apart:
        return [_problem(measured, config, measured.rows.of(machines), machines, False, near)]
    whole = split_by_leg(_problem(measured, config, measured.rows.of(machines), machines, True, near))
    if not measured.leg_rows:
        return whole
    own = []
    for i, part in enumerate(whole):
        rows = measured.leg_rows[leg_of(part)].of(machines)
        own.append(split_by_leg(_problem(measured, config, rows, machines, True, near))[i])
    return own


def leg_of(part: Problem) -> int:
    """The leg that a part of `split_by_leg` is of."""
    leg = part.parameters[0].leg
    assert leg is not None
    return leg


def _problem(
    measured: Measured, config: IdentifyConfig, rows: Rows, machines: Tensor, per_leg: bool, near: Tensor | None
) -> Problem:
    gaps = bool(rows.observed.isnan().any())
    if gaps and (config.residual == "inverse" or per_leg):
        key, give = ("methods", "leg by leg") if per_leg else ("residual", "inverse")
        raise InputError(
            f"{key}: {give} compares joints, which only a whole pose has, and some rows lack a part of it; write "
            "residual=auto and methods=[lm], or leave these rows out"
        )
    about = gaps or compares_poses(measured.mechanism) or config.frame.base or config.frame.tool
    forward = config.residual == "forward" or (config.residual == "auto" and about)
    if forward and per_leg:
        raise InputError(
            "methods: a pose depends on all legs, so legs are identified apart only by their joints; write "
            "residual=inverse, or remove _per_leg"
        )
    start = measured.start[machines] if near is None else near
    choice = choice_of(config, measured.mechanism)
    problem = _built(measured, config, rows, choice, start, None if forward else per_leg)
    return replace(problem, start=select(measured, config).start[machines])


def _built(
    measured: Measured,
    config: IdentifyConfig,
    rows: Rows,
    choice: ParameterChoice,
    start: Tensor,
    per_leg: bool | None = None,
) -> Problem:
    """The problem of joints, `per_leg` or not, or of poses where that is None."""
    build = partial(forward_problem, rotation_weight=config.rotation_weight)
    if per_leg is not None:
        build = partial(inverse_problem, per_leg=per_leg)
    return build(
        measured.view,
        rows.joints,
        rows.observed,
        choice=choice,
        pose_noise=measured.pose_noise,
        joint_noise=measured.joint_noise,
        start=start,
    )


def frames_first(measured: Measured, config: IdentifyConfig) -> Measured:
    """The rows with those frames fitted that no maker can know: the search and "before" begin from there."""
    if not (config.frame.base or config.frame.tool) or not isinstance(measured.mechanism, Framed):
        return measured
    observed = measured.rows.observed
    whole = (~observed.isnan().any(-1)).to(observed.dtype)
    frame = measured.view.frame(observed.nan_to_num())
    closed = measured.mechanism.fitted_frames(measured.rows.joints, frame, whole)
    prefixes = tuple(f"{part}_" for part, free in (("base", config.frame.base), ("tool", config.frame.tool)) if free)
    names = [p.name for p in measured.mechanism.geometry if p.name.startswith(prefixes)]
    choice = ParameterChoice(free=names)
    problem = _built(measured, config, measured.rows, choice, closed)
    found = get_solver("lm")(problem, config.seed)
    start = select_parameters(measured.mechanism.geometry, choice, closed).full(found.values)
    return replace(measured, start=start)


def without_far_rows(measured: Measured, config: IdentifyConfig) -> Measured:
    """Without the rows, held-out ones too, that a robust fit to all of them shows to be gross outliers, and named.

    Rows that have no names (simulated ones) stay, and all where the config has a robust loss of its own.
    """
    if measured.name_rows is None or config.robust is not None:
        return measured
    whole = replace(measured, rows=measured.rows.and_these(measured.test))
    found = run_method("lm", whole, config.model_copy(update={"robust": "cauchy"}))
    (problem,) = pieces_of(whole, config, False, found.machines, found.values)
    values = select(measured, config).free(found.values)
    length = WeightedRows(problem).residuals(values[:, None], found.machines)[0, 0].norm(dim=-1)
    near = inlying(length, torch.ones_like(length) > 0, len(problem.channels), values.shape[-1])
    far = torch.nonzero(~near).squeeze(-1).tolist()
    if not far or len(far) > OUTLIERS * len(near) or not bool(found.converged.all()):
        return measured
    train = measured.rows.joints.shape[1]
    rows, test = (
        Rows(rows.joints[:, kept], rows.observed[:, kept])
        for rows, kept in zip((measured.rows, measured.test), (near[:train], near[train:]), strict=True)
    )
    one = len(far) == 1
    said = (
        f"{len(far)} {'row is' if one else 'rows are'} far off among the others, mistyped or mismeasured, and left out "
        f"of the fit and of the held-out error: {measured.name_rows(far)}; correct or remove {'it' if one else 'them'}."
    )
    return replace(measured, rows=rows, test=test, doubts=[*measured.doubts, said])


def is_apart(method: str, config: IdentifyConfig) -> bool:
    """Whether a method identifies leg by leg."""
    return config.per_leg or method.endswith(PER_LEG)


def machines_of(method: str, measured: Measured, config: IdentifyConfig) -> Tensor:
    """Which machines a method is run on: slow ones on the first few only."""
    count = measured.machines
    return torch.arange(min(count, config.hga_machines) if base_method(method) not in QUICK else count)


def solver_of(method: str, config: IdentifyConfig) -> Solver:
    """The solver of a method with its settings."""
    settings = dict(config.settings.get(base_method(method), {}))
    if base_method(method) == "lm":
        settings = {"starts": config.starts, "loss": config.robust or "squared"} | settings
    return get_solver(base_method(method), **settings)


def run_method(method: str, measured: Measured, config: IdentifyConfig, progress: Progress | None = None) -> Outcome:
    """Run a method."""
    machines = machines_of(method, measured, config)
    solver, selection = solver_of(method, config), select(measured, config)
    begun = time.perf_counter()
    fits: list[Fit] = []
    values: Tensor | None = None
    rounds = _ROUNDS if base_method(method) in QUICK and measured.pose_noise is not None else 1
    for _ in range(rounds):
        pieces = pieces_of(measured, config, is_apart(method, config), machines, values)
        fits = []
        for i, piece in enumerate(pieces):
            fits.append(solver(piece, config.seed + i, part_of(progress, i, len(pieces))))
        free = selection.start[machines].clone()
        for piece, fit in zip(pieces, fits, strict=True):
            free[:, selection.places(piece.parameters)] = fit.values
        values = free @ selection.spread + selection.fixed[machines]
    assert values is not None
    seconds = time.perf_counter() - begun
    said = [fit.message for fit in fits if fit.message]
    return Outcome(
        machines,
        values,
        torch.stack([fit.converged for fit in fits]).all(0),
        sum(fit.evaluations for fit in fits),
        seconds,
        said[0] if said else "",
    )


def save_outcome(path: Path, outcome: Outcome, facts: Mapping[str, Any]) -> None:
    """Write an outcome; `facts` say what config and data it is of.

    Raises:
        WriteError: it cannot be written.
    """
    parts = vars(outcome)
    tensors = {name: part for name, part in parts.items() if isinstance(part, Tensor)}
    about = {name: part for name, part in parts.items() if name not in tensors}
    save_checkpoint(path, tensors, about | {"facts": dict(facts)})


def load_outcome(path: Path) -> Outcome:
    """The outcome in a file."""
    tensors, about = load_checkpoint(path)
    parts: dict[str, Any] = {**about, **tensors}
    del parts["facts"]
    return Outcome(**parts)
