"""Diagnosis of a machine in motion, from logs of time, commands and positions."""

from ccnn_torch.doors import door

TYPE_CHECKING = False
if TYPE_CHECKING:
    from ccnn_torch.motion.engine import MotionDiagnosis as MotionDiagnosis, diagnose_motion as diagnose_motion
    from ccnn_torch.motion.feed_forward import Corrected as Corrected, corrected_command as corrected_command
    from ccnn_torch.motion.identified import (
        Identified as Identified,
        load_identified as load_identified,
        write_identified as write_identified,
    )
    from ccnn_torch.motion.log import Log as Log, load_logs as load_logs
    from ccnn_torch.motion.nominal import Nominal as Nominal
    from ccnn_torch.motion.setting import nominal_of as nominal_of
else:
    __getattr__, __all__ = door(__name__)
