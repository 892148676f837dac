"""The config of a pose plan: its keys, defaults and checks."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from ccnn_torch.config.sizes import Size
from ccnn_torch.config.tree import Columns, JobConfig, JointMap, MechanismKeys, Names, Section


class ParameterConfig(Section):
    """Which parameters are identified, by name or pattern (`A*`, `leg1.*`)."""

    free: Names | None = Field(default=None, description="parameters to identify, names or patterns; null = all")
    fixed: Names = Field(default=[], description="parameters that keep their nominal value, names or patterns")
    tied: list[list[str]] = Field(default=[], description="groups of parameters with one common value")
    prior: dict[str, Size] = Field(
        default={},
        description="standard deviation of a Gaussian prior around the nominal value, by name or pattern, in SI or as "
        "'0.5 mm'",
    )


class PlanConfig(JobConfig):
    """What `ccnn plan` accepts."""

    of_a_run = ("columns", "joint_map", "mechanism", "mechanism_keys", "seed")

    mechanism: str | None = Field(default=None, description="the nominal machine; the same as --mechanism")
    mechanism_keys: MechanismKeys
    columns: Columns
    joint_map: JointMap
    parameters: ParameterConfig = Field(default_factory=ParameterConfig)
    residual: Literal["auto", "inverse", "forward"] = Field(
        default="auto",
        description="how the parameters will be identified: from joints (inverse) or poses (forward); auto = poses "
        "for serial arms and framed mechanisms, else joints",
    )
    noise: Size | dict[str, Size] = Field(
        default=1e-5,
        description="standard deviation of each measured coordinate, in SI or as '0.1 mm': of a position (an angle has "
        "it over 0.3 m), or by coordinate",
    )
    joint_noise: Size | dict[str, Size] = Field(
        default=0.0, description="standard deviation of the recorded joints, in SI or as '0.01 deg', one or by joint"
    )
    candidates: int = Field(default=100_000, ge=10, description="configurations that the poses are chosen from")
    limits: dict[str, tuple[Size, Size]] = Field(
        default={}, description="range of a joint or pose coordinate in SI or with units, {x: [-200 mm, 0.3]}"
    )
    max_condition: float = Field(
        default=50.0, gt=1, description="largest condition number of the Jacobian: farther is too near to a singularity"
    )
    rotation_weight: float = Field(
        default=0.04, gt=0, description="weight of orientation against position in that number, in m per rad"
    )
    per_leg: bool = Field(default=False, description="a plan for each leg's parameters (divide and conquer)")
    repeat: bool = Field(default=False, description="whether a pose may be planned more than once")
    least_gain: float = Field(
        default=0.02, gt=0, lt=1, description="what a further pose must give to be worth measuring, a share"
    )
    margin: float = Field(
        default=2.0,
        ge=0,
        description="poses stay in reach of machines whose parameters are off by so many plausible errors",
    )
    program: Literal["krl", "rapid", "urscript", "gcode"] | None = Field(
        default=None,
        description="write the skeleton of a robot program, too: krl (KUKA), rapid (ABB), urscript or gcode",
    )
    seed: int = Field(default=0, ge=0, lt=2**63, description="seed of the candidates")
