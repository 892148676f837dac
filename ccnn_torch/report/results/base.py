"""What the results of all commands share: a pydantic model for each file, from which JSON, schema and tables derive."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal, Self

from pydantic import BaseModel, ConfigDict, ValidationError

from ccnn_torch.display import number_text
from ccnn_torch.errors import InputError
from ccnn_torch.report.json_files import read_json

Length = Literal["m", "rad"]
"""SI unit of a position or of an angle."""
Number = float | None
"""null = not known."""
Ends = tuple[float, float]
"""Lower and upper end."""


class Result(BaseModel):
    """An object of a result's file: fields in its order, each with the text that documents it.

    `write_json` writes what was set. Fields are read as attributes, or by key as in the JSON.
    """

    model_config = ConfigDict(extra="forbid", populate_by_name=True, defer_build=True)

    def __getitem__(self, key: str) -> Any:
        fields = type(self).model_fields.items()
        return getattr(self, next((name for name, field in fields if field.serialization_alias == key), key))

    @classmethod
    def read(cls, path: Path) -> Self:
        """Read the file back.

        Raises:
            InputError: there is no such file, or it holds something else.
        """
        try:
            return cls.model_validate(read_json(path))
        except ValidationError as problem:
            first = problem.errors()[0]
            place = ".".join(map(str, first["loc"]))
            kind = (cls.__doc__ or "").partition(" ")[0]
            raise InputError(f"{path}: is no {kind} of this version: {place}: {first['msg']}") from None


class Spread(Result):
    """A figure of every repeat, and its median and quantiles over those that are known."""

    median: Number
    low: Number
    """5 % quantile"""
    high: Number
    """95 % quantile"""
    values: list[Number]
    """one a repeat, in the order of the seeds"""


class Axis(Result):
    """Name and SI unit of a joint or a covariate."""

    name: str
    unit: str


def interval_text(spread: Spread | None, scale: float = 1.0, digits: int = 4) -> str:
    """A spread as `median [low, high]`, or as one number when all repeats agree; says how many repeats have none.

    Args:
        spread: what to show; `–` for None.
        scale: the unit shown [SI].
        digits: significant digits of the median; the interval has one less.
    """
    if spread is None or spread.median is None or spread.low is None or spread.high is None:
        return "–"
    text = number_text(spread.median / scale, digits)
    if spread.low != spread.high:
        low, high = (number_text(end / scale, digits - 1) for end in (spread.low, spread.high))
        text += f" [{low}, {high}]"
    known = sum(value is not None for value in spread.values)
    return text if known == len(spread.values) else f"{text} ({known} of {len(spread.values)})"


def removed_percent(before: Spread | None, after: Spread | None) -> float | None:
    """Share of an error that was removed, from the medians [percent]; None where the error before is unknown or 0."""
    if before is None or after is None or not before.median or after.median is None:
        return None
    return 100.0 * (1.0 - after.median / before.median)
