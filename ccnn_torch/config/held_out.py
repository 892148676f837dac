"""The rows given by the keys `records` and `columns`, and those that `split` holds out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from ccnn_torch.config.split import HeldOutConfig
from ccnn_torch.errors import InputError
from ccnn_torch.records import Records
from ccnn_torch.records.sources import Source
from ccnn_torch.records.splits import Column, Split, split_rows

Given = Source | Records
"""Records given in Python in place of the config's file: a DataFrame, several, or loaded records."""


def given_records(records: Any) -> Given | None:
    """Records given in Python; None if they are the name of a file, or of several."""
    each = records if isinstance(records, list | tuple) else [records]
    return None if records is None or all(isinstance(one, str | Path) for one in each) else records


def name_given(given: Given) -> str:
    """The value of the key `records` in the config for records given in Python."""
    return given.path if isinstance(given, Records) else "DataFrame"


def with_test_file(source: Given, split: HeldOutConfig) -> Given:
    """The records, and after them the file whose rows are held out, where there is one.

    Raises:
        InputError: it is one of the records' files too, or the records are loaded already.
    """
    if split.test_file is None:
        return source
    if isinstance(source, Records):
        raise InputError("split.test: the records are loaded already; load them from both files, and split by a column")
    several = isinstance(source, Sequence) and not isinstance(source, str)
    sources: list[Any] = list(source) if several else [source]  # type: ignore[arg-type]
    if any(isinstance(one, str | Path) and str(one) == split.test_file for one in sources):
        raise InputError(f"split.test: {split.test_file} is among the records, which are trained on; name another file")
    return [*sources, split.test_file]


def split_by(
    split: HeldOutConfig,
    positions: Tensor,
    columns: Mapping[str, Column],
    seed: int,
    validation: float,
    held: Tensor | None = None,
) -> Split:
    """Split rows by a config.

    Args:
        positions: `rows x d` [m].
        columns: the columns that the config may name, `rows` each.
        held: which rows are from the test file, `rows` bool, as `rows_of_test_file` gives them.
    """
    test = split.test if held is None else held
    assert not isinstance(test, str)
    return split_rows(positions, split.kind, split.by, columns, test, validation, seed, split.test_values)


def rows_of_test_file(split: HeldOutConfig, parts: Sequence[tuple[str, int]]) -> Tensor | None:
    """Which rows are from the test file, the last of the parts, `rows` bool; None where there is none."""
    if split.test_file is None:
        return None
    held = torch.zeros(sum(count for _, count in parts), dtype=torch.bool)
    held[len(held) - parts[-1][1] :] = True
    return held


def held_out_notes(split: HeldOutConfig, rows: int) -> list[str]:
    """A note on the held-out rows if they were not drawn at random. rows: their number."""
    if split.test_file is not None:
        return [f"Held out: all {rows} rows of {Path(split.test_file).name}."]
    if split.kind == "column" and split.by and split.test_values:
        values = ", ".join(f"{value:g}" for value in split.test_values)
        return [f"Held out: the {rows} rows whose {split.by[0]} is {values}."]
    return []
