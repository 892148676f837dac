"""Refinement against automatic differentiation, and what it promises: generalisation, invariance, resume."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from ccnn_torch.evolution import refinement
from ccnn_torch.evolution.gauss_newton import linearise, network_of, residual
from ccnn_torch.evolution.refinement import (
    Refined,
    RefinementState,
    finish_refinement,
    log_evidence,
    pose_refinement,
    refine,
    second_order,
    start_refinement,
    step_refinement,
)
from ccnn_torch.numerics.trees import picked

Layers = list[Tensor]


def random_network(
    leading: tuple[int, ...],
    nodes: tuple[int, ...],
    generator: torch.Generator,
    density: float = 1.0,
    bias: bool = True,
) -> tuple[Layers, Layers]:
    shapes = list(zip(nodes[1:], nodes[:-1], strict=True))
    masks = [torch.rand(*leading, o, i, generator=generator) < density for o, i in shapes]
    weights = [
        torch.rand(*leading, o, i + int(bias), generator=generator, dtype=torch.float64) * 2 - 1 for o, i in shapes
    ]
    return masks, weights


def plain_forward(masks: Layers, weights: Layers, inputs: Tensor, bias: bool = True) -> Tensor:
    """One network, node by node as the paper draws it: a node without inputs or outputs gives 0."""
    alive = [torch.ones(masks[0].shape[1], dtype=torch.bool)]
    for mask in masks:
        alive.append((mask & alive[-1]).any(-1))
    useful = [torch.ones(masks[-1].shape[0], dtype=torch.bool)]
    for mask in reversed(masks):
        useful.insert(0, (mask & useful[0].unsqueeze(-1)).any(0))
    signal = inputs
    for index, (mask, weight) in enumerate(zip(masks, weights, strict=True)):
        columns = weight[:, :-1] if bias else weight
        signal = signal @ torch.where(mask, columns, 0).T
        if bias:
            signal = signal + weight[:, -1]
        if index < len(masks) - 1:
            signal = torch.sigmoid(signal) * (alive[index + 1] & useful[index + 1])
    return signal


def flat(weights: Layers) -> Tensor:
    return torch.cat([w.flatten(-2) for w in weights], dim=-1)


@pytest.mark.parametrize("judged", ["outputs", "channels"])
@pytest.mark.parametrize("bias", [True, False])
@pytest.mark.parametrize("nodes", [(3, 2), (3, 5, 2), (4, 5, 6, 3)])
def test_derivatives_match_autodiff(nodes: tuple[int, ...], bias: bool, judged: str) -> None:
    generator = torch.Generator().manual_seed(3)
    masks, weights = random_network((4,), nodes, generator, density=0.4, bias=bias)
    inputs = torch.rand(4, 7, nodes[0], generator=generator, dtype=torch.float64) * 2 - 1
    targets = torch.randn(4, 7, nodes[-1], generator=generator, dtype=torch.float64)
    factor = torch.randn(4, 7, 5, nodes[-1], generator=generator, dtype=torch.float64)
    given = None if judged == "outputs" else factor
    if given is None:
        factor = torch.eye(nodes[-1], dtype=torch.float64).expand(4, 7, -1, -1)
    precision = torch.rand(*factor.shape[:-1], generator=generator, dtype=torch.float64)
    network = network_of(masks, bias)
    w = flat(weights)
    error = residual(network, w, inputs, targets, given)
    local = linearise(network, w, inputs, targets, given, precision)
    kept = network.kept_flat
    assert network.active.sum() == network.active.gather(1, kept).sum()
    for b in range(4):
        shapes = [m.shape[-2:] for m in weights]

        def one(vector: Tensor, b: int = b, shapes: list[torch.Size] = shapes) -> Tensor:
            parts = vector.split([s.numel() for s in shapes])
            layers = [p.reshape(s) for p, s in zip(parts, shapes, strict=True)]
            output = plain_forward([m[b] for m in masks], layers, inputs[b], bias)
            return (factor[b] @ (output - targets[b]).unsqueeze(-1)).squeeze(-1)

        expected = torch.func.jacrev(one)(w[b])
        torch.testing.assert_close(error[b], one(w[b]), rtol=1e-12, atol=1e-12)
        wide = expected * precision[b].sqrt().unsqueeze(-1)
        matrix = torch.einsum("sck,scl->kl", wide, wide)
        torch.testing.assert_close(local.matrix[b], matrix[kept[b]][:, kept[b]], rtol=1e-10, atol=1e-12)
        gradient = torch.einsum("sck,sc,sc->k", expected, precision[b], error[b])
        torch.testing.assert_close(local.gradient[b], gradient[kept[b]], rtol=1e-10, atol=1e-12)


def toy(runs: int, rows: int, generator: torch.Generator) -> tuple[Tensor, Tensor, Tensor]:
    """Inputs, true outputs and noisy targets: a product, a parabola with a line, and nothing at all."""
    x = torch.rand(runs, rows, 3, generator=generator, dtype=torch.float64) * 2 - 1
    truth = torch.stack([torch.sin(3 * x[..., 0]) * x[..., 1], x[..., 0] ** 2 + x[..., 2] / 2, 0 * x[..., 0]], dim=-1)
    noise = torch.tensor([0.1, 0.3, 1.0], dtype=torch.float64)
    return x, truth, truth + noise * torch.randn(truth.shape, generator=generator, dtype=torch.float64)


def predict(masks: Layers, weights: Layers, inputs: Tensor) -> Tensor:
    outputs = [plain_forward([m[b] for m in masks], [w[b] for w in weights], inputs[b]) for b in range(inputs.shape[0])]
    return torch.stack(outputs)


def test_evidence_beats_plain_least_squares_on_held_out_rows() -> None:
    generator = torch.Generator().manual_seed(1)
    x, truth, targets = toy(6, 300, generator)
    masks, weights = random_network((6,), (3, 6, 6, 3), generator)
    rows = torch.ones(6, 100, dtype=torch.float64)
    errors = {}
    for warm_up in (3, 40):
        refined = refine(masks, weights, x[:, :100], targets[:, :100], rows, 40, warm_up=warm_up)
        difference = predict(masks, refined.weights, x[:, 100:]) - truth[:, 100:]
        errors[warm_up] = difference.square().mean((0, 1)).sqrt()
    assert bool((errors[3] < 0.6 * errors[40]).all()), errors
    # The noise is told from the signal: its deviation is right to a third for each output.
    refined = refine(masks, weights, x[:, :100], targets[:, :100], rows)
    deviation = refined.precisions.noise.rsqrt().median(0).values
    assert bool(((deviation / torch.tensor([0.1, 0.3, 1.0])).log().abs() < 0.3).all()), deviation


def test_pure_noise_gives_the_mean() -> None:
    generator = torch.Generator().manual_seed(2)
    x = torch.rand(4, 200, 3, generator=generator, dtype=torch.float64) * 2 - 1
    targets = torch.randn(4, 200, 2, generator=generator, dtype=torch.float64) + 5
    masks, weights = random_network((4,), (3, 6, 6, 2), generator)
    refined = refine(masks, weights, x, targets, torch.ones(4, 200, dtype=torch.float64))
    output = predict(masks, refined.weights, x)
    ones = torch.ones(4, 200, dtype=torch.float64)
    problem = pose_refinement(masks, refined.weights, x, targets, ones)
    state = start_refinement(problem, refined.weights, known=refined.precisions)
    for _ in range(10):
        state = step_refinement(problem, state, second_order(problem, state))
    assert float(state.effective.sum(-1).max()) < 8
    assert float((output - targets.mean(1, keepdim=True)).abs().mean()) < 0.12
    plain = refine(masks, weights, x, targets, torch.ones(4, 200, dtype=torch.float64), warm_up=50)
    assert float((predict(masks, plain.weights, x) - targets.mean(1, keepdim=True)).abs().mean()) > 0.2


def test_weights_without_a_part_stay_as_they_are() -> None:
    generator = torch.Generator().manual_seed(4)
    x, _, targets = toy(5, 40, generator)
    masks, weights = random_network((5,), (3, 5, 5, 3), generator, density=0.3)
    masks[0][0] = False  # a network that is a constant
    weights[0][1, 0] = torch.nan
    masks[0][1, 0] = False
    refined = refine(masks, weights, x, targets, torch.ones(5, 40, dtype=torch.float64))
    active = network_of(masks, bias=True).active
    before, after = flat(weights), flat(refined.weights)
    assert torch.equal(torch.nan_to_num(after[~active]), torch.nan_to_num(before[~active]))
    assert bool(after[active].isfinite().all())
    assert bool((after[active] != before[active]).any())
    constant = predict([m[:1] for m in masks], [w[:1] for w in refined.weights], x[:1])
    torch.testing.assert_close(constant[0, 0], targets[0].mean(0), rtol=0, atol=1e-4)


def test_padded_rows_do_not_matter() -> None:
    generator = torch.Generator().manual_seed(5)
    x, _, targets = toy(2, 50, generator)
    masks, weights = random_network((2,), (3, 4, 3), generator)
    rows = torch.ones(2, 50, dtype=torch.float64)
    alone = refine(masks, weights, x, targets, rows, 8)
    filler = torch.full((2, 7, 3), torch.nan, dtype=torch.float64)
    padded = refine(
        masks,
        weights,
        torch.cat([x, filler], dim=1),
        torch.cat([targets, filler], dim=1),
        torch.cat([rows, torch.zeros(2, 7, dtype=torch.float64)], dim=1),
        8,
    )
    torch.testing.assert_close(flat(padded.weights), flat(alone.weights), rtol=1e-6, atol=1e-8)
    twice = refine(
        masks,
        weights,
        torch.cat([x, x], dim=1),
        torch.cat([targets, targets], dim=1),
        torch.cat([rows, rows], 1) / 2,
        8,
    )
    torch.testing.assert_close(flat(twice.weights), flat(alone.weights), rtol=1e-6, atol=1e-8)


def test_a_batch_equals_separate_runs() -> None:
    generator = torch.Generator().manual_seed(6)
    x, _, targets = toy(2, 60, generator)
    masks, weights = random_network((2,), (3, 4, 3), generator, density=0.8)
    rows = torch.ones(2, 60, dtype=torch.float64)
    together = refine(masks, weights, x, targets, rows, 8)
    for k in range(2):
        one = refine(
            *([part[k : k + 1] for part in layers] for layers in (masks, weights)),
            *picked((x, targets, rows), slice(k, k + 1)),
            8,
        )
        expected = flat(together.weights)[k : k + 1]
        torch.testing.assert_close(flat(one.weights), expected, rtol=1e-5, atol=1e-7)
        torch.testing.assert_close(one.log_evidence, together.log_evidence[k : k + 1], rtol=1e-6, atol=1e-5)


def test_steps_interrupted_and_resumed_are_the_same_bit_by_bit() -> None:
    generator = torch.Generator().manual_seed(7)
    x, _, targets = toy(3, 60, generator)
    masks, weights = random_network((3,), (3, 4, 3), generator)
    rows = torch.ones(3, 60, dtype=torch.float64)
    whole = refine(masks, weights, x, targets, rows, 9)
    problem = pose_refinement(masks, weights, x, targets, rows)
    state = start_refinement(problem, weights)
    for iteration in range(9):
        if iteration == 4:
            stored = {name: value.clone() for name, value in state._asdict().items()}
            problem = pose_refinement(masks, weights, x, targets, rows)
            state = RefinementState(**stored)
        state = step_refinement(problem, state, second_order(problem, state))
    pieces = finish_refinement(problem, state)
    assert pieces.iterations == whole.iterations == 9
    assert torch.equal(flat(pieces.weights), flat(whole.weights))
    assert torch.equal(pieces.log_evidence, whole.log_evidence)


def test_the_plain_objective_never_rises_and_extreme_starts_stay_finite() -> None:
    generator = torch.Generator().manual_seed(8)
    x, _, targets = toy(4, 30, generator)
    masks, weights = random_network((4,), (3, 8, 8, 3), generator)
    scale = torch.tensor([0.0, 1.0, 1e3, 1e6], dtype=torch.float64).reshape(4, 1, 1)
    weights = [w * scale for w in weights]
    rows = torch.ones(4, 30, dtype=torch.float64)
    problem = pose_refinement(masks, weights, x, targets, rows, warm_up=15)
    state = start_refinement(problem, weights)
    last = refinement._objective(problem, state, state.weights)
    for _ in range(15):
        state = step_refinement(problem, state, second_order(problem, state))
        objective = refinement._objective(problem, state, state.weights)
        assert bool((objective <= last).all())
        last = objective
    refined = refine(masks, weights, x, targets, rows)
    assert bool(flat(refined.weights).isfinite().all())
    assert bool(refined.log_evidence.isfinite().all())


def test_a_metric_judges_errors_where_they_are_felt() -> None:
    """Two outputs of which only their sum is felt, except that a third of the rows feel the first alone."""
    generator = torch.Generator().manual_seed(9)
    x = torch.rand(300, 2, generator=generator, dtype=torch.float64) * 2 - 1
    truth = torch.stack([torch.sin(2 * x[:, 0]), x[:, 0] * x[:, 1]], dim=-1)
    metric = torch.tensor([[[1.0, 1.0]]], dtype=torch.float64).repeat(300, 1, 1)
    metric[::3] = torch.tensor([[1.0, 0.0]], dtype=torch.float64)
    # What is not felt may be measured wildly wrong.
    blind = torch.stack([metric[:, 0, 1], -metric[:, 0, 0]], dim=-1)
    wrong = 30 * torch.randn(300, 1, generator=generator, dtype=torch.float64)
    felt_noise = 0.05 * torch.randn(300, 2, generator=generator, dtype=torch.float64)
    masks, weights = random_network((1,), (2, 8, 2), generator)
    rows = torch.ones(1, 300, dtype=torch.float64)
    targets = (truth + felt_noise + wrong * blind)[None]
    refined = refine(masks, weights, x[None], targets, rows, row_metric=metric[None])
    error = predict(masks, refined.weights, x[None]) - truth
    assert float(error.square().mean().sqrt()) < 0.05


def test_a_descent_ends_where_its_evidence_does_and_keeps_the_highest(monkeypatch: pytest.MonkeyPatch) -> None:
    """Precisions that are estimated anew may take a network past its best; iterations after that are not made."""
    generator = torch.Generator().manual_seed(3)
    inputs = 2 * torch.rand(2, 60, 2, generator=generator, dtype=torch.float64) - 1
    targets = torch.sin(2 * inputs[..., :1]) + 0.1 * torch.randn(2, 60, 1, generator=generator, dtype=torch.float64)
    masks = [torch.ones(2, 6, 2, dtype=torch.bool), torch.ones(2, 1, 6, dtype=torch.bool)]
    weights = [torch.randn(2, 6, 3, generator=generator).double(), torch.randn(2, 1, 7, generator=generator).double()]
    rows = torch.ones(2, 60, dtype=torch.float64)

    def refined(iterations: int, patience: int) -> Refined:
        monkeypatch.setattr(refinement, "_PATIENCE", patience)
        return refine(masks, weights, inputs, targets, rows, iterations)

    monkeypatch.setattr(refinement, "_TOLERANCE", 0.0)

    early, late = refined(200, 6), refined(200, 1000)
    assert early.iterations < 60 and late.iterations == 200
    # No more is lost than six iterations of less than 1 nat could have brought, and what was found is kept.
    assert bool((early.log_evidence > late.log_evidence - 6).all())
    path = torch.stack([refined(n, 1000).log_evidence for n in range(6, 31, 4)])
    assert bool((path[1:] >= path[:-1] - 1e-9).all())


def test_where_the_normal_matrix_has_no_factor_there_is_no_evidence() -> None:
    inputs, targets = torch.zeros(3, 20, 2, dtype=torch.float64), torch.ones(3, 20, 1, dtype=torch.float64)
    masks = [torch.ones(3, 4, 2, dtype=torch.bool), torch.ones(3, 1, 4, dtype=torch.bool)]
    weights = [torch.ones(3, 4, 3, dtype=torch.float64), torch.ones(3, 1, 5, dtype=torch.float64)]
    problem = pose_refinement(masks, weights, inputs, targets, torch.ones(3, 20, dtype=torch.float64))
    state = start_refinement(problem, weights)
    known = second_order(problem, state)
    failed = torch.tensor([0, 3, 0], dtype=known.failed.dtype)
    spoilt = known._replace(failed=failed, root=known.root.index_fill(0, torch.tensor(2), torch.nan))
    assert torch.isfinite(log_evidence(problem, state, spoilt)).tolist() == [True, False, False]
    assert not torch.isnan(log_evidence(problem, state, spoilt)).any()
