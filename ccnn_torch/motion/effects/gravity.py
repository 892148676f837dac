"""Weight that the model lacks or has wrong: sag of an axis that turns against its own weight.

Sine and cosine of the joint's angle, since the direction of the weight is not known; of a sliding axis a constant,
which is an offset.
"""

from __future__ import annotations

from ccnn_torch.motion.effects.protocol import MotionEffect, Number, add

GRAVITY = MotionEffect(
    "gravity",
    lambda axis: (
        Number("torque at 90 degrees", "torque", 0.1, (add("gravity_sin"),), 0.2),
        Number("torque at 0 degrees", "torque", 0.1, (add("gravity_cos"),), 0.0),
    ),
    missing=lambda axis: (
        "" if axis.unit == "rad" else "a turning joint (the weight on a sliding one looks like an offset)"
    ),
)
