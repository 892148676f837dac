from __future__ import annotations

import os

import pytest
import torch
from filelock import FileLock

from ccnn_torch.motion.axis import Drive, simulate_axes


@pytest.fixture(scope="session", autouse=True)
def _compiled_once(tmp_path_factory: pytest.TempPathFactory) -> None:
    """numba compiles for seconds in a fresh checkout: one of the test processes does, and the others read its file."""
    base = tmp_path_factory.getbasetemp()
    folder = base.parent if "PYTEST_XDIST_WORKER" in os.environ else base
    time = torch.arange(3, dtype=torch.float64)[None]
    with FileLock(folder / "compiled.lock"):
        simulate_axes(Drive(time, time, time[:, :2]), {})
