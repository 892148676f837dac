"""When it is worth while to look at the rows again, and which shapes are looked for then."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import combinations

import pytest
import torch
from diagnosis._machines import measured, rows_of
from torch import Tensor

from ccnn_torch.diagnosis import diagnose_rows
from ccnn_torch.diagnosis.candidates.atom import Atom
from ccnn_torch.diagnosis.candidates.library import has_usual_shape
from ccnn_torch.diagnosis.residual.whitening import Whitening
from ccnn_torch.diagnosis.search.convergence import (
    discrepancy_is_active,
    has_new_effects,
    is_converged,
    known_shapes,
    most_probable_shapes,
)
from ccnn_torch.effects import make_effect
from ccnn_torch.evidence.dictionary import Dictionary, FittedSet, dictionary_of, singles_of
from ccnn_torch.evidence.sets import scored

ROWS, CHANNELS = 100, 2


def columns(seed: int, width: int) -> Tensor:
    return torch.randn(ROWS, CHANNELS, width, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def looked_at() -> tuple[Dictionary, Tensor, list[FittedSet]]:
    """Backlash is there, its second shape being the right one; drift does nearly what it does, thermal nothing."""
    x = columns(0, 8)
    y = 5 * x[..., 0] + 5 * x[..., 1] + columns(1, 1)[..., 0]
    near = x[..., :2] + 0.1 * x[..., 2:4]
    names = ["backlash", "backlash", "drift", "drift", "thermal", "thermal"]
    own = [x[..., 2:4], x[..., :2], x[..., 4:5], near, x[..., 5:6], x[..., 6:8]]
    shape, effects = y.new_ones(1), {name: make_effect(name) for name in names}
    atoms = [Atom(n, effects[n], k * shape, c, -2.0) for k, (n, c) in enumerate(zip(names, own, strict=True))]
    dictionary = dictionary_of(atoms, own, y, [], singles_of(atoms, own, y, 0.0), 0.0)
    pairs = [(i, j) for i, j in combinations(range(len(names)), 2) if names[i] != names[j]]
    found = scored(dictionary, [(), *((i,) for i in range(len(names))), *pairs], {})
    return dictionary, y, sorted(found, key=lambda f: -f.log_posterior)


@pytest.mark.parametrize("sought", [None, frozenset({"backlash"}), frozenset()])
def test_shapes_of_what_is_out_of_play_are_not_looked_for_again(sought: frozenset[str] | None) -> None:
    dictionary, _, found = looked_at()
    assert found[0].members == (1,)
    known = known_shapes(dictionary.atoms, found, found[0], sought)
    shapes = {name: [float(a.shape) for a in atoms] for name, atoms in known.items()}
    assert len(shapes.pop("thermal")) == 1, "it adds nothing beside what acts, and stays with one shape"
    # Backlash acts, drift does it nearly as well: they keep all shapes, unless these are looked for.
    kept = {"backlash": [0.0, 1.0], "drift": [2.0, 3.0]}
    assert shapes == {name: kept[name] for name in kept if sought is not None and name not in sought}


def test_the_likeliest_shape_of_an_effect_is_that_of_its_best_set() -> None:
    dictionary, _, found = looked_at()
    likely = most_probable_shapes(dictionary.atoms, found)
    assert set(likely) == {"backlash", "drift", "thermal"}
    assert float(likely["backlash"].shape) == 1.0 and float(likely["drift"].shape) == 3.0


@pytest.mark.parametrize("bend", [0.0, 1.0])
def test_a_catch_all_plays_where_it_does_something_beside_the_library(bend: float) -> None:
    x = columns(0, 4)
    y = 5 * x[..., 0] + bend * x[..., 2] + columns(1, 1)[..., 0]
    own = [x[..., :2], x[..., 2:]]
    known = Atom("backlash", make_effect("backlash"), y.new_ones(1), own[0], -2.0)
    atoms = [known, Atom("workspace", None, y.new_zeros(0), own[1], -7.0)]
    dictionary = dictionary_of(atoms, own, y, [1], singles_of(atoms, own, y, 0.0), 0.0)
    found = sorted(scored(dictionary, [(), (0,), (1,), (0, 1)], {}), key=lambda f: -f.log_posterior)
    best = next(f for f in found if f.members == (0,))
    assert discrepancy_is_active(dictionary, found, best) == (bend > 0)


def test_only_names_that_do_something_have_joined_a_set() -> None:
    dictionary, _, found = looked_at()
    alone = found[0]
    beside = next(f for f in found if f.members == (1, 4))
    gap = float(dictionary.grams.yy) - ROWS * CHANNELS

    def anew(best: FittedSet, *before: str) -> bool:
        return has_new_effects(dictionary, found, best, frozenset(before), gap)

    assert not anew(alone, "backlash")
    assert not has_new_effects(dictionary, found, alone, frozenset({"backlash"}), 0.0), (
        "nothing joined, in no gap either"
    )
    assert not anew(alone, "backlash", "drift"), "that one fell away is nothing new"
    assert not anew(beside, "backlash"), "thermal does nothing beside backlash"
    assert anew(beside, "thermal"), "backlash does nearly all"
    assert anew(alone, "drift")


def test_a_fit_is_settled_where_noise_and_machine_are_as_the_linear_model_says() -> None:
    dictionary, y, found = looked_at()
    best = found[0]
    old = Whitening(torch.arange(CHANNELS), torch.full((CHANNELS,), 2e-5), torch.ones(ROWS, CHANNELS), 0.0)
    linear = y - dictionary.columns[..., dictionary.groups[1]] @ best.mean[0]
    left = linear * old.sigma

    def fits(new: Whitening = old, left: Tensor = left) -> bool:
        return is_converged(dictionary, best, old, new, left)

    assert fits() and fits(replace(old, sigma=3 * old.sigma))
    assert not fits(replace(old, sigma=old.sigma * torch.tensor([1.0, 2.0]))), "one channel is noisier than thought"
    assert not fits(left=left + 0.2 * old.sigma), "the machine itself does something else"


def test_what_does_not_act_keeps_few_shapes_and_that_of_the_textbook() -> None:
    situation = rows_of("five_bar", 120, 3)
    effects = ["joint_gain", "backlash", "friction", "drift"]
    said = diagnose_rows(situation, measured(situation, {"joint_gain": 12.0}, 4), effects=effects)
    assert said.verdict["effects"] == ["joint_gain"]
    shapes: dict[str, list[Atom]] = {}
    for atom in said.analysis.atoms:
        if atom.effect is not None and atom.shape.numel():
            shapes.setdefault(atom.name, []).append(atom)
    for name in ("backlash", "friction"):
        assert any(has_usual_shape(situation, atom) for atom in shapes[name]), name
    # One found beside the gain, the likeliest of those found at first, and that of the textbook.
    assert max(len(atoms) for atoms in shapes.values()) <= 3 and len(shapes["drift"]) <= 2


def test_a_period_that_explains_the_gap_alone_stays_beside_what_suits_the_noise() -> None:
    situation = rows_of("five_bar", 400, 0)
    middle = situation.joints.median(0).values
    near = ((situation.joints - middle).abs() < math.pi / 3).all(-1)
    situation = replace(situation, joints=situation.joints[near], guess=situation.pose[near], covariates={})
    eccentric = torch.zeros_like(situation.joints)
    eccentric[:, 0] = 4e-4 * torch.sin(situation.joints[:, 0])
    pose = situation.mechanism.forward_kinematics(situation.joints + eccentric, None, situation.pose)
    pose = pose + 1e-5 * torch.randn(pose.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    atoms = diagnose_rows(situation, pose).analysis.atoms
    assert any(a.name == "transmission" and float(a.shape[0]) == 1.0 and 0 in (a.used or (0,)) for a in atoms)
