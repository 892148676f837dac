"""Derivatives of a simulator by central differences, all perturbations stacked in one call."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from ccnn_torch.errors import InputError
from ccnn_torch.mechanisms.pose import frame_jacobian
from ccnn_torch.numerics.rotations import matrix_to_rotation_vector

if TYPE_CHECKING:
    from ccnn_torch.mechanisms.simulators.black_box import BlackBox


def central_slope(
    machine: BlackBox,
    pose: Callable[[Tensor], Tensor],
    point: Tensor,
    step: Tensor,
    places: Sequence[str],
    bounds: tuple[Tensor, Tensor] | None = None,
) -> Tensor:
    """Derivative of position and rotation vector, `... x c x d`; one-sided at a bound and beside a row without a pose.

    Args:
        machine: whose frame counts.
        pose: `... x d` -> `... x p`, with further leading dims.
        point: `... x d`.
        step: of each coordinate, `d`.
        bounds: what they cannot pass, `d` each.
    """
    ahead = torch.diag(step).reshape(len(step), *[1] * (point.dim() - 1), len(step))
    if bounds is not None:
        point = torch.minimum(torch.maximum(point, bounds[0]), bounds[1])
    ends = torch.stack([point + ahead, point - ahead])
    if bounds is not None:
        ends = torch.minimum(torch.maximum(ends, bounds[0]), bounds[1])
    found = pose(ends)
    lost = ~torch.isfinite(found).all(-1)
    if bool(lost.any()):
        here = pose(point)
        _check_neighbours(machine, ends, lost.all(0) & torch.isfinite(here).all(-1), places)
        ends = torch.where(lost[..., None], point, ends)
        found = torch.where(lost[..., None], here, found)
    way = (ends[0] - ends[1]).sum(-1, keepdim=True)
    first, second = machine.frame(found[0]), machine.frame(found[1])
    change = first[0] - second[0]
    if first[1] is not None and second[1] is not None:
        change = torch.cat([change, matrix_to_rotation_vector(first[1] @ second[1].mT)], -1)
    # Where both ends are the point itself there is no way to go, and no change.
    return (change / torch.where(way == 0, 1.0, way)).movedim(0, -1)


def _check_neighbours(machine: BlackBox, ends: Tensor, nowhere: Tensor, places: Sequence[str]) -> None:
    if not bool(nowhere.any()):
        return
    k, *row = torch.nonzero(nowhere)[0].tolist()
    high, low = ends[(slice(None), k, *row, k)].tolist()
    raise InputError(
        f"simulator '{machine.name}' returns NaN with {places[k]} = {high:.6g} and {low:.6g}, and a pose between them "
        f"(row {row[-1] if row else 0}); let it take these values, or give a parameter another scale, or low and high"
    )


def differentiable_pose(machine: BlackBox, joints: Tensor, values: Tensor) -> Tensor:
    """Pose `... x p` of joints `... x n` and parameters `... x k`, with the differences as its first derivative."""
    found: Tensor = _Pose.apply(joints, values, machine)  # type: ignore[no-untyped-call]
    return found


class _Pose(torch.autograd.Function):
    @staticmethod
    def forward(joints: Tensor, values: Tensor, machine: BlackBox) -> Tensor:
        return machine.simulated(joints, values)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
        joints, values, ctx.machine = inputs
        ctx.save_for_backward(joints, values, output)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, Tensor | None, None]:
        joints, values, pose = ctx.saved_tensors
        parts: list[Tensor | None] = []
        for which, point in enumerate((joints, values)):
            if not ctx.needs_input_grad[which] or point.shape[-1] == 0:
                parts.append(None)
                continue
            # By a function of its own: a transform may have wrapped the tensors here, and a simulator wants plain ones.
            slope = _Slope.apply(joints, values, pose, ctx.machine, which)  # type: ignore[no-untyped-call]
            parts.append((gradient.unsqueeze(-2) @ slope).squeeze(-2).sum_to_size(point.shape))
        return parts[0], parts[1], None


class _Slope(torch.autograd.Function):
    """Derivative of the pose coordinates, `... x p x d`: of the frame by differences, and back to the coordinates."""

    @staticmethod
    def forward(joints: Tensor, values: Tensor, pose: Tensor, machine: BlackBox, which: int) -> Tensor:
        slope = (machine.parameter_jacobian if which else machine.jacobian)(joints, values)
        rows = frame_jacobian(machine.frame, torch.nan_to_num(pose)).detach()
        back: Tensor = torch.linalg.pinv(rows) @ slope
        return back

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
        ctx.mark_non_differentiable(output)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[None, ...]:
        return None, None, None, None, None
