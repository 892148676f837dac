"""What was commanded and when: joints, loads, temperatures, directions and speeds of the rows of a case."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ccnn_torch.mechanisms import Mechanism
from ccnn_validation.sources.multibody.arrays import Array
from ccnn_validation.sources.multibody.machine import Machine

__all__ = ["Design", "draw_design"]


@dataclass(frozen=True)
class Design:
    """Rows.

    Attributes:
        joints: commanded, `s x n` [rad, m].
        pose: nominal, `s x p` [m, rad].
        direction: sign of each joint's last motion, `s x n`.
        speed: of the commands, `s x n` [rad/s, m/s]; 0 at rest.
        time: `s` [s].
        temperature: of the machine's body, `s` [degC].
        load: force and moment on the tool, `s x 6` [N, N*m]; applied only where a cause has loads.
    """

    joints: Array
    pose: Array
    direction: Array
    speed: Array
    time: Array
    temperature: Array
    load: Array


def draw_design(machine: Machine, mechanism: Mechanism, rng: np.random.Generator, moving: bool = False) -> Design:
    """150 to 300 rows over the workspace, at rest or along a path."""
    rows = int(rng.integers(150, 301))
    if moving:
        step = 0.05
        time = step * np.arange(rows)
        # A path of three sines a coordinate, in shares of the workspace from its middle.
        rate, phase = rng.uniform(0.3, 1.6, (3, 1, 7)), rng.uniform(0, 2 * np.pi, (3, 1, 7))

        def path(t: Array) -> Array:
            share = np.sin(rate * t[:, None] + phase).sum(0)[:, : _width(machine, mechanism)] / 3.2
            return _joints_at(machine, mechanism, share)

        joints = path(time)
        speed = (path(time + 1e-4) - path(time - 1e-4)) / 2e-4
        direction = np.where(speed < 0, -1.0, 1.0)
    else:
        share = rng.uniform(-1, 1, (rows, _width(machine, mechanism)))
        joints = _joints_at(machine, mechanism, share)
        speed, time = np.zeros_like(joints), np.cumsum(rng.uniform(20, 60, rows))
        before = np.vstack([2 * joints[:1] - joints[1:2], joints[:-1]])
        drawn = rng.integers(0, 2, joints.shape) * 2.0 - 1.0
        direction = drawn if rng.random() < 0.5 else np.where(joints < before, -1.0, 1.0)
    shift = time / time[-1]
    swing = rng.uniform(5, 10) * np.sin(2 * np.pi * (rng.uniform(0.7, 2.5) * shift + rng.random()))
    temperature = rng.uniform(22, 28) + swing + rng.normal(0, 0.3, rows)
    moments = rng.normal(0, 6.0, (rows, 3)) * (machine.turns and rng.random() < 0.5)
    load = np.hstack([rng.normal(0, 60.0, (rows, 3)), moments])
    if machine.pose == ("x", "y"):
        load[:, 2] = 0.0
    pose = machine.forward(mechanism, joints)
    good = np.isfinite(pose).all(1) & np.isfinite(speed).all(1)
    parts = (joints, pose, direction, speed, time, temperature, load)
    return Design(*(part[good] for part in parts))


def _width(machine: Machine, mechanism: Mechanism) -> int:
    """How many numbers say where a row is."""
    return machine.drives if machine.low is not None else len(mechanism.pose)


def _joints_at(machine: Machine, mechanism: Mechanism, share: Array) -> Array:
    """Joints where shares from -1 to 1 of the workspace are, `s x n`."""
    if machine.low is not None and machine.high is not None:
        drawn: Array = (machine.low + machine.high) / 2 + share * (machine.high - machine.low) / 2
        return drawn
    middle: Array = ((mechanism.low + mechanism.high) / 2).numpy()
    half = ((mechanism.high - mechanism.low) / 2).numpy()
    if machine.pose == ("x", "y"):
        # From a square to the disc that the five-bar reaches, so that no corner is out of reach.
        u, v = share.T
        share = np.stack([u * np.sqrt(1 - v**2 / 2), v * np.sqrt(1 - u**2 / 2)], -1)
    joints: Array = machine.inverse(mechanism, middle + 0.85 * half * share)
    return joints
