"""Where a camera stands to a board, from the corners of each image: linear estimates to start from.

Planar boards by the homography (Zhang 2000), others by the direct linear transform (Hartley and Zisserman 2004,
sections 4.1 and 7.1).
"""

from __future__ import annotations

import torch
from torch import Tensor

from ccnn_torch.errors import InputError
from ccnn_torch.numerics.rotations import matrix_to_rotation_vector, nearest_rotation

# A board whose corners leave their plane by less than this share of its size is flat.
_FLAT = 1e-3


def board_poses(joints: Tensor, image: Tensor, corners: Tensor, on_hand: bool) -> tuple[Tensor, Tensor]:
    """Pose of the camera in the board's frame (on the hand) or of the board in the camera's, of each image.

    Args:
        joints: `s x n` [SI]; rows with the same joints are of one image.
        image: where the corner is seen, x/z and y/z in the camera's frame, `s x 2` [1].
        corners: on the board, `s x 3` [m].

    Returns:
        Joints of the images `t x n` [SI], and poses `t x 6`: position [m] and rotation vector [rad].

    Raises:
        InputError: fewer than three images show enough corners.
    """
    stands, number = torch.unique(joints, dim=0, return_inverse=True)
    middle = corners.mean(0)
    spread, axes = torch.linalg.svd(corners - middle, full_matrices=True)[1:]
    flat = len(spread) < 3 or bool(spread[2] <= _FLAT * spread[0])
    if float(torch.linalg.det(axes)) < 0:
        axes = axes * torch.tensor([[1.0], [1.0], [-1.0]], dtype=axes.dtype)
    # In the board's own axes, whose z is its normal where it is flat.
    local = (corners - middle) @ axes.mT
    needed = 4 if flat else 6
    found, kept = [], []
    for i in range(len(stands)):
        mine = number == i
        if int(mine.sum()) < needed:
            continue
        seen = local[mine, :2] if flat else local[mine]
        rotation, place = _from_projection(_projection(seen, image[mine]), flat)
        rotation = rotation @ axes
        place = place - rotation @ middle
        if on_hand:
            rotation, place = rotation.mT, -rotation.mT @ place
        found.append(torch.cat([place, matrix_to_rotation_vector(rotation)]))
        kept.append(i)
    if len(found) < 3:
        raise InputError(
            f"{len(found)} of {len(stands)} images show {needed} corners or more of the board; at least 3 are needed "
            "to find where it stands (rows of one image have the same joints)"
        )
    return stands[kept], torch.stack(found)


def _projection(points: Tensor, image: Tensor) -> Tensor:
    """The matrix P with image ~ P (points, 1), by the direct linear transform, `3 x (d + 1)`."""
    size = points.square().mean().sqrt()
    whole = torch.cat([points / size, torch.ones_like(points[:, :1])], -1)
    zero = torch.zeros_like(whole)
    u, v = image[:, :1], image[:, 1:]
    rows = torch.cat([torch.cat([whole, zero, -u * whole], -1), torch.cat([zero, whole, -v * whole], -1)])
    last = torch.linalg.svd(rows, full_matrices=True)[2][-1].reshape(3, -1)
    found: Tensor = last / torch.cat([size.expand(points.shape[-1]), size.new_ones(1)])
    return found


def _from_projection(matrix: Tensor, flat: bool) -> tuple[Tensor, Tensor]:
    """Rotation `3 x 3` and place `3` [m] of the board in the camera's frame, in front of it."""
    scale = matrix[:, : 2 if flat else 3].norm(dim=0).mean()
    matrix = matrix / scale * torch.where(matrix[2, -1] < 0, -1.0, 1.0)
    turned = matrix[:, :-1]
    if flat:
        turned = torch.cat([turned, torch.linalg.cross(turned[:, 0], turned[:, 1])[:, None]], -1)
    return nearest_rotation(turned), matrix[:, -1]
