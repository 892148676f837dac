"""Measured quantities of a pose: its coordinates, or points on the platform."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from ccnn_torch.config.sizes import Size, size
from ccnn_torch.coordinates import Coordinate
from ccnn_torch.errors import InputError
from ccnn_torch.mechanisms import Mechanism


@dataclass(frozen=True)
class Instrument:
    """What is measured of a machine.

    Attributes:
        view: the mechanism with what is measured as its pose, `o` coordinates.
        observe: (pose `... x p`, position `... x 3`, rotation `... x 3 x 3` or None) of the platform -> `... x o`.
        pose_of: `... x o` -> the pose that was measured, `... x p`.
    """

    view: Mechanism
    observe: Callable[[Tensor, Tensor, Tensor | None], Tensor]
    pose_of: Callable[[Tensor], Tensor]


def make_instrument(mechanism: Mechanism, points: Sequence[tuple[Size, Size, Size]] | None) -> Instrument:
    """The pose itself, or three points on the platform.

    Raises:
        InputError: points lie on one line, or the mechanism's inverse kinematics takes no measured frame.
    """
    if points is None:
        return Instrument(mechanism, lambda pose, position, rotation: pose, lambda observed: observed)
    place = torch.tensor([[size(v, "m", "simulate.points") for v in p] for p in points], dtype=torch.float64)
    if float(torch.linalg.cross(place[0] - place[1], place[2] - place[1]).norm()) < 1e-9:
        raise InputError("simulate.points: the three points lie on one line, which shows no rotation about it")
    if not (hasattr(mechanism, "joints_of_frame") and hasattr(mechanism, "pose_near")):
        raise InputError(
            f"simulate.points: {mechanism.name} takes no measured rotation matrix; measure its pose (remove points)"
        )
    view = PointsView(mechanism, place)
    return Instrument(view, lambda pose, *frame: view.seen(*frame), view.pose_of)


class PointsView(Mechanism):
    """A mechanism of which three points P1, P2, P3 on the platform are measured; pose p1_x, p1_y, …, p3_z [m].

    The rotation follows from them as in Sun et al. 2018, eq. 16 (u along P2P1, w normal to the plane, v = w x u), and
    the platform's position from their middle. Parameters and joints are the mechanism's own.
    """

    def __init__(self, mechanism: Mechanism, points: Tensor) -> None:
        """points: in the platform's frame, `3 x 3` [m]."""
        # In a tuple, so that the mechanism is not registered as a submodule.
        self._inner: Any = (mechanism,)
        self._turn = _triad(points)
        self._points = points
        home = self.seen(*mechanism.frame(mechanism.home_pose))
        super().__init__(
            name=f"{mechanism.name} by three points",
            joints=mechanism.joints,
            pose=[Coordinate(f"p{i + 1}_{c}", "m") for i in range(3) for c in "xyz"],
            geometry=mechanism.geometry,
            low=home.tolist(),
            high=home.tolist(),
            home_pose=home.tolist(),
            home_joints=mechanism.home_joints.tolist(),
        )
        self.nominal.copy_(mechanism.nominal)

    def seen(self, position: Tensor, rotation: Tensor | None) -> Tensor:
        """The points of a platform; position `... x 3` [m], rotation `... x 3 x 3`; returns `... x 9` [m]."""
        assert rotation is not None
        return (position[..., None, :] + self._points @ rotation.mT).flatten(-2)

    def pose_of(self, observed: Tensor) -> Tensor:
        """The mechanism's pose that is nearest to the measured frame; `... x 9` [m] -> `... x p` [SI]."""
        pose: Tensor = self._inner[0].pose_near(*self.frame(observed))
        return pose

    def frame(self, pose: Tensor) -> tuple[Tensor, Tensor]:
        """Position `... x 3` [m] and rotation `... x 3 x 3` from the points, `... x 9` [m]."""
        seen = pose.reshape(*pose.shape[:-1], 3, 3)
        rotation = _triad(seen) @ self._turn.mT
        return seen.mean(-2) - (rotation @ self._points.mean(0)), rotation

    def solve_inverse(self, pose: Tensor, parameters: Tensor | None = None, guess: Tensor | None = None) -> Tensor:
        """Joints of measured points, by the mechanism's real inverse kinematics; see `Mechanism.solve_inverse`."""
        position, rotation = self.frame(pose)
        joints: Tensor = self._inner[0].joints_of_frame(position, rotation, parameters)
        return joints


def _triad(points: Tensor) -> Tensor:
    """Eq. 16: columns u, v, w from three points; `... x 3 x 3` (a row each) -> `... x 3 x 3`."""
    first, second, third = points.unbind(-2)
    u = first - second
    u = u / torch.linalg.vector_norm(u, dim=-1, keepdim=True)
    w = torch.linalg.cross(u, third - second, dim=-1)
    w = w / torch.linalg.vector_norm(w, dim=-1, keepdim=True)
    return torch.stack([u, torch.linalg.cross(w, u, dim=-1), w], dim=-1)
