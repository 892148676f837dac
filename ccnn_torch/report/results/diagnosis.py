"""`diagnosis.json`, of poses and of a motion."""

from __future__ import annotations

from typing import Any, Generic, Literal, TypeVar

from pydantic import Field

from ccnn_torch.report.results.base import Ends, Length, Number, Result
from ccnn_torch.report.results.identified import Promise

_Share = TypeVar("_Share")
_Region = TypeVar("_Region")
_Regime = TypeVar("_Regime")
_Phase = TypeVar("_Phase")


class NominalMachine(Result):
    name: str
    joints: list[str]
    gravity: list[float]


class Gap(Result):
    unit: Length
    before: float
    after: float
    noise_floor: float
    reducible_share: float


class Region(Result):
    center: dict[str, float]
    half_width: dict[str, float]
    share: float
    rows: int


class Regime(Result):
    low: float = Field(validation_alias="from", serialization_alias="from")
    high: float = Field(validation_alias="to", serialization_alias="to")
    share: float
    rows: int = 1
    """how many rows have such a value"""


class Phase(Result):
    share: float
    samples: float
    """share of the samples in it"""


class Places(Result, Generic[_Share, _Region, _Regime, _Phase]):
    """Shares of the gap, or their intervals."""

    outputs: dict[str, _Share]
    joints: dict[str, _Share]
    legs: dict[str, _Share]
    regions: list[_Region]
    covariates: dict[str, list[_Regime]]
    phases: dict[str, _Phase] | None = None
    """of a motion: standstill, reversal, fast, slow"""


class About(Result):
    joint: str
    value: float
    unit: str


class Coefficient(Result):
    value: float
    sd: Number
    unit: str
    part: str | None = None
    """the one joint, leg or link that it belongs to"""
    nominal: Number = None
    """what the model has, of a parameter of the mechanism; the value is the difference to it"""
    together: int = 1
    """of a parameter of the mechanism: how many of its effect's clearest numbers, entered together, leave no more than
    1.2 times what is promised"""
    sense: str = ""
    """which way it counts, where that is not the usual one"""
    word: str = ""
    """what people call it, where the machine's file says so"""
    shown: str = ""
    """the unit that they tell it in"""
    searched: bool = False
    """whether it is a period, a time constant or the like, for which values were tried: no test against 0 exists"""
    about: About | None = None
    """of a gain: the joint that it multiplies, and the command of it from which it counts [SI]"""


class Signature(Result):
    angle: float
    """between what this effect does to the rows and all that the other can do [rad]"""
    separation: float
    """the difference that it makes, in units of the noise"""


class Step(Result):
    name: str
    gap_after: float
    shrink: Number
    shrink_ci95: Ends | None


class Effect(Result):
    name: str
    probability: float
    parameters: dict[str, Coefficient]
    gap_before: float
    gap_after: float
    shrink: Number
    shrink_ci95: Ends | None
    indistinguishable_from: list[str]
    signatures: dict[str, Signature]


class BlockGap(Result):
    rows: int
    before: float
    after: float


class ByBlock(Result):
    unit: Length
    before: float
    after: float
    noise_floor: float
    shrink: Number
    shrink_ci95: Ends | None
    blocks: list[BlockGap]


class Network(Result):
    unit: Length
    rows: int
    gap_before: float
    gap_after: Number
    """null where nothing was left to learn, for the reason given"""
    gap_after_ci95: Ends | None
    gain: Number
    gain_ci95: Ends | None
    reason: str


class Verdict(Result):
    effects: list[str]
    probability: float
    shrink: Number
    shrink_ci95: Ends | None
    none: bool
    outside_library: bool
    driver: str | None
    drivers: list[str]
    """the driver, and with a product of two both of them"""
    text: str


class JointVerdict(Result):
    joint: str
    word: str = ""
    """what the source of the logs calls the joint"""
    effects: list[str]
    classes: dict[str, list[str]]
    """of each effect what can stand in its place at this joint"""
    probability: float
    driver: str | None
    """what a rest follows that no effect describes; null where there is none"""
    gap_before: float
    gap_after: float


class NextMotion(Result):
    joint: str
    kind: str
    text: str
    seconds: float
    gain: float
    """factor on the proportional gain"""
    load: float
    """whether a load is added, as the angle that it costs"""


class NextMeasurement(Result):
    joints: dict[str, float]
    covariates: dict[str, float]
    motion: NextMotion | None = None
    """of a machine in motion: the motion to record, in joints its amplitude"""
    separates: list[str]
    gain: float


class MissingColumns(Result):
    columns: list[str]
    effects: dict[str, float]
    unit: Length
    constant: bool = False
    """whether they were recorded, and never change"""


class Covariate(Result):
    unit: str
    range: Ends


class ActingEffect(Result):
    name: str
    coefficients: list[float]
    shapes: list[float]


class FoundMachine(Result):
    nominal: dict[str, Any]
    parameters: dict[str, float]
    gravity: list[float]
    joints: dict[str, Ends]
    covariates: dict[str, Covariate]
    effects: list[ActingEffect]
    columns: dict[str, str] = {}
    joint_map: dict[str, str] = {}


class DiagnosisResults(Result):
    """diagnosis.json: which effect makes the gap between a model and measured records, where it lies, how far it
    shrinks. SI units; gaps are RMS over held-out rows. shrink = 1 - (after^2 - floor^2)/(before^2 - floor^2), clipped
    to 0 to 1; null where before is not above the floor."""

    motion: bool = False
    """true where the diagnosis is of time series of a machine in motion: gaps are then of the joints, in their unit"""
    mechanism: NominalMachine
    """the nominal machine, its joints in order, and gravity in its base frame [m/s^2]"""
    noise: Literal["given", "columns", "repeats", "estimated"]
    """where the size of the noise is from: given, columns of the records, repeated readings of one target, or estimated
    from what the best explanation leaves, which may hold another cause"""
    gap: Gap
    gap_rotation: Gap | None
    where: Places[float, Region, Regime, Phase]
    where_ci95: Places[Ends, Ends, Ends, Ends]
    """95 % intervals of the shares in where, in the same places; regions and regimes in the same order"""
    encoder_step: Number = None
    """of a motion the smallest step of its positions [unit of the gap]; null where there is none"""
    effects: list[Effect]
    in_order: list[Step]
    """the verdict's effects added to the model one after the other, the largest first, each step refitted"""
    by_block: ByBlock | None
    """gap and shrink of the verdict's effects where rows are held out in five blocks along the direction in which the
    joints vary most; null where the verdict names nothing"""
    network: Network | None
    """what a network trained on what the effects leave would still gain on rows not used for training; null where it
    was not asked for"""
    verdict: Verdict
    """of a motion of several joints, its probability is that of the least sure one"""
    joints: list[JointVerdict] = []
    """of a motion the verdict on each joint; their numbers are in effects"""
    next_measurements: list[NextMeasurement]
    missing_covariates: list[MissingColumns]
    """columns that were not recorded and would bring further effects into sight, most promising first, with the
    plausible size of each effect on these poses"""
    not_seen: dict[str, str]
    """effects that these records cannot show, with what is missing"""
    rows_set_aside: list[int]
    why_set_aside: list[str]
    """the reason for each of rows_set_aside"""
    cautions: list[str]
    """signs that records and model do not fit each other, one sentence each; they stand in verdict.text as well"""
    notes: list[str]
    frames: dict[str, list[float]] = {}
    """how far an arm's base and tool, where they were fitted, are from the model's with the verdict's numbers in it:
    shift [m] and rotation vector [rad], in the frame before. Errors of link 1's place and of the flange hide in them"""
    machine: FoundMachine | None = None
    """the machine with these effects, fitted together to all rows, as a compensator takes it"""
    promise: Promise | None = None
    """what the rows promise for new ones (ccnn verify), each by fits to others; null without a machine, or where it
    lacks an effect of the verdict"""
