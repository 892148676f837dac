"""The causes that the effects library has a name for."""

from __future__ import annotations

from collections.abc import Callable

from ccnn_validation.sources.shop import body_causes, joint_causes
from ccnn_validation.sources.shop.cause import Cause, Random
from ccnn_validation.sources.shop.machine import Machine

__all__ = ["LIBRARY"]

LIBRARY: dict[str, Callable[[Machine, Random], Cause]] = {
    "geometry": body_causes.geometry,
    "joint_offset": joint_causes.joint_offset,
    "joint_gain": joint_causes.joint_gain,
    "transmission": joint_causes.transmission,
    "backlash": joint_causes.backlash,
    "friction": joint_causes.friction,
    "compliance": joint_causes.compliance,
    "gravity": joint_causes.gravity,
    "thermal": body_causes.thermal,
    "drift": joint_causes.drift,
    "frame": body_causes.frame,
    "tool": body_causes.tool,
    "coupling": joint_causes.coupling,
    "latency": joint_causes.latency,
    "instrument": body_causes.instrument,
}
"""In this order they are dealt."""
