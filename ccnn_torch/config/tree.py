"""Common parts of all configs: read a tree of keys, apply overrides, validate, write."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any, ClassVar, Self, TypeVar

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, ValidationError, model_validator

from ccnn_torch.config.keys import config_model, explain
from ccnn_torch.errors import InputError
from ccnn_torch.files.yaml_file import check_values, dump_yaml, parse_yaml, read_yaml

# Keys whose value is always text: a path may hold a colon, a name may be 2024.
_MACHINES = ("mechanism", "first", "second")
_TEXT = ("name", "out", "records", "transfer", "mechanism")

# Files and folders with measured rows.
_FILES = ("records", "motion")

# Prefix of a file in `effects`.
_FROM = "from:"

# A share in quotes is not a file.
_NUMBER = re.compile(r"[+-]?\d*\.?\d*(e[+-]?\d+)?", re.IGNORECASE)

_PLUGINS = ("methods", "auto.methods", "effects")


def apply_overrides(tree: dict[str, Any], overrides: Iterable[str], folder: Path) -> dict[str, str]:
    """Write overrides into a tree, in place; relative paths in them start from `folder`.

    Returns:
        Key -> the override that set it, for messages.

    Raises:
        InputError: an override is not of the form ``key.sub=value``, or goes below a key that has a plain value.
    """
    given: dict[str, str] = {}
    for override in overrides:
        key, equals, text = override.partition("=")
        key = key.strip()
        steps = key.split(".")
        if not equals or not all(steps):
            raise InputError(f"'{override}': write key=value, e.g. seed=1 or split.test=0.2")
        plain = key in _TEXT or (key == "effects" and text.startswith(_FROM))
        value = text if plain and text not in ("", "null", "~") else parse_yaml(text, f"'{override}'")
        check_values([key, value], f"'{override}'")
        node = tree
        for depth, step in enumerate(steps[:-1]):
            if node.get(step) is None:
                node[step] = {}
            node = node[step]
            if not isinstance(node, dict):
                above = ".".join(steps[: depth + 1])
                raise InputError(f"'{override}': {above} has a plain value ({node}) and no keys below it")
        node[steps[-1]] = _resolve(key, value, folder)
        given[key] = override
    return given


def resolve_paths(tree: dict[str, Any], folder: Path) -> None:
    """Make the paths in a tree absolute, in place; relative ones start from `folder`."""
    for key in tree:
        tree[key] = _resolve(key, tree[key], folder)


def relate_paths(tree: dict[str, Any], folder: Path) -> None:
    """Make the paths in a tree relative to `folder`, in place: so that a folder can be moved with its data."""
    start = os.path.realpath(folder)

    def related(path: str) -> str:
        # Links above the file are followed, as `..` would; the file itself may be one and keeps its name.
        above, name = os.path.split(os.path.abspath(path))
        return Path(os.path.relpath(os.path.join(os.path.realpath(above), name), start)).as_posix()

    for key in tree:
        tree[key] = _changed(key, tree[key], related)


def _resolve(key: str, value: Any, folder: Path) -> Any:
    if key == "records" and isinstance(value, str):
        value = listed_files(value, folder)
    return _changed(key, value, lambda path: os.path.abspath(folder / Path(path).expanduser()))


def _changed(key: str, value: Any, change: Callable[[str], str]) -> Any:
    """The value of a key with each path in it changed."""
    if key in _FILES:
        return _changed_files(value, change)
    if key == "constraint" and isinstance(value, dict) and isinstance(value.get("beside"), list):
        beside = [
            {name: _changed(name, entry, change) for name, entry in one.items()} if isinstance(one, dict) else one
            for one in value["beside"]
        ]
        return {**value, "beside": beside}
    if key == "split" and isinstance(value, dict) and "test" in value:
        return {**value, "test": _changed("split.test", value["test"], change)}
    if key == "motion_keys" and isinstance(value, dict):
        return {k: change(v) if k == "calibration" and isinstance(v, str) else v for k, v in value.items()}
    if key == "mechanism_keys" and isinstance(value, dict):
        # Of a machine that holds others: framed, partial, instrument, pair.
        return {k: _changed("mechanism", v, change) if k in _MACHINES else v for k, v in value.items()}
    if key == "auto" and isinstance(value, dict):
        return {name: _changed(f"auto.{name}", entry, change) for name, entry in value.items()}
    if key in _PLUGINS and isinstance(value, list):
        return [_changed(key, entry, change) for entry in value]
    if key == "effects" and isinstance(value, str) and value.startswith(_FROM):
        return _FROM + change(value.removeprefix(_FROM).strip())
    if not isinstance(value, str) or not _is_path(key, value):
        return value
    return change(value)


def listed_files(text: str, folder: Path) -> str | list[str]:
    """Records as a text: one file, or several as ``a.csv,b.csv``, also in brackets."""
    # os.path: a list may be too long for a name.
    if os.path.exists(folder / Path(text).expanduser()):
        return text
    parts = [part.strip(" '\"") for part in text.strip().removeprefix("[").removesuffix("]").split(",")]
    return parts if len(parts) > 1 and all(Path(part).suffix for part in parts) else text


def _changed_files(value: Any, change: Callable[[str], str]) -> Any:
    """Records: one file as a text, several as a list."""
    files = value if isinstance(value, list) else [value]
    if not all(isinstance(file, str | Path) and str(file) for file in files):
        return value
    paths = [change(str(file)) for file in files]
    return paths[0] if len(paths) == 1 else paths


def _is_path(key: str, value: str) -> bool:
    if key in ("out", "transfer"):
        return value != ""
    if key == "split.test":
        return Path(value).suffix != "" and not _NUMBER.fullmatch(value.strip())
    if key == "mechanism":
        return ".py:" in value or Path(value).suffix.lower() in (".yaml", ".yml", ".urdf")
    return key in _PLUGINS and ".py:" in value


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

MechanismKeys = Annotated[dict[str, Any], Field(default={}, description="keys of the mechanism's constructor")]


class Section(BaseModel):
    """A section of a config: unknown keys are refused, values are finite and immutable."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class JobConfig(Section):
    """The config of a command: read from a file, from keys or from the command line, and written back."""

    of_a_run: ClassVar[tuple[str, ...]] = ()
    """Keys that mean the same in a config for `ccnn run`, where a command takes one and leaves its other keys out."""

    @model_validator(mode="before")
    @classmethod
    def _empty_sections(cls, tree: Any) -> Any:
        """An empty section is one of defaults."""
        if not isinstance(tree, dict):
            return tree
        sections = [key for key, field in cls.model_fields.items() if field.default_factory is not None]
        return {key: value for key, value in tree.items() if value is not None or key not in sections}

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


# Keys of another command that a remark names; a resolved config has all of them.
_LISTED = 8


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
    # A split is of every run, and what does not use it holds rows out by itself.
    left = [n for n in sorted(names) if (first := n.partition(".")[0]) in {n, *kept} and first != "split"]
    # A config that a run has written has all of its keys.
    if note is not None and left and not {*run.model_fields} <= tree.keys():
        are = "is a key of ccnn run and is" if len(left) == 1 else "are keys of ccnn run and are"
        more = f" and {len(left) - _LISTED} more" if len(left) > _LISTED else ""
        note(f"{path}: {', '.join(left[:_LISTED])}{more} {are} not used here.")
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
