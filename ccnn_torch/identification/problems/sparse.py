"""Jacobians of rows whose entries depend on different parameters: several entries in one backward pass.

Curtis, Powell and Reid (1974): entries that share no parameter can be differentiated together.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from ccnn_torch.identification.problems.linear import row_jacobian

# Structure is read at points this many plausible errors off, so that what is zero by chance at a nominal zero shows.
_PROBES, _AWAY = 4, 0.1


def dependence(
    gap: Callable[..., Tensor], start: Tensor, scale: Tensor, data: tuple[Tensor, ...], used: Tensor, entries: int
) -> Tensor:
    """Which entries of a row depend on which parameters, in the rows of one machine: `c x k`, bool.

    Args:
        gap: `(values, *data)` -> `… x c`.
        start, scale: `k` [SI].
        data: `s x …` each.
        used: `s`, bool: rows that count.
        entries: `c`.
    """
    generator = torch.Generator().manual_seed(0)
    draw = torch.randn(_PROBES, 1, len(start), generator=generator, dtype=torch.float64).to(start.device)
    points = (start + _AWAY * scale * draw).expand(_PROBES, len(used), -1)
    slope = row_jacobian(gap, points, tuple(d.expand(_PROBES, *d.shape) for d in data), entries)[1]
    known = used[:, None, None] & torch.isfinite(slope)
    size = (torch.where(known, slope, 0.0).abs() * scale).flatten(0, 1).amax(0)
    # Rounding in an iterative solution is no dependence.
    return size > 1e-9 * size.max()


def entries_together(moved: Tensor) -> list[list[int]]:
    """Entries in groups that share no parameter, greedily; moved: `c x k`, bool."""
    groups: list[list[int]] = []
    for i in range(len(moved)):
        fits = (g for g in groups if not bool((moved[g].any(0) & moved[i]).any()))
        group = next(fits, None)
        if group is None:
            groups.append([i])
        else:
            group.append(i)
    return groups


class WhitenedResidual:
    """The residual L⁻¹ gap of a row, or its entries over their standard deviations; the factor is the last of the data.

    `jacobian` gives what differentiating the residual would, with a backward pass for each group of entries that share
    no parameter in place of one for each entry.
    """

    def __init__(self, gap: Callable[..., Tensor], entries: int, kept: list[int], factor: str, moved: Tensor) -> None:
        """factor: `full` (`c x c`, flat), `diagonal` (one for each kept entry) or `none`; moved: `c x k`, bool."""
        self.gap = gap
        self.entries = entries
        self.kept = kept
        self.factor = factor
        self.groups = [g for g in ([i for i in g if i in kept] for g in entries_together(moved)) if g]
        # In a group, the entry that a parameter moves (any, where it moves none: its derivative is zero).
        self.owner = [torch.tensor(g, device=moved.device)[moved[g].to(torch.int8).argmax(0)] for g in self.groups]
        self.sparse = len(self.groups) < len(kept)
        self.whole = self.groups == [list(range(entries))]

    def __call__(self, values: Tensor, *data: Tensor) -> Tensor:
        difference = self.gap(values, *(data if self.factor == "none" else data[:-1]))
        return self._weighted(difference, data)

    def _weighted(self, difference: Tensor, data: tuple[Tensor, ...]) -> Tensor:
        if self.factor == "full":
            root = data[-1].reshape(*data[-1].shape[:-1], self.entries, self.entries)
            return (root * difference[..., None, :]).sum(-1)
        if len(self.kept) < self.entries:
            difference = difference[..., self.kept]
        return difference if self.factor == "none" else difference * data[-1]

    def jacobian(self, values: Tensor, data: tuple[Tensor, ...]) -> tuple[Tensor, Tensor]:
        """Residual `… x c` and Jacobian `… x c x k` of every row; values `… x k`."""
        if not self.sparse:
            return row_jacobian(self, values, data, len(self.kept))
        point = values.detach().clone().requires_grad_()
        with torch.enable_grad():
            difference = self.gap(point, *(data if self.factor == "none" else data[:-1]))
            sums = [difference.sum()] if self.whole else [difference[..., g].sum() for g in self.groups]
        slope: Tensor | None = None
        for i, owner in enumerate(self.owner):
            more = i + 1 < len(sums)
            part = torch.autograd.grad(sums[i], point, retain_graph=more, materialize_grads=True)[0][..., None, :]
            part = part * self._share(owner, data)
            slope = part if slope is None else slope + part
        difference = difference.detach()
        value = self._weighted(difference, data)
        return value, value.new_zeros(*value.shape, values.shape[-1]) if slope is None else slope

    def _share(self, owner: Tensor, data: tuple[Tensor, ...]) -> Tensor:
        """How far the entry that a parameter moves goes into each channel, `… x c x k`."""
        if self.factor == "full":
            root = data[-1].reshape(*data[-1].shape[:-1], self.entries, self.entries)
            return root.index_select(-1, owner)
        own = owner == torch.tensor(self.kept, device=owner.device)[:, None]
        return own if self.factor == "none" else own * data[-1][..., None]
