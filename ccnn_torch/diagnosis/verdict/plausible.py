"""How large a coefficient may be: some machines are off by much more than others in all that they do."""

from __future__ import annotations

from ccnn_torch.diagnosis.discrepancy.smooth import joint_moves
from ccnn_torch.diagnosis.search.analysis import Analysis
from ccnn_torch.effects import pose_residual

# Plausible sizes that no cause has on a machine of usual quality: sealed machines whose gap was 30 times the noise had
# up to 185; a unit mistaken makes 1000.
_IMPLAUSIBLE = 250.0


def implausible_size(analysis: Analysis) -> float:
    """Size beyond which no cause is believed, in plausible sizes: the more, the worse the machine is as a whole.

    A machine's scale is the root mean square of its gap over that of what its joints make when each of them is off by
    as much as is to be expected; at least 1.
    """
    white, situation = analysis.whitening, analysis.situation
    rows, channels = white.keep(), [c for c in white.channels.tolist() if c < 3] or white.channels.tolist()
    gap = pose_residual(situation, analysis.measured)[rows][:, channels].square().mean()
    usual = joint_moves(situation, situation.jacobian)[rows][:, channels].square().sum(-1).mean()
    return _IMPLAUSIBLE * max(1.0, float((gap / usual.clamp_min(1e-300)).sqrt()))
