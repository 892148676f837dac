"""Which poses to measure: observability, active calibration, and what each further pose gives."""

from ccnn_torch.planning.candidates import Candidates as Candidates, draw_candidates as draw_candidates
from ccnn_torch.planning.design import (
    Gains as Gains,
    observability as observability,
    recommended_count as recommended_count,
)
from ccnn_torch.planning.plan import (
    Choice as Choice,
    Plan as Plan,
    choose_poses as choose_poses,
    plan_poses as plan_poses,
)
