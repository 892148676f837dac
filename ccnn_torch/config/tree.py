"""Common parts of all configs: read a tree of keys, apply overrides, validate, write."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any, ClassVar, Self, TypeVar

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, ValidationError

from ccnn_torch.config.keys import config_model, explain
from ccnn_torch.config.overrides import apply_overrides, relate_paths, resolve_paths
from ccnn_torch.errors import InputError
from ccnn_torch.files.yaml_file import dump_yaml, read_yaml

Config = TypeVar("Config", bound=BaseModel)
Note = Callable[[str], None]


def _listed(value: Any) -> Any:
    """A name, or several separated by commas, as a list."""
    return [part.strip() for part in value.split(",") if part.strip()] if isinstance(value, str) else value


Names = Annotated[list[str], BeforeValidator(_listed, json_schema_input_type=str | list[str])]


def _files(value: Any) -> Any:
    if not (isinstance(value, str) or (isinstance(value, list) and value and all(isinstance(v, str) for v in value))):
        raise ValueError(
            f"must be a file of records or a list of them, e.g. day1.csv or [day1.csv, day2.csv], not {value}"
        )
    return value


Files = Annotated[str | list[str], BeforeValidator(_files, json_schema_input_type=str | list[str])]
"""Records: a file, or several with the same columns."""

Columns = Annotated[
    dict[str, str],
    Field(
        default={},
        description='columns under other names than ours: header in the file: "name[unit]", or ignore, e.g. '
        '{A1: "q1[deg]", X: "x[mm]", Note: ignore}',
    ),
]
"""Headers of records -> names and units."""

JointMap = Annotated[
    dict[str, str],
    Field(
        default={},
        description="joints as sums of the file's columns, where the controller counts otherwise, e.g. "
        '{q3: "J3 - J2"}; commands are written back in its count',
    ),
]
"""Joints -> linear functions of columns."""


class Section(BaseModel):
    """A section of a config: unknown keys are refused, values are finite and immutable."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class JobConfig(Section):
    """The config of a command: read from a file, from keys or from the command line, and written back."""

    of_a_run: ClassVar[tuple[str, ...]] = ()
    """Keys that mean the same in a config for `ccnn run`, where a command takes one and leaves its other keys out."""

    @classmethod
    def from_file(cls, path: str | Path | None, overrides: Iterable[str] = (), note: Note | None = None) -> Self:
        """Read a config file and put overrides ``key.sub=value`` over it; its name is the file's unless it has one.

        Args:
            path: the file, or a config for `ccnn run` as `ccnn new` writes it; None for defaults alone.
            overrides: ``key.sub=value``.
            note: called with a sentence that names the keys of `ccnn run` that were left out.

        Raises:
            InputError: the file or an override cannot be read, or keys are wrong: one line that names them all.
        """
        tree: dict[str, Any] = {}
        if path is not None:
            path = Path(path)
            tree = _used(read_yaml(path), cls, path, note)
            if "name" in cls.model_fields:
                tree.setdefault("name", path.stem)
            # Links are resolved, as the system does for `..` and as `to_yaml` does.
            resolve_paths(tree, Path(os.path.realpath(path.parent)))
        given = apply_overrides(tree, overrides, Path.cwd())
        filled = {key: value for key, value in tree.items() if value is not None}
        return validated(cls, filled, str(path or "command line"), given)

    @classmethod
    def from_keys(cls, **keys: Any) -> Self:
        """A config from keys, e.g. ``RunConfig.from_keys(case="tripod", repeats=3)``; paths from the current folder.

        Raises:
            InputError: keys are wrong: one line that names them all.
        """
        resolve_paths(keys, Path.cwd())
        return validated(cls, keys, "config", {})

    def to_yaml(self, folder: Path | None = None) -> str:
        """Every key as YAML for `from_file`; paths relative to `folder`, so that both can be moved, else absolute."""
        tree = self.model_dump(mode="json")
        if folder is not None:
            relate_paths(tree, folder)
        return dump_yaml(tree)


def _used(tree: dict[str, Any], model: type[BaseModel], path: Path, note: Note | None) -> dict[str, Any]:
    """A file's keys without those that `ccnn run` alone has; of a config for `ccnn run` the shared ones."""
    run, shared = config_model("run"), getattr(model, "of_a_run", ())
    names = {".".join(key) for key in _foreign(tree, model, run)} if shared else set()
    # A case study has no records to share.
    if not names or not {"records", "mechanism"} & tree.keys():
        return tree
    if tree.keys() <= {*run.model_fields}:
        names |= tree.keys() - {*shared}
    kept = {
        key: {k: v for k, v in value.items() if f"{key}.{k}" not in names} if isinstance(value, dict) else value
        for key, value in tree.items()
        if key not in names
    }
    if note is not None:
        left = [name for name in sorted(names) if name.partition(".")[0] == name or name.partition(".")[0] in kept]
        are = "is a key of ccnn run and is" if len(left) == 1 else "are keys of ccnn run and are"
        note(f"{path}: {', '.join(left)} {are} not used here.")
    return kept


def _foreign(tree: Mapping[str, Any], model: type[BaseModel], run: type[BaseModel]) -> Iterator[tuple[str, ...]]:
    """Keys of a tree, with those of their sections, that `run` has and `model` has not."""
    for key, value in tree.items():
        mine, theirs = model.model_fields.get(key), run.model_fields.get(key)
        if theirs is not None and mine is None:
            yield (key,)
        elif theirs is not None and mine is not None and isinstance(value, dict):
            ours, its = mine.annotation, theirs.annotation
            if isinstance(ours, type) and issubclass(ours, BaseModel) and isinstance(its, type):
                yield from ((key, *below) for below in _foreign(value, ours, its))


def validated(model: type[Config], tree: Mapping[str, Any], source: str, given: Mapping[str, str]) -> Config:
    """A config from a tree of keys whose paths are absolute.

    Args:
        model: class of the config.
        tree: keys and sections.
        source: the config's name, which opens the sentence of an error.
        given: key -> override, for keys that were set on the command line.

    Raises:
        InputError: keys are wrong: one line that names them all.
    """
    try:
        return model.model_validate(tree)
    except ValidationError as error:
        raise InputError(explain(error, model, source, given)) from None
