from __future__ import annotations

import os
from pathlib import Path

import pytest
from filelock import FileLock
from stand_ins import arm_compensator, fields, tripod_compensator

from ccnn_torch.compensation import Compensator, save_model


@pytest.fixture(scope="session")
def tripod() -> Compensator:
    return tripod_compensator()


@pytest.fixture(scope="session")
def arm() -> Compensator:
    return arm_compensator()


@pytest.fixture(scope="session")
def folder(tmp_path_factory: pytest.TempPathFactory, tripod: Compensator, arm: Compensator) -> Path:
    """`model.*` of the tripod and `arm.*` of the arm with covariates; read only.

    Exports take seconds, so the test processes of one run share them: whoever comes first writes them.
    """
    base = tmp_path_factory.getbasetemp()
    # Each of several processes has a folder of its own inside that of the run.
    path = (base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / "models"
    with FileLock(path.with_suffix(".lock")):
        if not (path / "arm.card.json").is_file():
            save_model(path, tripod, fields() | {"remark": "for the card alone"})
            mechanism = {"name": "arm", "joints": ["q1[rad]", "q2[rad]"], "pose": []}
            save_model(path, arm, fields() | {"mechanism": mechanism}, "arm")
    return path
