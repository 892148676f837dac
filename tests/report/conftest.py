"""Fixtures of the report's tests: the made-up runs of `report_runs.py`, in memory and as folders."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from report_runs import fill, tripod_run

from ccnn_torch.calibration.job import write_report
from ccnn_torch.report.arrays import RunArrays
from ccnn_torch.report.results.run import RunResults


@pytest.fixture
def results() -> RunResults:
    return tripod_run()[0]


@pytest.fixture
def arrays() -> RunArrays:
    return tripod_run()[1]


@pytest.fixture
def history() -> dict[str, np.ndarray]:
    return tripod_run()[2]


@pytest.fixture
def run_folder(tmp_path: Path) -> Path:
    return fill(tmp_path)


@pytest.fixture(scope="session")
def report_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run folder with its report, to be read only."""
    folder = fill(tmp_path_factory.mktemp("run"))
    write_report(folder, RunResults.read(folder / "results.json"))
    return folder
