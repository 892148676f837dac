"""Delta robots: three legs with parallelograms, with rotary or linear drives (Clavel 1988)."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from ccnn_torch.coordinates import Coordinate, Parameter
from ccnn_torch.mechanisms.machines.closed_forms import crank_angle, meeting_point, real_sqrt
from ccnn_torch.mechanisms.mechanism import Mechanism
from ccnn_torch.numerics.batching import stack_last

_ATTACHMENTS = tuple(math.radians(a) for a in (0.0, 120.0, 240.0))


class _Parallelograms(Mechanism):
    """What both kinds share: the platform's centre is a rod's length from three points that the joints move.

    A parallelogram acts as one rod from the drive's end, moved towards the axis by the platform's radius, to the
    platform's centre. The platform hangs below the drives.
    """

    closed_form = "forward"

    def __init__(
        self,
        name: str,
        unit: str,
        leg: Sequence[tuple[str, str, float | None]],
        low: Sequence[float],
        high: Sequence[float],
        drives: Callable[[Tensor, Tensor], Tensor],
    ) -> None:
        """Name the parts.

        Args:
            unit: of the joints.
            leg: name, unit and nominal value of each parameter of a leg (None: the leg's angle); base radius and angle
                come first, platform radius, rod and offset last.
            low, high: sampling box.
            drives: from joints `... x 3` and parameters by leg `... x 3 x k` to the ends of the drives,
                `... x 3 x 3` [m].
        """
        self._drives = drives
        geometry = [
            Parameter(f"{n}{i + 1}", u, angle if v is None else v, i + 1)
            for i, angle in enumerate(_ATTACHMENTS)
            for n, u, v in leg
        ]
        super().__init__(
            name=name,
            joints=[Coordinate(q, unit) for q in ("q1", "q2", "q3")],
            pose=[Coordinate(x, "m") for x in ("x", "y", "z")],
            geometry=geometry,
            low=low,
            high=high,
        )

    def skeleton(self, pose: Tensor, joints: Tensor, parameters: Tensor | None = None) -> dict[str, Tensor]:
        """Base to drive to platform of each leg; see `Mechanism.skeleton`."""
        legs = self.resolve(parameters).reshape(3, -1)
        away = _outward(legs[:, 1])
        foot, end = legs[:, :1] * away, self._drives(joints, legs)
        corners = torch.stack([foot, end, pose + legs[:, -3:-2] * away, pose.expand(3, 3)], -2)
        return {f"leg {i + 1}": leg for i, leg in enumerate(corners)}

    def _centres(self, joints: Tensor, values: Tensor) -> tuple[Tensor, Tensor]:
        """The three points, `... x 3 x 3` [m], and the lengths of the rods, `... x 3` [m]."""
        legs = values.reshape(*values.shape[:-1], 3, -1)
        angle, platform, rod = legs[..., 1], legs[..., -3], legs[..., -2]
        return self._drives(joints, legs) - platform[..., None] * _outward(angle), rod

    def forward_kinematics(
        self, joints: Tensor, parameters: Tensor | None = None, guess: Tensor | None = None
    ) -> Tensor:
        """The lower of the two points at the rods' lengths; closed form, NaN where the rods do not meet."""
        return meeting_point(*self._centres(joints, self.resolve(parameters)), below=True)

    def reachable(self, pose: Tensor, parameters: Tensor | None = None) -> Tensor:
        """Within reach of all legs, and below the points where the rods begin; `...`, bool."""
        values = self.resolve(parameters)
        joints = self.solve_inverse(pose, values)
        first, second, third = self._centres(joints, values)[0].unbind(-2)
        normal = torch.linalg.cross(second - first, third - first, dim=-1)
        below: Tensor = ((pose - first) * normal).sum(-1) < 0
        return torch.isfinite(joints).all(-1) & below


class Delta(_Parallelograms):
    """Rotary delta robot; joints q1..q3 [rad], 0 = crank level and outward, positive = downward; pose x, y, z [m].

    z points up and is 0 in the plane of the cranks' axes, so that the platform's z is negative. Leg i has the
    parameters basei (radius of the crank's axis), anglei (of the leg's plane, from +x), cranki, platformi (radius of
    the platform's joint), rodi (length of the parallelogram) and offseti (the crank is at the joint plus this).
    Base and platform radius of a leg act only by their difference: an identification reports this, or one of them is
    fixed.
    """

    def __init__(self, base: float = 0.2, crank: float = 0.25, platform: float = 0.05, rod: float = 0.55) -> None:
        """Radii of base and platform, lengths of cranks and rods [m].

        The sampling box begins below where all cranks are level, and goes by their length: ±0.6 of it in x and y, 0.8
        of it in z (by the default dimensions ±0.15 m, -0.6..-0.4 m).
        """
        level = math.sqrt(max(rod**2 - (base + crank - platform) ** 2, 0.0))
        wide, top, bottom = (round(v, 3) for v in (0.6 * crank, -level - 0.09 * crank, -level - 0.89 * crank))
        super().__init__(
            name="delta",
            unit="rad",
            leg=[
                ("base", "m", base),
                ("angle", "rad", None),
                ("crank", "m", crank),
                ("platform", "m", platform),
                ("rod", "m", rod),
                ("offset", "rad", 0.0),
            ],
            low=(-wide, -wide, bottom),
            high=(wide, wide, top),
            drives=_crank_ends,
        )

    def solve_inverse(self, pose: Tensor, parameters: Tensor | None = None, guess: Tensor | None = None) -> Tensor:
        """Closed form, cranks outward; NaN out of reach of a leg."""
        values = self.resolve(parameters)
        base, angle, crank, platform, rod, offset = _legs(values)
        radial, aside, up = _in_leg(pose, angle)
        out = radial + platform - base
        constant = out**2 + aside**2 + up**2 + crank**2 - rod**2
        # The direction is taken with the crank's angle upward, which does not jump while the platform hangs below.
        return -crank_angle(-2 * crank * out, -2 * crank * up, constant, _OUTWARD) - offset


class DeltaLinear(_Parallelograms):
    """Linear delta robot; joints q1..q3 [m], height of the carriages along their rails; pose x, y, z [m].

    z points up and is 0 where the rails begin; the platform hangs below the carriages. Leg i has the parameters basei
    (radius where the rail begins), anglei (of the leg's plane, from +x), leani and skewi (of the rail: outward in the
    leg's plane, and out of that plane; 0 = upright), platformi (radius of the platform's joint), rodi (length of the
    parallelogram) and offseti (the carriage is at the joint plus this). Base and platform radius of a leg act only
    by their difference.
    """

    def __init__(self, base: float = 0.3, platform: float = 0.05, rod: float = 0.6, lean: float = 0.0) -> None:
        """Radii of base and platform, length of the rods [m]; lean of the rails [rad], 0 = upright.

        The sampling box is x, y ±0.15, z 0..0.3 m.
        """
        super().__init__(
            name="delta_linear",
            unit="m",
            leg=[
                ("base", "m", base),
                ("angle", "rad", None),
                ("lean", "rad", lean),
                ("skew", "rad", 0.0),
                ("platform", "m", platform),
                ("rod", "m", rod),
                ("offset", "m", 0.0),
            ],
            low=(-0.15, -0.15, 0.0),
            high=(0.15, 0.15, 0.3),
            drives=_carriages,
        )

    def solve_inverse(self, pose: Tensor, parameters: Tensor | None = None, guess: Tensor | None = None) -> Tensor:
        """Closed form, carriages above the platform; NaN out of reach of a leg."""
        values = self.resolve(parameters)
        base, angle, lean, skew, platform, rod, offset = _legs(values)
        radial, aside, up = _in_leg(pose, angle)
        joint = stack_last(radial + platform - base, aside, up)
        along = (joint * _rail(lean, skew)).sum(-1)
        above, real = real_sqrt(along**2 - (joint**2).sum(-1) + rod**2)
        return torch.where(real, along + above - offset, torch.nan)


# Of the two solutions for a crank, the one that puts its end outward.
_OUTWARD = -1.0


def _legs(values: Tensor) -> tuple[Tensor, ...]:
    """The parameters by kind, `... x 3` each."""
    return values.reshape(*values.shape[:-1], 3, -1).unbind(-1)


def _outward(angle: Tensor) -> Tensor:
    """Level direction of a leg's plane, `... x 3`."""
    return stack_last(torch.cos(angle), torch.sin(angle), torch.zeros_like(angle))


def _in_leg(pose: Tensor, angle: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Position in the axes of each leg, outward, sideways and up: `... x 3` each [m]."""
    x, y, z = (c[..., None] for c in pose.unbind(-1))
    s, c = torch.sin(angle), torch.cos(angle)
    return x * c + y * s, y * c - x * s, z


def _from_leg(outward: Tensor, aside: Tensor, up: Tensor, angle: Tensor) -> Tensor:
    """Inverse of `_in_leg`, `... x 3 x 3` [m]."""
    s, c = torch.sin(angle), torch.cos(angle)
    return stack_last(outward * c - aside * s, outward * s + aside * c, up)


def _rail(lean: Tensor, skew: Tensor) -> Tensor:
    """Direction of a rail in the axes of its leg, `... x 3`."""
    return stack_last(torch.sin(lean) * torch.cos(skew), torch.sin(skew), torch.cos(lean) * torch.cos(skew))


def _crank_ends(joints: Tensor, legs: Tensor) -> Tensor:
    """Ends of the cranks, `... x 3 x 3` [m]."""
    base, angle, crank, _, _, offset = legs.unbind(-1)
    turned = joints + offset
    return _from_leg(base + crank * torch.cos(turned), torch.zeros_like(base), -crank * torch.sin(turned), angle)


def _carriages(joints: Tensor, legs: Tensor) -> Tensor:
    """Joints on the carriages, `... x 3 x 3` [m]."""
    base, angle, lean, skew, _, _, offset = legs.unbind(-1)
    outward, aside, up = ((joints + offset)[..., None] * _rail(lean, skew)).unbind(-1)
    return _from_leg(base + outward, aside, up, angle)
