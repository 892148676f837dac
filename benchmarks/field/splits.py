"""Which rows are trained on and which are held out: fixed by one seed."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from benchmarks.field.data import Data
from benchmarks.field.protocol import Ints

SEED = 20260
HELD_OUT = 0.3
# More training rows are thinned to these, by the seed: as many as people measure, and what a run can take.
TRAINING = 300
Split = tuple[Ints, Ints]
Mask = NDArray[np.bool_]


def splits(data: Data, seed: int = SEED) -> dict[str, Split]:
    """Training and held-out rows by the split's name, each as far as the data have it.

    `random` rows; whole `target` places; the far `block` of the workspace, along the first principal direction of the
    positions; another `placement` of the measuring frame or another `day`; the authors' own `published` test rows.
    """
    count, rows, group = len(data.rows.joints), data.rows, data.group
    drawn = group == np.random.default_rng(seed).integers(group.max() + 1)
    # Each night has zeros of its own: one night is trained on.
    usable = drawn if data.source.night else np.ones(count, np.bool_)
    found = {"random": _held(np.arange(count), usable, seed)}
    if data.target is not None:
        found["target"] = _held(data.target, usable, seed)
    if not rows.sockets:
        centred = rows.poses[:, :3] - rows.poses[:, :3].mean(0)
        along = centred @ np.linalg.svd(centred, full_matrices=False)[2][0]
        found["block"] = along > np.quantile(along[usable], 1 - HELD_OUT)
    if data.published is not None and 0 < data.published.sum() < count:
        found["published"] = data.published == 1
    masks = {name: (usable & ~out, usable & out) for name, out in found.items()}
    if data.source.night:
        masks["day"] = drawn, ~drawn
    elif group.max() > 0:
        masks["placement"] = ~drawn, drawn
    return {name: (thinned(np.flatnonzero(a), seed), np.flatnonzero(b)) for name, (a, b) in masks.items()}


def _held(group: Ints, usable: Mask, seed: int) -> Mask:
    groups = np.unique(group[usable])
    drawn = np.random.default_rng(seed).permutation(groups)[: round(HELD_OUT * len(groups))]
    return np.isin(group, drawn)


def thinned(index: Ints, seed: int) -> Ints:
    """At most `TRAINING` of the rows, in their order."""
    if len(index) <= TRAINING:
        return index
    return np.sort(np.random.default_rng(seed).permutation(index)[:TRAINING])


def halves(index: Ints, seed: int = SEED) -> Split:
    """Two halves of training rows."""
    drawn = np.random.default_rng(seed).permutation(index)
    return np.sort(drawn[: len(drawn) // 2]), np.sort(drawn[len(drawn) // 2 :])
