"""Blank cells of a pose: a row counts with the coordinates that were measured in it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch import Tensor

from ccnn_torch.api import identify
from ccnn_torch.errors import InputError
from ccnn_torch.identification.identify import Identification
from ccnn_torch.mechanisms import Mechanism, load_mechanism
from ccnn_torch.records import load_records, write_table

Array = NDArray[np.float64]
Cli = Callable[..., tuple[int, str, str]]
NAN = float("nan")


def write(path: Path, machine: Mechanism, joints: Tensor, pose: Tensor) -> Path:
    columns = torch.cat([joints, pose], -1).T
    names = [c.header for c in (*machine.joints, *machine.pose)]
    write_table(path, {name: values.numpy() for name, values in zip(names, columns, strict=True)})
    return path


def printer(seed: int) -> tuple[Mechanism, Tensor, Tensor, Tensor, list[str]]:
    """A linear delta: rows of which 12 have x, y, z and 60 the height alone; and what is held at its nominal value."""
    machine = load_mechanism("delta_linear")
    generator = torch.Generator().manual_seed(seed)
    held = [p.name for p in machine.geometry if not p.name.startswith(("base", "rod", "offset"))]
    free = torch.tensor([p.name not in held for p in machine.geometry])
    truth = machine.nominal + 5e-4 * free * torch.randn(len(machine.geometry), generator=generator, dtype=torch.float64)
    joints = machine.sample_joints(72, generator)
    pose = machine.forward_kinematics(joints, truth)
    pose = pose + 1e-5 * torch.randn(pose.shape, generator=generator, dtype=torch.float64)
    pose[12:, :2] = NAN
    return machine, truth, joints, pose, held


def left(machine: Mechanism, found: Identification, truth: Tensor) -> float:
    """RMS error of the identified machine at new joints [m]."""
    joints = machine.sample_joints(200, torch.Generator().manual_seed(99))
    there, real = (machine.forward_kinematics(joints, v) for v in (found.outcomes["lm"].values[0], truth))
    return float((there - real)[:, :3].square().sum(-1).mean().sqrt())


def errors_in_sd(found: Identification, truth: Tensor) -> Tensor:
    """Errors of the parameters that the rows determine, in their stated standard deviations."""
    entries: dict[str, Any] = found.results["parameters"]
    names = [p.name for p in found.measured.mechanism.geometry]
    values = found.outcomes["lm"].values[0]
    sd = {n: e["sd"] for n, e in entries.items() if e.get("sd")}
    return torch.tensor([float(values[names.index(n)] - truth[names.index(n)]) / s for n, s in sd.items()])


def test_heights_beside_few_positions(tmp_path: Path) -> None:
    better, ratios = [], []
    for seed in range(4):
        machine, truth, joints, pose, held = printer(seed)
        keys = {"mechanism": "delta_linear", "parameters": {"fixed": held}, "noise": "10 um", "split": {"test": 0.2}}
        mixed = identify(records=str(write(tmp_path / "m.csv", machine, joints, pose)), **keys)
        whole = identify(records=str(write(tmp_path / "w.csv", machine, joints[:12], pose[:12])), **keys)
        assert "x, y are missing in 60 of 72 rows, which count with what was measured" in mixed.results["notes"]
        better.append(left(machine, mixed, truth) / left(machine, whole, truth))
        ratios.append(errors_in_sd(mixed, truth))
    assert np.exp(np.mean(np.log(better))) < 0.8, better
    every = torch.cat(ratios)
    assert len(every) >= 12 and 0.4 < float(every.square().mean().sqrt()) < 1.7, every


def test_what_is_blank_and_what_is_not(tmp_path: Path) -> None:
    machine, _, joints, pose, _ = printer(0)
    file = write(tmp_path / "r.csv", machine, joints, pose)
    records = load_records(file, machine, learns=False)
    assert records.pose.isnan().equal(pose.isnan()) and int(records.whole.sum()) == 12
    lines = file.read_text().splitlines()

    def refused(row: str, *parts: str) -> None:
        file.write_text("\n".join([*lines[:30], row, *lines[31:]]) + "\n")
        with pytest.raises(InputError) as error:
            load_records(file, machine, learns=False)
        assert all(part in str(error.value) for part in parts), error.value

    refused("0.4,0.4,0.4,lost,,0.1", "column 'x' has 'lost' at line 31")
    refused("0.4,0.4,0.4,nan,,0.1", "column 'x' has 'nan' at line 31")
    refused("0.4,,0.4,,,0.1", "column 'q2' is empty at line 31")
    refused("0.4,0.4,0.4,,,", "nothing of the pose was measured at line 31")
    # Blank in all rows is no column.
    empty = write(tmp_path / "e.csv", machine, joints, torch.cat([pose[:, :2] * NAN, pose[:, 2:]], -1))
    assert [c.name for c in load_records(empty, machine, learns=False).pose_coordinates] == ["z"]
