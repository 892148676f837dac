"""A plain cause that the library lacks is not put together from two others; one that it has is named."""

from __future__ import annotations

import pytest
from diagnosis._machines import measured, rows_of

from ccnn_torch.diagnosis import diagnose_rows
from ccnn_torch.effects import EFFECTS


@pytest.mark.parametrize(
    ("machine", "cause", "size", "driver"),
    [
        ("tripod", "tool", 30.0, "workspace"),
        ("delta", "joint_gain", 10.0, "joint"),
    ],
)
def test_a_plain_cause_is_outside_a_library_that_lacks_it(machine: str, cause: str, size: float, driver: str) -> None:
    situation = rows_of(machine, 80, 30)
    poses = measured(situation, {cause: size}, 1)
    # A frame that steps before the first rows is one that stands elsewhere.
    lacking = {cause, "frame_drift"} if cause == "frame" else {cause}
    without = diagnose_rows(situation, poses, effects=[name for name in EFFECTS if name not in lacking]).verdict
    assert without["outside_library"] and without["driver"].startswith(driver) and not without["effects"]
    told = diagnose_rows(situation, poses, effects=[cause, "geometry", "frame", "backlash"]).verdict
    assert told["effects"] == [cause] and not told["outside_library"]
