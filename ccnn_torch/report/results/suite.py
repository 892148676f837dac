"""`suite.json` of a comparison over several runs."""

from __future__ import annotations

from ccnn_torch.report.results.base import Number, Result, Spread
from ccnn_torch.report.results.run import RowCounts


class Standing(Result):
    """A method in a case, against the noise floor and the best method."""

    mse: Spread
    ratio_to_floor: Spread | None
    ratio_to_best: Spread
    """repeat by repeat"""
    best: bool
    tied: bool
    """see definitions; true for the best itself"""
    close: bool
    seconds: Spread | None
    """of one repeat"""


class Case(Result):
    name: str
    """also the name of its run folder"""
    split: str
    machine: str = ""
    cause: str = ""
    strength: float = 0.0
    rows: int = 0
    noise: Number = None
    case: str | None
    unit: str
    """of all joints"""
    seed: int
    repeats: int
    counts: RowCounts
    floor: Spread | None
    """realised mean squared noise of the held-out rows"""
    best: str
    methods: dict[str, Standing]
    failed_methods: dict[str, str]


class Summary(Result):
    cases: int
    """in which it was asked for"""
    failed: int
    best: int
    best_or_tied: int
    close: int
    share: dict[str, float]
    typical_ratio_to_best: Number
    """geometric mean over the cases of the median ratio"""
    seconds: Number
    """median over the cases"""


class SuiteResults(Result):
    """suite.json of a comparison over several runs. Every number is in SI (m, rad and their squares) and on held-out
    rows, over all joints."""

    name: str
    cases: list[Case]
    failed: dict[str, str]
    """cases without results, and why"""
    methods: dict[str, Summary]
    definitions: dict[str, str]
