"""`verify.json`."""

from __future__ import annotations

from typing import Literal

from ccnn_torch.report.results.base import Length, Number, Result


class Size(Result):
    rms: float
    max: float


class Middle(Result):
    median: float
    max: float


class Promised(Result):
    rms: float
    low: float
    high: float


class Error(Result):
    unit: Length
    before: Size
    after: Size
    promised: Promised | None


class JointError(Result):
    unit: str
    before: Number
    after: Number


class Repeated(Result):
    """Accuracy and repeatability of poses (ISO 9283:1998, 7.2), of the targets that were reached three times or more;
    beside each the median and the largest over them."""

    targets: int
    cycles: int
    """readings of the target that has the fewest"""
    accuracy: Middle
    """AP: distance of the mean position from the commanded one, without the model"""
    accuracy_after: Middle
    """the same with it"""
    repeatability: Middle
    """RP: mean distance of a reading from the mean of its target, and three standard deviations of it"""


class VerifyResults(Result):
    """verify.json: a model judged on rows that it has never seen. SI units. null = not known."""

    model: str
    records: str
    mechanism: str
    rows: int
    configurations: int
    """rows at the same commanded joints count once"""
    outside_domain: int
    """rows outside the model's domain"""
    compensated: bool
    """the machine was commanded by the model while it was measured"""
    frames: Literal["the model's", "fitted again"]
    position: Error
    rotation: Error | None
    repeated: Repeated | None = None
    """null where no target was reached three times"""
    joints: dict[str, JointError]
    """RMS of each joint's deviation; null where no row has one"""
    kept: bool
    notes: list[str]
    text: str
