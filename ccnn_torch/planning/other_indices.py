"""Exchange of poses for the indices O2 to O5."""

from __future__ import annotations

import torch
from torch import Tensor

from ccnn_torch.identification.problems.problem import Progress
from ccnn_torch.planning.observability import index_of

# Candidates whose index is computed in full in place of a chosen pose; the derivative of the index picks them.
_SHORTLIST = 256
_SWEEPS = 50
# Relative gain that counts.
_GAIN = 1e-7


def exchange_by_index(
    rows: Tensor, chosen: list[int], prior: Tensor, index: str, repeat: bool = False, progress: Progress | None = None
) -> tuple[list[int], bool]:
    """Improve a design by exchanging its poses one by one, until the index grows no more.

    These indices have no cheap update: the derivative of the index by the information selects the candidates for which
    the index is computed in full.

    Args:
        rows: of the candidates, `M x c x k` [1], in the units that the index is meant in.
        chosen: a design in which every direction is observable, for example the one of largest O1.
        prior: information without any pose, `k x k`.
        index: `O2` … `O5`.
        repeat: whether a candidate may be chosen more than once.
        progress: called with the share that is done.

    Returns:
        The design, and whether no exchange improves it.
    """
    chosen = list(chosen)
    information = prior + _information(rows[chosen]).sum(0)
    free = torch.ones(len(rows), dtype=torch.bool)
    free[chosen] = repeat
    for sweep in range(_SWEEPS):
        changed = False
        for place, old in enumerate(chosen):
            here = float(_index(information, index))
            without = information - _information(rows[old])
            short = _promising(rows, information, index, free)
            tried = without + _information(rows[short])
            values = _index(tried, index)
            best = int(values.argmax())
            if float(values[best]) <= here * (1 + _GAIN):
                continue
            free[old], chosen[place] = True, int(short[best])
            free[chosen[place]] = repeat
            information = prior + _information(rows[chosen]).sum(0)
            changed = True
        if progress is not None:
            progress((sweep + 1) / (sweep + 2))
        if not changed:
            return chosen, True
    return chosen, False


def _promising(rows: Tensor, information: Tensor, index: str, free: Tensor) -> Tensor:
    """Numbers of the free candidates along which the index grows most steeply."""
    values, vectors = torch.linalg.eigh(information)
    slope = torch.func.grad(lambda square: index_of(index, square.flip(-1).sqrt()))(values.clamp_min(1e-300))
    steepness = ((rows @ vectors).square() @ slope).sum(-1)
    steepness = torch.where(free, steepness, -torch.inf)
    return steepness.topk(min(_SHORTLIST, int(free.sum()))).indices


def _information(rows: Tensor) -> Tensor:
    return rows.mT @ rows


def _index(information: Tensor, index: str) -> Tensor:
    """The index of informations `... x k x k`; `...`."""
    values = torch.linalg.eigvalsh(information).clamp_min(0.0)
    return index_of(index, values.flip(-1).sqrt())
