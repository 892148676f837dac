from __future__ import annotations

from pathlib import Path

import pytest
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
    """`model.*` of the tripod and `arm.*` of the arm with covariates; read only."""
    path = tmp_path_factory.mktemp("models")
    save_model(path, tripod, fields() | {"remark": "for the card alone"})
    save_model(
        path, arm, fields() | {"mechanism": {"name": "arm", "joints": ["q1[rad]", "q2[rad]"], "pose": []}}, "arm"
    )
    return path
