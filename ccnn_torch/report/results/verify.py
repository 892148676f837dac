"""`verify.json`."""

from __future__ import annotations

from typing import Literal

from ccnn_torch.report.results.base import Length, Number, Result


class Size(Result):
    rms: float
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
    joints: dict[str, JointError]
    """RMS of each joint's deviation; null where no row has one"""
    kept: bool
    notes: list[str]
    text: str
