"""Weight that the model lacks or has wrong: sag of an axis that turns against its own weight.

Sine and cosine of the joint's angle, since the direction of the weight is not known; of a sliding axis a constant,
which is an offset.
"""

from __future__ import annotations

from collections.abc import Mapping

from ccnn_torch.motion.effects.protocol import Facts, Number, add

__all__ = ["GRAVITY"]


class _Gravity:
    name = "gravity"

    def missing(self, axis: Facts) -> str:
        return "" if axis.unit == "rad" else "a turning joint (the weight on a sliding one looks like an offset)"

    def numbers(self, axis: Facts) -> tuple[Number, ...]:
        return (
            Number("sin", "torque", 0.1, (add("gravity_sin"),), 0.2),
            Number("cos", "torque", 0.1, (add("gravity_cos"),), 0.0),
        )

    def shapes(self, axis: Facts) -> tuple[Mapping[str, float], ...]:
        return ({},)


GRAVITY = _Gravity()
