"""Delay between the recorded joints and the recorded pose of a moving machine."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from ccnn_torch.effects.columns import by_joint
from ccnn_torch.effects.lag import velocity
from ccnn_torch.effects.protocol import Coefficient, Kind, Shape
from ccnn_torch.effects.situation import Situation
from ccnn_torch.mechanisms import Mechanism

_DELAY = 5e-3


class Latency:
    """Δq_i = -(τ + τ_i) dq_i/dt: the machine is where the command was τ before; τ_i is what one drive lags behind.

    Velocities are the columns speed1… where the records have them, else differences along a trajectory: rows that are
    more than a second apart are none.
    """

    name = "latency"
    kind: Kind = "joints"
    description = "poses recorded on the move that lag behind their commands"
    ordered = False

    def missing(self, mechanism: Mechanism, covariates: Sequence[str]) -> str:
        """Velocities, or the time along a trajectory."""
        speeds = [f"speed{i + 1}" for i in range(len(mechanism.joints))]
        if "time" in covariates or any(s in covariates for s in speeds):
            return ""
        unit = mechanism.joints[0].unit
        return (
            f"the joints' velocities, speed1[{unit}/s]…, or time[s] along a trajectory with rows under a second apart"
        )

    def coefficients(self, situation: Situation) -> tuple[Coefficient, ...]:
        """The delay of all, then that of each joint on top."""
        own = [Coefficient(j.name, "s", 0.3 * _DELAY, joint=j.name, secondary=True) for j in situation.mechanism.joints]
        return (Coefficient("delay", "s", _DELAY), *own)

    def shapes(self, situation: Situation) -> tuple[Shape, ...]:
        """None."""
        return ()

    def basis(self, situation: Situation, shape: Tensor) -> Tensor:
        """`... x s x n x (1 + n)`."""
        behind = -_velocity(situation)
        return torch.cat([behind.unsqueeze(-1), by_joint(behind.unsqueeze(-1))], -1)


def _velocity(situation: Situation) -> Tensor:
    columns = [situation.covariates.get(f"speed{i + 1}") for i in range(situation.joints.shape[-1])]
    time = situation.covariates.get("time")
    if time is None or any(c is not None for c in columns):
        zero = torch.zeros_like(situation.joints[..., 0])
        return torch.stack([zero if c is None else c.expand_as(zero) for c in columns], -1)
    return velocity(time, situation.joints)
