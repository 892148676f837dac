"""The config of simulated records: its keys, defaults and checks."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from ccnn_torch.config.tree import JobConfig, MechanismKeys
from ccnn_torch.effects.covariates import SHIFT

Positive = Annotated[float, Field(gt=0)]


class SimulateConfig(JobConfig):
    """What `ccnn simulate` accepts."""

    mechanism_keys: MechanismKeys
    covariates: list[str] | None = Field(
        default=None, description="columns to write, names or patterns; null = all that the rows have"
    )
    rows: Literal["auto", "poses", "trajectory"] = Field(
        default="auto",
        description="poses at rest over the workspace, or moves recorded on the way; auto = moves where latency acts",
    )
    duration: Positive = Field(default=SHIFT, description="time from the first to the last pose at rest, in s")
    step: Positive = Field(default=0.02, description="time between the rows of a move, in s")
    move: Positive = Field(default=1.0, description="how long a move takes, in s")
    way: float = Field(
        default=0.25, gt=0, le=1, description="how far a move goes from one configuration to another one, a share"
    )
    load: Annotated[float, Field(ge=0)] = Field(default=60.0, description="standard deviation of forces, in N")
    moment: Annotated[float, Field(ge=0)] = Field(default=6.0, description="standard deviation of moments, in N*m")
    gravity: tuple[float, float, float] | None = Field(
        default=None,
        description="in the base frame, in m/s^2; null = along -y for a machine in the x-y plane, of an arm on a track "
        "against its first axis that turns, else -z",
    )
    max_condition: float = Field(
        default=50.0, gt=1, description="largest condition number of the Jacobian: farther is too near to a singularity"
    )
    rotation_weight: float = Field(
        default=0.04, gt=0, description="weight of orientation against position in that number, in m per rad"
    )
