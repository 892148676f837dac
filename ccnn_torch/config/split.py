"""The keys that select the held-out rows of a run or an identification."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, ConfigDict, Field, model_validator

from ccnn_torch.config.tree import Names, Section


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
