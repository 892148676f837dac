"""Forward kinematics of the nominal motion, or of a machine as built."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from torch import Tensor

from ccnn_torch.errors import InputError
from ccnn_torch.mechanisms import Mechanism

# Each round of `command` shrinks the remainder by about the relative size of the errors.
_ROUNDS = 6


@dataclass(frozen=True)
class Kinematics:
    """A mechanism and whether its machines leave the nominal motion (`as_built`, `pose_near` of the mechanism)."""

    mechanism: Mechanism
    built: bool = False

    def frame(self, joints: Tensor, parameters: Tensor, guess: Tensor | None) -> tuple[Tensor, Tensor | None]:
        """Platform frame: position `... x 3` [m] and rotation `... x 3 x 3` (None without orientation)."""
        if self.built:
            mechanism: Any = self.mechanism
            position, rotation = mechanism.as_built(joints, parameters)
            return position, rotation
        return self.mechanism.frame(self.mechanism.forward_kinematics(joints, parameters, guess))

    def reached(self, joints: Tensor, parameters: Tensor, guess: Tensor | None) -> Tensor:
        """Pose, `... x p` [SI]; of a machine that leaves the nominal motion the pose nearest to its frame."""
        if not self.built:
            return self.mechanism.forward_kinematics(joints, parameters, guess)
        mechanism: Any = self.mechanism
        pose: Tensor = mechanism.pose_near(*self.frame(joints, parameters, guess))
        return pose

    def command(self, wanted: Tensor, parameters: Tensor, guess: Tensor) -> Tensor:
        """Joints that take a machine with these parameters to a pose, `... x n` [SI].

        Exact: off the nominal motion the inverse kinematics of the pose alone are a first guess, corrected by the
        joints between the wanted pose and the one reached until nothing is left.
        """
        joints = self.mechanism.solve_inverse(wanted, parameters, guess)
        if not self.built:
            return joints
        ideal = joints
        for _ in range(_ROUNDS):
            there = self.mechanism.solve_inverse(self.reached(joints, parameters, wanted), parameters, guess)
            joints = joints + self.mechanism.wrap(ideal - there)
        return joints


def make_kinematics(mechanism: Mechanism, built: bool) -> Kinematics:
    """Check that the mechanism knows how it is built."""
    if built and not (hasattr(mechanism, "as_built") and hasattr(mechanism, "pose_near")):
        raise InputError(
            f"simulate.as_built: {mechanism.name} never leaves its nominal motion, so that there is nothing to "
            "simulate; remove the key"
        )
    return Kinematics(mechanism, built)
