"""Rows for training, for choosing a model, and for the figures that are reported.

Four kinds, each a function of the rows and one seed:

* ``random``: rows at random, those of one target (the same joints were commanded) together: readings of a target that
  was trained on show how well it repeats, not how well the model knows others.
* ``group``: whole groups at random. `by` is a column or ``position:5mm``, the default: rows whose measured positions
  round to the same cell of 5 mm share a target pose and form a group. Several entries, or a pattern such as ``goal_*``,
  make a group of the rows that are alike in all. A column that is named counts alone: where many groups visit the same
  poses, joining them by pose too would leave a single group. Beware: measured positions scatter across the borders of
  cells. Where the commanded target is recorded, grouping by its columns is the stricter split.
* ``block``: whole groups (same `by`), sorted by their mean along the first principal direction of the positions; the
  far end is held out, so that the figures are those of extrapolation.
* ``column``: the rows whose column `by` has one of `test_values`.

The test rows may also be given one by one. Then, and with ``column``, they are the same for every seed, and single rows
(``group``: groups) of the rest are drawn for validation.

The training rows come first in the draw or along the direction, then the validation rows, last the test rows: a model
is chosen on rows of the same kind as those it is judged on, in a block split on the block beside the test block.
Cross-validation (`fold_splits`) keeps to that: groups stay whole, and the folds of a block split are blocks too.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ccnn_torch.errors import InputError
from ccnn_torch.spelling import hint, matching, nearest
from ccnn_torch.units import to_si

KINDS = ("random", "group", "block", "column")
DEFAULT_BY = "position:5mm"

# Values that a sentence lists.
_FEW = 8
# Joints are the same to this share of their range; fewer targets than this are not dealt to parts.
_SAME_TARGET, _FEWEST_TARGETS = 1e-6, 5
_FOLDS = 1
"""Beside the seed of a repeat, so that folds are not drawn like the split."""

Column = NDArray[np.float64] | Tensor
"""A column to group by, `rows`."""
_Integers = NDArray[np.int64]


@dataclass(frozen=True)
class Split:
    """Row indices, each ascending and int64; together every row once.

    Attributes:
        groups: number of each row's group, `rows` int64; those of a block split ascend along its direction. None =
            every row is a group of its own.
    """

    train: Tensor
    validation: Tensor
    test: Tensor
    groups: Tensor | None = None


def split_rows(
    positions: Tensor,
    kind: str = "random",
    by: str | Sequence[str] | None = None,
    columns: Mapping[str, Column] | None = None,
    test: float | Tensor = 0.3,
    validation: float = 0.2,
    seed: int = 0,
    test_values: Sequence[float] | None = None,
    targets: Tensor | None = None,
) -> Split:
    """Split rows.

    Of `k` rows (or groups) the first ``int((1 - test) * k)`` of ``numpy.random.default_rng(seed).permutation(k)`` are
    not test rows; of these `k'` the first ``int((1 - validation) * k')`` are for training, the others for validation.
    Groups are numbered as `numpy.unique` sorts their keys. A block split takes the same shares, of rows, along the
    sorted groups; a group across a border belongs to the far side.

    Args:
        positions: `rows x d` [m]; d may be 0 where `by` names columns.
        kind: ``random``, ``group``, ``block`` or ``column``.
        by: what makes a group, see above; one entry or several.
        columns: the columns that `by` may name, `rows` each.
        test: share of the rows (``group``: of the groups) that is held out, between 0 and 1; or which rows are, `rows`
            bool (``random`` and ``group``).
        validation: share of the rest, from 0.
        seed: seed of the draw; a block split draws nothing.
        test_values: values of the column `by` whose rows are held out (``column``), as in `columns`.
        targets: commanded joints, `rows x n`; rows alike in all are of one target (``random``). None = no two are.

    Raises:
        InputError: an unknown kind or column, a share out of range, a value that does not occur, or too few rows or
            groups for the shares.
    """
    rows = len(positions)
    given = isinstance(test, Tensor)
    for key, share, low in (("test", 0.5 if given else test, 0.0), ("validation", validation, -1e-300)):
        if not low < share < 1:
            raise InputError(f"split.{key}: {share:g} is not a share; write a number between 0 and 1, e.g. 0.2")
    if kind not in KINDS:
        near = nearest(kind, KINDS)
        raise InputError(f"split.kind: '{kind}' is not one of {', '.join(KINDS)}" + (f"; '{near}'?" if near else ""))
    if (kind == "column") != (test_values is not None) or (given and kind in ("block", "column")):
        raise InputError(
            "split: test_values go with split.kind=column, test rows that are given with split.kind=random or group"
        )
    if kind == "column":
        return _hold_out(_having(by, test_values or [], columns or {}), None, validation, seed)
    if kind == "random":
        if by is not None:
            raise InputError(f"split.by: '{by}' has no meaning with split.kind=random; write split.kind=group")
        shared = None if targets is None else number_targets(targets)
        places = None if shared is None else shared.numpy()
        if isinstance(test, Tensor):
            return _hold_out(test.numpy(), places, validation, seed)
        if places is None:
            return _draw(np.arange(rows), test, validation, seed, "rows")
        return replace(_draw(places, test, validation, seed, "targets"), groups=torch.from_numpy(places))
    groups = _groups(positions, DEFAULT_BY if by is None else by, columns or {})
    if isinstance(test, Tensor):
        return _hold_out(test.numpy(), groups, validation, seed)
    if kind == "group":
        return replace(_draw(groups, test, validation, seed, "groups"), groups=torch.from_numpy(groups))
    return _block(positions.numpy(), groups, test, validation)


def number_targets(joints: Tensor, fewest: int = _FEWEST_TARGETS) -> Tensor | None:
    """Number of each row's target, `rows`: rows of the same joints `rows x n` share one.

    None where no two do, or there are fewer targets than `fewest`: then every row is one of its own.
    """
    spread = (joints.amax(0) - joints.amin(0)).clamp_min(1e-300)
    number: Tensor = torch.unique((joints / (spread * _SAME_TARGET)).round(), dim=0, return_inverse=True)[1]
    return number if fewest <= int(number.max()) + 1 < len(number) else None


def fold_splits(split: Split, kind: str, folds: int, seed: int) -> list[Split]:
    """Cross-validation within the rows that are not test rows: every one is a validation row once.

    Whole groups are dealt to the folds in a random order; for ``block`` the folds are neighbouring blocks of about
    equally many rows along the split's direction. Random folds would select the model that interpolates best, and would
    underestimate its error on the held-out block, where it extrapolates.

    Args:
        folds: at least 2.
        seed: of the draw; it is another than the one `split_rows` makes of the same seed.

    Raises:
        InputError: there are fewer groups than folds.
    """
    rows = torch.cat([split.train, split.validation]).sort().values
    groups = np.arange(len(rows)) if split.groups is None else split.groups[rows].numpy()
    numbers, which, size = np.unique(groups, return_inverse=True, return_counts=True)
    if len(numbers) < folds:
        what = "rows" if split.groups is None else "groups"
        raise InputError(f"folds: {len(numbers)} {what} cannot be dealt to {folds} folds; write a smaller number")
    if kind == "block":
        middle = np.cumsum(size) - size / 2
        fold = np.minimum((middle / len(rows) * folds).astype(np.int64), folds - 1)
    else:
        fold = np.empty(len(numbers), dtype=np.int64)
        fold[np.random.default_rng([seed, _FOLDS]).permutation(len(numbers))] = np.arange(len(numbers)) % folds
    held = torch.from_numpy(fold[which])
    empty = set(range(folds)) - set(held.tolist())
    if empty:
        raise InputError(
            f"folds: the groups of this block split are too uneven for {folds} folds; write a smaller number"
        )
    return [replace(split, train=rows[held != k], validation=rows[held == k]) for k in range(folds)]


def _draw(groups: _Integers, test: float, validation: float, seed: int, what: str) -> Split:
    """Whole groups at random. groups: number of each row's group, `rows`."""
    count = int(groups.max(initial=-1)) + 1
    order = np.random.default_rng(seed).permutation(count)
    kept = _first(1 - test, count)
    trained = _first(1 - validation, kept)
    part = np.empty(count, dtype=np.int64)
    part[order[:trained]], part[order[trained:kept]], part[order[kept:]] = 0, 1, 2
    return _collect(part[groups], validation, f"{count} {what}")


def _hold_out(held: NDArray[np.bool_], groups: _Integers | None, validation: float, seed: int) -> Split:
    """The rows that are to be held out; of the others whole groups at random for validation. held: `rows`."""
    rest = np.flatnonzero(~held)
    numbers = np.arange(len(rest)) if groups is None else np.unique(groups[rest], return_inverse=True)[1].reshape(-1)
    count = int(numbers.max(initial=-1)) + 1
    order = np.random.default_rng(seed).permutation(count)
    chosen = np.ones(count, dtype=np.int64)
    chosen[order[: _first(1 - validation, count)]] = 0
    part = np.full(len(held), 2, dtype=np.int64)
    part[rest] = chosen[numbers]
    split = _collect(part, validation, f"{count} {'rows' if groups is None else 'groups'} beside the test rows")
    return split if groups is None else replace(split, groups=torch.from_numpy(groups))


def _having(
    by: str | Sequence[str] | None, values: Sequence[float], columns: Mapping[str, Column]
) -> NDArray[np.bool_]:
    """Which rows have one of some values in a column, `rows`."""
    names = [by] if isinstance(by, str) else list(by or [])
    if len(names) != 1:
        raise InputError("split.by: split.kind=column takes one column; write e.g. split.by=set")
    column = _column(names[0], columns)
    held = np.zeros(len(column), dtype=bool)
    there = ", ".join(f"{value:g}" for value in np.unique(column)[:_FEW])
    for value in values:
        # A value that was converted to SI differs from the one asked for in its last digits.
        found = np.isclose(column, value, rtol=1e-9, atol=0.0)
        if not found.any():
            more = " …" if len(np.unique(column)) > _FEW else ""
            raise InputError(
                f"split.test_values: no row has {value:g} in '{names[0]}', which has {there}{more} (in SI)"
            )
        held |= found
    if held.all():
        raise InputError(
            f"split.test_values: every row has one of them in '{names[0]}', and none is left to train on; remove one"
        )
    return held


def _block(positions: NDArray[np.float64], groups: _Integers, test: float, validation: float) -> Split:
    """Whole groups along the first principal direction, whose largest component counts as negative.

    A principal direction has no sign of its own; this one agrees with the published reference figures of the UR10 sets.
    """
    rows = len(positions)
    if positions.shape[1] == 0:
        raise InputError("split.kind: a block split needs positions, and this pose has none; write split.kind=group")
    centred = positions - positions.mean(axis=0)
    direction = np.linalg.svd(centred, full_matrices=False)[2][0]
    direction = -direction * np.sign(direction[np.argmax(np.abs(direction))])
    size = np.bincount(groups)
    mean = np.bincount(groups, weights=centred @ direction) / size
    order = np.argsort(mean, kind="stable")
    reached = np.cumsum(size[order])
    kept = _first(1 - test, rows)
    trained = _first(1 - validation, kept)
    part = np.empty(len(size), dtype=np.int64)
    part[order] = np.where(reached <= trained, 0, np.where(reached <= kept, 1, 2))
    along = np.empty(len(size), dtype=np.int64)
    along[order] = np.arange(len(size))
    split = _collect(part[groups], validation, f"{len(size)} groups of {rows} rows")
    return replace(split, groups=torch.from_numpy(along[groups]))


def _first(share: float, count: int) -> int:
    """Whole number of items in a share: `int(share * count)` without rounding errors, so that 0.8 of 125 is 100."""
    return int(share * count + 1e-9)


def _collect(part: _Integers, validation: float, stock: str) -> Split:
    train, chosen, test = (torch.from_numpy(np.flatnonzero(part == number)) for number in range(3))
    for key, indices, wanted in (
        ("training", train, True),
        ("validation", chosen, validation > 0),
        ("test", test, True),
    ):
        if wanted and len(indices) == 0:
            raise InputError(f"split: {stock} are too few, no {key} row is left; record more or change the shares")
    return Split(train, chosen, test)


def _groups(positions: Tensor, by: str | Sequence[str], columns: Mapping[str, Column]) -> _Integers:
    """Number of each row's group, `rows`, from 0: rows alike in every entry of `by` form a group."""
    keys = []
    for entry in [by] if isinstance(by, str) else by:
        if entry.partition(":")[0] == "position":
            if positions.shape[1] == 0:
                raise InputError(f"split.by: '{entry}' needs positions, and this pose has none; name a column instead")
            keys.append(np.round(positions.numpy() / _cell(entry)))
        else:
            keys += [_column(name, columns)[:, None] for name in _matching(entry, columns)]
    return np.unique(np.concatenate(keys, axis=1), axis=0, return_inverse=True)[1].reshape(-1).astype(np.int64)


def _cell(by: str) -> float:
    """Edge of the cells in m, from ``position:5mm``."""
    match = re.fullmatch(r"position:\s*(\d+\.?\d*|\.\d+)\s*(\D+)", by)
    if match is None or float(match[1]) == 0:
        raise InputError(f"split.by: '{by}' is not of the form position:LENGTH; write e.g. {DEFAULT_BY}")
    where, hint = f"split.by: the length in '{by}'", f"write e.g. {DEFAULT_BY}"
    return float(to_si(float(match[1]), match[2].strip(), "m", where, hint=hint))


def _matching(entry: str, columns: Mapping[str, Column]) -> list[str]:
    """The columns that a pattern such as ``goal_*`` names; a plain name stays itself."""
    return matching(columns, [entry]) or [entry]


def _column(name: str, columns: Mapping[str, Column]) -> NDArray[np.float64]:
    if name not in columns:
        near = hint(name, [DEFAULT_BY, *columns], "write one of")
        raise InputError(f"split.by: there is no column '{name}' to group by; {near}")
    values = np.asarray(columns[name], dtype=np.float64)
    missing = np.flatnonzero(np.isnan(values))
    if len(missing):
        raise InputError(
            f"split.by: column '{name}' has no value in row {missing[0] + 1}; fill it in or group otherwise"
        )
    return values
