"""Candidate poses: reachable, inside the limits, away from singularities; and their rows of the Jacobian."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import torch
from scipy.linalg import qr
from torch import Tensor

from ccnn_torch.coordinates import Parameter
from ccnn_torch.errors import InputError
from ccnn_torch.identification.identifiability import combinations_in_words
from ccnn_torch.identification.problems.problem import Problem, Progress
from ccnn_torch.mechanisms import Instrument, Mechanism
from ccnn_torch.numerics.least_squares import jacobian_of
from ccnn_torch.records.commanded import SECOND
from ccnn_torch.spelling import hint

Limits = Mapping[str, tuple[float, float]]

# Candidates drawn and evaluated in one call.
_AT_ONCE = 20_000
# Configurations after which progress is shown.
_TOLD = 4000
# Machines with plausible errors that must reach a pose, too.
_MACHINES = 8
# Configurations whose forward kinematics are tried on these machines in one call.
_TRIED = 500
# Draws after which the search ends for a mechanism with hardly any candidate.
_DRAWS = 200
# Singular values below this share of the largest are no information but rounding.
_UNSEEN = 1e-9


@dataclass(frozen=True)
class Candidates:
    """Configurations to choose from: joints `M x n` and poses `M x p` [SI]; `drawn`: how many were drawn."""

    joints: Tensor
    pose: Tensor
    drawn: int


def draw_candidates(
    mechanism: Mechanism,
    count: int,
    seed: int = 0,
    *,
    limits: Limits | None = None,
    max_condition: float = 50.0,
    rotation_weight: float = 0.04,
    uncertainty: Tensor | None = None,
    progress: Progress | None = None,
) -> Candidates:
    """Configurations from the mechanism's own sampling of its workspace.

    Args:
        mechanism: any; a serial arm is sampled in its joints, all others in their poses.
        count: how many to find.
        seed: of the draws.
        limits: lowest and highest value of joints and pose coordinates by name [SI].
        max_condition: bound on the condition number of the Jacobian: beyond it is too near to a singularity.
        rotation_weight: of the Jacobian's rotation rows [m/rad].
        uncertainty: by how much each of the mechanism's parameters may be off, `K` [SI]; configurations that are out of
            reach of one of eight machines, every parameter of which is off by so much to one side or the other, are
            left out: the most informative ones are at the edge of the workspace. Serial arms reach all of theirs.
        progress: called with the share that is found.

    Raises:
        InputError: a limit on something that the mechanism does not have, or fewer than one draw in a hundred is left.
    """
    bounds = _bounds(mechanism, limits or {})
    generator = torch.Generator().manual_seed(seed)
    others = _others(mechanism, uncertainty)
    found: list[tuple[Tensor, Tensor]] = []
    there = drawn = 0
    shown = 0.0

    def report(share: float) -> None:
        """Progress within this draw, if as large a share of it is kept as of those before."""
        nonlocal shown
        kept = there / drawn if there else 1.0
        shown = max(shown, min(1.0, (there + share * kept * min(count, _AT_ONCE)) / count))
        if progress is not None:
            progress(shown)

    for _ in range(_DRAWS):
        joints, pose = _draw(mechanism, min(count, _AT_ONCE), generator)
        values = torch.cat([joints, pose], dim=-1)
        good = (torch.isfinite(values) & (values >= bounds[:, 0]) & (values <= bounds[:, 1])).all(-1)
        joints, pose = joints[good], pose[good]
        # In parts, so that progress is shown.
        parts = torch.split(torch.arange(len(joints)), _TOLD)
        condition = torch.empty(len(joints), dtype=torch.float64)
        for number, part in enumerate(parts):
            condition[part] = mechanism.condition_number(joints[part], rotation_weight, guess=pose[part])
            report(0.5 * (number + 1) / len(parts))
        order = condition.argsort(descending=True)
        order = order[condition[order] <= max_condition]
        if others is not None:
            order = _in_reach(mechanism, joints, pose, order, others)
        kept = order.sort().values
        found.append((joints[kept], pose[kept]))
        there, drawn = there + len(kept), drawn + min(count, _AT_ONCE)
        report(0.0)
        if there >= count:
            joints, pose = (torch.cat(part)[:count] for part in zip(*found, strict=True))
            return Candidates(joints, pose, drawn)
        if there < drawn / 100 and drawn >= _DRAWS // 2 * min(count, _AT_ONCE):
            break
    raise InputError(
        f"mechanism '{mechanism.name}': only {there} of {drawn} configurations are inside the limits, have a condition "
        f"number up to {max_condition:g}, and are in reach with plausible errors; widen limits or max_condition"
    )


def _draw(mechanism: Mechanism, count: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    if type(mechanism).sample_joints is Mechanism.sample_joints:
        pose = mechanism.sample_workspace(count, generator)
        return mechanism.solve_inverse(pose), pose
    joints = mechanism.sample_joints(count, generator)
    given = mechanism.sample_given(count, generator) if isinstance(mechanism, Instrument) else None
    return joints, mechanism.forward_kinematics(joints, guess=given)


def _others(mechanism: Mechanism, uncertainty: Tensor | None) -> Tensor | None:
    """Parameters of machines with errors, `m x 1 x K`."""
    if uncertainty is None or mechanism.orientations:
        return None
    draw = torch.rand(_MACHINES, 1, len(uncertainty), generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    return mechanism.nominal + torch.where(draw < 0.5, -uncertainty, uncertainty)


def _in_reach(mechanism: Mechanism, joints: Tensor, pose: Tensor, order: Tensor, others: Tensor) -> Tensor:
    """Which of the configurations in `order` (worst conditioned first) all the other machines reach, too.

    Whether a machine has joints for the pose is checked everywhere. Whether the commanded joints close its loops is
    checked near singularities of the second kind only: from the worst conditioned on, until none fails any more.
    """
    order = order[mechanism.reachable(pose[order], others).all(0)]
    kept = []
    for part in torch.split(order, _TRIED):
        there = mechanism.forward_kinematics(joints[part], others, pose[part])
        good = torch.isfinite(there).all(-1).all(0)
        kept.append(part[good])
        if bool(good.all()):
            break
    return torch.cat([*kept, order[len(kept) * _TRIED :]])


def _bounds(mechanism: Mechanism, limits: Limits) -> Tensor:
    """Lowest and highest value of joints and pose coordinates, `(n + p) x 2`."""
    names = [c.name for c in (*mechanism.joints, *mechanism.pose)]
    bounds = torch.tensor([-torch.inf, torch.inf], dtype=torch.float64).repeat(len(names), 1)
    # Those of a joint hold in the second place of a row, too, unless that has its own.
    seconds = {f"{name}{SECOND}": ends for name, ends in limits.items() if f"{name}{SECOND}" in names}
    for name, (low, high) in {**seconds, **limits}.items():
        if name not in names:
            near = hint(name, names, "it has")
            raise InputError(f"limits: mechanism '{mechanism.name}' has no joint or pose coordinate '{name}'; {near}")
        if not low < high:
            raise InputError(f"limits.{name}: the first number must be smaller than the second, not {low:g}, {high:g}")
        bounds[names.index(name)] = torch.tensor([low, high], dtype=torch.float64)
    return bounds


def identification_rows(problem: Problem, progress: Progress | None = None) -> Tensor:
    """Identification rows of a problem: derivatives of its residual at the start, `s x c x k` [1] (first machine).

    The residual is in units of its noise and each parameter in its plausible error, so that the rows are numbers.
    """
    rows = []
    count = problem.weights.shape[-1]
    for begin in range(0, count, _AT_ONCE):
        part = slice(begin, begin + _AT_ONCE)
        residual = _at(problem, tuple(d[0, part] for d in problem.data))
        values = problem.start[0].expand(min(_AT_ONCE, count - begin), -1)
        rows.append(jacobian_of(residual, values)[1] * problem.scale)
        if progress is not None:
            progress(min(1.0, (begin + _AT_ONCE) / count))
    return torch.cat(rows)


def _at(problem: Problem, data: tuple[Tensor, ...]) -> Callable[[Tensor], Tensor]:
    return lambda values: problem.residual(values, *data)


def what_is_seen(
    rows: Tensor, prior: Tensor, parameters: Sequence[Parameter], scale: Tensor
) -> tuple[Tensor, tuple[str, ...]]:
    """Parameters enough to span all that the candidates show, and the combinations that show in none of them.

    Which parameter of such a combination is fixed does not matter to a plan: the determinants of all designs then
    change by the same factor. Those that show best are kept (QR with column pivoting).

    Args:
        rows: `M x c x k` [1].
        prior: square roots of the prior's information, `k` [1], 0 where there is none.
        parameters: the `k`.
        scale: plausible errors, `k` [SI].

    Returns:
        The parameters that candidates determine when the others are fixed, by number, ascending `k'`, int64; and the
        combinations that are not determined, in words.

    Raises:
        InputError: no candidate shows any of them.
    """
    factor = _factor(rows, prior)
    _, values, directions = torch.linalg.svd(factor)
    seen = values > _UNSEEN * values[0]
    rank = int(seen.sum())
    if rank == 0:
        names = ", ".join(p.name for p in parameters)
        raise InputError(f"no pose shows any of the parameters {names}; free others, or give them a prior")
    if rank == len(parameters):
        return torch.arange(rank), ()
    kept = sorted(qr(factor.numpy(), mode="r", pivoting=True)[1][:rank].tolist())
    return torch.tensor(kept), combinations_in_words(parameters, directions[~seen], scale)


def _factor(rows: Tensor, prior: Tensor) -> Tensor:
    """Triangular R `k x k` with RᵀR the mean information of a candidate and the prior's; `common_coordinates`."""
    flat = rows.flatten(0, 1) / len(rows) ** 0.5
    # In parts, so that no second copy of all rows is needed.
    parts = [torch.linalg.qr(part).R for part in torch.split(flat, _AT_ONCE)]
    factor: Tensor = torch.linalg.qr(torch.cat([*parts, torch.diag(prior)])).R
    return factor


def common_coordinates(rows: Tensor, prior: Tensor) -> Tensor:
    """Coordinates in which all candidates together give one unit of information a pose in every direction.

    Determinants compare designs alike in all coordinates; in these nothing is lost to rounding.

    Args:
        rows: `M x c x k` [1], which show every parameter (`what_is_seen`).
        prior: square roots of the prior's information, `k` [1], 0 where there is none.

    Returns:
        T, `k x k`: rows @ T are the rows there.
    """
    factor = _factor(rows, prior)
    turn: Tensor = torch.linalg.solve_triangular(factor, torch.eye(len(factor), dtype=rows.dtype), upper=True)
    return turn
