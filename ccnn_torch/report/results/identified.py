"""`identified.json`."""

from __future__ import annotations

from typing import Literal

from ccnn_torch.report.results.base import Ends, Length, Number, Result

Spreads = dict[str, Ends]
"""5 % and 95 % over the machines, by figure."""


class RowCounts(Result):
    train: int
    per_leg: dict[str, int] = {}
    test: int


class Parameter(Result):
    nominal: float
    value: float
    sd: Number
    """standard error; null where the rows do not tell the parameter, or it is not free"""
    true: Number = None
    error_before: Number = None
    deviation: Number = None
    spread: Spreads = {}
    free: bool
    identifiable: bool
    unit: str
    leg: int | None
    word: str = ""
    """what people call it; empty where the name is the word"""
    shown: str = ""
    """the unit that they tell it in; empty = SI"""


class PoseGap(Result):
    unit: Length
    before: Number
    after: Number
    mean_before: Number = None
    mean_after: Number = None
    max_before: Number
    max_after: Number
    noise: Number = None
    spread: Spreads = {}
    removed: Number = None


class Poses(Result):
    position: PoseGap | None
    rotation: PoseGap | None


class Deviation(Result):
    largest: Number = None
    mean: Number = None
    median: Number = None
    spread: Spreads = {}


class Bound(Result):
    """Standard deviation over the machines divided by the Cramér-Rao bound, over the parameters."""

    median: Number
    lowest: Number
    highest: Number


class Compensation(Result):
    exact: Poses
    linear: Poses


class Solved(Result):
    test: Poses
    seconds: float
    machines: int
    per_leg: bool
    converged: float
    evaluations: int
    deviations: dict[str, Deviation] | None
    bound: Bound | None
    coverage: Number
    compensation: Compensation | None


class NoiseRatio(Result):
    value: Number
    spread: Spreads = {}


class CountFigures(Result):
    position: Number
    deviation: Number
    spread: Spreads = {}


class Count(Result):
    poses: int
    methods: dict[str, CountFigures]


class PromisedError(Result):
    unit: Length
    before: float
    rms: float
    spread: float
    """variance over squared mean of the squared error of a configuration"""


class Promise(Result):
    rows: int
    configurations: int
    position: PromisedError | None
    rotation: PromisedError | None


class Placement(Result):
    number: float
    columns: dict[str, float]
    rows: int


class Unknown(Result):
    value: float
    sd: Number
    unit: str


class Beside(Result):
    kind: Literal["pose", "sockets", "distances", "plane"]
    records: str
    rows: int
    unit: Literal["m", "rad"] = "m"
    """of noise, before and after"""
    noise: float
    """standard deviation of one equation: given, or that of the residuals"""
    before: float
    """RMS of what an equation is off by, links nominal"""
    after: float


class Read(Result):
    unit: Literal["m", "rad"]
    rows: int
    noise: float
    """standard deviation: given, or that of the residuals; readings of one instrument in one unit share it"""
    noise_known: bool
    before: float
    """RMS of what the reading is off by, links nominal"""
    after: float


class Constraint(Result):
    kind: Literal["sockets", "distances", "plane", "pose"]
    placements: list[Placement]
    unknowns: dict[str, Unknown]
    """where plates, anchors or planes stand"""
    unit: Literal["m", "rad"] = "m"
    """of noise"""
    noise: float
    """standard deviation of one equation: given, or that of the residuals"""
    noise_known: bool
    beside: list[Beside] = []
    """rows of other kinds in the same fit; none of them is held out"""
    readings: dict[str, Read] = {}
    """what instruments of several kinds read, by column"""


class Transfer(Result):
    records: str
    rows: RowCounts
    test: Poses


class IdentifiedResults(Result):
    """identified.json: what an identification found. SI units. With several machines every number is the median over
    them, and spread has 5 % and 95 % beside it. null = not known."""

    name: str
    seed: int
    mechanism: str
    allow_code: bool = False
    """whether identified.yaml names a Python file, so that commands need --allow-code"""
    machines: int
    simulated: bool
    rows: RowCounts
    method: str
    """whose values stand under parameters: the first of the config"""
    parameters: dict[str, Parameter]
    combinations_not_identifiable: list[str]
    test: Poses
    """held-out measured poses against those predicted by nominal (before) and identified (after) geometry; RMS,
    mean and maximum"""
    methods: dict[str, Solved]
    compensation: Compensation | None
    singular_values: list[list[float]]
    noise_ratio: NoiseRatio
    """standard deviation of the residuals that the fit leaves, in units of the noise where that is known"""
    doubts: list[str]
    """sentences that say what speaks against the figures: a noise that does not fit, an error that stays"""
    counts: list[Count]
    paper: Literal["001", "004"] | None
    """null since the papers' tables are those of `python -m benchmarks.papers`"""
    data_sha256: str | None
    notes: list[str]
    versions: dict[str, str]
    promise: Promise | None = None
    """what the held-out rows promise for new ones (ccnn verify)"""
    constraint: Constraint | None = None
    """what held the tool instead of a measuring device; test.position is then the distance of held-out rows from where
    it held them"""
    transfer: Transfer | None = None
    """the same arm on other records, its frames fitted anew, on held-out rows"""
