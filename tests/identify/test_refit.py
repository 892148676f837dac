"""What held-out rows have judged is fitted again to all rows."""

from pathlib import Path

import numpy as np
import pytest
import torch

import ccnn_torch
from ccnn_torch import load_mechanism

TRUE = 1e-3


def records(path: Path, rows: int, seed: int) -> Path:
    """A five-bar whose crank 1 is 1 mm longer, seen with 20 um of noise."""
    machine = load_mechanism("five_bar")
    generator = torch.Generator().manual_seed(seed)
    joints = machine.solve_inverse(machine.sample_workspace(rows, generator))
    names = [p.name for p in machine.geometry]
    true = machine.nominal.index_add(0, torch.tensor([names.index("l1")]), torch.tensor([TRUE], dtype=torch.float64))
    pose = machine.forward_kinematics(joints, true)
    pose = pose + 2e-5 * torch.randn(pose.shape, generator=generator, dtype=torch.float64)
    header = ",".join(["q1[rad]", "q2[rad]", *(c.header for c in machine.pose)])
    np.savetxt(path, torch.cat([joints, pose], 1).numpy(), "%.17g", ",", header=header, comments="")
    return path


def test_values_are_of_all_rows_and_the_judgement_of_those_left_out(tmp_path: Path) -> None:
    path = records(tmp_path / "r.csv", 60, 1)
    keys = {"mechanism": "five_bar", "records": str(path), "parameters": {"free": ["l1"]}, "save_report": False}
    keys |= {"noise": "0.02 mm"}
    half = {"test": 0.5}
    again, judged, every = (
        ccnn_torch.identify(**keys, **more)
        for more in ({"split": half}, {"split": half, "refit": False}, {"split": {"test": 0.02}, "refit": False})
    )
    one, other, whole = (found.results["parameters"]["l1"] for found in (again, judged, every))
    assert again.results["test"] == judged.results["test"]
    assert one["sd"] < 0.9 * other["sd"] and one["sd"] == pytest.approx(whole["sd"], rel=0.1)
    length = dict(zip((p.name for p in again.mechanism().geometry), again.mechanism().nominal.tolist(), strict=True))
    assert length["l1"] == pytest.approx(one["value"], abs=1e-12) != pytest.approx(other["value"], abs=1e-9)
    assert again.results["rows"] == judged.results["rows"]
