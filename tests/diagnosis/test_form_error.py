"""A cause of slightly another form is one cause, however many rows; a weak cause beside a strong one is another."""

from __future__ import annotations

import math

import pytest
import torch
from diagnosis._machines import NOISE, measured, rows_of
from diagnosis.test_convergence import looked_at
from torch import Tensor

from ccnn_torch.diagnosis import diagnose_rows
from ccnn_torch.diagnosis.candidates.atom import Atom
from ccnn_torch.effects import Situation, make_effect
from ccnn_torch.evidence.beam import probable_sets
from ccnn_torch.evidence.dictionary import dictionary_of, singles_of, with_noise
from ccnn_torch.evidence.form_error import with_form_error
from ccnn_torch.evidence.priors import EFFECT


def test_sets_under_a_known_noise_are_those_of_scaled_data() -> None:
    dictionary, y, _ = looked_at()
    atoms, size = dictionary.atoms, 3.0
    x = [dictionary.columns[..., dictionary.groups[i]] / size for i in range(len(atoms))]
    known = with_noise(dictionary, size**2)
    other = dictionary_of(atoms, x, y / size, [], singles_of(atoms, x, y / size, known.noise_dof), known.noise_dof)
    ours, theirs = ({f.members: f.log_posterior for f in probable_sets(d)} for d in (known, other))
    assert ours == pytest.approx(theirs, rel=1e-9) and len(ours) > 7
    assert torch.allclose(known.columns, other.columns)


@pytest.mark.parametrize(("beside", "counts"), [(110.0, True), (20.0, False)])
def test_what_is_small_beside_a_cause_is_of_its_form_and_what_is_larger_another_cause(
    beside: float, counts: bool
) -> None:
    """The strong one does 2000 times the noise in each direction: a form error of 5e-5 of that is 200 times its
    variance, and what counts beside it must be clearly more. Twenty times as much or as little would tip either."""
    x, *_ = torch.linalg.qr(torch.randn(400, 3, generator=torch.Generator().manual_seed(3), dtype=torch.float64))
    own = [x[:, None, i : i + 1] for i in range(2)]
    y = 2000.0 * x[:, [0]] + beside * x[:, [1]] + 20 * x[:, [2]]
    names = ["backlash", "compliance"]
    atoms = [Atom(n, make_effect(n), y.new_ones(1), c, EFFECT) for n, c in zip(names, own, strict=True)]
    dictionary = dictionary_of(atoms, own, y, [], singles_of(atoms, own, y, 0.0), 0.0)
    levels = with_form_error(dictionary, probable_sets(dictionary)[0], 1.0, False)
    sets = [(level.weight, [(f.members, f.log_posterior) for f in level.found]) for level in levels]
    of_both = sum(
        weight / sum(math.exp(other - own) for _, other in found)
        for weight, found in sets
        for members, own in found
        if members == (0, 1)
    )
    assert (of_both > 0.5) == counts


def _backlash_that_grows(situation: Situation, seed: int) -> Tensor:
    """Play of both drives, 12 % larger at one end of their range than at the other."""
    sign = torch.stack([situation.covariates[f"direction{i}"] for i in (1, 2)], -1)
    place = (situation.joints - situation.joints.mean(0)) / (situation.joints.amax(0) - situation.joints.amin(0))
    moved = situation.joints + 1.5e-3 * sign * (1 + 0.12 * place)
    pose = situation.mechanism.forward_kinematics(moved, guess=situation.pose)
    drawn = torch.randn(pose.shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return pose + NOISE * drawn


def test_a_misfit_of_form_is_no_second_cause_however_many_rows() -> None:
    situation = rows_of("five_bar", 600, 5)
    effects = ["geometry", "joint_gain", "transmission", "backlash", "friction", "compliance"]
    found = diagnose_rows(situation, _backlash_that_grows(situation, 6), torch.tensor([NOISE] * 2), effects)
    assert found.verdict["effects"] == ["backlash"] and not found.verdict["outside_library"]


def test_a_weak_cause_beside_a_strong_one_is_named_where_the_noise_is_known() -> None:
    situation = rows_of("five_bar", 200, 7)
    pose = measured(situation, {"compliance": 200.0, "thermal": 4.0}, 8)
    found = diagnose_rows(situation, pose, torch.tensor([NOISE] * 2))
    assert found.verdict["effects"] == ["compliance", "thermal"] and not found.verdict["outside_library"]
