"""Configs, the paper's cases, the main job and its run folder."""

from ccnn_torch.runs.calibrate import Calibration as Calibration
from ccnn_torch.runs.calibrate import calibrate as calibrate
from ccnn_torch.runs.config import RunConfig as RunConfig
from ccnn_torch.runs.config import describe_keys as describe_keys
from ccnn_torch.runs.config import load_config as load_config
from ccnn_torch.runs.runner import resume_run as resume_run
from ccnn_torch.runs.runner import start_run as start_run
