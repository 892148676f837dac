"""`geometry: identify`: parameters first, a network for what they leave, and both in the files of a run."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from fitted import fitted_geometry
from typer.testing import CliRunner

from ccnn_torch import calibrate
from ccnn_torch.calibration.config import RunConfig
from ccnn_torch.calibration.job import RUN
from ccnn_torch.calibration.prepare import prepare
from ccnn_torch.cli.application import app
from ccnn_torch.coordinates import Coordinate
from ccnn_torch.errors import InputError
from ccnn_torch.mechanisms import load_mechanism
from ccnn_torch.records import read_table, stack_columns, write_table
from ccnn_torch.report.arrays import load_arrays

DATA = Path(__file__).parent.parent / "experiments" / "data"
UR10 = {"records": str(DATA / "ur10_b_500.csv"), "mechanism": str(DATA / "ur10.yaml"), "covariates": []}
QUICK = {"hidden": [6], "rival_hidden": [], "members": 1, "kept": 1, "generations": 2, "population": 20}
QUICK |= {"refinement_iterations": 15, "wave_searches": 1}


def test_geometry_and_network_on_measured_rows_beat_geometry_alone() -> None:
    keys = {**UR10, "geometry": "identify", "effects": "none", "training": {"early_stop": False}, "refit": False}
    found = calibrate(**keys, ccnn=QUICK)
    pose = found.results["pose"]
    before, after = (pose["position"][key]["rms"]["median"] for key in ("before", "after"))
    alone = pose["position"]["geometry"]["rms"]["median"]
    assert 0.9e-3 < before < 1.2e-3 and 0.4e-3 < alone < 0.5e-3
    assert after < 0.85 * alone
    assert pose["rotation"]["after"]["rms"]["median"] < pose["rotation"]["geometry"]["rms"]["median"]
    assert any("Geometry identified" in note for note in found.results["notes"])
    # Held-out rows of the compensator, both parts in it, are those of the results.
    prepared, made = found.prepared, found.compensator()
    test = prepared.dataset.splits[0].test
    joints, arm = prepared.joints[0, test], found.mechanism()
    reached = arm.forward_kinematics(joints + made.deviation(joints))
    error = arm.pose_error(prepared.pose[0, test], reached).position
    assert float(error.square().mean().sqrt()) == pytest.approx(after, rel=0.05)


def tripod_records(path: Path, rows: int = 160) -> torch.Tensor:
    """A tripod with 0.3 mm of geometric error and 0.1 mm of a cause that is none; returns the real parameters."""
    tripod = load_mechanism("tripod")
    generator = torch.Generator().manual_seed(3)
    draw = torch.randn(tripod.nominal.shape, generator=generator, dtype=torch.float64)
    truth = tripod.nominal + 3e-4 * draw
    low = torch.tensor([-0.15, 0.45, -0.2], dtype=torch.float64)
    high = torch.tensor([0.15, 0.65, 0.2], dtype=torch.float64)
    wanted = low + (high - low) * torch.rand(rows, 3, generator=generator, dtype=torch.float64)
    joints = tripod.solve_inverse(wanted)
    moved = joints + 5e-5 * torch.sin(20 * joints.roll(1, -1))
    pose = tripod.forward_kinematics(moved, truth, wanted)
    names = [c.header for c in (*tripod.joints, *tripod.pose)]
    write_table(path, dict(zip(names, torch.cat([joints, pose], -1).mT.numpy(), strict=True)))
    return truth


def test_commands_of_a_parallel_mechanism(tmp_path: Path) -> None:
    tripod_records(tmp_path / "rows.csv")
    keys = {"records": str(tmp_path / "rows.csv"), "mechanism": "tripod", "methods": ["constant"], "effects": "none"}
    found = calibrate(**keys, geometry="identify")
    found.save(tmp_path, forms=())
    pose = found.results["pose"]["position"]
    assert pose["after"]["rms"]["median"] < 0.4 * pose["before"]["rms"]["median"]
    joints = found.mechanism().joints

    def compensate(given: str, written: str, *options: str) -> None:
        paths = [str(tmp_path / name) for name in ("model.safetensors", given, written)]
        done = CliRunner().invoke(app, ["compensate", *paths, *options])
        assert done.exit_code == 0, done.output

    def columns(name: str, prefix: str) -> np.ndarray:
        return stack_columns(read_table(tmp_path / name), tuple(Coordinate(prefix + c.name, c.unit) for c in joints))

    compensate("rows.csv", "commands.csv", "--sd")
    compensate("commands.csv", "ideal.csv", "--back")
    ideal, command = columns("rows.csv", ""), columns("commands.csv", "command_")
    np.testing.assert_allclose(command + columns("commands.csv", "deviation_"), ideal, rtol=0, atol=1e-12)
    np.testing.assert_allclose(columns("ideal.csv", "ideal_"), ideal, rtol=0, atol=1e-9)


def test_the_remainder_is_what_the_identified_machine_leaves(tmp_path: Path) -> None:
    truth = tripod_records(tmp_path / "rows.csv")
    keys = {"records": str(tmp_path / "rows.csv"), "mechanism": "tripod", "methods": ["constant"], "effects": "none"}
    plain = prepare(RunConfig.from_keys(**keys, geometry="none"))
    known = prepare(RunConfig.from_keys(**keys, geometry="identify", repeats=2))
    assert plain.physics is None and known.physics is not None
    torch.testing.assert_close(known.total[0], plain.dataset.deviation[0], rtol=0, atol=0)
    left = known.dataset.deviation.square().mean().sqrt()
    assert float(left) < 0.3 * float(plain.dataset.deviation.square().mean().sqrt())
    # With what is left the identified machine has the measured pose.
    for k in range(2):
        reached = known.physics.poses(k, known.joints[k] + known.dataset.deviation[k])
        torch.testing.assert_close(reached, known.pose[k], rtol=0, atol=1e-9)
    assert known.physics.values.shape == (2, 1, len(truth))


def test_before_in_the_figures_is_before_the_geometry_too(tmp_path: Path) -> None:
    tripod_records(tmp_path / "rows.csv")
    keys = {"records": str(tmp_path / "rows.csv"), "mechanism": "tripod", "geometry": "identify", "effects": "none"}
    config = RunConfig.from_keys(
        **keys, methods=["constant"], out=str(tmp_path / "r"), save_models=False, save_report=False
    )
    RUN.start(config, quiet=True)
    arrays = load_arrays(tmp_path / "r")
    tripod, names = load_mechanism("tripod"), [c.header for c in load_mechanism("tripod").pose]
    table = read_table(tmp_path / "rows.csv")
    pose = torch.stack([torch.from_numpy(table.column(n.split("[")[0])) for n in names], -1)
    nominal = tripod.solve_inverse(pose).numpy() - arrays.commanded
    np.testing.assert_allclose(arrays.measured, nominal, rtol=0, atol=1e-9)
    left = arrays.measured - arrays.predicted
    assert np.sqrt(np.mean(left**2)) < 0.4 * np.sqrt(np.mean(nominal**2))


def test_held_out_rows_do_not_change_the_geometry() -> None:
    tripod = load_mechanism("tripod")
    joints = tripod.sample_joints(60, torch.Generator().manual_seed(1))
    pose = tripod.forward_kinematics(joints, tripod.nominal + 2e-4)
    rows = torch.arange(60) < 40
    first = fitted_geometry(tripod, joints, pose, rows=rows)
    pose[50:] += 1e-2
    torch.testing.assert_close(fitted_geometry(tripod, joints, pose, rows=rows), first, rtol=0, atol=0)
    error = tripod.forward_kinematics(joints[:50], first) - tripod.forward_kinematics(
        joints[:50], tripod.nominal + 2e-4
    )
    assert float(error.abs().max()) < 1e-5


def test_where_geometry_has_no_place() -> None:
    with pytest.raises(InputError, match="geometry: a case is there to compare learners"):
        RunConfig.from_keys(case="tripod", geometry="identify")
    with pytest.raises(InputError, match="geometry"):
        RunConfig.from_keys(**UR10, geometry="identfy")
