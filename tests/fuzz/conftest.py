"""Valid inputs that the fuzzers start from, and how many cases they try."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import pytest
import torch
from hypothesis import HealthCheck, Phase, settings

from ccnn_torch.mechanisms import load_mechanism
from ccnn_torch.records import write_table

ARM = """\
dof: 6
convention: standard Denavit-Hartenberg
units: {length: mm, angle: rad}
a: [0.0, -612.0, -572.3, 0.0, 0.0, 0.0]
alpha: [1.5707963267948966, 0.0, 0.0, 1.5707963267948966, -1.5707963267948966, 0.0]
d: [127.3, 0.0, 0.0, 163.941, 115.7, 92.2]
theta: [0.0, 0.0, 0.0, 0.0, 0.0, 0.0]
base_frame: unknown
tool_frame: unknown
"""


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """Give every fuzzer its number of cases: hypothesis reads settings from the function itself.

    Without any (CASES = 0) its examples are tried alone.
    """
    count = metafunc.config.getoption("--fuzz-cases")
    inner = getattr(metafunc.function, "hypothesis", None)
    if inner is not None:
        few = getattr(metafunc.module, "CASES", 8)
        metafunc.function._hypothesis_internal_use_settings = settings(
            max_examples=max(few, 1) if count is None else count,
            phases=[Phase.explicit] if count is None and few == 0 else [*Phase],
            derandomize=count is None,
            database=None,
            deadline=None,
            suppress_health_check=list(HealthCheck),
            print_blob=True,
        )


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """These take processes: tests/test_run.py and tests/test_files.py have some in the ordinary run."""
    if config.getoption("--fuzz-cases") is None:
        items[:] = [item for item in items if item.name not in ("test_a_kill_at_any_moment", "test_a_full_disk")]


def rows_of(name: str, folder: Path, rows: int, noise: float = 1e-5) -> list[list[str]]:
    """Records as cells: joints off by 0.1 mm or mrad, poses with noise, time and temperature beside them."""
    mechanism = load_mechanism(name)
    generator = torch.Generator().manual_seed(1)
    pose = mechanism.sample_workspace(rows, generator)
    arm = hasattr(mechanism, "sample_joints") and name.endswith(".yaml")
    joints = mechanism.sample_joints(rows, generator) if arm else mechanism.solve_inverse(pose)
    reached = mechanism.forward_kinematics(joints + 1e-4, guess=None if arm else pose)
    reached = reached + noise * torch.randn(reached.shape, generator=generator, dtype=torch.float64)
    columns = {c.header: v for c, v in zip(mechanism.joints, joints.unbind(-1), strict=True)}
    columns |= {c.header: v for c, v in zip(mechanism.pose, reached.unbind(-1), strict=True)}
    columns["time[s]"] = torch.arange(rows, dtype=torch.float64)
    columns["temperature[degC]"] = 20 + torch.rand(rows, generator=generator, dtype=torch.float64)
    write_table(folder / "base.csv", {name: values.numpy() for name, values in columns.items()})
    return [line.split(",") for line in (folder / "base.csv").read_text().splitlines()]


@pytest.fixture(scope="session")
def bases(tmp_path_factory: pytest.TempPathFactory) -> dict[str, list[list[str]]]:
    """Cells of valid records by mechanism."""
    folder = tmp_path_factory.mktemp("bases")
    (folder / "arm.yaml").write_text(ARM)
    return {
        "tripod": rows_of("tripod", folder, 40),
        "five_bar": rows_of("five_bar", folder, 40),
        "arm": rows_of(str(folder / "arm.yaml"), folder, 30),
    }


@pytest.fixture(scope="session")
def fresh() -> Callable[[], Any]:
    """A folder of its own for every case, gone afterwards; with `arm.yaml` in it."""

    class Folder(TemporaryDirectory[str]):
        def __enter__(self) -> Path:  # type: ignore[override]
            path = Path(super().__enter__())
            (path / "arm.yaml").write_text(ARM)
            return path

    return Folder


@pytest.fixture(autouse=True)
def _same_random_numbers() -> Iterator[None]:
    torch.manual_seed(0)
    yield
