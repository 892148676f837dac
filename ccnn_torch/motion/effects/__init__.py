"""Effects of motion, one file each: delay, gains, weights, friction, play, flexibility, limits."""

from ccnn_torch.motion.effects.protocol import Facts as Facts
from ccnn_torch.motion.effects.protocol import MotionEffect as MotionEffect
from ccnn_torch.motion.effects.protocol import Number as Number
from ccnn_torch.motion.effects.registry import EFFECTS as EFFECTS
from ccnn_torch.motion.effects.registry import EXACT as EXACT
from ccnn_torch.motion.effects.registry import motion_effects as motion_effects
