"""Axes in motion, simulated in MuJoCo, whose models are changed by a known cause.

It shares no formula with `ccnn_torch.motion`, but its author: it was written before anything there was tuned. A cause
is an element of MuJoCo's model (damping, friction loss, armature, force range, a second hinge with a range or a
spring), a change of what the controller is told, or a torque that is applied.
"""

from __future__ import annotations

from ccnn_validation.sources.motion.families import FAMILIES
from ccnn_validation.sources.motion.records import make

__all__ = ["FAMILIES", "make"]
