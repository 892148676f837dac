"""Whether identified links hold in another series of measurements, with the same arm mounted elsewhere."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from torch import Tensor

from ccnn_torch.errors import InputError
from ccnn_torch.identification.config import IdentifyConfig
from ccnn_torch.identification.measured.measured import Rows
from ccnn_torch.identification.measured.records import read_records, split_records
from ccnn_torch.identification.pose_errors import before_and_after
from ccnn_torch.mechanisms import Mechanism, SerialArm, fit_frames


@dataclass(frozen=True)
class Elsewhere:
    """Another series of measurements: rows that place the arm anew, and rows that judge; `arm` has nominal links."""

    arm: SerialArm
    train: Rows
    test: Rows


def read_elsewhere(config: IdentifyConfig, mechanism: Mechanism) -> Elsewhere | None:
    """The records of `transfer`, split as the others are; None where there are none."""
    if config.transfer is None:
        return None
    if not isinstance(mechanism, SerialArm) or not mechanism.unknown_frames:
        raise InputError(
            f"transfer: {mechanism.name} has no frame to be fitted anew; it takes a serial arm whose base_frame or "
            "tool_frame is unknown"
        )
    records, arm = read_records(config, config.transfer, mechanism)
    assert isinstance(arm, SerialArm)
    return Elsewhere(arm, *split_records(config, records))


def transferred(config: IdentifyConfig, elsewhere: Elsewhere, values: Tensor) -> dict[str, Any]:
    """The block `transfer` of identified.json: pose errors with nominal and with identified links.

    Args:
        values: identified parameters, `k` [SI]; the frames are fitted anew to either.
    """
    train, test = elsewhere.train, elsewhere.test
    errors = []
    for nominal in (elsewhere.arm.nominal, values):
        arm = elsewhere.arm.with_nominal(nominal)
        assert isinstance(arm, SerialArm)
        placed = fit_frames(arm, train.joints[0], train.observed[0], rotation_weight=config.rotation_weight)
        errors.append(arm.pose_error(arm.forward_kinematics(test.joints, placed), test.observed))
    return {
        "records": "/".join(Path(str(config.transfer)).parts[-2:]),
        "rows": {"train": train.joints.shape[1], "test": test.joints.shape[1]},
        "test": before_and_after(*errors),
    }
