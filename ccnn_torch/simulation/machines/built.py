"""A machine as built under command: drives, deflection, and the pose that it reaches."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from ccnn_torch.simulation.machines.causes import Causes, Climate
from ccnn_torch.simulation.machines.structure import Structure

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
