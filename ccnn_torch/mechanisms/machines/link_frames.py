"""Link transforms of serial chains, in closed form, all joints at once."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from ccnn_torch.numerics.batching import stack_last
from ccnn_torch.numerics.rotations import euler_zyx_to_matrix, rotation_vector_to_matrix

LinkTransform = Callable[[Tensor, Tensor, Tensor, Tensor], tuple[Tensor, Tensor]]


def _standard(links: Tensor, turn: Tensor, slide: Tensor, axes: Tensor) -> tuple[Tensor, Tensor]:
    """Rz(q + theta) Tz(d) Tx(a) Rx(alpha) (Denavit and Hartenberg 1955); links `... x n x 4` = a, alpha, d, theta."""
    a, alpha, d, theta = links.unbind(-1)
    s, c, sa, ca = torch.sin(turn + theta), torch.cos(turn + theta), torch.sin(alpha), torch.cos(alpha)
    zero = torch.zeros_like(s)
    rotation = stack_last(c, -s * ca, s * sa, s, c * ca, -c * sa, zero, sa, ca)
    return rotation.reshape(*rotation.shape[:-1], 3, 3), stack_last(a * c, a * s, d + slide)


def _modified(links: Tensor, turn: Tensor, slide: Tensor, axes: Tensor) -> tuple[Tensor, Tensor]:
    """Rx(alpha) Tx(a) Rz(q + theta) Tz(d) (Craig 1986); links `... x n x 4` = a, alpha, d, theta."""
    a, alpha, d, theta = links.unbind(-1)
    s, c, sa, ca = torch.sin(turn + theta), torch.cos(turn + theta), torch.sin(alpha), torch.cos(alpha)
    zero = torch.zeros_like(s)
    rotation = stack_last(c, -s, zero, s * ca, c * ca, -sa, s * sa, c * sa, ca)
    return rotation.reshape(*rotation.shape[:-1], 3, 3), stack_last(a, -sa * (d + slide), ca * (d + slide))


def _origin(links: Tensor, turn: Tensor, slide: Tensor, axes: Tensor) -> tuple[Tensor, Tensor]:
    """URDF: a fixed origin, then the motion about or along an axis; links `... x n x 6` = x, y, z, roll, pitch, yaw."""
    fixed = euler_zyx_to_matrix(links[..., 3:].flip(-1))
    motion = rotation_vector_to_matrix(axes * turn[..., None])
    slid = (fixed @ (axes * slide[..., None])[..., None])[..., 0]
    return fixed @ motion, links[..., :3] + slid


# Transform, parameter names of a link, their units, and whether the joint axis is fixed in the frame before the link
# (standard DH: z of frame i - 1) or in the one behind it.
LINKS: dict[str, tuple[LinkTransform, tuple[str, ...], tuple[str, ...], bool]] = {
    "standard": (_standard, ("a", "alpha", "d", "theta"), ("m", "rad", "m", "rad"), True),
    "modified": (_modified, ("a", "alpha", "d", "theta"), ("m", "rad", "m", "rad"), False),
    "urdf": (_origin, ("x", "y", "z", "roll", "pitch", "yaw"), ("m", "m", "m", "rad", "rad", "rad"), False),
}


def compose(first: tuple[Tensor, Tensor], second: tuple[Tensor, Tensor]) -> tuple[Tensor, Tensor]:
    """Product of two transforms, each (rotation `... x 3 x 3`, translation `... x 3`)."""
    rotation, translation = first
    return rotation @ second[0], translation + (rotation @ second[1][..., None])[..., 0]
