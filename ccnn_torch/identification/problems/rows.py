"""Measured rows in one shape, and their noise: shared by both kinds of residual."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from ccnn_torch.coordinates import Coordinate
from ccnn_torch.errors import InputError
from ccnn_torch.mechanisms import Mechanism


@dataclass(frozen=True)
class MeasuredRows:
    """joints `r x s x n`, pose `r x s x p` (r = 1 where the machines share them), weights `r x s`; `r` machines."""

    joints: Tensor
    pose: Tensor
    weights: Tensor
    machines: int


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
    return MeasuredRows(q, x, w.to(torch.float64).expand(machines, -1), machines)


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
