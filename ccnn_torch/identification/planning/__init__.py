"""Which poses to measure: observability, active calibration, and what each further pose gives."""

from ccnn_torch.identification.planning._candidates import Candidates as Candidates
from ccnn_torch.identification.planning._candidates import draw_candidates as draw_candidates
from ccnn_torch.identification.planning._gains import Gains as Gains
from ccnn_torch.identification.planning._gains import recommended_count as recommended_count
from ccnn_torch.identification.planning._observability import INDICES as INDICES
from ccnn_torch.identification.planning._observability import Observability as Observability
from ccnn_torch.identification.planning._observability import observability as observability
from ccnn_torch.identification.planning._plan import Choice as Choice
from ccnn_torch.identification.planning._plan import Plan as Plan
from ccnn_torch.identification.planning._plan import choose_poses as choose_poses
from ccnn_torch.identification.planning._plan import plan_poses as plan_poses
