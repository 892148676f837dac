"""Physical causes of error, one class each, all of one protocol."""

from ccnn_torch.doors import door

TYPE_CHECKING = False
if TYPE_CHECKING:
    from ccnn_torch.effects.apply import (
        Acting as Acting,
        filled as filled,
        labelled as labelled,
        measured_channels as measured_channels,
        measured_pose as measured_pose,
        moved as moved,
        moved_joints as moved_joints,
        pose_residual as pose_residual,
        reached as reached,
        signature as signature,
        used_covariates as used_covariates,
        without_pose_effects as without_pose_effects,
    )
    from ccnn_torch.effects.protocol import Coefficient as Coefficient, Effect as Effect, Kind as Kind, Shape as Shape
    from ccnn_torch.effects.registry import (
        EFFECTS as EFFECTS,
        EXACT as EXACT,
        OUTLIER as OUTLIER,
        check_names as check_names,
        effect_names as effect_names,
        make_effect as make_effect,
        missing_on as missing_on,
        owned as owned,
    )
    from ccnn_torch.effects.situation import (
        PLATFORM_WEIGHT as PLATFORM_WEIGHT,
        Situation as Situation,
        default_gravity as default_gravity,
    )
else:
    __getattr__, __all__ = door(__name__)
