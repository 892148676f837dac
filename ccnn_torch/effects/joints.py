"""Effects on each joint alone or on another one: offset, gain, coupling, periodic errors of the drives."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from ccnn_torch.coordinates import Parameter, plausible_error
from ccnn_torch.effects.columns import OfJoints, by_joint, of_rows
from ccnn_torch.effects.protocol import Coefficient, Effect, Shape
from ccnn_torch.effects.situation import Situation
from ccnn_torch.mechanisms import Mechanism


class JointOffset(Effect):
    """Δq_i = c_i."""

    name = "joint_offset"
    kind = "joints"
    description = "a constant error of each joint, as of a reference switch or an encoder's zero"

    def coefficients(self, situation: Situation) -> tuple[Coefficient, ...]:
        """One a joint."""
        return tuple(
            Coefficient(j.name, j.unit, plausible_error(Parameter(j.name, j.unit, 0.0)), joint=j.name)
            for j in situation.mechanism.joints
        )

    def basis(self, situation: Situation, shape: Tensor) -> Tensor:
        """The identity at every row, `... x s x n x n`."""
        n = situation.joints.shape[-1]
        eye = torch.eye(n, dtype=situation.joints.dtype, device=situation.joints.device)
        return eye.expand(*situation.joints.shape[:-1], n, n)


_GAIN = 1e-3
ZERO = {"m": 3e-4, "rad": 1e-3}
"""What a gain makes between the middle of a joint's workspace and where the joint counts from [joint's unit]."""


class JointGain(Effect):
    """Δq_i = c_i (q_i - middle of its workspace) + z_i; z (secondary): it may be 0 elsewhere than in the middle."""

    name = "joint_gain"
    kind = "joints"
    description = "joints that move by a constant share too far or too short, as by a screw's lead or a gear ratio"

    def coefficients(self, situation: Situation) -> tuple[Coefficient, ...]:
        """Gain and zero of each joint."""
        return tuple(
            one
            for j in situation.mechanism.joints
            for one in (
                Coefficient(j.name, "1", _GAIN, joint=j.name),
                Coefficient(f"{j.name} zero", j.unit, ZERO[j.unit], joint=j.name, secondary=True),
            )
        )

    def counted_from(self, situation: Situation) -> dict[str, int]:
        """Coefficients that multiply a joint's command less the middle of its workspace, and the number of that joint.

        A command of that middle has the joint where the zero says.
        """
        return {joint.name: i for i, joint in enumerate(situation.mechanism.joints)}

    def basis(self, situation: Situation, shape: Tensor) -> Tensor:
        """`... x s x n x 2n`."""
        return by_joint(torch.stack([situation.from_middle, torch.ones_like(situation.joints)], -1))


class Coupling(Effect):
    """Δq_i = Σ c_ij (q_j - middle of its workspace) + z_i over j ≠ i; z (secondary): it may be 0 elsewhere."""

    name = "coupling"
    kind = "joints"
    description = "one joint's motion that moves another, as in a wrist's gears or a belt over several axes"

    def missing(self, mechanism: Mechanism, covariates: Sequence[str]) -> str:
        """A second joint; where sliding axes have a squareness, which is the same, one that turns."""
        if all(j.unit == "m" for j in mechanism.joints) and any("squareness" in p.word for p in mechanism.geometry):
            return "a joint that turns: between axes that slide a coupling is their squareness"
        return "" if len(mechanism.joints) > 1 else "a second joint: a single one has nothing to be coupled to"

    def coefficients(self, situation: Situation) -> tuple[Coefficient, ...]:
        """One for each ordered pair of joints; a length per angle is 0.1 m a radian as likely as a share."""
        joints = situation.mechanism.joints
        size = {"m/rad": 1e-4, "rad/m": 1e-2}
        pairs = [(i, j) for i in joints for j in joints if i.name != j.name]
        units = ["1" if i.unit == j.unit else f"{i.unit}/{j.unit}" for i, j in pairs]
        found = [
            Coefficient(f"{i.name} by {j.name}", unit, size.get(unit, 1e-3), joint=i.name)
            for (i, j), unit in zip(pairs, units, strict=True)
        ]
        found += [Coefficient(f"{j.name} zero", j.unit, ZERO[j.unit], joint=j.name, secondary=True) for j in joints]
        return tuple(found)

    def parts(self, situation: Situation) -> list[list[int]]:
        """Numbers of the coefficients of each pair, one screw, belt or gear, with the zero of what it moves."""
        n = len(situation.mechanism.joints)
        return [[k, n * (n - 1) + k // (n - 1)] for k in range(n * (n - 1))]

    def counted_from(self, situation: Situation) -> dict[str, int]:
        """As of `JointGain`: the joint that moves the other one."""
        joints = situation.mechanism.joints
        return {f"{i.name} by {j.name}": k for i in joints for k, j in enumerate(joints) if i.name != j.name}

    def basis(self, situation: Situation, shape: Tensor) -> Tensor:
        """`... x s x n x n²`."""
        n = situation.joints.shape[-1]
        others = torch.nonzero(~torch.eye(n, dtype=torch.bool).flatten()).squeeze(-1)
        eye = torch.eye(n, dtype=situation.joints.dtype, device=situation.joints.device)
        # moved joint, pair (i, j): 1 where the moved joint is i, times the position of joint j.
        moved = eye[:, :, None] * situation.from_middle[..., None, None, :]
        return torch.cat([moved.flatten(-2)[..., others], eye.expand(*moved.shape[:-2], n)], -1)


_PERIODIC = {"m": 5e-5, "rad": 1e-4}
# Waves: harmonics of the period, and how large they are likely to be.
_HARMONICS = tuple(
    (f"{wave}{'' if k == 1 else f' {k}'}", size)
    for k, size in ((1, 1.0), (2, 0.5), (3, 0.02), (4, 0.02))
    for wave in ("sin", "cos")
)
# Harmonics of a turn, up to the wave generator of a harmonic drive of 160 : 1, the highest that is common.
_MOST_PER_TURN = 161
# Periods of a sliding joint over the travel of the rows: fewer than the first are indistinguishable from a bend; screws
# of the shortest lead [m] (ISO 3408-2 begins at 1 mm, machines at 2) are looked for, but no more periods than the last.
_FEWEST_PERIODS, _SHORTEST_LEAD, _MOST_PERIODS = 1.5, 2e-3, 250.0
# Of a period over the travel between neighbours of the grid; a wave is lost from a whole one on.
_PERIOD_STEP = 1 / 3
# Travel of the rows, at least, as a share of the workspace's.
_LEAST_TRAVEL = 0.1


class Transmission(OfJoints):
    """Δq_i = a_i sin(f_i q_i) + b_i cos(f_i q_i) and their harmonics up to the fourth; f_i unknown.

    The second may be as large as the first (a gear's two teeth in mesh), the third and the fourth are small. A wave of
    which rows show less than one and a half periods is a bend: beyond the travel of the rows it stays as it is there.
    """

    name = "transmission"
    description = "a periodic error of a drive, of unknown period, as of a gear, a screw or an encoder"

    def coefficients(self, situation: Situation) -> tuple[Coefficient, ...]:
        """Sine and cosine of a joint's period, then of its harmonics, joint by joint."""
        return tuple(
            Coefficient(f"{j.name} {wave}", j.unit, _PERIODIC[j.unit] * size, joint=j.name, secondary=size < 1)
            for j in situation.mechanism.joints
            for wave, size in _HARMONICS
        )

    def shapes(self, situation: Situation) -> tuple[Shape, ...]:
        """The frequency of each joint's error: whole numbers a turn, or from 1.5 periods over the travel upward.

        The drives of a machine's legs are made alike.
        """
        (low, high), rows = situation.workspace, situation.joints.flatten(0, -2)
        # A joint that is not known in some rows travels as far as in the others.
        measured = rows.nan_to_num(nan=-torch.inf).amax(0) - rows.nan_to_num(nan=torch.inf).amin(0)
        travels = torch.maximum(measured, _LEAST_TRAVEL * (high - low)).tolist()
        joints, count = situation.mechanism.joints, len(_HARMONICS)
        alike = any(p.leg is not None for p in situation.mechanism.geometry)
        gears = situation.mechanism.gears or (None,) * len(joints)
        if alike:
            travels = [max(t for t, other in zip(travels, joints, strict=True) if other.unit == j.unit) for j in joints]
        return tuple(
            Shape(
                f"{j.name} frequency",
                f"rad/{j.unit}" if j.unit != "rad" else "1",
                _frequencies(j.unit, travels[i]),
                tuple(range(count * i, count * (i + 1))),
                refined=j.unit != "rad",
                alike=j.unit if alike else "",
                told=gear if gear is None or j.unit == "rad" else 2 * math.pi / gear,
            )
            for i, (j, gear) in enumerate(zip(joints, gears, strict=True))
        )

    def moves(self, situation: Situation, shape: Tensor, rows: Tensor | None = None) -> Tensor:
        """Waves of each joint."""
        angle = of_rows(_followed(situation, shape), rows) * shape.unsqueeze(-2)
        sine, cosine = torch.sin(angle), torch.cos(angle)
        waves = [sine, cosine]
        # The next harmonic by the sum of angles: sines are what a grid of hundreds of frequencies takes its time for.
        for _ in range(len(_HARMONICS) // 2 - 1):
            s, c = waves[-2:]
            waves += [s * cosine + c * sine, c * cosine - s * sine]
        return torch.stack(waves, -1)


def _followed(situation: Situation, shape: Tensor) -> Tensor:
    """Turns of the motors that waves of these frequencies follow, `... x s x n`."""
    held = situation.held_turns()
    if held is None:
        return situation.motor_turns
    slow = shape * held[1] < 2 * math.pi * _FEWEST_PERIODS
    return torch.where(slow.unsqueeze(-2), held[0], situation.motor_turns)


def _frequencies(unit: str, travel: float) -> tuple[float, ...]:
    """Grid of a joint's frequencies, ascending [rad per joint's unit]."""
    if unit == "rad":
        return tuple(float(k) for k in range(1, _MOST_PER_TURN + 1))
    travel = max(travel, 1e-6)
    most = min(max(travel / _SHORTEST_LEAD, 2 * _FEWEST_PERIODS), _MOST_PERIODS)
    steps = round((most - _FEWEST_PERIODS) / _PERIOD_STEP)
    return tuple(2 * math.pi / travel * (_FEWEST_PERIODS + _PERIOD_STEP * k) for k in range(steps + 1))
