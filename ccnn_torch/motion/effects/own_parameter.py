"""A wrong value of a parameter of the user's own simulator."""

from __future__ import annotations

from ccnn_torch.effects.constant import PARAMETER
from ccnn_torch.motion.effects.protocol import MotionEffect, Number, add

OWN = "own "
"""What the names of a simulator's own parameters begin with among those of an axis."""


def own_parameter(key: str, value: float) -> MotionEffect:
    """What the simulator gives at another value of one of its parameters, to first order."""
    # Half of it is a plausible error; of one that is 0 nothing is known.
    number = Number(key, "", 0.5 * abs(value) or 1.0, (add(f"{OWN}{key}"),), 0.0, model=value)
    return MotionEffect(f"{PARAMETER}{key}", lambda axis: (number,))
