"""`since.json`."""

from __future__ import annotations

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
