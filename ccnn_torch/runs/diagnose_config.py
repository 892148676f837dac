"""The config of a diagnosis: its keys, defaults and checks."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Any

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, ValidationError

from ccnn_torch.errors import InputError
from ccnn_torch.runs._keys import explain, list_keys
from ccnn_torch.runs._overrides import apply_overrides
from ccnn_torch.runs._yaml import read_yaml

__all__ = ["DiagnoseConfig", "describe_diagnose_keys", "load_diagnose_config"]


def _listed(value: Any) -> Any:
    return [part.strip() for part in value.split(",") if part.strip()] if isinstance(value, str) else value


Names = Annotated[list[str], BeforeValidator(_listed)]
Positive = Annotated[float, Field(gt=0)]


class DiagnoseConfig(BaseModel):
    """What `ccnn diagnose` and `ccnn check` may be told."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    records: str | None = Field(default=None, description="CSV of the records; the same as --records")
    mechanism: str | None = Field(default=None, description="the nominal machine; the same as --mechanism")
    out: str | None = Field(default=None, description="folder to write; the same as --out")
    mechanism_keys: dict[str, Any] = Field(default={}, description="keys of the mechanism's constructor")
    covariates: Names | None = Field(
        default=None,
        description="covariate columns by name or pattern; null = time, temperature, load_*, direction*, …",
    )
    noise: Positive | dict[str, Positive] | None = Field(
        default=None,
        description="standard deviation of the measured pose in SI, one number for every coordinate or by coordinate; "
        "null = estimated from the records",
    )
    effects: Names | None = Field(default=None, description="candidates, by name or path/to/file.py:Name; null = all")
    gravity: tuple[float, float, float] | None = Field(
        default=None, description="gravity in the base frame in m/s²; null = down along -z (planar machines: -y)"
    )
    seed: int = Field(default=0, ge=0, description="seed of folds and resampling")


def load_diagnose_config(path: Path | None, overrides: Iterable[str] = ()) -> DiagnoseConfig:
    """Read a config file (defaults where there is none) and put overrides ``key.sub=value`` over it.

    Raises:
        InputError: the file or an override cannot be read, or keys are wrong: one line that names them all.
    """
    tree = {} if path is None else read_yaml(path)
    given = apply_overrides(tree, overrides, Path.cwd())
    try:
        return DiagnoseConfig.model_validate({key: value for key, value in tree.items() if value is not None})
    except ValidationError as error:
        raise InputError(explain(error, DiagnoseConfig, str(path or "config"), given)) from None


def describe_diagnose_keys() -> list[tuple[str, str, str]]:
    """Every key with its default and what it means."""
    return list_keys(DiagnoseConfig)
