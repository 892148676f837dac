"""The interface of a simulated machine to a run, for the case studies and for realistic machines."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from ccnn_torch.mechanisms import PoseError
from ccnn_torch.simulation.cases import CaseStudy
from ccnn_torch.simulation.machines.realistic import RealisticMachine


class Simulation(Protocol):
    """A machine with known true behaviour.

    Attributes:
        pose: poses wanted, `r x s x p` [SI].
        noise: what noise adds to the joint deviations as they are learned, `r x s x n` [SI].
        noise_variance: its variance, `r x s x n` [SI²].
        unlearnable: part of the signal that no function of the inputs can follow, `r x s x n` [SI], or None.
    """

    @property
    def pose(self) -> Tensor: ...
    @property
    def noise(self) -> Tensor: ...
    @property
    def noise_variance(self) -> Tensor: ...
    @property
    def unlearnable(self) -> Tensor | None: ...

    def pose_errors(self, command: Tensor) -> tuple[PoseError, PoseError]:
        """Distance from the poses wanted to those that the machine reaches under a command.

        Args:
            command: `r x s x n` [SI].

        Returns:
            `r x s` each: as it is, and without the scatter of the machine itself. A machine whose noise is all in the
            measurement has none, and both are one.
        """
        ...


@dataclass(frozen=True)
class CaseSimulation:
    """A case study of paper 000: its noise is scatter of the machine itself."""

    case: CaseStudy
    noise: Tensor

    @property
    def pose(self) -> Tensor:
        return self.case.pose.expand(len(self.noise), -1, -1)

    @property
    def noise_variance(self) -> Tensor:
        return self.case.sigma.square().expand(self.noise.shape)

    @property
    def unlearnable(self) -> Tensor | None:
        chirp = self.case.unlearnable
        return chirp.expand(self.noise.shape) if bool(chirp.any()) else None

    def pose_errors(self, command: Tensor) -> tuple[PoseError, PoseError]:
        return self.case.pose_error(command, self.noise), self.case.pose_error(command)


@dataclass(frozen=True)
class RealisticSimulation:
    """A machine as built: it repeats exactly, and the noise is that of the measurement."""

    machine: RealisticMachine
    noise: Tensor
    noise_variance: Tensor
    unlearnable: Tensor | None = None

    @property
    def pose(self) -> Tensor:
        return self.machine.pose

    def pose_errors(self, command: Tensor) -> tuple[PoseError, PoseError]:
        error = self.machine.pose_error(command)
        return error, error


def simulate_realistic(
    machine: RealisticMachine, deviations: Callable[[Tensor], Tensor], measured: Tensor
) -> RealisticSimulation:
    """Propagate the noise of the measurement to the joints by the pseudoerror.

    Args:
        machine: the rows.
        deviations: joint deviations of poses, `r x s x p` -> `r x s x n` [SI].
        measured: those of the measured poses, `r x s x n` [SI].
    """
    true = deviations(machine.reached)
    # One degree of freedom of the pose at a time: the noise is far below the curvature of the kinematics.
    parts = [(deviations(machine.shifted(i)) - true).square() for i in range(len(machine.sd))]
    return RealisticSimulation(machine, measured - true, torch.stack(parts).sum(0))
