"""A measuring frame that was moved between two series of measurements."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from ccnn_torch.errors import InputError
from ccnn_torch.mechanisms import Mechanism
from ccnn_torch.mechanisms.frames.fit import rigid_body_frame
from ccnn_torch.numerics.rotations import rotation_vector_to_matrix

# Weight of orientation against position [m/rad], as in fits of an arm's frames.
_ROTATION_WEIGHT = 0.3
_NEEDED = 4


@dataclass(frozen=True)
class Motion:
    """A rigid motion `6`: position [m] and rotation vector [rad], from the model's measuring frame into the new one."""

    frame: Tensor

    @classmethod
    def none(cls) -> Motion:
        return cls(torch.zeros(6, dtype=torch.float64))

    @staticmethod
    def fits(mechanism: Mechanism) -> bool:
        """Whether poses of this mechanism can be moved in space."""
        names = {c.name for c in mechanism.pose}
        return names in ({"x", "y", "z"}, {"x", "y", "z", "rx", "ry", "rz"})

    def undone(self, mechanism: Mechanism, pose: Tensor) -> Tensor:
        """Poses `s x p` as they would have been measured in the model's frame."""
        if not bool(self.frame.any()):
            return pose
        position, rotation = mechanism.frame(pose)
        turn = rotation_vector_to_matrix(self.frame[3:]).mT
        place = ((position - self.frame[:3])[..., None, :] @ turn.mT)[..., 0, :]
        return mechanism.pose_near(place, None if rotation is None else turn @ rotation)

    @property
    def words(self) -> str:
        shift, turn = self.frame[:3].norm(), self.frame[3:].norm()
        return f"{1e3 * float(shift):.3g} mm and {1e3 * float(turn):.3g} mrad"


def fit_motion(mechanism: Mechanism, expected: Tensor, measured: Tensor) -> Motion:
    """The motion that takes expected poses nearest to those measured, `s x p` [SI] each.

    Raises:
        InputError: the mechanism's poses cannot be moved in space, or the rows are too few.
    """
    if not Motion.fits(mechanism):
        names = ", ".join(c.name for c in mechanism.pose)
        raise InputError(
            f"--refit-frames: the pose of {mechanism.name} is {names}, and a frame can be fitted to x, y, z only "
            "(with or without rx, ry, rz); leave the option out"
        )
    if len(measured) < _NEEDED:
        raise InputError(f"--refit-frames: {len(measured)} rows are too few to fit a frame; give {_NEEDED} or more")
    weights = torch.ones(len(measured), dtype=torch.float64)
    return Motion(rigid_body_frame(mechanism.frame(expected), mechanism.frame(measured), weights, _ROTATION_WEIGHT))
