"""When it is worth while to look at the rows again, and which shapes are looked for then."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations

import pytest
import torch
from torch import Tensor

from ccnn_torch.diagnosis._again import known_shapes, settled
from ccnn_torch.diagnosis._atoms import Atom
from ccnn_torch.diagnosis._dictionary import Dictionary, Found, dictionary_of, singles_of
from ccnn_torch.diagnosis._sets import scored
from ccnn_torch.diagnosis._whitening import Whitening
from ccnn_torch.effects import make_effect

ROWS, CHANNELS = 100, 2


def columns(seed: int, width: int) -> Tensor:
    return torch.randn(ROWS, CHANNELS, width, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def looked_at() -> tuple[Dictionary, Tensor, list[Found]]:
    """Backlash is there, its second shape being the right one; drift does nearly what it does, thermal nothing."""
    x = columns(0, 8)
    y = 5 * x[..., 0] + 5 * x[..., 1] + columns(1, 1)[..., 0]
    near = x[..., :2] + 0.1 * x[..., 2:4]
    names = ["backlash", "backlash", "drift", "drift", "thermal", "thermal"]
    own = [x[..., 2:4], x[..., :2], x[..., 4:5], near, x[..., 5:6], x[..., 6:8]]
    shape = y.new_ones(1)
    atoms = [Atom(n, make_effect(n), k * shape, c, -2.0) for k, (n, c) in enumerate(zip(names, own, strict=True))]
    dictionary = dictionary_of(atoms, own, y, [], singles_of(atoms, own, y, 0.0), 0.0)
    pairs = [(i, j) for i, j in combinations(range(len(names)), 2) if names[i] != names[j]]
    found = scored(dictionary, [(), *((i,) for i in range(len(names))), *pairs], {})
    return dictionary, y, sorted(found, key=lambda f: -f.log_posterior)


@pytest.mark.parametrize("same", [False, True])
def test_shapes_of_what_is_out_of_play_are_not_looked_for_again(same: bool) -> None:
    dictionary, _, found = looked_at()
    assert found[0].members == (1,)
    known = known_shapes(dictionary, found, found[0], same)
    shapes = {name: [float(a.shape) for a in atoms] for name, atoms in known.items()}
    assert "backlash" not in shapes, "what acts is looked for whatever is known"
    assert len(shapes["thermal"]) == 1, "it adds nothing beside what acts, and stays with one shape"
    if same:
        assert shapes["drift"] == [2.0, 3.0], "nearly as good, and looked for beside the same before"
    else:
        assert "drift" not in shapes, "nearly as good, and looked for beside something else before"


def test_another_look_is_spared_only_where_noise_rows_and_machine_are_as_the_linear_model_says() -> None:
    dictionary, y, found = looked_at()
    best = found[0]
    old = Whitening(torch.arange(CHANNELS), torch.full((CHANNELS,), 2e-5), torch.ones(ROWS), 0.0)
    linear = y - dictionary.columns[..., dictionary.groups[1]] @ best.mean[0]
    left = linear * old.sigma

    def spared(new: Whitening = old, left: Tensor = left) -> bool:
        return settled(dictionary, y, best, old, new, left)

    assert spared() and spared(replace(old, sigma=3 * old.sigma))
    assert not spared(replace(old, sigma=old.sigma * torch.tensor([1.0, 2.0]))), "one channel is noisier than thought"
    aside = old.weight.clone()
    aside[:1] = 0
    assert spared(replace(old, weight=aside))
    aside[:5] = 0
    assert not spared(replace(old, weight=aside)), "many rows are set aside"
    assert not spared(left=left + 0.2 * old.sigma), "the machine itself does something else"
