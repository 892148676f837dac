"""An arm whose base and tool frame are fitted to the records: what these can do is no cause and no noise."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import torch

from ccnn_torch.diagnosis import diagnose_rows
from ccnn_torch.diagnosis.from_records import situation_of
from ccnn_torch.diagnosis.outputs import write_corrected
from ccnn_torch.effects import Acting, make_effect, reached
from ccnn_torch.mechanisms import SerialArm, load_mechanism
from ccnn_torch.records import load_records

DATA = Path(__file__).parents[2] / "experiments" / "data"
NOISE = 5e-5


def test_a_large_error_beside_fitted_frames_leaves_the_noise_and_no_length_of_the_tool(tmp_path: Path) -> None:
    arm = load_mechanism(str(DATA / "ur10.yaml"))
    assert isinstance(arm, SerialArm)
    records = load_records(DATA / "ur10_b_500.csv", arm, learns=False)
    measured_about = situation_of(records, arm)
    effect = make_effect("geometry")
    coefficients = effect.coefficients(measured_about)
    g = torch.Generator().manual_seed(3)
    sizes = torch.tensor([c.scale for c in coefficients], dtype=torch.float64)
    cause = Acting(effect, sizes.new_zeros(0), 6 * sizes * torch.randn(len(sizes), generator=g, dtype=torch.float64))
    pose = reached(measured_about, [cause])
    pose = pose + NOISE * torch.randn(pose.shape, generator=g, dtype=torch.float64)
    situation = situation_of(replace(records, pose=pose), arm)
    found = diagnose_rows(situation, pose)
    assert found.verdict["effects"] == ["geometry"] and not found.verdict["outside_library"]
    sigma = found.analysis.whitening.sigma
    assert float(sigma.min()) > 0.8 * NOISE and float(sigma.max()) < 1.25 * NOISE, sigma
    told = found.effects[0]["parameters"]
    # The tool frame stands for the last link's length: nothing of it is left for the geometry.
    assert abs(told["d6"]["value"]) < 1e-4, told["d6"]
    # What is proposed lies where the arm has been: its joints do not turn many times, and hit nothing new.
    low, high = situation.joints.amin(0).tolist(), situation.joints.amax(0).tolist()
    proposed = [list(row["joints"].values()) for row in found.next_measurements]
    assert len(proposed) == 8
    assert all(a <= q <= b for row in proposed for a, q, b in zip(low, row, high, strict=True))
    # All of the numbers together correct the machine.
    write_corrected(tmp_path, found)
    for name in ("corrected.yaml", "corrected.urdf"):
        corrected = load_mechanism(str(tmp_path / name))
        far = corrected.pose_error(pose, corrected.forward_kinematics(situation.joints)).position
        assert float(far.square().mean().sqrt()) < 1.1 * NOISE * 3**0.5, name
