"""Effects of motion by subject: control loop and drive, masses, friction, gears."""

from ccnn_torch.motion.effects.protocol import Facts as Facts, MotionEffect as MotionEffect, Number as Number
from ccnn_torch.motion.effects.registry import EFFECTS as EFFECTS, EXACT as EXACT, motion_effects as motion_effects
