"""The evidence against the textbook's, and the search for shapes against a brute one."""

from __future__ import annotations

import math
from collections.abc import Sequence

import pytest
import torch
from diagnosis._machines import rows_of
from scipy.stats import multivariate_normal

from ccnn_torch.diagnosis.candidates.atom import Atom
from ccnn_torch.diagnosis.candidates.nuisance import NuisanceFit, SharedColumns, TrialColumns
from ccnn_torch.effects import make_effect
from ccnn_torch.evidence.dictionary import Dictionary, dictionary_of, singles_of
from ccnn_torch.evidence.marginal_likelihood import (
    NO_COLUMNS,
    Prior,
    column_indices,
    fit_sets,
    fit_single_groups,
    grams_of,
    own_products,
)
from ccnn_torch.evidence.sets import promising, scored


def _columns(seed: int, rows: int, width: int) -> torch.Tensor:
    return torch.randn(rows, 1, width, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def test_the_evidence_is_that_of_the_marginal_normal_with_the_hyperpriors() -> None:
    x, y = _columns(0, 30, 4), _columns(1, 30, 1)[..., 0] * 0.7
    y = y + (x[..., :2] @ torch.tensor([1.0, -2.0], dtype=torch.float64))
    fit = fit_sets(grams_of(x, y), [[torch.tensor([0, 1])], [torch.tensor([0, 1]), torch.tensor([2, 3])]], 0.0, 25)
    for row, groups in enumerate(([[0, 1]], [[0, 1], [2, 3]])):
        noise, scale = float(fit.noise[row]), fit.log_scale[row].exp()
        covariance = noise * torch.eye(30, dtype=torch.float64)
        for k, group in enumerate(groups):
            covariance += scale[k] * x[:, 0, group] @ x[:, 0, group].T
        plain = multivariate_normal(cov=covariance.numpy()).logpdf(y.flatten().numpy()) + 15 * math.log(2 * math.pi)
        # Normal prior of log α² with spread 4, and the width that the data leave to it (Laplace).
        inverse = torch.linalg.inv(covariance)
        for k, group in enumerate(groups):
            kernel = scale[k] * x[:, 0, group].T @ inverse @ x[:, 0, group]
            plain += -0.5 * float(scale[k].log()) ** 2 / 16 - 0.5 * math.log1p(8 * float(kernel.trace()))
        assert float(fit.log_evidence[row]) == pytest.approx(plain, abs=1e-6)


def test_sets_side_by_side_are_as_sets_alone() -> None:
    x, y = _columns(2, 40, 7), _columns(3, 40, 1)[..., 0]
    sets = [[torch.tensor([0])], [torch.tensor([1, 2]), torch.tensor([3, 4, 5])], []]
    together = fit_sets(grams_of(x, y), sets, 10.0)
    for row, one in enumerate(sets):
        alone = fit_sets(grams_of(x, y), [one], 10.0)
        assert float(together.log_evidence[row]) == pytest.approx(float(alone.log_evidence[0]), rel=1e-12)


def test_the_noise_that_was_given_counts_more_the_surer_it_is() -> None:
    y = 2 * _columns(4, 200, 1)[..., 0]
    x = _columns(5, 200, 2)
    found = [float(fit_sets(grams_of(x, y), [[]], dof).noise[0]) for dof in (0.0, 200.0, 1e6)]
    assert found[0] == pytest.approx(float(y.square().mean()), rel=1e-6)
    assert found[0] > found[1] > found[2] == pytest.approx(1.0, abs=1e-2)


@pytest.mark.parametrize("name", ["transmission", "backlash", "friction", "drift"])
def test_columns_without_their_zeros_are_the_columns(name: str) -> None:
    situation, effect = rows_of("tripod", 20, 1), make_effect(name)
    shape = torch.tensor([[s.grid[0], s.grid[-1]] for s in effect.shapes(situation)], dtype=torch.float64).mT
    dense = effect.basis(situation, shape)
    own = effect.one_by_one(situation, shape)  # type: ignore[attr-defined]
    assert torch.equal(dense.sum(-2), own)
    assert int((dense != 0).sum(-2).max()) == 1
    rows = torch.tensor([17, 3, 8])
    assert torch.equal(effect.one_by_one(situation, shape, rows), own[:, rows])  # type: ignore[attr-defined]


def test_what_is_put_beside_in_parts_takes_what_it_takes_at_once() -> None:
    y, x = _columns(6, 60, 1).reshape(30, 2), 5 * _columns(7, 60, 9).reshape(30, 2, 9)
    at_once, in_parts = NuisanceFit(y, x), NuisanceFit(y, x[..., :4]).beside(x[..., 4:])
    factors, lead = (
        _columns(8, 30, 12).reshape(30, 4, 3).transpose(0, 1),
        SharedColumns(_columns(9, 60, 2).reshape(30, 2, 2)),
    )
    led, each = TrialColumns(factors[..., None, :], lead), TrialColumns(factors[..., :2, None], lead)
    plain, apart = (TrialColumns(torch.stack([t.one(k) for k in range(4)])) for t in (led, each))
    wanted = at_once.gain(plain)
    assert at_once.gain(each) == pytest.approx(at_once.gain(apart).numpy(), rel=1e-9)
    # By the textbook: what M(I + MᵀM)^-1 Mᵀ leaves of y and of the columns, M having ten plausible sizes.
    flat, columns = 10 * x.flatten(0, 1), plain.factors.flatten(1, 2)
    leave = torch.linalg.inv(torch.eye(60, dtype=y.dtype) + flat @ flat.mT)
    along = columns.mT @ leave @ y.flatten()
    assert wanted == pytest.approx(
        (along * torch.linalg.solve(columns.mT @ leave @ columns, along)).sum(-1).numpy(), rel=1e-5
    )
    for left in (at_once, in_parts):
        for tried in (led, plain):
            assert left.gain(tried) == pytest.approx(wanted.numpy(), rel=1e-9)


@pytest.mark.parametrize("own", [False, True])
@pytest.mark.parametrize("width", [1, 4])
def test_several_remainders_at_once_are_as_one_by_one(own: bool, width: int) -> None:
    y, x = _columns(20, 60, 1).reshape(30, 2), _columns(21, 60, 3).reshape(30, 2, 3)
    more, lead = _columns(22, 180, 2).reshape(3, 30, 2, 2), _columns(23, 180, 3).reshape(3, 30, 2, 3)
    factors = _columns(24, 3 * 5 * 30 * 3, width).reshape(3, 5, 30, 3, width)[..., : 3 if own else 1, :]
    left = NuisanceFit(y, x)
    together = left.beside(more).gain(TrialColumns(factors, SharedColumns(lead)))
    for mine, m, f, k in zip(together, more, factors, lead, strict=True):
        assert mine == pytest.approx(left.beside(m).gain(TrialColumns(f, SharedColumns(k))).numpy(), rel=1e-9)


def test_nearly_the_same_columns_far_above_the_noise_can_be_taken_out_twice() -> None:
    y, x = _columns(12, 60, 1).reshape(30, 2), 1e7 * _columns(13, 60, 5).reshape(30, 2, 5)
    twice = NuisanceFit(y, x).beside(x * (1 + 1e-12 * torch.arange(5))).beside(x)
    assert twice.y == pytest.approx(NuisanceFit(y, x).y.numpy(), abs=0.05)
    assert bool(torch.isfinite(twice.gain(TrialColumns(_columns(14, 240, 3).reshape(4, 30, 2, 3)))).all())


def test_groups_in_their_axes_are_as_sets_of_one() -> None:
    x, y = _columns(10, 40, 9), _columns(11, 40, 1)[..., 0]
    x[..., 8] = x[..., 7]
    groups = [torch.arange(0, 3), torch.arange(3, 7), torch.arange(7, 9)]
    products = [NO_COLUMNS, *(own_products(x[..., g], y) for g in groups)]
    found, axes = fit_single_groups(products, y.square().sum(), Prior(40.0, 5.0))
    for k, group in enumerate([[], *([g] for g in groups)]):
        one = fit_sets(grams_of(x, y), [group], 5.0)
        assert float(found.log_evidence[k]) == pytest.approx(float(one.log_evidence[0]), rel=1e-9)
        coefficients = axes[k] @ found.first[k, : len(axes[k])]
        assert coefficients == pytest.approx(one.mean[0].numpy(), rel=1e-6)
        for name in ("noise", "rss", "effective"):
            assert float(getattr(found, name)[k]) == pytest.approx(float(getattr(one, name)[0]), rel=1e-9)


def _dictionary(seed: int, noise_dof: float, opposed: float, firsts: Sequence[int] | None = None) -> Dictionary:
    """Four groups, of which the first two make the data; opposed: how far they cancel each other."""
    x = _columns(seed, 80, 14)
    x[..., 5:8] = opposed * x[..., :3] + (1 - opposed**2) ** 0.5 * x[..., 5:8]
    y = 10 * (x[..., 0] - x[..., 5]) + 2 * x[..., 8] + _columns(seed + 1, 80, 1)[..., 0]
    columns = [x[..., k] for k in (slice(0, 5), slice(5, 8), slice(8, 12), slice(12, 14))]
    atoms = [Atom(f"group {k}", make_effect("tool"), y.new_zeros(0), c, -2.0) for k, c in enumerate(columns)]
    return dictionary_of(atoms, columns, y, [], singles_of(atoms, columns, y, noise_dof), noise_dof, firsts)


@pytest.mark.parametrize("opposed", [0.0, 0.7])
@pytest.mark.parametrize("noise_dof", [0.0, 40.0])
def test_sets_are_fitted_to_the_end(noise_dof: float, opposed: float) -> None:
    dictionary = _dictionary(40, noise_dof, opposed)
    sets = [(), (1,), (0, 1), (0, 2), (1, 2), (0, 1, 2), (0, 1, 2, 3)]
    fits = fit_sets(dictionary.grams, [[dictionary.groups[i] for i in members] for members in sets], noise_dof, 200)
    for k, (members, found) in enumerate(zip(sets, scored(dictionary, sets, {}), strict=True)):
        mean = torch.cat([dictionary.grams.xy[:0], *found.mean])
        assert found.members == members
        assert found.log_evidence == pytest.approx(float(fits.log_evidence[k]), abs=0.3)
        assert mean.numpy() == pytest.approx(fits.mean[k, : len(mean)].numpy(), abs=0.1)


def test_a_dictionary_for_some_sets_says_of_these_what_the_whole_says() -> None:
    whole, some = _dictionary(60, 0.0, 0.5), _dictionary(60, 0.0, 0.5, firsts=[2])
    sets = [(0, 2), (1, 2), (2, 3)]
    for one, other in zip(scored(whole, sets, {}), scored(some, sets, {}), strict=True):
        assert one.log_evidence == pytest.approx(other.log_evidence, abs=1e-6)
        assert torch.cat(one.mean).numpy() == pytest.approx(torch.cat(other.mean).numpy(), abs=1e-9)
    assert bool(some.grams.xx[whole.groups[0]][:, whole.groups[1]].isnan().all())


def test_columns_of_runs_stand_side_by_side() -> None:
    begin, width = torch.tensor([[4, 0], [2, 9]]), torch.tensor([[2, 3], [1, 1]])
    columns, slot = column_indices(begin, width)
    assert columns.tolist() == [[4, 5, 0, 1, 2], [2, 9, -1, -1, -1]]
    assert slot.tolist() == [[0, 0, 1, 1, 1], [0, 1, -1, -1, -1]]


def test_what_is_far_behind_is_left_out_and_the_best_is_not() -> None:
    dictionary = _dictionary(50, 0.0, 0.7)
    pairs = [(i, j) for i in range(4) for j in range(i + 1, 4)]
    every = {f.members: f.log_posterior for f in scored(dictionary, pairs, {})}
    kept = {f.members: f.log_posterior for f in promising(dictionary, pairs, -math.inf, {})}
    assert max(every, key=lambda s: every[s]) == (0, 1)
    assert kept[0, 1] == pytest.approx(every[0, 1], abs=0.1)
    assert every[2, 3] < every[0, 1] - 60 and (2, 3) not in kept
