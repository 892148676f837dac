"""Predictive variance of networks, against a naive twin and against repeated noise."""

import itertools

import numpy as np
import pytest
import torch

from ccnn_torch.evolution import MaskedNetwork
from ccnn_torch.evolution.masked_network import readout_spread, spread_variance
from ccnn_torch.evolution.network import Bundle, averaged, hidden_signal
from ccnn_torch.evolution.waves import no_waves


def _networks(
    members: int, hidden: tuple[int, ...], bias: bool = True, seed: int = 0
) -> tuple[list[torch.Tensor], list[torch.Tensor]]:
    generator = torch.Generator().manual_seed(seed)
    sizes = (3, *hidden, 2)
    masks, weights = [], []
    for before, after in itertools.pairwise(sizes):
        masks.append(torch.rand(2, members, after, before, generator=generator) < 0.7)
        weights.append(torch.randn(2, members, after, before + bias, generator=generator, dtype=torch.float64))
    return masks, weights


def _rows(seed: int = 1) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    inputs = torch.randn(2, 40, 3, generator=generator, dtype=torch.float64)
    targets = torch.randn(2, 40, 2, generator=generator, dtype=torch.float64)
    rows = torch.ones(2, 40, dtype=torch.float64)
    rows[1, 30:] = 0
    return inputs, targets, rows


@pytest.mark.parametrize(("members", "hidden"), [(1, (5,)), (3, (5, 4)), (2, ())])
@pytest.mark.parametrize("bias", [True, False])
def test_the_module_the_batch_and_a_naive_twin_agree(members: int, hidden: tuple[int, ...], bias: bool) -> None:
    masks, weights = _networks(members, hidden, bias)
    inputs, targets, rows = _rows()
    spread = readout_spread(masks, weights, inputs, targets, rows)
    wide_masks, wide_weights, _ = averaged(Bundle(masks, weights, no_waves((2, members), 0, inputs)))
    new = torch.randn(2, 7, 3, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    batched = spread_variance(wide_masks, wide_weights, spread, new)
    for repeat in range(2):
        module = MaskedNetwork(
            [m[repeat] for m in wide_masks],
            [w[repeat] for w in wide_weights],
            spread.factors[repeat],
            spread.noise[repeat],
        )
        assert torch.allclose(module.variance(new[repeat]), batched[repeat], rtol=1e-9)
        again = MaskedNetwork.from_description(module.describe())
        again.load_state_dict(module.state_dict())
        assert torch.equal(again.variance(new[repeat]), module.variance(new[repeat]))
        naive = _naive(repeat, masks, weights, new, (inputs, targets, rows), spread.noise)
        assert np.allclose(naive, batched[repeat].numpy(), rtol=1e-6)


def _naive(repeat, masks, weights, new, data, noise):  # type: ignore[no-untyped-def]
    """Member by member and output by output, in numpy."""
    inputs, _, rows = (part[repeat].numpy() for part in data)
    members, outputs = masks[0].shape[1], masks[-1].shape[2]
    total = np.zeros((new.shape[1], outputs))
    values = np.zeros((members, new.shape[1], outputs))
    for m in range(members):
        own = [mask[repeat, m] for mask in masks], [weight[repeat, m] for weight in weights]
        at_rows = hidden_signal(*own, torch.as_tensor(inputs)).numpy()
        at_new = hidden_signal(*own, new[repeat]).numpy()
        width = at_rows.shape[-1]
        for o in range(outputs):
            there = own[0][-1][o].numpy()
            readout = own[1][-1][o].numpy()
            kept = readout[:width][there]
            bias = readout[width] if len(readout) > width else 0.0
            basis = np.column_stack([at_rows[:, there], np.ones(len(at_rows))])
            precision = max(there.sum(), 1) / max(float(np.sum(kept**2)), 1e-6)
            prior = np.diag([precision] * int(there.sum()) + [1e-6])
            matrix = basis.T @ (basis * rows[:, None]) / float(noise[repeat, o]) + prior
            features = np.column_stack([at_new[:, there], np.ones(len(at_new))])
            total[:, o] += np.einsum("sk,kl,sl->s", features, np.linalg.inv(matrix), features) / members
            values[m, :, o] = at_new[:, there] @ kept + bias
    if members > 1:
        total += values.var(axis=0, ddof=1)
    return total + noise[repeat].numpy()


def test_intervals_of_a_linear_model_cover_what_they_say() -> None:
    """A network without hidden layers is Bayesian linear regression, whose intervals are right by construction."""
    generator = torch.Generator().manual_seed(3)
    inputs = torch.randn(400, 20, 3, generator=generator, dtype=torch.float64)
    truth = torch.tensor([[0.5, -1.0, 2.0]], dtype=torch.float64)
    targets = inputs @ truth.mT + 0.3 * torch.randn(400, 20, 1, generator=generator, dtype=torch.float64)
    basis = torch.cat([inputs, torch.ones_like(inputs[..., :1])], -1)
    fitted = torch.linalg.lstsq(basis, targets).solution.mT
    mask = torch.ones(400, 1, 1, 3, dtype=torch.bool)
    spread = readout_spread([mask], [fitted.unsqueeze(1)], inputs, targets, torch.ones(400, 20, dtype=torch.float64))
    new = torch.randn(400, 50, 3, generator=generator, dtype=torch.float64)
    measured = new @ truth.mT + 0.3 * torch.randn(400, 50, 1, generator=generator, dtype=torch.float64)
    predicted = torch.cat([new, torch.ones_like(new[..., :1])], -1) @ fitted.mT
    sd = spread_variance([mask[:, 0]], [fitted], spread, new).sqrt()
    covered = ((predicted - measured).abs() < 1.96 * sd).to(torch.float64).mean()
    assert 0.92 < float(covered) < 0.96
