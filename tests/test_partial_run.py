"""A run on a part of the pose delivers commands for whole poses: the true machine is judged under them."""

from __future__ import annotations

from pathlib import Path

import torch

from ccnn_torch.calibration.calibrate import calibrate
from ccnn_torch.calibration.config import RunConfig
from ccnn_torch.mechanisms import load_mechanism
from ccnn_torch.records import write_table


def test_positions_of_a_reflector_make_a_hexapod_reach_its_poses(tmp_path: Path) -> None:
    machine = load_mechanism("stewart")
    generator = torch.Generator().manual_seed(0)
    lengths = torch.tensor([p.unit == "m" for p in machine.geometry])
    error = 3e-4 * torch.randn(len(machine.geometry), generator=generator, dtype=torch.float64)
    truth = machine.nominal + torch.where(lengths, error, 0.0)
    joints = machine.sample_joints(120, generator)
    seen = machine.forward_kinematics(joints, truth)[:, :3]
    seen = seen + 1e-5 * torch.randn(seen.shape, generator=generator, dtype=torch.float64)
    columns = {c.header: joints[:, k].numpy() for k, c in enumerate(machine.joints)}
    write_table(tmp_path / "r.csv", columns | {f"{a}[m]": seen[:, k].numpy() for k, a in enumerate("xyz")})
    keys = {"records": str(tmp_path / "r.csv"), "mechanism": "stewart", "geometry": "identify", "effects": "none"}
    found = calibrate(RunConfig.from_keys(**keys, methods=["constant"], refit=False))
    pose = found.results.pose
    assert pose.rotation is None and pose.position.after.rms.median is not None
    explained = pose.position.explained
    assert explained is not None and explained.rms.median is not None
    assert pose.position.after.rms.median < 1.05 * explained.rms.median
    # What is saved takes all six coordinates.
    assert [c.name for c in found.mechanism().pose] == ["x", "y", "z", "rx", "ry", "rz"]
    wanted = machine.sample_workspace(60, generator)
    ideal = machine.solve_inverse(wanted)
    commands = found.compensator().solve(ideal).command
    reached = [(machine.forward_kinematics(q, truth, wanted) - wanted)[:, :3].norm(dim=-1) for q in (ideal, commands)]
    before, after = (float(e.square().mean().sqrt()) for e in reached)
    assert before > 3e-4 and after < 0.15 * before, (before, after)
