"""Guides and bearings that shift and turn what a joint carries while it moves."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from ccnn_torch.effects.columns import TWIST, inside, twist_columns
from ccnn_torch.effects.protocol import Coefficient, Effect, Shape
from ccnn_torch.effects.situation import Situation
from ccnn_torch.mechanisms import Mechanism, SerialArm
from ccnn_torch.numerics.rotations import rotation_vector_to_matrix


class _Form(NamedTuple):
    """A form in which a motion goes along the way of a joint.

    Attributes:
        name: as coefficients name it.
        size: how large it is likely to be beside the others.
        secondary, part: as of `Coefficient`.
    """

    name: str
    size: float
    secondary: bool
    part: str


# Highest degree over a travel: of rails of 4 m screwed down every 0.6 m with some to spare. Halves and quarters of it
# have sizes of their own: how smooth a rail is, is asked of the rows.
_DEGREES = 16


def _slide(degree: int) -> _Form:
    """As large as of a path between two ends whose slope is random: the integral of P_(k-1) is f_k / (2k - 1)."""
    part = "waves" if 4 < degree <= _DEGREES // 2 else "short waves" if degree > 4 else ""
    return _Form(str(degree), 1 / math.sqrt(2 * degree - 1), degree > 2, part)


_SLIDES = tuple(_slide(degree) for degree in range(1, _DEGREES + 1))
# Bearings and rails are not made alike.
_TURNS = tuple(_Form(name, 1.0, "2" in name, "turning") for name in ("sin", "cos", "sin 2", "cos 2"))


def _along(slides: bool, at: Tensor) -> list[Tensor]:
    """The forms at places of a joint: `_SLIDES` of -1 to 1 over its travel, or `_TURNS` of its angle [rad]."""
    if not slides:
        return [torch.sin(at), torch.cos(at), torch.sin(2 * at), torch.cos(2 * at)]
    # Bonnet's recursion.
    found = [torch.ones_like(at), at]
    for k in range(2, _DEGREES + 1):
        found.append(((2 * k - 1) * at * found[-1] - (k - 1) * found[-2]) / k)
    return [at, *(one - other for one, other in zip(found[2:], found[:-2], strict=True))]


# Of machine tools as built over a metre [m], [rad] (ISO 10791-1); the rows say what it is here.
_SIZE = {"m": 1e-5, "rad": 2e-5}


class ErrorMotion(Effect):
    """Δx = Σ f_k(q) (t_k + ω_k × (x - o)), ΔR = Σ f_k(q) ω_k: error motions of axes (ISO 230-1:2012, 3.4; ISO 230-7).

    Of a sliding joint f_1 is its place in its travel, -1 to 1, and f_k = P_k - P_(k-2) of Legendre's polynomials of it,
    up to k = 16: their integrals, 0 at both ends as straightness is told. Of one that turns sin q, cos q, sin 2q and
    cos 2q: once a turn, as a bearing that runs out or an axis that wobbles, and twice. o is the origin of the frame
    that the joint carries, and t and ω are along and about that frame's axes.
    The travel is that of the machine's file, or where its rows have been, which are shapes of one value. Shifts in
    proportion to the travel are leads and squarenesses and no error motion; turns about a joint's own axis
    are an error of its drive. Degrees above 2, and twice a turn, are secondary.
    """

    name = "error_motion"
    kind = "pose"
    description = "guides and bearings of a machine tool that shift and turn what they carry as it moves"

    def missing(self, mechanism: Mechanism, covariates: Sequence[str]) -> str:
        """A joint that slides, of an arm: where all turn, their drives and links are off by far more."""
        slides = isinstance(arm := inside(mechanism), SerialArm) and any(j.unit == "m" for j in arm.joints)
        return "" if slides else "a joint that slides, in a machine whose links follow one another"

    def coefficients(self, situation: Situation) -> tuple[Coefficient, ...]:
        """Of each joint the shifts and turns of its first form, then of the next."""
        return tuple(
            Coefficient(
                f"{joint.name} {name} {form.name}",
                unit,
                _SIZE[unit] * form.size,
                joint.name,
                secondary=form.secondary,
                part=form.part,
            )
            for i, joint in enumerate(_arm(situation).joints)
            for form, motions in _motions(_arm(situation), i)
            for name, unit in (TWIST[k] for k in motions)
        )

    def shapes(self, situation: Situation) -> tuple[Shape, ...]:
        """Where each joint that slides begins and ends, where the machine's file does not tell it."""
        arm = _arm(situation)
        every = situation.joints.flatten(0, -2)
        ends = zip(arm.joints, every.amin(0).tolist(), every.amax(0).tolist(), strict=True)
        return tuple(
            Shape(f"{joint.name} {name}", "m", (value,), refined=False)
            for joint, *found in ends
            for name, value in zip(("from", "to"), found, strict=True)
            if joint.unit == "m" and not arm.has_limits
        )

    def basis(self, situation: Situation, shape: Tensor) -> Tensor:
        """`... x s x c x m`."""
        arm = _arm(situation)
        values = arm.resolve(situation.whole.parameters)
        base, frames = rotation_vector_to_matrix(values[..., 3:6]), arm.link_frames(situation.joints, values)
        ends = arm.limits.expand(*shape.shape[:-1], -1, -1)
        if not arm.has_limits:
            sliding = torch.nonzero(~arm.revolute)[:, 0]
            ends = ends.index_copy(-2, sliding, shape.reshape(*shape.shape[:-1], len(sliding), 2))
        low, high = ends.unsqueeze(-3).unbind(-1)
        travel = ((2 * situation.joints - low - high) / (high - low).clamp_min(1e-9)).clamp(-1, 1)
        found = []
        for i, joint in enumerate(arm.joints):
            turn, place = frames[i + 1]
            origin = (base @ place[..., None])[..., 0] + values[..., :3]
            twist = twist_columns(situation, situation.platform[0] - origin, base @ turn)
            slides = joint.unit == "m"
            at = travel[..., i] if slides else situation.joints[..., i].expand_as(travel[..., i])
            own = zip(_motions(arm, i), _along(slides, at), strict=True)
            found += [twist[..., motions] * size[..., None, None] for (_, motions), size in own]
        return torch.cat(found, -1)


def _arm(situation: Situation) -> SerialArm:
    arm = situation.whole.mechanism
    assert isinstance(arm, SerialArm)
    return arm


def _motions(arm: SerialArm, joint: int) -> list[tuple[_Form, list[int]]]:
    """Forms in which what a joint carries moves, and the numbers of these motions in a twist."""
    if arm.joints[joint].unit == "m":
        return [(form, [k for k in range(len(TWIST)) if k > 2 or degree > 1]) for degree, form in enumerate(_SLIDES, 1)]
    # A turn about the joint's own axis is an error of its drive.
    across = [k for k in range(len(TWIST)) if k != 3 + arm.along_axis[joint]]
    return [(form, across) for form in _TURNS]
