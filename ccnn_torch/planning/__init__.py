"""Which poses to measure: observability, active calibration, and what each further pose gives."""

from ccnn_torch.planning.candidates import Candidates as Candidates
from ccnn_torch.planning.candidates import draw_candidates as draw_candidates
from ccnn_torch.planning.gains import Gains as Gains
from ccnn_torch.planning.gains import Observability as Observability
from ccnn_torch.planning.gains import observability as observability
from ccnn_torch.planning.gains import recommended_count as recommended_count
from ccnn_torch.planning.plan import Choice as Choice
from ccnn_torch.planning.plan import Plan as Plan
from ccnn_torch.planning.plan import choose_poses as choose_poses
from ccnn_torch.planning.plan import plan_poses as plan_poses
