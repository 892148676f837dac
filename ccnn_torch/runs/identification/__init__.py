"""Identification of geometry from a config: simulated machines or records, methods, figures, files."""

from ccnn_torch.runs.identification._folder import resume_identification as resume_identification
from ccnn_torch.runs.identification._folder import start_identification as start_identification
from ccnn_torch.runs.identification._identify import Identification as Identification
from ccnn_torch.runs.identification._identify import identify as identify
