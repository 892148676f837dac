"""The main jobs, each as one Python call."""

from __future__ import annotations

from typing import Any

from ccnn_torch.runs.calibrate import Calibration
from ccnn_torch.runs.calibrate import calibrate as _calibrate
from ccnn_torch.runs.config import make_config
from ccnn_torch.runs.identification import Identification
from ccnn_torch.runs.identification import identify as _identify
from ccnn_torch.runs.identify_config import make_identify_config

__all__ = ["calibrate", "identify"]


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


def identify(**keys: Any) -> Identification:
    """Identify geometric parameters from measured records or simulated machines; nothing is written.

    Args:
        keys: those of a config (`ccnn identify --keys` lists them), for example `mechanism="five_bar",
            simulate={"machines": 10, "poses": 36}`, or `mechanism="arm.yaml", records="measured.csv", methods=["lm"]`.

    Returns:
        An `Identification`: `results` (as in identified.json), `mechanism()`, `save(folder)`.

    Raises:
        InputError: a key, the records or the mechanism cannot be used; the sentence says what to change.
    """
    return _identify(make_identify_config(**keys))
