"""Neural compensation of robot kinematics: every source of error as one deviation of the actuated joints.

The names below are loaded on first use, so that `ccnn --help` does not wait for torch.
"""

from __future__ import annotations

from ccnn_torch.doors import door

TYPE_CHECKING = False
if TYPE_CHECKING:
    from ccnn_torch.api import (
        calibrate as calibrate,
        diagnose_motion as diagnose_motion,
        identify as identify,
        since as since,
        verify as verify,
    )
    from ccnn_torch.compensation import (
        Compensator as Compensator,
        export_model as export_model,
        load_model as load_model,
        save_model as save_model,
    )
    from ccnn_torch.diagnosis import diagnose as diagnose
    from ccnn_torch.mechanisms import Mechanism as Mechanism, load_mechanism as load_mechanism
    from ccnn_torch.pseudoerror import joint_deviations as joint_deviations
    from ccnn_torch.records import load_records as load_records
    from ccnn_torch.version import __version__ as __version__
else:
    __getattr__, __all__ = door(__name__)
