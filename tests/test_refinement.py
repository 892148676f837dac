"""Refinement against automatic differentiation, and what it promises: generalisation, invariance, resume."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from ccnn_torch.evolution._gauss_newton import dense_jacobian, linearise, network_of, residual
from ccnn_torch.evolution.refinement import (
    RefinementSettings,
    RefinementState,
    finish_refinement,
    pose_refinement,
    refine,
    start_refinement,
    step_refinement,
)

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


@pytest.mark.parametrize("bias", [True, False])
@pytest.mark.parametrize("nodes", [(3, 2), (3, 5, 2), (4, 5, 6, 3)])
def test_derivatives_match_autodiff(nodes: tuple[int, ...], bias: bool) -> None:
    generator = torch.Generator().manual_seed(3)
    masks, weights = random_network((4,), nodes, generator, density=0.4, bias=bias)
    inputs = torch.rand(4, 7, nodes[0], generator=generator, dtype=torch.float64) * 2 - 1
    targets = torch.randn(4, 7, nodes[-1], generator=generator, dtype=torch.float64)
    factor = torch.randn(4, 7, 5, nodes[-1], generator=generator, dtype=torch.float64)
    precision = torch.rand(4, 7, 5, generator=generator, dtype=torch.float64)
    network = network_of(masks, bias)
    w = flat(weights)
    error = residual(network, w, inputs, targets, factor)
    jacobian = dense_jacobian(network, w, inputs, targets, factor)
    local = linearise(network, w, inputs, targets, factor, precision)
    for b in range(4):
        shapes = [m.shape[-2:] for m in weights]

        def one(vector: Tensor, b: int = b, shapes: list[torch.Size] = shapes) -> Tensor:
            parts = vector.split([s.numel() for s in shapes])
            layers = [p.reshape(s) for p, s in zip(parts, shapes, strict=True)]
            output = plain_forward([m[b] for m in masks], layers, inputs[b], bias)
            return (factor[b] @ (output - targets[b]).unsqueeze(-1)).squeeze(-1)

        expected = torch.func.jacrev(one)(w[b])
        torch.testing.assert_close(error[b], one(w[b]), rtol=1e-12, atol=1e-12)
        torch.testing.assert_close(jacobian[b], expected, rtol=1e-10, atol=1e-12)
        wide = expected * precision[b].sqrt().unsqueeze(-1)
        matrix = torch.einsum("sck,scl->kl", wide, wide)
        torch.testing.assert_close(local.matrix[b], matrix, rtol=1e-10, atol=1e-12)
        gradient = torch.einsum("sck,sc,sc->k", expected, precision[b], error[b])
        torch.testing.assert_close(local.gradient[b], gradient, rtol=1e-10, atol=1e-12)
