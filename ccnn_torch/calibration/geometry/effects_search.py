"""`effects: auto`: the effects that a diagnosis of the training rows names."""

from __future__ import annotations

import torch
from torch import Tensor

from ccnn_torch.calibration.rows.some_rows import rows_of
from ccnn_torch.diagnosis.from_file import Verdict
from ccnn_torch.diagnosis.from_records import name_effects
from ccnn_torch.errors import InputError
from ccnn_torch.mechanisms import BlackBox, Mechanism, SerialArm
from ccnn_torch.records import Records

# Rows that the search uses: more take longer and name the same.
_MOST_ROWS = 400


def search_effects(
    mechanism: Mechanism, records: Records, rows: Tensor, names: list[str] | None, seed: int
) -> tuple[Verdict | None, list[str]]:
    """Diagnose some rows, at most 400 of them.

    Args:
        rows: numbers of the rows that are not held out.
        names: effects to look for; all of the library when None.
        seed: of the choice of rows and of the diagnosis.

    Returns:
        The effects that were named and that a model file can hold, None without any; and notes, one sentence each.
    """
    if isinstance(mechanism, BlackBox):
        return None, ["Effects were not searched: of a simulator every row takes long; see ccnn diagnose."]
    if isinstance(mechanism, SerialArm) and (mechanism.frame_per or mechanism.tool_per):
        return None, ["Effects were not searched: one compensator needs one frame, and these rows have several."]
    if len(rows) > _MOST_ROWS:
        rows = rows[torch.randperm(len(rows), generator=torch.Generator().manual_seed(seed))[:_MOST_ROWS]]
    try:
        verdict, notes, said, probability = name_effects(rows_of(records, rows.sort().values), mechanism, names, seed)
    except InputError as reason:
        return None, [f"Effects were not searched: {reason}"]
    if not said:
        return None, ["Effects were searched in the training rows, and none was named."]
    shown = f"Effects that the training rows show: {', '.join(said)} (probability {probability:.2f})."
    return verdict, [shown, *notes]
