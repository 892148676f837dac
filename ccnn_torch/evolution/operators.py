"""Selection, equivalent crossover and mutation of whole subpopulations (paper 000, sections III-D and F).

Every random number is an argument, so that an operator can be held against a plain one-individual-at-a-time version
that is given the same numbers. The length of the paper's weight string is the number of ones by construction: each
operator leaves 0 where there is no connection, and a weight travels with its bit.
"""

from __future__ import annotations

import torch
from torch import Tensor

from ccnn_torch.evolution.genome import Genome, active


def tournament(fitness: Tensor, draws: Tensor) -> Tensor:
    """Tournament selection with replacement.

    Args:
        fitness: `r x p`.
        draws: uniform numbers, `r x c x t`, t = contestants of one tournament.

    Returns:
        Number of each winner, `r x c`, int64; of equal contestants the first drawn.
    """
    contestants = (draws * fitness.shape[-1]).long()
    scores = fitness.gather(-1, contestants.flatten(1)).view_as(contestants)
    return contestants.gather(-1, scores.argmax(-1, keepdim=True)).squeeze(-1)


def swap_genes(draws: Tensor, genes: int) -> Tensor:
    """Which genes two parents exchange: the row-order string is cut, and its segments are exchanged alternately.

    Args:
        draws: uniform numbers, `... x cuts` (one: single-point), each a cut at one of the places 1 .. genes - 1; two at
            one place cancel.
        genes: length of the string.

    Returns:
        `... x genes`, bool.
    """
    cuts = 1 + (draws * (genes - 1)).long()
    places = torch.arange(genes, device=draws.device)
    return (places >= cuts.unsqueeze(-1)).sum(-2) % 2 == 1


def crossover(first: Genome, second: Genome, swap: Tensor) -> tuple[Genome, Genome]:
    """Equivalent crossover (III-D): the cut in the weight string follows the ones before the cut in the bit string.

    With weights kept at the place of their bits that is one exchange of the same genes in both tensors.

    Args:
        first, second: parents, `... x out x in`.
        swap: genes to exchange, `... x out x in`, or `... x out x (in + 1)` where there are biases.
    """
    bits = swap[..., : first.mask.shape[-1]]
    return (
        Genome(torch.where(bits, second.mask, first.mask), torch.where(swap, second.weight, first.weight)),
        Genome(torch.where(bits, first.mask, second.mask), torch.where(swap, first.weight, second.weight)),
    )


def flip_connections(genome: Genome, flip: Tensor, fresh: Tensor) -> Genome:
    """Bit-flip mutation: a connection that appears gets a fresh weight, one that vanishes loses its own.

    Args:
        flip: bits to change, `... x out x in`, bool.
        fresh: weights for those that appear, `... x out x in`.
    """
    mask = genome.mask ^ flip
    kept = genome.weight[..., : mask.shape[-1]]
    weight = torch.where(flip, torch.where(mask, fresh, torch.zeros_like(fresh)), kept)
    return Genome(mask, torch.cat([weight, genome.weight[..., mask.shape[-1] :]], dim=-1))


def weakest_draw(genome: Genome, draws: Tensor) -> Tensor:
    """The one active gene of each individual with the smallest draw: an unbiased choice of a gene to mutate.

    Args:
        draws: uniform numbers, shape of the weights.

    Returns:
        bool, shape of the weights; all False for an individual without any weight.
    """
    places = active(genome)
    lowest = draws.masked_fill(~places, 1.0)
    return (lowest == lowest.amin((-2, -1), keepdim=True)) & places


def nonuniform_mutation(
    genome: Genome, chosen: Tensor, draws: Tensor, progress: float, low: float, high: float, exponent: float
) -> Genome:
    """Non-uniform mutation, eqs. 12-13: steps that shrink with the generations.

    Args:
        chosen: weights to change, shape of the weights, bool; places without a connection are left at 0.
        draws: uniform numbers, shape of the weights. One number serves both: below 1/2 the weight goes up (rand = 0 in
            eq. 12), above it down, and its fraction of that half is r of eq. 13.
        progress: t / T in [0, 1].
        low, high: LD and UD. A weight outside (a refined one may be) is drawn back towards the range.
        exponent: b.
    """
    doubled = draws * 2
    up = doubled < 1
    share = 1 - torch.where(up, doubled, doubled - 1) ** ((1 - progress) ** exponent)
    stepped = genome.weight + torch.where(up, high - genome.weight, low - genome.weight) * share
    return Genome(genome.mask, torch.where(chosen & active(genome), stepped, genome.weight))
