"""`verify.json`."""

from __future__ import annotations

from typing import Literal

from ccnn_torch.report.results.base import Length, Number, Result


class ChangedNumber(Result):
    """One number of a change: what the machine has more of it than the model."""

    name: str
    unit: str
    value: float
    sd: float


class Change(Result):
    """A cause that may have changed by itself, such as the zero of one joint."""

    name: str
    text: str
    probability: float
    """that it is among what changed"""
    seen_from: Number
    """size of its first number that these rows would have shown, all others unchanged; null where it has many"""
    unit: str
    """of `seen_from`"""


class Told(Result):
    """A change of the verdict."""

    name: str
    text: str
    numbers: list[ChangedNumber]
    instead: list[str]
    """changes that these rows do not tell from it"""
    look: str
    """where to look on the machine"""


class Gap(Result):
    """RMS of the new rows' error about the model, and what the verdict leaves of it in rows it was not fitted to."""

    unit: Length
    before: float
    after: Number
    """each configuration left out in turn; null where nothing changed"""
    promised: float
    """RMS of rows held out when the model was made"""


class NextPose(Result):
    joints: dict[str, float]
    gain: float
    """expected information [nat]"""
    separates: list[str]
    """changes that the pose tells apart; empty where it makes the numbers sharper"""


class SinceResults(Result):
    """since.json: what changed on a machine since its model was made. SI units. null = not known."""

    model: str
    records: str
    mechanism: str
    rows: int
    configurations: int
    """rows at the same commanded joints count once"""
    changed: list[Told]
    probability: float
    """that the verdict is right"""
    rest: bool
    """whether more is left than the model promises, which no change here explains"""
    position: Gap
    rotation: Gap | None
    changes: list[Change]
    """all that was weighed, the most probable first"""
    next_measurements: list[NextPose]
    notes: list[str]
    text: str


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

    @property
    def kinds(self) -> list[Literal["position", "rotation"]]:
        """Which errors there are: of a machine that only turns, none of the position."""
        if self.rotation is None:
            return ["position"]
        return ["position", "rotation"] if self.position.before.rms else ["rotation"]
