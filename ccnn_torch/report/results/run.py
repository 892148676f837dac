"""`results.json` of a calibration run."""

from __future__ import annotations

from typing import Literal

from pydantic import ConfigDict, Field

from ccnn_torch.report.results.base import Axis, Length, Number, Result, Spread


class Mse(Result):
    mse: Spread


class Errors(Mse):
    """Errors of one joint, or of `all`: squared ones in squared SI units."""

    mae: Spread
    sse: Spread


class Before(Result):
    """Signed errors of a joint before calibration; plain numbers are medians over the repeats."""

    mean: Number
    max: Number
    max_abs: Number
    spread: dict[str, Spread]


class RmsMax(Result):
    rms: Spread
    max: Spread


class MethodPose(Result):
    """Pose error that a method leaves."""

    unit: Length
    rms: Spread
    max: Spread
    explained: RmsMax | None = None


class RowCounts(Result):
    train: int
    validation: int
    test: int
    not_trained_on: int = 0


class Method(Result):
    # null without a reason would be a silent failure.
    model_config = ConfigDict(
        json_schema_extra={"if": {"properties": {"test": {"type": "null"}}}, "then": {"required": ["failed"]}}
    )

    test: dict[str, Errors] | None
    """null where it could not be trained"""
    ratio_to_floor: Spread | None = None
    score: Spread | None = None
    """standardised mean squared error that methods and repeats are chosen by: of the validation rows, or of the test
    rows where none are held out"""
    seconds: Spread | None = None
    """inside the learner, one repeat's share"""
    coverage: Spread | None = None
    """share of the held-out figures inside the domain that lie within 1.96 predictive sd"""
    sd: dict[str, Spread] = {}
    """predictive sd of each joint, median over the held-out rows"""
    converged: Spread | None = None
    """1 where the learner met its own criterion, 0 where not; null = it does not say"""
    evaluations: Spread | None = None
    """passes of all training rows through one model; null = the learner does not count"""
    pose: dict[str, MethodPose | None] = {}
    failed: str | None = None
    """why it could not be trained"""

    @property
    def mse(self) -> Spread | None:
        """Over all joints; None where they have different units, or it was not trained."""
        return self.test["all"].mse if self.test and "all" in self.test else None


class Floor(Result):
    """The error that no model can go below."""

    realised: dict[str, Mse]
    """of the noise drawn in the test rows"""
    expected: dict[str, Mse]
    with_unlearnable: dict[str, Mse] | None = None
    """noise, and what the inputs do not determine"""


class Compared(Result):
    cv: Spread
    standard_error: Number
    seconds: float
    steps: int
    stopped: bool
    """true where the budget ended it"""


class Auto(Result):
    budget: float
    """seconds inside the learners"""
    folds: int
    compared: dict[str, Compared]
    skipped: dict[str, str]
    chosen: str
    why: str


class WithoutOutliers(Result):
    rows: int
    """held-out rows that are far from every model, in the repeat that has most"""
    before: Spread
    after: Spread
    explained: Spread | None = None
    geometry: Spread | None = None
    effects: Spread | None = None


class PoseFigures(Result):
    unit: Length
    before: RmsMax
    after: RmsMax
    """under the commands of the written file"""
    explained: RmsMax | None = None
    """what the model leaves of the measured poses"""
    geometry: RmsMax | None = None
    """identified geometry alone"""
    effects: RmsMax | None = None
    """known effects alone, with geometry"""
    not_compensable: RmsMax | None = None
    """what no joint deviation explains"""
    without_outliers: WithoutOutliers | None = None
    """RMS on the other rows, where some are gross outliers"""

    def led(self, name: str) -> Spread | None:
        """The RMS that a sentence leads with, of `before`, `after` or a part: without gross outliers."""
        block: RmsMax | None = self[name]
        others = None if self.without_outliers is None else self.without_outliers[name]
        return others or (None if block is None else block.rms)


class Energy(PoseFigures):
    rotation_weight: float


class Pose(Result):
    position: PoseFigures
    rotation: PoseFigures | None
    energy: Energy | None = None
    """position error plus weighted rotation error"""

    @property
    def told(self) -> tuple[str, PoseFigures]:
        """The error that a sentence tells, with its name: of the position, or of rotation where nothing else moves."""
        if self.rotation is not None and not self.position.before.rms.median:
            return "rotation", self.rotation
        return "position", self.position

    @property
    def parts(self) -> list[str]:
        """What of the compensator was not learned."""
        return [part for part in ("geometry", "effects") if self.position[part] is not None]


class RecordRows(Result):
    rows: int
    rows_set_aside: list[int]
    why_set_aside: dict[str, int]


class Values(Result):
    unit: str
    values: list[float]


class KnownEffects(Result):
    source: str = Field(validation_alias="from", serialization_alias="from")
    """the diagnosis"""
    test: dict[str, Errors]
    """what they leave by themselves on held-out rows"""
    coefficients: dict[str, dict[str, Values]]
    """their numbers, one a repeat"""


class Geometry(Result):
    chosen: Literal["identify", "none"]
    why: str


class Reached(Result):
    step: int
    seconds: float
    evaluations: Number


class Reach(Result):
    level: float
    set_by: str
    methods: dict[str, Reached | None]
    """null = never"""


class ModelFiles(Result):
    method: str | None
    """whose model files `model.*` and `card.json` are; null = no method has any"""
    without: dict[str, str]
    """why others have none"""
    damped: dict[str, float] = {}
    """share of what a method learned that its model files apply, where all of it was too steep for a command"""
    allow_code: bool = False
    """whether they name a Python file, so that commands with poses need --allow-code"""


class RunResults(Result):
    """results.json of a calibration run. Every number is in SI (m, rad and their squares) and on held-out rows, unless
    its key says otherwise."""

    name: str
    seed: int
    repeats: int
    case: str | None = None
    """a case of the paper: tripod, machine_tool:printed, machine_tool:tabulated; or realistic:MACHINE:CAUSE"""
    joints: list[Axis]
    best_method: str | None = None
    chosen_by: Literal["folds", "validation", "test"] = "test"
    rows: RowCounts
    before: dict[str, Before]
    before_train: dict[str, Before] | None = None
    methods: dict[str, Method]
    constant: Method
    """the mean deviation of the training rows"""
    floor: Floor | None
    """null where it is unknown"""
    auto: Auto | None = None
    """how methods=auto chose"""
    pose: Pose
    records: RecordRows | None = None
    effects: KnownEffects | None = None
    """known effects that are a part of the compensator"""
    data_sha256: str | None = None
    geometry: Geometry | None = None
    """what the key geometry ended as, and why"""
    notes: list[str] = []
    versions: dict[str, str] = {}
    reach: Reach | None = None
    """effort until the median held-out mse of all joints is at or below one level"""
    model: ModelFiles | None = None
