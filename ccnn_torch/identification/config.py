"""The config of an identification: its keys, defaults and checks.

Relative paths in a config file start from the file's folder, those on the command line from the current one.
"""

from __future__ import annotations

from typing import Any, Literal

from pydantic import Field, field_validator, model_validator

from ccnn_torch.config.sizes import Size
from ccnn_torch.config.split import HeldOutConfig
from ccnn_torch.config.tree import (
    Columns,
    Files,
    JobConfig,
    JointMap,
    MechanismKeys,
    Names,
    Section,
)
from ccnn_torch.identification.solvers import SOLVERS, unknown_solver
from ccnn_torch.planning.config import ParameterConfig

PER_LEG = "_per_leg"
"""A method with this ending identifies each leg from its own equations alone."""


class FrameConfig(Section):
    """Whether the measuring frame and the tool frame are unknown, too (parallel mechanisms)."""

    base: bool = Field(default=False, description="identify the pose of the mechanism in the measuring frame")
    tool: bool = Field(default=False, description="identify where the measured target sits on the platform")


class BesideConfig(Section):
    """Rows of another kind that the same machine has to explain."""

    kind: Literal["pose", "sockets", "distances", "plane"] = Field(
        description="pose (what was measured of the pose, all or a part), or a kind of constraint"
    )
    records: Files = Field(description="their file, with the columns of that kind")
    by: Names | None = Field(default=None, min_length=1, description="as constraint.by")
    instrument: dict[str, Any] | None = Field(
        default=None, description="what measured rows of kind pose, e.g. {kind: level} or {kind: wire, anchors: 2}"
    )
    noise: Size | None = Field(
        default=None, description="standard deviation of one of their equations; null = that of the residuals"
    )


class ConstraintConfig(Section):
    """What holds the tool instead of a measuring device; see `docs/how_to/identify.md`."""

    kind: Literal["sockets", "distances", "plane", "pose"] = Field(
        default="sockets",
        description="sockets (a ball in sockets of a plate; columns x, y, z = the socket's place on the plate), "
        "distances (column distance; from an anchor, or to the place of a second set of joints in columns such as "
        "q1_b), plane (points on a plane; column reading of a dial gauge, or none) or pose (a part of the pose, in "
        "the machine's own base)",
    )
    by: Names | None = Field(
        default=None,
        min_length=1,
        description="columns whose values number the placement, anchor or plane; default placement, anchor or plane",
    )
    tolerance: Size | dict[str, Size] | None = Field(
        default=None,
        description="prior standard deviation of the links' parameters, by name, pattern or unit, e.g. {m: 1 mm, "
        "rad: 0.1 deg}, or one number in m and rad alike; null, or of what is not named: as in the machine file, else "
        "1 mm and 10 mrad",
    )
    plate_tolerance: Size | None = Field(
        default=None,
        description="standard deviation of the plate's largest extent (sockets); null = 0.1 mm where there are several",
    )
    where: dict[str, float] = Field(
        default={}, description="values that a row's columns must have to take part, e.g. {robot: 1}"
    )
    beside: list[BesideConfig] = Field(
        default=[],
        description="further rows in the same fit, each with kind, records, by and noise, e.g. [{kind: pose, "
        "records: bed.csv}]",
    )


class SimulateConfig(Section):
    """Simulated machines, each with errors of its own, measured with noise."""

    machines: int = Field(default=1, ge=1, description="machines, side by side; machine k has seed + k")
    poses: int = Field(default=24, ge=1, description="poses measured of each machine")
    design: Literal["random", "even", "planned", "planned_per_leg"] = Field(
        default="even",
        description="how poses are chosen: random (each machine its own), even (low discrepancy in the box), planned "
        "(the most informative), or planned_per_leg (poses / legs of them for each leg, from which that leg alone "
        "is identified by the methods *_per_leg; the others get planned ones)",
    )
    candidates: int = Field(default=4000, ge=10, description="poses that planned ones are chosen from")
    noise: Size | dict[str, Size] = Field(
        default=1e-5,
        description="standard deviation of each measured coordinate, in SI or as '0.01 mm': of a position (an angle "
        "has it over 0.3 m), or by coordinate; of each coordinate of each point where points are measured",
    )
    joint_noise: Size | dict[str, Size] = Field(
        default=0.0, description="standard deviation of the recorded joints, one size or by joint"
    )
    errors: Size | dict[str, Size] = Field(
        default={},
        description="standard deviation of each parameter's error by name, pattern or unit (m, rad, 1); one number "
        "multiplies the usual sizes; what is not named has its usual size (m: 1e-3, rad: 2e-3, 1: 2e-3), and 0 where "
        "values are given",
    )
    values: dict[str, Size] = Field(
        default={}, description="errors that every machine has beside the random ones, by parameter"
    )
    box: dict[str, tuple[Size, Size]] = Field(
        default={}, description="range of a pose coordinate, [low, high]; null = the mechanism's own"
    )
    circle: bool = Field(default=False, description="poses inside the mechanism's maximal inscribed circle")
    points: list[tuple[Size, Size, Size]] | None = Field(
        default=None,
        min_length=3,
        max_length=3,
        description="three points on the platform that are measured instead of the pose, x, y, z in its frame",
    )
    as_built: bool = Field(
        default=False,
        description="machines that leave the nominal motion by their errors, where the mechanism knows how "
        "(overconstrained_2dof); needs points",
    )
    test_poses: int = Field(default=100, ge=1, description="held-out poses, measured with the same noise")
    counts: list[int] = Field(
        default=[], description="numbers of measured poses for which the study is repeated (measurements needed)"
    )


class IdentifyConfig(JobConfig):
    """An identification: mechanism, data, parameters, methods."""

    of_a_run = ("name", "seed", "records", "columns", "joint_map", "mechanism", "mechanism_keys", "split")

    name: str = Field(
        default="identification", min_length=1, description="name of the run; default: the config file's name"
    )
    seed: int = Field(default=0, ge=0, lt=2**63, description="seed of the first machine; machine k has seed + k")
    out: str | None = Field(default=None, description="folder to write; default runs/NAME-STAMP")
    mechanism: str = Field(
        default="",
        description="a mechanism's name, a DH file (.yaml), a URDF, an identified.yaml, or file.py:Name",
    )
    mechanism_keys: MechanismKeys
    links: Literal["lean", "given"] = Field(
        default="lean",
        description="parameters of a serial arm's links: those of its file, and of parallel axes their lean against "
        "each other, which a Denavit-Hartenberg table lacks (lean); or those of its file alone (given)",
    )
    frame: FrameConfig = Field(default_factory=FrameConfig)
    records: Files | None = Field(
        default=None,
        description="measured records, a CSV file (or .xlsx) with headers name[unit], or a list of such files",
    )
    columns: Columns
    joint_map: JointMap
    simulate: SimulateConfig | None = Field(default=None, description="simulated machines instead of records")
    constraint: ConstraintConfig | None = Field(
        default=None, description="what holds the tool in the records, which then have no measured pose"
    )
    transfer: str | None = Field(
        default=None,
        description="records of the same arm in another place: its frames are fitted to them anew, the identified "
        "links stay, and held-out rows judge (split as the records are)",
    )
    noise: Size | dict[str, Size] | None = Field(
        default=None, description="known noise of the records' pose, as simulate.noise; null = estimated from the fit"
    )
    joint_noise: Size | dict[str, Size] | None = Field(
        default=None, description="known noise of the records' joints, one size or by joint; null = none"
    )
    split: HeldOutConfig = Field(default_factory=HeldOutConfig)
    residual: Literal["auto", "inverse", "forward"] = Field(
        default="auto",
        description="compare joints (inverse kinematics of the measured pose) or poses (forward kinematics); auto = "
        "poses for serial arms and where a frame is identified, else joints",
    )
    rotation_weight: float = Field(
        default=0.3, gt=0, description="weight of orientation against position in m per rad, where noise is not known"
    )
    parameters: ParameterConfig = Field(default_factory=ParameterConfig)
    methods: Names = Field(
        default=["lm"],
        min_length=1,
        description="solvers: a list of lm, hga and tikhonov, each also as NAME_per_leg; all = the three",
    )
    per_leg: bool = Field(
        default=False, description="identify each leg from its own equations in every method, not only NAME_per_leg"
    )
    robust: Literal["huber", "cauchy"] | None = Field(
        default=None, description="loss of lm that outliers cannot pull at: huber or cauchy; null = least squares"
    )
    starts: int = Field(default=1, ge=1, description="starts of lm, the first at the nominal values")
    hga_machines: int = Field(default=5, ge=1, description="machines that hga is run on, at most")
    settings: dict[str, dict[str, Any]] = Field(
        default={}, description="settings of a method, e.g. {hga: {generations: 500}}"
    )
    refit: bool = Field(
        default=True,
        description="fit again to all rows of the records when held-out rows have judged the first fit: the values and "
        "identified.yaml are of all rows (methods lm and tikhonov; not where split.test names a file)",
    )
    save_report: bool = Field(default=True, description="draw plots/ and write report.html")

    def fits_again(self) -> bool:
        """Whether what was judged is fitted again to all rows."""
        return self.refit and self.records is not None and self.split.test_file is None

    @field_validator("methods")
    @classmethod
    def _known(cls, methods: list[str]) -> list[str]:
        if methods == ["all"]:
            return list(SOLVERS)
        for method in methods:
            if base_method(method) not in SOLVERS:
                raise ValueError(unknown_solver(method, PER_LEG))
            if methods.count(method) > 1:
                raise ValueError(f"'{method}' is given twice")
        return methods

    @model_validator(mode="after")
    def _one_source(self) -> IdentifyConfig:
        if not self.mechanism:
            raise ValueError("mechanism: name one, e.g. mechanism=five_bar, a DH file, a URDF or file.py:Name")
        if (self.records is None) == (self.simulate is None):
            both = "both records and simulate are given; remove one" if self.records else "no data is named"
            raise ValueError(f"{both}: records=FILE.csv, or a section simulate with machines, poses and noise")
        if self.constraint is not None:
            self._constrained(self.constraint)
        if self.transfer is not None and self.records is None:
            raise ValueError("transfer: needs measured records; write records=FILE.csv, or remove the key")
        if self.transfer is not None and self.split.test_file is not None:
            raise ValueError(
                "transfer: its rows are split as the records are, and split.test names a file; write a share"
            )
        if self.simulate is not None and (self.columns or self.joint_map or self.split.test_file):
            raise ValueError(
                "columns, joint_map and a file in split.test: simulated machines read no file; remove the key"
            )
        if self.simulate is not None and (self.noise is not None or self.joint_noise is not None):
            raise ValueError("noise: simulated data has simulate.noise and simulate.joint_noise; remove the key")
        if self.simulate is not None and self.simulate.points and self.residual == "forward":
            raise ValueError("residual: measured points are compared by joints; write residual=inverse or auto")
        if self.simulate is not None and self.simulate.as_built and not self.simulate.points:
            raise ValueError("simulate.as_built: such a machine is measured by points; give simulate.points")
        wrong = [name for name in self.settings if name not in SOLVERS]
        if wrong:
            raise ValueError(f"settings: {unknown_solver(wrong[0])}")
        return self

    def _constrained(self, constraint: ConstraintConfig) -> None:
        """Refuse what a constraint has no use for."""
        refused = {
            "simulate": (self.simulate is not None, "needs records; write records=FILE.csv"),
            "methods": (self.methods != ["lm"], "is identified by lm alone; write methods=[lm]"),
            "residual": (self.residual != "auto", "has a residual of its own; remove the key"),
            "per_leg": (self.per_leg, "depends on all legs; remove the key"),
            "frame.base": (self.frame.base, "has no known place and cannot determine the base frame; remove the key"),
            "noise": (
                isinstance(self.noise, dict) and constraint.kind != "pose",
                "has one noise; write one size, e.g. noise='0.02 mm'",
            ),
            "joint_noise": (self.joint_noise is not None, "has one noise, that of the whole; remove the key"),
            "transfer": (self.transfer is not None, "has no measured poses to transfer to; remove the key"),
            "split.kind": (self.split.kind == "block", "measures no positions to sort by; write random or group"),
            "constraint.plate_tolerance": (
                constraint.kind != "sockets" and constraint.plate_tolerance is not None,
                f"of kind {constraint.kind} has no plate; remove the key",
            ),
        }
        for key, (wrong, why) in refused.items():
            if wrong:
                raise ValueError(f"{key}: a constraint {why}")


def base_method(method: str) -> str:
    """`lm` of `lm` and of `lm_per_leg`."""
    return method.removesuffix(PER_LEG)
