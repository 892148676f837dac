"""``key.sub=value`` from the command line over a config, and what a relative path in either is relative to."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from ccnn_torch.errors import InputError
from ccnn_torch.files.yaml_file import check_values, parse_yaml

# Keys whose value is always text: a path may hold a colon, a name may be 2024.
_TEXT = ("name", "out", "records", "transfer", "mechanism")

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
    if key == "records":
        return _changed_files(value, change)
    if key == "split" and isinstance(value, dict) and "test" in value:
        return {**value, "test": _changed("split.test", value["test"], change)}
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
    if (folder / Path(text).expanduser()).exists():
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
