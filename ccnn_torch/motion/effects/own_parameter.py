"""A wrong value of a parameter of the user's own simulator."""

from __future__ import annotations

from collections.abc import Mapping

from ccnn_torch.effects.parameter import PARAMETER
from ccnn_torch.motion.effects.protocol import Facts, Number, add

__all__ = ["OWN", "OwnParameter"]

OWN = "own "
"""What the names of a simulator's own parameters begin with among those of an axis."""


class OwnParameter:
    """What the simulator gives at another value of one of its parameters, to first order."""

    def __init__(self, key: str, value: float) -> None:
        self.key, self.name = key, f"{PARAMETER}{key}"
        # Half of it is a plausible error; of one that is 0 nothing is known.
        self.size = 0.5 * abs(value) or 1.0

    def missing(self, axis: Facts) -> str:
        return ""

    def numbers(self, axis: Facts) -> tuple[Number, ...]:
        return (Number(self.key, "1", self.size, (add(f"{OWN}{self.key}"),), 0.0),)

    def shapes(self, axis: Facts) -> tuple[Mapping[str, float], ...]:
        return ({},)
