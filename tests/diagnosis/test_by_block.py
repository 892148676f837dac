"""How far the gap shrinks on blocks of rows: every one judged by a fit to the rows outside of it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from _machines import NOISE, measured, rows_of

from ccnn_torch.diagnosis import Diagnosis, diagnose, diagnose_rows
from ccnn_torch.diagnosis.residual.rows import frame_columns
from ccnn_torch.diagnosis.verdict.blocks import cut
from ccnn_torch.effects import pose_residual
from ccnn_torch.mechanisms import load_mechanism
from ccnn_torch.records import load_records

UR10 = Path(__file__).parents[2] / "experiments" / "data"


def test_blocks_lie_along_the_joints_and_every_frame_is_in_each() -> None:
    joints = torch.tensor([[1.0, 0.1], [0.0, 0.0]], dtype=torch.float64)[torch.arange(40) % 2]
    joints = joints * torch.arange(40, dtype=torch.float64)[:, None] + torch.tensor([0.0, 2.0])
    frames = torch.zeros(40, 3, 2, dtype=torch.float64)
    frames[:10, 0, 0] = frames[10:, 1, 1] = 1.0
    number = cut(joints, frames)
    along = joints[:, 0] * (1.0 if number[joints[:, 0].argmax()] == 4 else -1.0)
    for mine in (slice(0, 10), slice(10, 40)):
        place, size = number[mine], len(number[mine]) // 5
        assert torch.bincount(place).tolist() == [size] * 5
        for k in range(4):
            assert along[mine][place == k].max() <= along[mine][place == k + 1].min()
    assert torch.bincount(cut(torch.randn(23, 2), frames[:23, :, :0])).tolist() == [5, 5, 4, 5, 4]


def _by_least_squares(said: Diagnosis, nominal: torch.Tensor) -> list[tuple[float, float]]:
    """RMS of the position of each block without and with the verdict's effects, fitted to the other rows by numpy."""
    analysis, situation = said.analysis, said.analysis.situation
    keep, white = analysis.whitening.keep(), analysis.whitening
    frames = frame_columns(situation, white.counted)
    number = cut(situation.joints[keep], frames[keep]).numpy()
    atoms = [analysis.atoms[i] for i in said.judgement.found.members]
    effects = torch.cat([a.columns for a in atoms if a.name in said.verdict["effects"]], -1)
    channels = white.channels[white.channels < 3]
    scale = white.scale[keep].numpy()

    def left(target: torch.Tensor, columns: torch.Tensor, block: int) -> float:
        y, x = target[keep][:, white.channels].numpy(), columns[keep][:, white.channels].numpy()
        mine = number == block
        flat = torch.from_numpy((x * scale[..., None])[~mine]).flatten(0, 1).numpy()
        found = np.linalg.lstsq(flat, (y * scale)[~mine].ravel(), rcond=1e-9)[0] if flat.size else np.zeros(0)
        rest = (y - x @ found)[mine][:, : len(channels)]
        return float(np.sqrt(np.square(rest).sum(-1).mean()))

    every = torch.cat([frames, effects], -1)
    return [(left(nominal, frames, k), left(analysis.residual, every, k)) for k in range(5)]


def test_a_block_is_judged_by_what_the_other_rows_say() -> None:
    rows = rows_of("five_bar", 200, 3)
    poses = measured(rows, {"joint_gain": 40.0}, 4)
    said = diagnose_rows(rows, poses, effects=["joint_gain", "backlash"])
    far = said.by_block
    assert said.verdict["effects"] == ["joint_gain"] and far is not None and far["unit"] == "m"
    expected = _by_least_squares(said, pose_residual(rows, poses))
    for block, (before, after) in zip(far["blocks"], expected, strict=True):
        assert block["before"] == pytest.approx(before, rel=1e-9)
        assert block["after"] == pytest.approx(after, rel=1e-3)
    count = np.array([b["rows"] for b in far["blocks"]])
    assert count.sum() == len(said.analysis.whitening.keep())
    assert far["after"] == pytest.approx(np.sqrt(np.average([b["after"] ** 2 for b in far["blocks"]], weights=count)))
    low, high = far["shrink_ci95"]
    assert low <= far["shrink"] <= high and far["shrink"] > 0.99 and far["after"] < 2 * NOISE


def test_frames_that_are_not_known_are_fitted_outside_of_the_block_too(tmp_path: Path) -> None:
    arm = load_mechanism(str(UR10 / "ur10.yaml"))
    rows = (UR10 / "ur10_b_500.csv").read_text(encoding="utf-8").splitlines(keepends=True)
    (tmp_path / "r.csv").write_text("".join(rows[:151]), encoding="utf-8")
    said = diagnose(load_records(tmp_path / "r.csv", arm, learns=False), arm, effects=["geometry"])
    far, situation = said.by_block, said.analysis.situation
    assert far is not None and said.verdict["effects"] == ["geometry"]
    expected = _by_least_squares(said, pose_residual(situation, said.analysis.measured))
    assert [b["before"] for b in far["blocks"]] == pytest.approx([b for b, _ in expected], rel=1e-6)
    # Links are held to plausible sizes, which least squares does not know.
    assert [b["after"] for b in far["blocks"]] == pytest.approx([a for _, a in expected], rel=0.1)
    # Where no row was fitted the frames are worse, too, and the links still halve what is left.
    assert far["before"] > said.gap["before"] and far["after"] > said.gap["after"] and far["shrink"] > 0.7
