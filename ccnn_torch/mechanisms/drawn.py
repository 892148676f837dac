"""What a machine with its position errors is drawn from, in the robot's own frame."""

from __future__ import annotations

import torch
from torch import Tensor

from ccnn_torch.mechanisms.frames.partial import Seen
from ccnn_torch.mechanisms.machines.serial import SerialArm
from ccnn_torch.mechanisms.mechanism import Mechanism


def drawn(
    mechanism: Mechanism,
    joints: Tensor,
    pose: Tensor,
    place: Tensor,
    before: Tensor,
    after: Tensor,
    parameters: Tensor | None = None,
) -> dict[str, Tensor]:
    """Arrays as `report.machine_plot` takes them; an arm's are in its own base, wherever the measuring device stands.

    Args:
        mechanism: what is drawn, if it has lines.
        joints: `s x n` [SI].
        pose: `s x p` [SI], for the passive parts of the lines.
        place: where the errors are, `s x 3` [m] in the measuring frame.
        before, after: errors there, `s x 3`, or their sizes `s` [m].
        parameters: `k`, `1 x k` or `s x k` [SI]; nominal when None.
    """
    values = None if parameters is None else parameters.expand(len(joints), -1)
    arm, own = mechanism, values
    if isinstance(mechanism, Seen) and isinstance(mechanism.mechanism, SerialArm):
        arm, own = mechanism.mechanism, mechanism.inner_values(values)
    if isinstance(arm, SerialArm):
        vectors = torch.stack([before, after], 1) if before.ndim == 2 else place.new_zeros(len(place), 0, 3)
        place, vectors = arm.in_own_base(place, vectors, own)
        before, after = vectors.unbind(1) if before.ndim == 2 else (before, after)
    found = {"drawn.place": place, "drawn.before": before, "drawn.after": after}
    whole = place.isfinite().all(-1)
    if not bool(whole.any()):
        return found
    middle = place[whole].median(0).values
    row = int(torch.where(whole, (place - middle).square().sum(-1), torch.inf).argmin())
    lines = mechanism.skeleton(pose[row], joints[row], None if values is None else values[row])
    return found | {f"drawn.line.{name}": line for name, line in lines.items()}
