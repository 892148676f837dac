"""Measured rows in one shape, and their residuals: decorrelated, of unit variance, and quickly differentiated."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from ccnn_torch.coordinates import Coordinate, Parameter
from ccnn_torch.errors import InputError
from ccnn_torch.identification.problems.parameters import Selection
from ccnn_torch.identification.problems.problem import Channel, Problem, check_equations, row_jacobian
from ccnn_torch.mechanisms import Mechanism


@dataclass(frozen=True)
class MeasuredRows:
    """joints `r x s x n`, pose `r x s x p` (r = 1 where the machines share them), weights `r x s`."""

    joints: Tensor
    pose: Tensor
    weights: Tensor


def gather_rows(
    mechanism: Mechanism, joints: Tensor, pose: Tensor, weights: Tensor | None, start: Tensor | None
) -> MeasuredRows:
    """Check the shapes and count the machines.

    Args:
        joints: `s x n` or `r x s x n` [SI].
        pose: `s x p` or `r x s x p` [SI].
        weights: `s` or `r x s` [1]; all 1 when None.
        start: `K` or `r x K` [SI], or None.
    """
    for what, table, coordinates in (("joints", joints, mechanism.joints), ("pose", pose, mechanism.pose)):
        if table.dim() not in (2, 3) or table.shape[-1] != len(coordinates):
            raise InputError(
                f"{what} have the shape {tuple(table.shape)}; mechanism '{mechanism.name}' needs a column for each of "
                f"{', '.join(c.name for c in coordinates)}"
            )
    q, x = (t.detach().to(torch.float64).reshape(-1, *t.shape[-2:]) for t in (joints, pose))
    w = (
        torch.ones(1, q.shape[1], dtype=torch.float64, device=q.device)
        if weights is None
        else weights.reshape(-1, weights.shape[-1])
    )
    counts = {len(q), len(x), len(w), 1 if start is None or start.dim() == 1 else len(start)}
    rows = {q.shape[1], x.shape[1], w.shape[1]}
    if len(counts | {1}) > 2 or len(rows) > 1:
        raise InputError(
            f"joints {tuple(q.shape)}, pose {tuple(x.shape)} and weights {tuple(w.shape)} (machines, rows, …) do not "
            "fit together; give the same number of rows, and of machines or one for all"
        )
    if not bool((w >= 0).all()):
        raise InputError("weights must be 0 or positive; a row with weight 0 is left out")
    machines = max(counts)
    empty = torch.nonzero(~(w > 0).any(-1))
    if len(empty):
        raise InputError(f"machine {int(empty[0]) + 1} of {machines}: no row has a weight above 0; keep some rows")
    for table, coordinates in ((q, mechanism.joints), (x, mechanism.pose)):
        wrong = torch.nonzero(~torch.isfinite(table) & (w > 0)[..., None])
        if len(wrong):
            raise InputError(
                f"row {int(wrong[0, 1]) + 1}: {coordinates[int(wrong[0, 2])].name} is not a finite number; "
                "measure it again or leave the row out"
            )
    return MeasuredRows(q, x, w.to(torch.float64).expand(machines, -1))


def covariance(
    noise: float | Sequence[float] | Tensor | None, coordinates: Sequence[Coordinate], what: str
) -> Tensor | None:
    """Covariance of a row's noise, `… x d x d`.

    Args:
        noise: standard deviation, one for all or one for each coordinate [SI], or a covariance, `… x d x d`.
    """
    if noise is None:
        return None
    sd = torch.as_tensor(noise, dtype=torch.float64)
    d = len(coordinates)
    if sd.dim() >= 2 and sd.shape[-2:] == (d, d):
        return sd
    if sd.dim() > 1 or (sd.dim() == 1 and len(sd) != d) or not bool((sd >= 0).all() & torch.isfinite(sd).all()):
        raise InputError(
            f"{what}: give one standard deviation, or one for each of {', '.join(c.name for c in coordinates)} [SI], "
            f"none negative; got {sd.tolist()}"
        )
    return torch.diag(sd.expand(d) ** 2)


def inverse_root(matrix: Tensor, used: Tensor) -> Tensor:
    """L⁻¹ of covariances L Lᵀ, `r x s x d x d`; the identity in rows that are not `used` (`r x s`, bool)."""
    d = matrix.shape[-1]
    unit = torch.eye(d, dtype=matrix.dtype, device=matrix.device)
    factor, info = torch.linalg.cholesky_ex(torch.where(used[..., None, None], matrix, unit))
    # Roundoff can leave the factor of a singular matrix a tiny pivot in place of none.
    pivot = factor.diagonal(dim1=-2, dim2=-1)
    spoilt = (info > 0) | (pivot <= 1e-9 * matrix.diagonal(dim1=-2, dim2=-1).abs().sqrt()).any(-1) & used
    if bool(spoilt.any()):
        row = int(torch.nonzero(spoilt)[0, -1]) + 1
        raise InputError(
            f"row {row}: the noise given leaves a direction of the residual without any; give joint_noise too, or a "
            "pose_noise above 0 for every coordinate"
        )
    root: Tensor = torch.linalg.solve_triangular(factor, unit.expand_as(factor), upper=False)
    return root


def check_finite(
    residual: Tensor,
    used: Tensor,
    given: Tensor,
    coordinates: Sequence[Coordinate],
    mechanism: str,
    channels: Sequence[str],
) -> None:
    """Name the first row, and its channel, whose residual `r x s x c` is not finite although it is used (`r x s`).

    Args:
        given: what the kinematics were solved for, `r x s x …`, with its coordinates.
        channels: names of the `c` columns.
    """
    lost = torch.nonzero(~torch.isfinite(residual) & used[..., None])
    if not len(lost):
        return
    machine, row, channel = (int(i) for i in lost[0])
    many = len(torch.unique(lost[:, 1]))
    values = given[machine if len(given) > 1 else 0, row].tolist()
    where = ", ".join(f"{c.name} = {v:.6g} {c.unit}" for c, v in zip(coordinates, values, strict=True))
    place = f"row {row + 1}" + (f" of machine {machine + 1}" if len(given) > 1 else "")
    raise InputError(
        f"{place}: {mechanism} with its starting geometry is out of reach at {where}: {channels[channel]} has no "
        f"solution ({many} {'row' if many == 1 else 'rows'} so in all); check units, frame and starting values, or "
        "leave the row out"
    )


# Structure is read at points this many plausible errors off, so that what is zero by chance at a nominal zero shows.
_PROBES, _AWAY = 4, 0.1


def dependence(
    gap: Callable[..., Tensor], start: Tensor, scale: Tensor, data: tuple[Tensor, ...], used: Tensor, entries: int
) -> Tensor:
    """Which entries of a row depend on which parameters, in the rows of one machine: `c x k`, bool.

    Args:
        gap: `(values, *data)` -> `… x c`.
        start, scale: `k` [SI].
        data: `s x …` each.
        used: `s`, bool: rows that count.
        entries: `c`.
    """
    generator = torch.Generator().manual_seed(0)
    draw = torch.randn(_PROBES, 1, len(start), generator=generator, dtype=torch.float64).to(start.device)
    points = (start + _AWAY * scale * draw).expand(_PROBES, len(used), -1)
    slope = row_jacobian(gap, points, tuple(d.expand(_PROBES, *d.shape) for d in data), entries)[1]
    known = used[:, None, None] & torch.isfinite(slope)
    size = (torch.where(known, slope, 0.0).abs() * scale).flatten(0, 1).amax(0)
    # Rounding in an iterative solution is no dependence.
    return size > 1e-9 * size.max()


def entries_together(moved: Tensor) -> list[list[int]]:
    """Entries in groups that share no parameter, greedily; moved: `c x k`, bool."""
    groups: list[list[int]] = []
    for i in range(len(moved)):
        fits = (g for g in groups if not bool((moved[g].any(0) & moved[i]).any()))
        group = next(fits, None)
        if group is None:
            groups.append([i])
        else:
            group.append(i)
    return groups


class WhitenedResidual:
    """The residual L⁻¹ gap of a row, or its entries over their standard deviations; the factor is the last of the data.

    `jacobian` gives what differentiating the residual would, with a backward pass for each group of entries that share
    no parameter in place of one for each entry.
    """

    def __init__(self, gap: Callable[..., Tensor], entries: int, kept: list[int], factor: str, moved: Tensor) -> None:
        """factor: `full` (`c x c`, flat), `diagonal` (one for each kept entry) or `none`; moved: `c x k`, bool."""
        self.gap = gap
        self.entries = entries
        self.kept = kept
        self.factor = factor
        self.groups = [g for g in ([i for i in g if i in kept] for g in entries_together(moved)) if g]
        # In a group, the entry that a parameter moves (any, where it moves none: its derivative is zero).
        self.owner = [torch.tensor(g, device=moved.device)[moved[g].to(torch.int8).argmax(0)] for g in self.groups]
        self.sparse = len(self.groups) < len(kept)
        self.whole = self.groups == [list(range(entries))]

    def __call__(self, values: Tensor, *data: Tensor) -> Tensor:
        difference = self.gap(values, *(data if self.factor == "none" else data[:-1]))
        return self._weighted(difference, data)

    def _weighted(self, difference: Tensor, data: tuple[Tensor, ...]) -> Tensor:
        if self.factor == "full":
            root = data[-1].reshape(*data[-1].shape[:-1], self.entries, self.entries)
            return (root * difference[..., None, :]).sum(-1)
        if len(self.kept) < self.entries:
            difference = difference[..., self.kept]
        return difference if self.factor == "none" else difference * data[-1]

    def jacobian(self, values: Tensor, data: tuple[Tensor, ...]) -> tuple[Tensor, Tensor]:
        """Residual `… x c` and Jacobian `… x c x k` of every row; values `… x k`."""
        if not self.sparse:
            return row_jacobian(self, values, data, len(self.kept))
        point = values.detach().clone().requires_grad_()
        with torch.enable_grad():
            difference = self.gap(point, *(data if self.factor == "none" else data[:-1]))
            sums = [difference.sum()] if self.whole else [difference[..., g].sum() for g in self.groups]
        slope: Tensor | None = None
        for i, owner in enumerate(self.owner):
            more = i + 1 < len(sums)
            part = torch.autograd.grad(sums[i], point, retain_graph=more, materialize_grads=True)[0][..., None, :]
            part = part * self._share(owner, data)
            slope = part if slope is None else slope + part
        difference = difference.detach()
        value = self._weighted(difference, data)
        return value, value.new_zeros(*value.shape, values.shape[-1]) if slope is None else slope

    def _share(self, owner: Tensor, data: tuple[Tensor, ...]) -> Tensor:
        """How far the entry that a parameter moves goes into each channel, `… x c x k`."""
        if self.factor == "full":
            root = data[-1].reshape(*data[-1].shape[:-1], self.entries, self.entries)
            return root.index_select(-1, owner)
        own = owner == torch.tensor(self.kept, device=owner.device)[:, None]
        return own if self.factor == "none" else own * data[-1][..., None]


class Geometry:
    """The whole geometry from the free values, as cheaply as the choice allows."""

    def __init__(self, selection: Selection, rows: int) -> None:
        spread, fixed = selection.spread, selection.fixed
        square = spread.shape[0] == spread.shape[1]
        self._spread = None if square and bool((spread == torch.eye(len(spread)).to(spread)).all()) else spread
        self._fixed = fixed[0]
        apart = len(fixed) > 1 and bool((fixed != fixed[:1]).any())
        # Fixed parameters that differ between machines travel with the rows; a problem knows no other way.
        self.data: tuple[Tensor, ...] = (fixed[:, None].expand(-1, rows, -1),) if apart else ()

    def __call__(self, values: Tensor, *data: Tensor) -> Tensor:
        """`… x K` from values `… x k` and `self.data`, a row each."""
        if self._spread is None:
            return values
        return values @ self._spread + (data[0] if data else self._fixed)


def whitened_problem(
    gap: Callable[..., Tensor],
    data: tuple[Tensor, ...],
    covariance: Tensor | None,
    rows: MeasuredRows,
    selection: Selection,
    names: Sequence[str],
    what: str,
    noise_known: bool,
    per_leg: bool = False,
    seen: Tensor | None = None,
) -> Problem:
    """The problem with the residual L⁻¹ gap, L Lᵀ being the noise of a row.

    Args:
        gap: `(values, *data)` -> `… x c` [SI].
        data: `r x s x …`.
        covariance: of a row's gap, broadcasts to `r x s x c x c`; None leaves the gap as it is.
        names: of the `c` entries.
        what: what the entries are, for messages.
        noise_known: whether the covariance is the noise itself or only its proportions.
        per_leg: divide by the diagonal alone, and leave out entries that no free parameter moves.
        seen: which entries were measured, `r x s x c` bool, where the gap is 0 in the others; all when None.
    """
    if not noise_known and bool(torch.isfinite(selection.prior_sd).any()):
        raise InputError("parameters.prior: a prior can be weighed against the rows only if their noise is given")
    begin = selection.start.expand(len(rows.weights), -1)
    c = len(names)
    moved = dependence(gap, begin[0], selection.scale, tuple(d[0] for d in data), rows.weights[0] > 0, c)
    kept = [i for i in range(c) if bool(moved[i].any())] if per_leg else list(range(c))
    if not bool(moved.any()):
        free = ", ".join(p.name for p in selection.parameters)
        raise InputError(f"parameters.free: no {what} depends on {free}; free others")
    diagonal = covariance is None or per_leg or bool((covariance == _only_diagonal(covariance)).all())
    whiten: tuple[Tensor, ...] = ()
    if covariance is not None and seen is not None:
        # What was not measured is independent of the rest, so that this is decorrelated alone.
        both = seen[..., None] & seen[..., None, :]
        covariance = torch.where(both, covariance, torch.eye(c, dtype=torch.float64))
    if covariance is not None:
        covariance = covariance.expand(1, rows.pose.shape[1], c, c) if covariance.dim() < 4 else covariance
        root = _shared(inverse_root(_only_diagonal(covariance) if diagonal else covariance, rows.weights > 0))
        whiten = (root.diagonal(dim1=-2, dim2=-1)[..., kept] if diagonal else root.flatten(-2),)

    factor = "none" if covariance is None else "diagonal" if diagonal else "full"
    problem = Problem(
        parameters=selection.parameters,
        start=begin,
        scale=selection.scale,
        prior_sd=selection.prior_sd,
        residual=WhitenedResidual(gap, c, kept, factor, moved),
        data=(*data, *whiten),
        weights=rows.weights,
        channels=tuple(Channel(names[i], _leg(selection.parameters, moved[i]) if diagonal else None) for i in kept),
        noise_known=noise_known,
        missing=None if seen is None else (~seen).sum(-1),
    )
    check_equations(problem)
    return problem


def _only_diagonal(matrix: Tensor) -> Tensor:
    return torch.diag_embed(matrix.diagonal(dim1=-2, dim2=-1))


def _leg(parameters: Sequence[Parameter], moved: Tensor) -> int | None:
    legs = {p.leg for p, m in zip(parameters, moved.tolist(), strict=True) if m}
    return legs.pop() if len(legs) == 1 else None


def _shared(table: Tensor) -> Tensor:
    """One copy where all machines have the same."""
    return table[:1] if len(table) > 1 and bool((table == table[:1]).all()) else table
