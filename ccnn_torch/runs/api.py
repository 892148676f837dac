"""The main job as one Python call."""

from __future__ import annotations

from typing import Any

from ccnn_torch.runs.calibrate import Calibration
from ccnn_torch.runs.calibrate import calibrate as _calibrate
from ccnn_torch.runs.config import make_config

__all__ = ["calibrate"]


def calibrate(**keys: Any) -> Calibration:
    """Train on measured records or on a case study, judge on held-out rows; nothing is written.

    Args:
        keys: those of a config (`ccnn keys` lists them), for example `records="robot.csv", mechanism="robot.yaml"`,
            `case="tripod"`, `seed=3`, `split={"kind": "group"}`, `ccnn={"generations": 200}`.

    Returns:
        A `Calibration`: `results` (as in results.json), `compensator()`, `mechanism()`, `save(folder)`.

    Raises:
        InputError: a key, the records or the mechanism cannot be used; the sentence says what to change.
    """
    return _calibrate(make_config(**keys))
