"""One realistic case: machines, poses, conditions and measuring noise of every repeat, each from its own seed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from ccnn_torch.config.sizes import ANGLE_ARM
from ccnn_torch.coordinates import Coordinate
from ccnn_torch.mechanisms import Mechanism, PoseError
from ccnn_torch.numerics.rotations import matrix_to_rotation_vector, rotation_vector_to_matrix
from ccnn_torch.simulation.machines.arm import ArmStructure
from ccnn_torch.simulation.machines.built import BuiltMachine
from ccnn_torch.simulation.machines.causes import draw, draw_causes, draw_climate
from ccnn_torch.simulation.machines.legs import machine_tool_structure, tripod_structure
from ccnn_torch.simulation.machines.structure import Structure

_BUILDERS: dict[str, Callable[[], Structure]] = {
    "tripod": tripod_structure,
    "machine_tool": machine_tool_structure,
    "arm": ArmStructure,
}
MACHINES = tuple(_BUILDERS)

_POSES, _LOAD, _NOISE = 10, 20, 21


@dataclass(frozen=True)
class RealisticMachine:
    """Rows of a realistic case, in the order measured.

    Attributes:
        mechanism: the nominal machine.
        pose: poses wanted, `r x s x p` [SI].
        joints: nominal joints of these, which are commanded, `r x s x n` [SI].
        columns: what is recorded beside joints and pose, by coordinate, `r x s` each [SI].
        reached: true poses under these commands, `r x s x p` [SI].
        measured: with the noise of the measurement, `r x s x p` [SI].
        sd: standard deviation of that noise in each degree of freedom of the pose, `p` [SI].
    """

    mechanism: Mechanism
    built: BuiltMachine
    pose: Tensor
    joints: Tensor
    columns: dict[Coordinate, Tensor]
    reached: Tensor
    measured: Tensor
    sd: Tensor

    @property
    def turns_far(self) -> Tensor:
        """Joints that move by more than a quarter turn in the workspace, `n` bool; the same for every seed."""
        travel = self.built.structure.travel
        return travel[:, 1] - travel[:, 0] > torch.pi / 2

    def pose_error(self, command: Tensor) -> PoseError:
        """Distance from the wanted poses to those that the machine reaches; command `r x s x n` [SI]; `r x s`."""
        return self.mechanism.pose_error(self.built.reach(command, self.pose), self.pose)

    def shifted(self, freedom: int) -> Tensor:
        """True poses displaced by one standard deviation of the noise in one degree of freedom, `r x s x p` [SI]."""
        step = torch.zeros_like(self.sd)
        step[freedom] = self.sd[freedom]
        return _displaced(self.mechanism, self.reached, step)


def build_machine(
    machine: str, cause: str, strength: float, rows: int, noise: float, seeds: list[int]
) -> RealisticMachine:
    """Build and measure the machine of each repeat.

    Args:
        machine: one of `MACHINES`.
        cause: one of `CAUSES`.
        strength: size of the cause; 1 = 0.05 to 0.3 mm of pose error.
        rows: poses measured.
        noise: standard deviation of each measured coordinate of the position [m].
        seeds: one a repeat; a repeat depends on its own alone.
    """
    structure = _BUILDERS[machine]()
    mechanism = structure.mechanism
    drawn = [structure.draw(rows, np.random.default_rng([seed, _POSES])) for seed in seeds]
    pose, joints = (torch.stack(parts) for parts in zip(*drawn, strict=True))
    shape = (rows, pose.shape[-1])
    acts = {"compliance": cause in ("compliance", "mixed"), "backlash": cause in ("backlash", "mixed")}
    load = draw(seeds, _LOAD, lambda g: g.standard_normal(shape)) * structure.load * acts["compliance"]
    start = joints.new_zeros(len(seeds), 1, joints.shape[-1]) + structure.travel.mean(-1)
    direction = torch.sign(torch.diff(joints, dim=1, prepend=start))
    climate = draw_climate(seeds, rows, joints.shape[-1])
    built = BuiltMachine(structure, draw_causes(structure, cause, strength, seeds), climate, load, direction)
    columns: dict[Coordinate, Tensor] = {}
    if cause in ("thermal", "mixed"):
        columns |= {Coordinate("time", "s"): climate.time, Coordinate("temperature", "K"): climate.surroundings}
    if acts["compliance"]:
        for i, coordinate in enumerate(mechanism.pose):
            if structure.load[i] > 0:
                unit = "N" if coordinate.unit == "m" else "N*m"
                columns[Coordinate(f"load_{coordinate.name}", unit)] = load[..., i]
    if acts["backlash"]:
        columns |= {Coordinate(f"direction{i + 1}", "1"): direction[..., i] for i in range(joints.shape[-1])}
    reached = built.reach(joints, pose)
    units = torch.tensor([coordinate.unit == "m" for coordinate in mechanism.pose])
    sd = torch.where(units, noise, noise / ANGLE_ARM).to(torch.float64)
    draws = draw(seeds, _NOISE, lambda g: g.standard_normal(shape))
    measured = _displaced(mechanism, reached, draws * sd)
    return RealisticMachine(mechanism, built, pose, joints, columns, reached, measured, sd)


def _displaced(mechanism: Mechanism, pose: Tensor, step: Tensor) -> Tensor:
    """Poses moved by small steps, `... x p` each; a rotation vector is turned about the axes of the base."""
    names = [coordinate.name for coordinate in mechanism.pose]
    if names[-3:] != ["rx", "ry", "rz"]:
        return pose + step
    rotation = rotation_vector_to_matrix(step[..., -3:]) @ rotation_vector_to_matrix(pose[..., -3:])
    return torch.cat([pose[..., :-3] + step[..., :-3], matrix_to_rotation_vector(rotation)], dim=-1)
