"""A drift of the measuring frame, taken out of the measured poses: it is no error of the machine."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from ccnn_torch.diagnosis.from_file import Verdict, in_time, with_numbers
from ccnn_torch.diagnosis.from_records import situation_of
from ccnn_torch.diagnosis.joint_fit import fit_jointly, loose_parameters, on_fitted_frames
from ccnn_torch.effects import without_pose_effects
from ccnn_torch.effects.time import FrameDrift, elapsed
from ccnn_torch.mechanisms import Mechanism
from ccnn_torch.records import Records


def without_frame_drift(
    mechanism: Mechanism, records: Records, rows: Tensor, verdict: Verdict, identify: bool
) -> tuple[Records, Verdict | None, list[str]]:
    """Records as from a frame that stood where it stood at the first row, where a verdict names a drift of it.

    The drift is fitted to some rows together with the verdict's other effects and the machine's parameters, its shapes
    staying, and taken out of all.

    Args:
        rows: numbers of the rows that are not held out.
        identify: whether all parameters of the machine are fitted beside.

    Returns:
        The records; the verdict without the drift, None where it then names nothing; and notes.
    """
    others, drift = verdict.of_machine()
    if drift is None:
        return records, verdict, []
    recorded = situation_of(records, mechanism)
    situation = in_time(on_fitted_frames(recorded), moments(records))
    known = [*others.on(recorded, identify)[0], with_numbers(FrameDrift(), situation, drift)]
    fine = torch.zeros(len(records), dtype=torch.bool)
    fine[rows] = True
    fine &= torch.isfinite(situation.pose).all(-1)
    loose = loose_parameters(situation.mechanism, identify)
    *_, found = fit_jointly(situation, records.pose, known, fine, loose).acting
    pose = without_pose_effects(situation, records.pose, [found])
    moved = float(found.change(situation)[..., :3].norm(dim=-1).max())
    note = (
        f"A drift of the measuring frame ({FrameDrift.name}, up to {1e3 * moved:.3g} mm) was fitted to the training "
        "rows of the first repeat and taken out of all measured poses: it is no error of the machine, and commands are "
        "not corrected for it."
    )
    return replace(records, pose=pose), others if others.effects else None, [note]


def moments(records: Records) -> Tensor:
    """Time of each row since the first one [s], or its number where none was recorded in all rows."""
    time = torch.as_tensor(records.columns.get("time", ()), dtype=torch.float64)
    return elapsed(time) if len(time) and bool(time.isfinite().all()) else torch.arange(len(records)).double()
