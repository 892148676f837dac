"""Structure of a machine: geometry with all its tolerances, statics, and thermal growth."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from torch import Tensor

from ccnn_torch.mechanisms import Mechanism

GRAVITY = 9.80665
"""[m/s²], along -z of the base frame."""
LENGTH_TOLERANCE, ANGLE_TOLERANCE = 5e-5, 5e-5
"""Standard deviations of geometry at strength 1 [m], [rad]."""
EXPANSION = 1.2e-5
"""Of steel [1/K]."""


class Structure(Protocol):
    """A machine's structure; its parameters are those of the machine as built, more than the nominal ones.

    Attributes:
        mechanism: nominal kinematics, what a controller has.
        parameters: those of the structure that equals the nominal machine, `k` [SI].
        tolerances: of each parameter at strength 1, `k` [SI]; 0 where it has none.
        growth: of each parameter per kelvin, `k x 3` [SI/K]: with the frame's temperature, with that of the legs or
            links, and with the difference between surroundings and frame, which bends (a scale for a random factor).
        drive_compliance: displacement of a drive per force on it at strength 1, `n` [joint's unit per N or N·m].
        drive_growth: share by which a drive's travel grows per kelvin, 0 for revolute joints, `n` [1/K].
        drive_force: typical force on a drive, `n` [N or N·m].
        backlash: of a drive at strength 1, typical, `n` [joint's unit].
        wave: amplitude of a drive's periodic error at strength 1, typical, `n` [joint's unit].
        screw: whether a drive is a screw, with a travel, rather than a gear, with turns, `n` bool.
        travel: lowest and highest joint in the workspace, `n x 2` [SI].
        load: standard deviation of the load along each pose coordinate, `p` [N or N·m]; 0 where there is none.
    """

    mechanism: Mechanism
    parameters: Tensor
    tolerances: Tensor
    growth: Tensor
    drive_compliance: Tensor
    drive_growth: Tensor
    drive_force: Tensor
    backlash: Tensor
    wave: Tensor
    screw: Tensor
    travel: Tensor
    load: Tensor

    def draw(self, count: int, generator: np.random.Generator) -> tuple[Tensor, Tensor]:
        """Poses in the workspace box, all reachable and away from singular ones, and their nominal joints.

        Returns:
            `count x p` and `count x n` [SI].
        """
        ...

    def reach(self, drives: Tensor, parameters: Tensor, guess: Tensor) -> Tensor:
        """Pose of the structure. drives: `... x n`; parameters: `... x k`; guess: `... x p`; returns `... x p` [SI]."""
        ...

    def forces(self, drives: Tensor, parameters: Tensor, pose: Tensor, load: Tensor) -> tuple[Tensor, Tensor]:
        """Statics under gravity and a load, at a pose that `reach` gave.

        Args:
            drives: `... x n` [SI].
            parameters: `... x k` [SI].
            pose: `... x p` [SI].
            load: along the pose coordinates, `... x p` [N or N·m].

        Returns:
            Force that pushes each drive along its coordinate, `... x n` [N or N·m], and force in each elastic member,
            `... x e` [N] (e may be 0).
        """
        ...

    def stretched(self, parameters: Tensor, members: Tensor) -> Tensor:
        """Parameters under the forces in the members at strength 1. members: `... x e` [N]; returns `... x k`."""
        ...
