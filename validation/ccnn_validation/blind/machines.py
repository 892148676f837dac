"""The nominal machines of blind cases: their kinematics, drives and loads."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from ccnn_torch.mechanisms import Delta, DeltaLinear, FiveBar, MachineTool, Mechanism, Stewart, Tripod
from ccnn_torch.numerics.least_squares import jacobian_of
from ccnn_torch.numerics.rotations import matrix_to_rotation_vector
from ccnn_validation.blind.arm import draw_arm_poses, link_weight_torque, mass_of_links, nominal_arm

__all__ = ["MACHINES", "BlindMachine", "blind_machine"]

_TURN = 6.0
"""Rotation of the platform equivalent to a metre in the condition number of a pose, rad/m: a lever of 1/6 m."""
_CONDITION = 15.0
_GRAVITY = 9.80665


@dataclass(frozen=True)
class BlindMachine:
    """A nominal machine with the properties that a simulation needs besides its kinematics.

    Attributes:
        mechanism: the nominal one; its parameters are those that geometry errors may have.
        draw: so many poses and their joints, `s x p` and `s x n` [SI].
        travel: lowest and highest joint in the workspace, `n x 2` [SI].
        load: standard deviation of the load along each pose coordinate, `p` [N]; 0 where there is none.
        weight: of what the drives carry: the platform, or the links of an arm [N].
        screw: whether the drives are screws with a travel, rather than gears with turns.
        orientation: whether position and all three rotations are measured.
        own_weight: torque of the arm's own links on its drives, `... x n` from joints; None for a platform.
    """

    mechanism: Mechanism
    draw: Callable[[int, np.random.Generator], tuple[Tensor, Tensor]]
    travel: Tensor
    load: Tensor
    weight: float
    screw: bool
    orientation: bool
    own_weight: Callable[[Tensor], Tensor] | None = None

    def slope(self, pose: Tensor, joints: Tensor) -> Tensor:
        """Derivative of the pose coordinates by the joints, `... x p x n`.

        Of an arm the rotation vector's rows are about the axes of the base; its loads are forces, so they do not count.
        """
        if self.own_weight is not None:
            return self.mechanism.jacobian(joints)
        backward = jacobian_of(self.mechanism.solve_inverse, pose)[1]
        forward: Tensor = torch.linalg.inv(backward)
        return forward

    def weight_torque(self, pose: Tensor, joints: Tensor) -> Tensor:
        """Force or torque of the machine's own weight on each drive, `... x n` [N or N·m]."""
        if self.own_weight is not None:
            return self.own_weight(joints)
        names = [c.name for c in self.mechanism.pose]
        height = names.index("z" if "z" in names else "y")
        return -self.weight * self.slope(pose, joints)[..., height, :]

    def coordinates(self, position: Tensor, rotation: Tensor | None) -> Tensor:
        """Pose coordinates of a frame; what the machine cannot do is not measured. `... x p`."""
        x, y, z = position.unbind(-1)
        found = {"x": x, "y": y, "z": z}
        if rotation is not None:
            found |= zip(("rx", "ry", "rz"), matrix_to_rotation_vector(rotation).unbind(-1), strict=True)
            found["phi"] = torch.atan2(rotation[..., 2, 0], rotation[..., 0, 0])
            found["theta_x"] = torch.atan2(rotation[..., 2, 1], rotation[..., 1, 1])
            found["theta_y"] = torch.atan2(rotation[..., 0, 2], rotation[..., 0, 0])
        return torch.stack([found[c.name] for c in self.mechanism.pose], dim=-1)


def _platform(mechanism: Mechanism, load: float, weight: float, condition: float = _CONDITION) -> BlindMachine:
    """A parallel machine; loads act along the coordinates that are lengths."""

    def draw(count: int, generator: np.random.Generator) -> tuple[Tensor, Tensor]:
        own = torch.Generator().manual_seed(int(generator.integers(2**62)))
        found: list[Tensor] = []
        while sum(map(len, found)) < count:
            pose = mechanism.sample_workspace(count, own)
            joints = mechanism.solve_inverse(pose)
            found.append(pose[mechanism.condition_number(joints, 1 / _TURN, None, pose) < condition])
        pose = torch.cat(found)[:count]
        return pose, mechanism.solve_inverse(pose)

    joints = draw(500, np.random.default_rng(0))[1]
    along = [load if c.unit == "m" else 0.0 for c in mechanism.pose]
    return BlindMachine(
        mechanism=mechanism,
        draw=draw,
        travel=torch.stack([joints.amin(0), joints.amax(0)], dim=-1),
        load=torch.tensor(along, dtype=torch.float64),
        weight=weight,
        screw=mechanism.joints[0].unit == "m",
        orientation=len(mechanism.pose) == 6,
    )


def _arm() -> BlindMachine:
    arm = nominal_arm()
    joints = draw_arm_poses(arm, 500, np.random.default_rng(0))[1]
    return BlindMachine(
        mechanism=arm,
        draw=lambda count, generator: draw_arm_poses(arm, count, generator),
        travel=torch.stack([joints.amin(0), joints.amax(0)], dim=-1),
        load=torch.tensor([40.0, 40.0, 40.0, 0.0, 0.0, 0.0], dtype=torch.float64),
        weight=mass_of_links() * _GRAVITY,
        screw=False,
        orientation=True,
        own_weight=link_weight_torque,
    )


_MAKERS: dict[str, Callable[[], BlindMachine]] = {
    "five_bar": lambda: _platform(FiveBar(), 50.0, 30.0),
    "tripod": lambda: _platform(Tripod(per_leg=True), 80.0, 250.0),
    "machine_tool": lambda: _platform(MachineTool(per_leg=True), 200.0, 400.0),
    "stewart": lambda: _platform(Stewart(), 100.0, 300.0),
    "delta": lambda: _platform(Delta(), 20.0, 15.0),
    "delta_linear": lambda: _platform(DeltaLinear(), 40.0, 30.0),
    "arm": _arm,
    # Bodies with inertia and soft servos leave their assembly mode near its edge.
    "mujoco_five_bar": lambda: _platform(FiveBar(), 50.0, 30.0, 6.0),
}
MACHINES = tuple(name for name in _MAKERS if name != "mujoco_five_bar")
"""Those with the causes of this package."""


def blind_machine(name: str) -> BlindMachine:
    """One of `MACHINES`, or `mujoco_five_bar`."""
    return _MAKERS[name]()
