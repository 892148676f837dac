"""Under which conditions the rows of a blind case are measured: hall, loads, approach, and motion."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.signal import lfilter
from torch import Tensor

from ccnn_torch.coordinates import Coordinate
from ccnn_validation.blind.machines import BlindMachine

__all__ = ["REFERENCE", "Conditions", "draw_conditions", "lagged"]

REFERENCE = 293.15
"""Temperature at which machines have their dimensions [K]."""
_SESSION = 8 * 3600.0
_STEP = 10.0
"""Of the grid in time on which temperatures are followed [s]."""

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Conditions:
    """Rows of one case, in the order measured.

    Attributes:
        pose, joints: wanted pose `s x p` and commanded joints `s x n` [SI].
        time: since the start, `s` [s].
        hall: temperature of the surroundings on the grid in time [K].
        load: along the pose coordinates, `s x p` [N].
        direction: sign of each joint's last motion, `s x n` [1].
        speed: of the joints where the pose is read in motion, `s x n` [SI/s], else None.
        acceleration: likewise, `s x n` [SI/s²].
        torque: of the load on the drives, by virtual work, `s x n` [N or N·m].
        weight: likewise of the machine's own weight.
    """

    pose: Tensor
    joints: Tensor
    time: Tensor
    hall: Array
    load: Tensor
    direction: Tensor
    speed: Tensor | None
    acceleration: Tensor | None
    torque: Tensor
    weight: Tensor

    @property
    def temperature(self) -> Tensor:
        """Of the surroundings at each row, `s` [K]."""
        return self.at_rows(self.hall)

    def at_rows(self, on_grid: Array) -> Tensor:
        """A quantity on the grid in time, at each row."""
        grid = np.arange(len(on_grid)) * _STEP
        return torch.as_tensor(np.interp(self.time.numpy(), grid, on_grid))

    def columns(self, machine: BlindMachine) -> dict[Coordinate, Tensor]:
        """What is recorded beside joints and pose, `s` each [SI]."""
        found = {Coordinate("time", "s"): self.time, Coordinate("temperature", "K"): self.temperature}
        for i, coordinate in enumerate(machine.mechanism.pose):
            if machine.load[i] > 0:
                found[Coordinate(f"load_{coordinate.name}", "N")] = self.load[:, i]
        for i in range(self.joints.shape[-1]):
            found[Coordinate(f"direction{i + 1}", "1")] = self.direction[:, i]
        if self.speed is not None:
            for i, joint in enumerate(machine.mechanism.joints):
                found[Coordinate(f"speed{i + 1}", f"{joint.unit}/s")] = self.speed[:, i]
        return found


def draw_conditions(machine: BlindMachine, rows: int, moving: bool, generator: np.random.Generator) -> Conditions:
    """Draw the conditions of one day's measurement.

    Args:
        rows: `s`.
        moving: the pose is read while the machine passes, rather than after it has stopped.
        generator: its own; everything is drawn from it.
    """
    pose, joints = machine.draw(rows, generator)
    n = joints.shape[-1]
    pause = generator.uniform(0.7, 1.3, rows)
    time = np.cumsum(pause) - pause[0]
    time *= _SESSION * generator.uniform(0.4, 1.0) / time[-1]
    levels = generator.normal(size=(rows, len(machine.load)))
    # Half the machines are loaded by a weight that is attached or not, half by random process forces.
    if generator.random() < 0.5:
        levels = generator.integers(-1, 2, levels.shape) * generator.uniform(1.0, 1.5, (1, levels.shape[1]))
    load = torch.as_tensor(levels) * machine.load
    span = machine.travel[:, 1] - machine.travel[:, 0]
    speed = acceleration = None
    if moving:
        speed = torch.as_tensor(generator.normal(size=(rows, n))) * span / 4
        acceleration = torch.as_tensor(generator.normal(size=(rows, n))) * span
        direction = torch.sign(speed)
    else:
        # Half come straight from the previous pose; half approach every pose from a side of their choice.
        direction = torch.sign(torch.diff(joints, dim=0, prepend=machine.travel.mean(-1)[None]))
        if generator.random() < 0.5:
            direction = torch.as_tensor(generator.choice([-1.0, 1.0], (rows, n)))
    slope = machine.slope(pose, joints)
    return Conditions(
        pose=pose,
        joints=joints,
        time=torch.as_tensor(time),
        hall=REFERENCE + _day(generator),
        load=load,
        direction=direction,
        speed=speed,
        acceleration=acceleration,
        torque=(slope.mT @ load[:, : slope.shape[-2], None])[..., 0],
        weight=machine.weight_torque(pose, joints),
    )


def lagged(temperature: Array, lag: float) -> Array:
    """Temperature of a body of one heat capacity behind that of the hall, T' = (hall - T) / lag; both on the grid."""
    keep = np.exp(-_STEP / lag)
    followed, _ = lfilter([1 - keep], [1.0, -keep], temperature, zi=[keep * temperature[0]])
    return np.asarray(followed, dtype=np.float64)


def _day(generator: np.random.Generator) -> Array:
    """The hall's departure from the reference on the grid [K]: a slow drift, two swings, doors."""
    t = np.arange(0.0, _SESSION + _STEP, _STEP)
    drift = generator.uniform(1.0, 6.0) * generator.choice([-1.0, 1.0]) * t / _SESSION
    swings = sum(
        generator.uniform(0.5, 2.5) * np.sin(2 * np.pi * t / (3600 * hours) + generator.uniform(0, 2 * np.pi))
        for hours in (generator.uniform(3.0, 8.0), generator.uniform(0.7, 2.0))
    )
    doors = np.zeros_like(t)
    for _ in range(3):
        opened, closes = generator.uniform(0, _SESSION), generator.uniform(600.0, 2400.0)
        doors -= generator.uniform(0.5, 2.0) * np.where(t > opened, np.exp(-(t - opened) / closes), 0.0)
    return np.asarray(generator.normal(0.0, 1.0) + drift + swings + doors, dtype=np.float64)
