"""Forward kinematics of a serial arm and their derivative, in operators that every export has.

No solver is called and no arc function, so that the graph runs in ONNX Runtime in double. Each link is
`cos q C + sin q S + D` with constant matrices, base and tool folded in, and a joint moves what is behind it about a
screw that is constant in its own link.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from ccnn_torch.compensation.geometry.matrices import cross, skew_vector
from ccnn_torch.compensation.machine.forward import Placed
from ccnn_torch.mechanisms import Mechanism, SerialArm
from ccnn_torch.numerics.rotations import rotation_vector_to_matrix

# Cosines of a right angle and their products with lengths: rounding [1 or m], and as zeros they cost nothing.
_NOTHING = 1e-15


class Links(nn.Module):
    """One geometry of an arm: where its tool is, and how the joints move it."""

    _links: Tensor
    _spins: Tensor
    _shifts: Tensor
    _slides: Tensor
    _turns: Tensor

    def __init__(self, arm: Mechanism, values: Tensor) -> None:
        """values: all parameters, frames included, `k` [SI]."""
        super().__init__()
        assert isinstance(arm, SerialArm)
        self._turned = arm.orientation != "none"
        links = _links(arm, values.detach())
        spins, shifts = _screws(links)
        for name, value in {
            "_links": links,
            "_spins": spins,
            "_shifts": shifts,
            "_slides": (~arm.revolute).to(torch.float64),
            "_turns": arm.revolute.to(torch.float64),
        }.items():
            self.register_buffer(name, value, persistent=False)

    def at(self, joints: Tensor) -> Placed:
        """At joints `... x n` [SI]."""
        turned, other = torch.cos(joints) * self._turns, torch.sin(joints) * self._turns + joints * self._slides
        moved = turned[..., None, None] * self._links[0] + other[..., None, None] * self._links[1] + self._links[2]
        chain = [moved[..., 0, :, :]]
        for link in moved.unbind(-3)[1:]:
            chain.append(chain[-1] @ link)
        ends = torch.stack(chain, dim=-3)
        rotations, lever = ends[..., :3, :3], chain[-1][..., None, :3, 3] - ends[..., :3, 3]
        spins = (rotations @ self._spins)[..., 0]
        linear = (rotations @ self._shifts)[..., 0] + cross(spins, lever)
        rotation = chain[-1][..., :3, :3] if self._turned else None
        return Placed(chain[-1][..., :3, 3], rotation, linear, spins)


def _links(arm: SerialArm, values: Tensor) -> Tensor:
    """`cos q`, `sin q` (or q of a prismatic joint) and constant part of every link's transform, `3 x n x 4 x 4`.

    The base comes before the first link and the tool after the last one.
    """

    def at(q: float) -> Tensor:
        joints = torch.full((len(arm.joints),), q, dtype=torch.float64)
        return _homogeneous(*arm.link_transforms(joints, values))

    zero, quarter, half = at(0.0), at(math.pi / 2), at(math.pi)
    turns = arm.revolute[:, None, None]
    constant = torch.where(turns, (zero + half) / 2, zero)
    cosine = torch.where(turns, (zero - half) / 2, 0.0)
    other = torch.where(turns, quarter - constant, (half - zero) / math.pi)
    links = torch.stack([cosine, other, constant])
    base = _homogeneous(rotation_vector_to_matrix(values[3:6]), values[:3])
    tool = _homogeneous(rotation_vector_to_matrix(values[-3:]), values[-6:-3])
    links[:, 0] = base @ links[:, 0]
    links[:, -1] = links[:, -1] @ tool
    return torch.where(links.abs() < _NOTHING, 0.0, links)


def _screws(links: Tensor) -> tuple[Tensor, Tensor]:
    """What each joint does to what is behind it, in the frame of its own link's end: rotation and velocity of the
    frame's origin per joint unit, `n x 3 x 1` each, from links `3 x n x 4 x 4`.

    A link is `K Rot(q) L` or `K Shift(q) L` with constant K and L, so that its derivative is the link times a constant.
    """
    rate = torch.linalg.solve(links[0] + links[2], links[1])
    rate = torch.where(rate.abs() < _NOTHING, 0.0, rate)
    return skew_vector(rate[..., :3, :3])[..., None], rate[..., :3, 3:]


def _homogeneous(rotation: Tensor, translation: Tensor) -> Tensor:
    """`... x 4 x 4` of a rotation `... x 3 x 3` and a translation `... x 3`."""
    whole = rotation.new_zeros(*rotation.shape[:-2], 4, 4)
    whole[..., :3, :3], whole[..., :3, 3], whole[..., 3, 3] = rotation, translation, 1.0
    return whole
