"""Identified link parameters of a serial arm as a deviation of its joints, in operators that every export has."""

from __future__ import annotations

import json
import math
from typing import Any

import torch
from torch import Tensor, nn

from ccnn_torch.mechanisms import SerialArm
from ccnn_torch.numerics.rotations import rotation_vector_to_matrix

# In a redundant arm the joints are not determined by the pose; so much damping [m per joint unit] always keeps the
# normal equations regular, and leaves out less than 1e-4 of what a lever of 0.1 m corrects.
_LEAST_DAMPING = 1e-3
_STEPS = 2
# Cosines of a right angle and their products with lengths: rounding [1 or m], and as zeros they cost nothing.
_NOTHING = 1e-15


class SerialGeometry(nn.Module):
    """Joint deviation with which the nominal arm has the pose of the identified arm: δ(q) = g(f(q)) - q.

    f is the identified forward kinematics, g the nominal inverse kinematics: here two damped Gauss-Newton steps from q
    that share the Jacobian at q, which the deviation (milliradians) changes by thousandths. Near a singularity the
    damping bounds δ. Only sums, products, quotients, sines and cosines: no solver is called and no arc function, so
    that the graph runs in ONNX Runtime in double. A command evaluates this half a dozen times, hence the few
    operations: each link is `cos q C + sin q S + D` with constant matrices, base and tool folded in, and a joint moves
    what is behind it about a screw that is constant in its own link.

    Attributes:
        nominal, identified: all parameters of the arm, frames included, `... x k` [SI].
        extrapolates: what is true of the links is true outside the domain of the training rows as well.
        export_tolerance: share of the limit to which exports agree: differences of lengths near 1 m are rounded.
    """

    extrapolates = True
    export_tolerance = 1e-9
    nominal: Tensor
    identified: Tensor
    _nominal_links: Tensor
    _identified_links: Tensor
    _slides: Tensor
    _turns: Tensor
    _spins: Tensor
    _shifts: Tensor
    _weight: Tensor
    _damped: Tensor
    _unit: Tensor

    def __init__(
        self, arm: SerialArm, nominal: Tensor, identified: Tensor, rotation_weight: float = 0.04, damping: float = 0.01
    ) -> None:
        """Take the two geometries.

        Args:
            nominal: parameters whose links are the maker's and whose frames were fitted to them, `... x k` [SI].
            identified: parameters with links and frames fitted together, `... x k` [SI].
            rotation_weight: of orientation against position [m/rad].
            damping: directions in which a joint moves the tool less than this are held back [m per joint unit]; at
                least 1e-3.
        """
        super().__init__()
        # In a tuple, since the arm's own buffers are no part of the model.
        self._arm = (arm,)
        self._turned = arm.orientation != "none"
        self.rotation_weight, self.damping = rotation_weight, damping
        # All of them follow from the description.
        weight = torch.ones(6 if self._turned else 3, dtype=torch.float64)
        weight[3:] = rotation_weight
        unit = torch.eye(len(arm.joints), dtype=torch.float64)
        links = _links(arm, nominal.detach())
        spins, shifts = _screws(links)
        for name, value in {
            "nominal": nominal.detach().clone(),
            "identified": identified.detach().clone(),
            "_nominal_links": links,
            "_spins": spins,
            "_shifts": shifts,
            "_identified_links": _links(arm, identified.detach()),
            "_slides": (~arm.revolute).to(torch.float64),
            "_turns": arm.revolute.to(torch.float64),
            "_weight": weight,
            "_damped": max(damping, _LEAST_DAMPING) ** 2 * unit,
            "_unit": unit,
        }.items():
            self.register_buffer(name, value, persistent=False)

    def forward(self, joints: Tensor) -> Tensor:
        """joints: commanded, `... x n` [SI]; returns δ, `... x n` [SI]."""
        moved = self._moved(joints)
        wanted = _chain(_placed(moved, self._identified_links))[-1]
        placed = _chain(_placed(moved, self._nominal_links))
        slope = self._slope(placed)
        inverse = _inverse(slope @ slope.mT + self._damped, self._unit)

        def step(here: Tensor) -> Tensor:
            gap = wanted[..., :3, 3] - here[..., :3, 3]
            if self._turned:
                gap = torch.cat([gap, _axis(wanted[..., :3, :3] @ here[..., :3, :3].mT)], dim=-1)
            return (inverse @ (slope @ (self._weight * gap)[..., None]))[..., 0]

        deviation = step(placed[-1])
        for _ in range(_STEPS - 1):
            deviation = deviation + step(_chain(_placed(self._moved(joints + deviation), self._nominal_links))[-1])
        return deviation

    def repeat(self, index: int) -> SerialGeometry:
        """The deviation of one repeat of parameters `r x 1 x k`, which `describe` can write."""
        own = (self.nominal[index, 0], self.identified[index, 0])
        return SerialGeometry(self._arm[0], *own, self.rotation_weight, self.damping)

    def identified_arm(self) -> SerialArm:
        """The arm with the identified parameters as its nominal ones."""
        arm = SerialArm(**self._arm[0].recipe["keys"])
        arm.set_parameters(dict(zip((p.name for p in arm.geometry), self.identified.tolist(), strict=True)))
        return arm

    def describe(self) -> dict[str, Any]:
        """Everything `from_description` needs."""
        return {
            "kind": "serial_geometry",
            "arm": json.loads(json.dumps(self._arm[0].recipe["keys"])),
            "parameters": [parameter.name for parameter in self._arm[0].geometry],
            "nominal": self.nominal.tolist(),
            "identified": self.identified.tolist(),
            "rotation_weight": self.rotation_weight,
            "damping": self.damping,
        }

    @classmethod
    def from_description(cls, description: dict[str, Any]) -> SerialGeometry:
        """The module as it was described, bit by bit."""
        nominal, identified = (torch.tensor(description[k], dtype=torch.float64) for k in ("nominal", "identified"))
        arm = SerialArm(**description["arm"])
        return cls(arm, nominal, identified, description["rotation_weight"], description["damping"])

    def _moved(self, joints: Tensor) -> tuple[Tensor, Tensor]:
        """Cosines, and sines of revolute joints and prismatic joints themselves, `... x n`."""
        return torch.cos(joints) * self._turns, torch.sin(joints) * self._turns + joints * self._slides

    def _slope(self, placed: list[Tensor]) -> Tensor:
        """Jacobian of the nominal arm with its columns weighted, transposed, `... x n x c`.

        Args:
            placed: transforms of the links' ends, as `_chain` gives them.
        """
        links = torch.stack(placed, dim=-3)
        rotations, lever = links[..., :3, :3], placed[-1][..., None, :3, 3] - links[..., :3, 3]
        spins = (rotations @ self._spins)[..., 0]
        shifts = (rotations @ self._shifts)[..., 0]
        columns = shifts + _cross(spins, lever)
        if self._turned:
            columns = torch.cat([columns, spins], dim=-1)
        return columns * self._weight


def _links(arm: SerialArm, values: Tensor) -> Tensor:
    """`cos q`, `sin q` (or q of a prismatic joint) and constant part of every link's transform, `3 x ... x n x 4 x 4`.

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
    base = _homogeneous(rotation_vector_to_matrix(values[..., 3:6]), values[..., :3])
    tool = _homogeneous(rotation_vector_to_matrix(values[..., -3:]), values[..., -6:-3])
    links[..., 0, :, :] = base @ links[..., 0, :, :]
    links[..., -1, :, :] = links[..., -1, :, :] @ tool
    return torch.where(links.abs() < _NOTHING, 0.0, links)


def _screws(links: Tensor) -> tuple[Tensor, Tensor]:
    """What each joint does to what is behind it, in the frame of its own link's end: rotation and velocity of the
    frame's origin per joint unit, `... x n x 3 x 1` each, from links `3 x ... x n x 4 x 4`.

    A link is `K Rot(q) L` or `K Shift(q) L` with constant K and L, so that its derivative is the link times a constant.
    """
    rate = torch.linalg.solve(links[0] + links[2], links[1])
    rate = torch.where(rate.abs() < _NOTHING, 0.0, rate)
    return _axis(rate[..., :3, :3])[..., None], rate[..., :3, 3:]


def _homogeneous(rotation: Tensor, translation: Tensor) -> Tensor:
    """`... x 4 x 4` of a rotation `... x 3 x 3` and a translation `... x 3`."""
    whole = rotation.new_zeros(*rotation.shape[:-2], 4, 4)
    whole[..., :3, :3], whole[..., :3, 3], whole[..., 3, 3] = rotation, translation, 1.0
    return whole


def _placed(moved: tuple[Tensor, Tensor], links: Tensor) -> Tensor:
    """Transforms of the links, `... x n x 4 x 4`; links `3 x ... x n x 4 x 4`."""
    turned, other = moved
    return turned[..., None, None] * links[0] + other[..., None, None] * links[1] + links[2]


def _chain(moved: Tensor) -> list[Tensor]:
    """Products of the first, the first two, … of `... x n x 4 x 4`."""
    links = moved.unbind(-3)
    products = [links[0]]
    for link in links[1:]:
        products.append(products[-1] @ link)
    return products


def _axis(turn: Tensor) -> Tensor:
    """Vector of the skew part of `... x 3 x 3`, `... x 3`: of a small rotation its vector, to the third order of the
    angle; of a rate of rotation the rate."""
    half = (turn - turn.mT) / 2
    return torch.stack([half[..., 2, 1], half[..., 0, 2], half[..., 1, 0]], dim=-1)


def _cross(a: Tensor, b: Tensor) -> Tensor:
    """Cross product of `... x 3`, without an operation that a file lacks."""
    next_, last = [1, 2, 0], [2, 0, 1]
    return a[..., next_] * b[..., last] - a[..., last] * b[..., next_]


def _inverse(matrix: Tensor, unit: Tensor) -> Tensor:
    """Gauss-Jordan without pivoting, unrolled: the matrix `... x n x n` is positive definite."""
    table = torch.cat([matrix, unit.expand_as(matrix)], dim=-1)
    count = matrix.shape[-1]
    for k in range(count):
        row = table[..., k : k + 1, :] / table[..., k : k + 1, k : k + 1]
        table = table - (table[..., :, k : k + 1] - unit[:, k : k + 1]) * row
    return table[..., count:]
