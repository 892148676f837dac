"""Physical causes of error, one file each, all of one protocol."""

from ccnn_torch.effects.apply import Acting as Acting
from ccnn_torch.effects.apply import labelled as labelled
from ccnn_torch.effects.apply import measured_pose as measured_pose
from ccnn_torch.effects.apply import moved_joints as moved_joints
from ccnn_torch.effects.apply import pose_residual as pose_residual
from ccnn_torch.effects.apply import reached as reached
from ccnn_torch.effects.apply import signature as signature
from ccnn_torch.effects.apply import used_covariates as used_covariates
from ccnn_torch.effects.apply import without_pose_effects as without_pose_effects
from ccnn_torch.effects.protocol import Coefficient as Coefficient
from ccnn_torch.effects.protocol import Effect as Effect
from ccnn_torch.effects.protocol import Kind as Kind
from ccnn_torch.effects.protocol import Shape as Shape
from ccnn_torch.effects.registry import EFFECTS as EFFECTS
from ccnn_torch.effects.registry import EXACT as EXACT
from ccnn_torch.effects.registry import OUTLIER as OUTLIER
from ccnn_torch.effects.registry import effect_names as effect_names
from ccnn_torch.effects.registry import make_effect as make_effect
from ccnn_torch.effects.registry import owned as owned
from ccnn_torch.effects.registry import refuse_one_name as refuse_one_name
from ccnn_torch.effects.registry import tried as tried
from ccnn_torch.effects.situation import PLATFORM_WEIGHT as PLATFORM_WEIGHT
from ccnn_torch.effects.situation import Situation as Situation
from ccnn_torch.effects.situation import default_gravity as default_gravity
