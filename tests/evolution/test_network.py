"""Masked networks: dead nodes, pruning and the exported module against a network evaluated node by node."""

from __future__ import annotations

import naive_network as naive
import onnxruntime
import pytest
import torch
from hypothesis import given, settings, strategies as st
from module_graph import to_onnx
from reference_operators import decode
from torch import Tensor

from ccnn_torch.evolution import Genome, MaskedNetwork, alive_nodes, forward, prune
from ccnn_torch.evolution.network import Bundle, averaged, fed_nodes
from ccnn_torch.evolution.waves import no_waves

SIZES = st.sampled_from([[3, 6, 6, 3], [2, 4, 1], [3, 3], [4, 2, 3, 2, 2]])


def parts(layers: list[Genome]) -> tuple[list[Tensor], list[Tensor]]:
    return [layer.mask for layer in layers], [layer.weight for layer in layers]


@settings(max_examples=25, deadline=None)
@given(SIZES, st.sampled_from([0.0, 0.15, 0.4, 1.0]), st.booleans(), st.integers(0, 2**31))
def test_forward_pruned_and_exported_network_give_the_naive_numbers(
    sizes: list[int], density: float, bias: bool, seed: int
) -> None:
    generator = torch.Generator().manual_seed(seed)
    masks, weights = parts(naive.random_layers(sizes, (2,), density, bias, generator))
    inputs = 2 * torch.rand(2, 5, sizes[0], generator=generator, dtype=torch.float64) - 1
    together = forward(masks, weights, inputs)
    for k in range(2):
        one_masks, one_weights = [m[k] for m in masks], [w[k] for w in weights]
        rows = [naive.output(one_masks, one_weights, row) for row in inputs[k].tolist()]
        expected = torch.tensor(rows, dtype=torch.float64)
        assert torch.allclose(together[k], expected, rtol=0, atol=1e-13)
        small_masks, small_weights = prune(one_masks, one_weights)
        assert torch.allclose(forward(small_masks, small_weights, inputs[k]), together[k], rtol=0, atol=1e-13)
        # Nothing is left to prune.
        assert all(bool(alive.all()) for alive in alive_nodes(small_masks))
        network = MaskedNetwork(one_masks, one_weights)
        assert torch.allclose(network(inputs[k]), together[k], rtol=0, atol=1e-13)


@settings(max_examples=25, deadline=None)
@given(SIZES, st.sampled_from([0.15, 0.5, 1.0]), st.booleans(), st.integers(1, 4), st.integers(0, 2**31))
def test_the_average_of_networks_is_one_network(
    sizes: list[int], density: float, bias: bool, members: int, seed: int
) -> None:
    generator = torch.Generator().manual_seed(seed)
    masks, weights = parts(naive.random_layers(sizes, (2, members), density, bias, generator))
    inputs = 2 * torch.rand(2, 5, sizes[0], generator=generator, dtype=torch.float64) - 1
    expected = forward(masks, weights, inputs.unsqueeze(1)).mean(1)
    wide_masks, wide_weights, _ = averaged(Bundle(masks, weights, no_waves((2, members), 0, inputs)))
    assert [mask.shape[-2] for mask in wide_masks[:-1]] == [members * size for size in sizes[1:-1]]
    assert torch.allclose(forward(wide_masks, wide_weights, inputs), expected, rtol=0, atol=1e-13)
    if len(sizes) > 2:
        assert [int(m.sum()) for m in wide_masks] == [int(m.sum()) for m in masks]


@settings(max_examples=25, deadline=None)
@given(SIZES, st.sampled_from([0.1, 0.3, 0.6]), st.integers(0, 2**31))
def test_dead_nodes_are_those_that_deletion_leaves(sizes: list[int], density: float, seed: int) -> None:
    layers = naive.random_layers(sizes, (4,), density, True, torch.Generator().manual_seed(seed))
    masks = [layer.mask for layer in layers]
    for function, outputs_too in ((fed_nodes, False), (alive_nodes, True)):
        kept = function(masks)
        for k in range(4):
            dead = naive.dead_nodes([mask[k] for mask in masks], outputs_too)
            assert [set((~layer[k]).nonzero().flatten().tolist()) for layer in kept] == dead


def test_the_papers_example_of_dead_nodes() -> None:
    """Eq. 14: the third node of the first layer has no input, the first of the second layer's inputs no output."""
    first = decode("11 10 00", [0.2, 0.4, -0.2])
    second = decode("011 001 010", [0.3, -0.3, 0.1, 0.4])
    last = decode("111", [0.1, -0.1, 0.2])
    masks, weights = parts([first, second, last])
    # h1: node 0 is read by nobody, node 2 has no input; h2: node 1 reads node 2 alone, so it dies with it.
    assert [alive.tolist() for alive in alive_nodes(masks)] == [[False, True, False], [True, False, True]]
    small, _ = prune(masks, weights)
    assert [tuple(mask.shape) for mask in small] == [(1, 2), (2, 1), (1, 2)]


def test_a_network_without_any_path_gives_its_output_bias() -> None:
    masks = [torch.ones(4, 3, dtype=torch.bool), torch.zeros(2, 4, dtype=torch.bool)]
    weights = [torch.ones(4, 4, dtype=torch.float64), torch.full((2, 5), 0.7, dtype=torch.float64)]
    network = MaskedNetwork(masks, weights)
    assert network.describe() == {"kind": "masked", "sizes": [3, 2], "spread": 0, "waves": 0}
    assert torch.equal(network(torch.randn(6, 3, dtype=torch.float64)), torch.full((6, 2), 0.7, dtype=torch.float64))


def test_weights_without_a_connection_do_not_matter() -> None:
    masks, weights = parts(naive.random_layers([3, 5, 2], (), 0.5, True, torch.Generator().manual_seed(3)))
    junk = []
    for mask, weight in zip(masks, weights, strict=True):
        absent = torch.cat([~mask, mask.new_zeros(len(mask), 1)], -1)
        junk.append(torch.where(absent, torch.nan, weight))
    inputs = torch.linspace(-1, 1, 12, dtype=torch.float64).view(4, 3)
    assert torch.equal(forward(masks, junk, inputs), forward(masks, weights, inputs))
    assert torch.equal(MaskedNetwork(masks, junk)(inputs), MaskedNetwork(masks, weights)(inputs))


def test_a_described_network_takes_the_tensors_of_the_first() -> None:
    masks, weights = parts(naive.random_layers([3, 6, 6, 3], (), 0.4, True, torch.Generator().manual_seed(5)))
    network = MaskedNetwork(masks, weights)
    again = MaskedNetwork.from_description(network.describe())
    again.load_state_dict(network.state_dict())
    inputs = torch.linspace(-1, 1, 12, dtype=torch.float64).view(4, 3)
    assert torch.equal(again(inputs), network(inputs))
    assert {p.dtype for p in network.parameters()} == {torch.float64}
    assert not any(p.requires_grad for p in network.parameters())


def test_building_a_network_leaves_the_global_random_state_alone() -> None:
    masks, weights = parts(naive.random_layers([3, 4, 2], (), 0.8, True, torch.Generator().manual_seed(5)))
    before = torch.random.get_rng_state()
    MaskedNetwork(masks, weights)
    assert torch.equal(torch.random.get_rng_state(), before)


@pytest.mark.parametrize("density", [0.5, 0.0])
def test_exports_to_onnx_and_torch_export_with_any_batch(density: float) -> None:
    masks, weights = parts(naive.random_layers([3, 6, 6, 3], (), density, True, torch.Generator().manual_seed(8)))
    network = MaskedNetwork(masks, weights).eval()
    example = torch.linspace(-1, 1, 12, dtype=torch.float64).view(4, 3)
    shapes = ({0: torch.export.Dim("batch")},)
    model = to_onnx(network, {"inputs": example}, ["output"])
    session = onnxruntime.InferenceSession(model.SerializeToString(), providers=["CPUExecutionProvider"])
    program = torch.export.export(network, (example,), dynamic_shapes=shapes).module()
    for rows in (4, 1, 9):
        inputs = torch.linspace(-3, 2, 3 * rows, dtype=torch.float64).view(rows, 3)
        expected = network(inputs)
        (got,) = session.run(None, {session.get_inputs()[0].name: inputs.numpy()})
        assert torch.allclose(torch.from_numpy(got), expected, rtol=0, atol=1e-14)
        assert torch.allclose(program(inputs), expected, rtol=0, atol=1e-15)
