"""Diagnosis of a machine in motion, from logs of time, commands and positions."""

from ccnn_torch.motion.engine import MotionDiagnosis as MotionDiagnosis
from ccnn_torch.motion.engine import diagnose_motion as diagnose_motion
from ccnn_torch.motion.feed_forward import Corrected as Corrected
from ccnn_torch.motion.feed_forward import corrected_command as corrected_command
from ccnn_torch.motion.identified import Identified as Identified
from ccnn_torch.motion.identified import load_identified as load_identified
from ccnn_torch.motion.identified import write_identified as write_identified
from ccnn_torch.motion.log import Log as Log
from ccnn_torch.motion.log import load_logs as load_logs
from ccnn_torch.motion.models import nominal_of as nominal_of
from ccnn_torch.motion.nominal import Nominal as Nominal
