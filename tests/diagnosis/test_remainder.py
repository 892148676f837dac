"""Whether what a verdict leaves is noise."""

import numpy as np
import pytest
import torch
from diagnosis._machines import NOISE, pose_of, rows_of
from torch import Tensor

from ccnn_torch.diagnosis import Diagnosis, diagnose_rows
from ccnn_torch.diagnosis.engine import candidates
from ccnn_torch.diagnosis.residual.linearisation import remainder
from ccnn_torch.diagnosis.search.analysis import analyse
from ccnn_torch.diagnosis.verdict.remainder import Remainder, remainder_of, rest_of
from ccnn_torch.effects import Acting, Situation, make_effect, reached
from ccnn_torch.evidence.dictionary import FittedSet

ROWS = 150


def left_by(situation: Situation, pose: Tensor, names: set[str]) -> tuple[Remainder, tuple[str, ...] | None, FittedSet]:
    """What the most probable set of these names leaves, and what is said of it."""
    analysis = analyse(situation, pose, candidates(situation, sorted(names | {"backlash"}))[0], None, None)
    sets = ({analysis.atoms[i].name for i in f.members} for f in analysis.found)
    found = next(f for f, own in zip(analysis.found, sets, strict=True) if own == names)
    rest = remainder_of(analysis, found)
    assert rest is not None
    return rest, rest_of(analysis, found), found


@pytest.mark.parametrize("tails", [False, True])
def test_noise_is_noise(tails: bool) -> None:
    chances = []
    for seed in range(4):
        rng = np.random.default_rng(seed)
        situation = rows_of("five_bar", ROWS, seed)
        drawn = rng.standard_t(3, situation.pose.shape) if tails else rng.normal(size=situation.pose.shape)
        rest, said, _ = left_by(situation, situation.pose + NOISE * torch.from_numpy(drawn), set())
        chances.append(rest.probability)
        assert said is None
    assert min(chances) > 0.01 and np.mean(np.array(chances) < 0.2) <= 0.5


def moved(situation: Situation, change: Tensor, seed: int) -> Tensor:
    """Poses with joints that are off by a change, measured with noise."""
    pose = situation.mechanism.forward_kinematics(situation.joints + change, guess=situation.pose)
    return pose + NOISE * torch.randn(pose.shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def test_what_is_left_beside_a_name_is_told_with_its_driver() -> None:
    """A zero that moves at a row, beside a gain that explains most."""
    situation = rows_of("five_bar", ROWS, 3)
    gain = 2e-3 * situation.joints
    assert left_by(situation, moved(situation, gain, 4), {"joint_gain"})[1] is None
    gain[ROWS // 2 :, 0] += 2e-4
    rest, said, _ = left_by(situation, moved(situation, gain, 4), {"joint_gain"})
    assert said == ("time",) and rest.probability < 1e-4


@pytest.mark.parametrize(("more", "told"), [(0.02, False), (0.12, True)])
def test_a_form_error_of_usual_size_is_no_rest_and_a_larger_one_is(more: float, told: bool) -> None:
    """Play that changes along the joint by some per cent is still play."""
    situation = rows_of("five_bar", 400, 5)
    play = 6e-4 * torch.stack([situation.covariates[f"direction{i}"] for i in (1, 2)], -1)
    pose = moved(situation, play * (1 + more * torch.sin(3 * situation.joints)), 6)
    rest, said, _ = left_by(situation, pose, {"backlash"})
    assert rest.probability < 0.01 and (said is not None) == told


def geometry_and_bump(name: str, seed: int) -> Diagnosis:
    """A machine with errors of its geometry whose first coordinate is off by a wave along it, 50 times the noise."""
    situation = rows_of(name, 200, seed)
    effect, g = make_effect("geometry"), torch.Generator().manual_seed(seed)
    sizes = torch.tensor([c.scale for c in effect.coefficients(situation)], dtype=torch.float64)
    drawn = 0.15 * sizes * torch.randn(len(sizes), generator=g, dtype=torch.float64)
    there = reached(situation, [Acting(effect, torch.zeros(0, dtype=torch.float64), drawn)])
    along = situation.pose[:, 0]
    there[:, 0] += 1e-3 * torch.sin(1.5 * (along - along.mean()) / along.std() + 0.3)
    there += NOISE * torch.randn(there.shape, generator=g, dtype=torch.float64)
    effects = ["geometry", "joint_offset", "joint_gain", "gravity", "compliance"]
    return diagnose_rows(situation, pose_of(situation.mechanism, there), effects=effects)


def test_what_one_channel_alone_shows_is_not_its_noise() -> None:
    """A noise of each channel by itself has room for it: it was "geometry", 0.90, beside 38 times the noise."""
    said = geometry_and_bump("stewart", 1)
    assert said.verdict["effects"] == ["geometry"] and said.verdict["outside_library"]
    assert said.verdict["driver"] == "workspace" and said.verdict["probability"] <= 0.6


def test_numbers_beside_something_outside_repair_the_machine() -> None:
    """Fitted beside a term for the workspace, which takes its part of the gap, they left 4.7 mm of 4.0."""
    said = geometry_and_bump("five_bar", 1)
    assert said.verdict["effects"] == ["geometry"] and said.verdict["outside_library"]
    analysis = said.analysis
    left = remainder(analysis.situation, analysis.measured, said.acting)[:, :2].square().sum(-1).mean().sqrt()
    assert left < 1.5 * said.gap["after"] < 0.4 * said.gap["before"]
