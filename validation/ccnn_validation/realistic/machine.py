"""One realistic case: machines, poses, conditions and measuring noise of every repeat, each from its own seed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ccnn_torch.config.sizes import ANGLE_ARM
from ccnn_torch.coordinates import Coordinate
from ccnn_torch.mechanisms import Mechanism, PoseError
from ccnn_torch.numerics.rotations import matrix_to_rotation_vector, rotation_vector_to_matrix
from ccnn_torch.simulation.case_study import Simulation
from ccnn_validation.realistic.structure import ArmStructure, Structure, machine_tool_structure, tripod_structure

CAUSES = ("geometry", "compliance", "transmission", "thermal", "backlash", "mixed")
_MIXED = 0.5
"""Of each cause's strength where all act together."""
REFERENCE = 293.15
"""Temperature at which a machine has its dimensions, 20 degC [K]."""
SESSION = 8 * 3600.0
"""Rows are measured evenly over one working day [s], however many they are."""
_GRID = 10.0
_LINKED = 0.4
"""Share of the drives' own warmth that the legs or links take on."""

# Streams of random numbers of a seed; 1 is the noise of the paper's cases.
_GEOMETRY, _COMPLIANCE, _WAVE_SIZE, _WAVE_PLACE, _GROWTH, _SCREW_GROWTH, _BACKLASH, _CLIMATE = range(11, 19)

Array = NDArray[np.float64]


def draw(seeds: list[int], stream: int, function: Callable[[np.random.Generator], Array]) -> Tensor:
    """One draw a repeat, each from its own seed and stream; `r x ...`."""
    return torch.as_tensor(np.stack([function(np.random.default_rng([seed, stream])) for seed in seeds]))


@dataclass(frozen=True)
class Climate:
    """Temperatures while the rows are measured.

    Attributes:
        time: since the start, `r x s` [s].
        surroundings: `r x s` [K], what a thermometer in the hall shows.
        structure: of frame, legs or links, and their bending difference (surroundings less frame), as departures from
            the reference temperature, `r x s x 3` [K].
        drives: of the drives, warmed by their own work, `r x s x n` [K].
    """

    time: Tensor
    surroundings: Tensor
    structure: Tensor
    drives: Tensor


@dataclass(frozen=True)
class Causes:
    """Errors of each repeat's machine; a cause that does not act is all zeros.

    Attributes:
        geometry: errors of the parameters, `r x 1 x k` [SI].
        drive_compliance: of the drives, `r x 1 x n` [joint's unit per N or N·m].
        member_compliance: factor on that of the members, `r x 1 x 1`.
        amplitude, frequency, phase: of the drives' periodic errors, `r x n x h` [joint's unit], [rad per joint's unit],
            [rad]; h harmonics.
        growth: of each parameter, as in `Structure`, `r x k x 3` [SI/K].
        drive_growth: of the drives' travel, `r x 1 x n` [1/K].
        backlash: half the backlash of each drive, `r x 1 x n` [joint's unit].
        friction: force by which friction holds a drive against its flank, in units of its typical force, `r x 1 x n`.
    """

    geometry: Tensor
    drive_compliance: Tensor
    member_compliance: Tensor
    amplitude: Tensor
    frequency: Tensor
    phase: Tensor
    growth: Tensor
    drive_growth: Tensor
    backlash: Tensor
    friction: Tensor


def draw_causes(structure: Structure, cause: str, strength: float, seeds: list[int]) -> Causes:
    """The machine of each repeat.

    Args:
        structure: its nominal parameters and tolerances.
        cause: one of `CAUSES`; `mixed` has all, each at half the strength.
        strength: 1 = 0.05 to 0.3 mm of pose error.
        seeds: one a repeat.
    """
    k, n = len(structure.parameters), len(structure.drive_compliance)

    def factor(name: str) -> float:
        return strength * (_MIXED if cause == "mixed" else float(cause == name))

    normal = draw(seeds, _GEOMETRY, lambda g: g.standard_normal((1, k)))
    give = draw(seeds, _COMPLIANCE, lambda g: g.uniform(0.5, 1.5, (1, n + 1))) * factor("compliance")
    amplitude, frequency, phase = _waves(structure, seeds)
    uneven = draw(seeds, _GROWTH, lambda g: np.concatenate([g.uniform(0.5, 1.5, (k, 2)), g.normal(size=(k, 1))], -1))
    screws = draw(seeds, _SCREW_GROWTH, lambda g: g.uniform(0.5, 1.5, (1, n)))
    backlash = draw(seeds, _BACKLASH, lambda g: g.uniform(0.5, 1.5, (2, 1, n)))
    return Causes(
        geometry=normal * structure.tolerances * factor("geometry"),
        drive_compliance=give[..., :n] * structure.drive_compliance,
        member_compliance=give[..., n:],
        amplitude=amplitude * factor("transmission"),
        frequency=frequency,
        phase=phase,
        growth=uneven * structure.growth * factor("thermal"),
        drive_growth=screws * structure.drive_growth * factor("thermal"),
        backlash=backlash[:, 0] * structure.backlash / 2 * factor("backlash"),
        friction=backlash[:, 1],
    )


def _waves(structure: Structure, seeds: list[int]) -> tuple[Tensor, Tensor, Tensor]:
    """Two harmonics a drive: 3 to 6 and twice as many periods over a screw's travel, 1 to 4 and twice as many per turn
    of a gear (whole numbers, so that it is periodic)."""
    n = len(structure.wave)
    size = draw(seeds, _WAVE_SIZE, lambda g: g.uniform(0.6, 1.4, (n, 2)))
    rest = draw(seeds, _WAVE_PLACE, lambda g: g.uniform(0.0, 1.0, (n, 3)))
    span = structure.travel[:, 1] - structure.travel[:, 0]
    screws = (3 + 3 * rest[..., 0]) * 2 * torch.pi / span
    gears = 1 + torch.floor(4 * rest[..., 0])
    base = torch.where(structure.screw, screws, gears)
    amplitude = size * structure.wave[:, None] * torch.tensor([1.0, 0.5], dtype=torch.float64)
    frequency = base[..., None] * torch.tensor([1.0, 2.0], dtype=torch.float64)
    return amplitude, frequency, 2 * torch.pi * rest[..., 1:]


def draw_climate(seeds: list[int], rows: int, drives: int) -> Climate:
    """A working day: the hall drifts by a few kelvin, the structure follows hours or half an hour behind, drives warm
    up by their own work. The `rows` rows are evenly spaced in time."""
    grid = np.arange(0.0, SESSION + _GRID, _GRID)
    time = np.linspace(0.0, SESSION, rows)

    def day(g: np.random.Generator) -> Array:
        start, drift = g.normal(0.0, 2.0), g.uniform(3.0, 8.0) * g.choice([-1.0, 1.0])
        swing, period, phase = g.uniform(1.0, 3.0), g.uniform(1.5, 4.0) * 3600, g.uniform(0, 2 * np.pi)
        hall = start + drift * grid / SESSION + swing * (np.sin(2 * np.pi * grid / period + phase) - np.sin(phase))
        frame = _follow(hall, g.uniform(2.0, 4.0) * 3600, hall[0])
        legs = _follow(hall, g.uniform(0.3, 0.8) * 3600, hall[0])
        warm = g.uniform(8.0, 16.0, drives) * (1 - np.exp(-grid[:, None] / g.uniform(0.3, 1.0, drives) / 3600))
        legs = legs + _LINKED * warm.mean(1)
        states = np.concatenate([hall[:, None], frame[:, None], legs[:, None], legs[:, None] + warm], axis=1)
        return np.stack([np.interp(time, grid, column) for column in states.T], axis=-1)

    found = draw(seeds, _CLIMATE, day)
    hall, frame, legs = found[..., 0], found[..., 1], found[..., 2]
    return Climate(
        time=torch.as_tensor(time).expand(len(seeds), -1),
        surroundings=REFERENCE + hall,
        structure=torch.stack([frame, legs, hall - frame], dim=-1),
        drives=found[..., 3:],
    )


def _follow(hall: Array, lag: float, start: float) -> Array:
    """Temperature of a body of one heat capacity behind that of its surroundings: T' = (hall - T) / lag."""
    # Only here: scipy.signal takes a quarter of a second to load, which no other run should pay.
    from scipy.signal import lfilter

    keep = np.exp(-_GRID / lag)
    followed, _ = lfilter([1 - keep], [1.0, -keep], hall, zi=[keep * start])
    return np.asarray(followed, dtype=np.float64)


# Each round gains a factor of the stiffness's share in the machine's size, about 1e-3.
_ROUNDS = 6
_STIFFENING = 0.5
"""A drive starts softer by this share and has its stiffness above its typical force: preload, wind-up."""
_EDGE = 0.5
"""Width of the change from one flank of the backlash to the other, in units of the typical force."""


@dataclass(frozen=True)
class BuiltMachine:
    """Machines of `r` repeats, each under the conditions of its `s` rows.

    Attributes:
        load: on the platform or tool along the pose coordinates, `r x s x p` [N or N·m].
        direction: sign of each drive's last motion, `r x s x n` [1].
    """

    structure: Structure
    causes: Causes
    climate: Climate
    load: Tensor
    direction: Tensor

    def reach(self, command: Tensor, guess: Tensor) -> Tensor:
        """Poses under a command, solved for the structure as it is.

        Args:
            command: `r x s x n` [SI].
            guess: poses nearby, `r x s x p` [SI].

        Returns:
            `r x s x p` [SI].
        """
        return self.equilibrium(command, guess)[2]

    def equilibrium(self, command: Tensor, guess: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Where drives, parameters and pose settle under weight and load.

        The force on a drive depends on the pose and the pose on the drive's deflection: a fixed point, each iteration
        of which solves the closure and takes the forces by the transposed Jacobian.

        Returns:
            Drives `r x s x n`, parameters `r x s x k`, pose `r x s x p` [SI].
        """
        still, parameters = self.drives(command, guess), self.parameters()
        drives, shape, pose = still, parameters, guess
        for _ in range(_ROUNDS):
            pose = self.structure.reach(drives, shape, pose)
            force, members = self.structure.forces(drives, shape, pose, self.load)
            drives = still + self.deflection(force)
            shape = self.structure.stretched(parameters, members * self.causes.member_compliance)
        return drives, shape, self.structure.reach(drives, shape, pose)

    def parameters(self) -> Tensor:
        """Geometry at each row's temperatures, without load, `r x s x k` [SI]."""
        grown = (self.causes.growth[:, None] * self.climate.structure[..., None, :]).sum(-1)
        return self.structure.parameters + self.causes.geometry + grown

    def drives(self, command: Tensor, guess: Tensor) -> Tensor:
        """Drive positions without deflection: periodic error, thermal growth of the screws, backlash; `r x s x n`."""
        causes = self.causes
        angle = command[..., None] * causes.frequency[:, None] + causes.phase[:, None]
        wave = (causes.amplitude[:, None] * torch.sin(angle)).sum(-1)
        # A screw is held at the low end of its travel.
        grown = causes.drive_growth * self.climate.drives * (command - self.structure.travel[:, 0])
        return command + wave + grown + self._backlash(command, guess)

    def _backlash(self, command: Tensor, guess: Tensor) -> Tensor:
        """Half the backlash, towards the flank that friction and load determine, `r x s x n`.

        Friction keeps the output behind the motion, the load pushes it in its own direction; where the two balance it
        floats between the flanks.
        """
        if not bool(self.causes.backlash.any()):
            return torch.zeros_like(command)
        force, _ = self.structure.forces(command, self.structure.parameters, guess, self.load)
        push = force / self.structure.drive_force - self.causes.friction * self.direction
        return self.causes.backlash * torch.tanh(push / _EDGE)

    def deflection(self, force: Tensor) -> Tensor:
        """Displacement of the drives under their forces, `r x s x n` [joint's unit]."""
        typical = self.structure.drive_force
        return self.causes.drive_compliance * (force + _STIFFENING * typical * torch.tanh(force / typical))


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


def simulate_realistic(
    machine: RealisticMachine, deviations: Callable[[Tensor], Tensor], measured: Tensor
) -> Simulation:
    """A machine as built, which repeats exactly: propagate the noise of the measurement to the joints.

    Args:
        machine: the rows.
        deviations: joint deviations of poses, `r x s x p` -> `r x s x n` [SI].
        measured: those of the measured poses, `r x s x n` [SI].
    """
    true = deviations(machine.reached)
    # One degree of freedom of the pose at a time: the noise is far below the curvature of the kinematics.
    parts = [(deviations(machine.shifted(i)) - true).square() for i in range(len(machine.sd))]
    variance = torch.stack(parts).sum(0)
    return Simulation(machine.pose, measured - true, variance, lambda command: (machine.pose_error(command),) * 2)
