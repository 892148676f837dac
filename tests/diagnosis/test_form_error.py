"""A cause of slightly another form is one cause, however many rows; a weak cause beside a strong one is another."""

from __future__ import annotations

import pytest
import torch
from diagnosis._machines import NOISE, measured, rows_of
from diagnosis.test_convergence import looked_at
from torch import Tensor

from ccnn_torch.diagnosis import diagnose_rows
from ccnn_torch.effects import Situation
from ccnn_torch.evidence.beam import probable_sets
from ccnn_torch.evidence.dictionary import dictionary_of, singles_of, with_noise


def test_sets_under_a_known_noise_are_those_of_scaled_data() -> None:
    dictionary, y, _ = looked_at()
    atoms, size = dictionary.atoms, 3.0
    x = [dictionary.columns[..., dictionary.groups[i]] / size for i in range(len(atoms))]
    known = with_noise(dictionary, size**2)
    other = dictionary_of(atoms, x, y / size, [], singles_of(atoms, x, y / size, known.noise_dof), known.noise_dof)
    ours, theirs = ({f.members: f.log_posterior for f in probable_sets(d)} for d in (known, other))
    assert ours == pytest.approx(theirs, rel=1e-9) and len(ours) > 7
    assert torch.allclose(known.columns, other.columns)


def _backlash_that_grows(situation: Situation, seed: int) -> Tensor:
    """Play of both drives, 12 % larger at one end of their range than at the other."""
    sign = torch.stack([situation.covariates[f"direction{i}"] for i in (1, 2)], -1)
    place = (situation.joints - situation.joints.mean(0)) / (situation.joints.amax(0) - situation.joints.amin(0))
    moved = situation.joints + 1.5e-3 * sign * (1 + 0.12 * place)
    pose = situation.mechanism.forward_kinematics(moved, guess=situation.pose)
    drawn = torch.randn(pose.shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return pose + NOISE * drawn


@pytest.mark.parametrize("rows", [150, 600])
def test_a_misfit_of_form_is_no_second_cause_however_many_rows(rows: int) -> None:
    situation = rows_of("five_bar", rows, 5)
    found = diagnose_rows(situation, _backlash_that_grows(situation, 6), torch.tensor([NOISE] * 2))
    assert found.verdict["effects"] == ["backlash"] and not found.verdict["outside_library"]


def test_a_weak_cause_beside_a_strong_one_is_named_where_the_noise_is_known() -> None:
    situation = rows_of("five_bar", 200, 7)
    pose = measured(situation, {"compliance": 200.0, "thermal": 4.0}, 8)
    found = diagnose_rows(situation, pose, torch.tensor([NOISE] * 2))
    assert found.verdict["effects"] == ["compliance", "thermal"] and not found.verdict["outside_library"]
