"""The keys that select held-out rows, and the rows that they hold out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import torch
from pydantic import BeforeValidator, ConfigDict, Field, model_validator
from torch import Tensor

from ccnn_torch.config.tree import Names, Section
from ccnn_torch.errors import InputError
from ccnn_torch.records import Records
from ccnn_torch.records.load import Source
from ccnn_torch.records.splits import Column, Split, split_rows


def _share_or_file(value: Any) -> Any:
    """A number as it is, for pydantic to judge; a text that is no number must name a file."""
    if isinstance(value, str) and not Path(value).suffix:
        try:
            return float(value)
        except ValueError:
            raise ValueError(
                f"must be a share such as 0.3, or a file of records such as test.csv, not {value}"
            ) from None
    if isinstance(value, str):
        return value
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise ValueError(f"must be a share such as 0.3, or a file of records such as test.csv, not {value}")
    if not 0 < value < 1:
        raise ValueError(f"must be greater than 0 and less than 1, or a file of records, not {value}")
    return float(value)


def _listed(value: Any) -> Any:
    return [value] if isinstance(value, int | float) else value


class HeldOutConfig(Section):
    """Which rows are held out; see `ccnn_torch.records.splits`."""

    model_config = ConfigDict(coerce_numbers_to_str=True)

    kind: Literal["random", "group", "block", "column"] = Field(
        default="random", description="random, group, block or column"
    )
    by: Names | None = Field(
        default=None,
        description="what makes a group: columns or patterns (goal_*), or position:5mm, the default; with "
        "split.kind=column the column whose values split.test_values names",
    )
    test: Annotated[float | str, BeforeValidator(_share_or_file, json_schema_input_type=float | str)] = Field(
        default=0.3,
        description="share of the rows (group: of the groups) that is held out; or another file of records with the "
        "same columns, all of whose rows are held out",
    )
    test_values: Annotated[list[float] | None, BeforeValidator(_listed)] = Field(
        default=None,
        min_length=1,
        description="with split.kind=column: rows whose column split.by has one of these values are held out",
    )

    @property
    def test_file(self) -> str | None:
        """The file whose rows are held out; None if a share or a column selects the rows."""
        return self.test if isinstance(self.test, str) else None

    @model_validator(mode="after")
    def _one_way(self) -> HeldOutConfig:
        if self.kind == "column" and (self.by is None or len(self.by) != 1 or self.test_values is None):
            raise ValueError("kind=column needs one column and its values, e.g. split.by=set split.test_values=[1]")
        if self.kind != "column" and self.test_values is not None:
            raise ValueError("test_values have a meaning with split.kind=column alone; write that, or remove them")
        if self.test_file is not None and self.kind in ("column", "block"):
            raise ValueError(
                f"kind={self.kind} chooses test rows, and test names a file of them; write split.kind=random or group, "
                "or remove the file"
            )
        return self


class SplitConfig(HeldOutConfig):
    """Which rows are held out, and which are for validation."""

    validation: float = Field(default=0.2, ge=0, lt=1, description="share of the rest that chooses the model")


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
    targets: Tensor | None = None,
) -> Split:
    """Split rows by a config.

    Args:
        positions: `rows x d` [m].
        columns: the columns that the config may name, `rows` each.
        held: which rows are from the test file, `rows` bool, as `rows_of_test_file` gives them.
        targets: commanded joints, `rows x n`, as of `split_rows`.
    """
    test = split.test if held is None else held
    assert not isinstance(test, str)
    return split_rows(positions, split.kind, split.by, columns, test, validation, seed, split.test_values, targets)


def rows_of_test_file(split: HeldOutConfig, parts: Sequence[tuple[str, int]]) -> Tensor | None:
    """Which rows are from the test file, the last of the parts, `rows` bool; None where there is none."""
    if split.test_file is None:
        return None
    held = torch.zeros(sum(count for _, count in parts), dtype=torch.bool)
    held[len(held) - parts[-1][1] :] = True
    return held


def held_out_notes(split: HeldOutConfig, rows: int, drawn: Split | None = None) -> list[str]:
    """A note on the held-out rows if they were not drawn one by one at random.

    Args:
        rows: their number.
        drawn: the split, where rows may share targets.
    """
    if split.test_file is not None:
        return [f"Held out: all {rows} rows of {Path(split.test_file).name}."]
    if split.kind == "column" and split.by and split.test_values:
        values = ", ".join(f"{value:g}" for value in split.test_values)
        return [f"Held out: the {rows} rows whose {split.by[0]} is {values}."]
    if split.kind == "random" and drawn is not None and drawn.groups is not None:
        held, every = (len(set(numbers.tolist())) for numbers in (drawn.groups[drawn.test], drawn.groups))
        return [f"Held out: the {rows} rows of {held} of {every} targets, so that no target is in both parts."]
    return []
