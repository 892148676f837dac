"""YAML 1.2, so that 1e-4 is a number, `no` a word and a key that stands twice an error."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

from ruamel.yaml import YAML
from ruamel.yaml.error import MarkedYAMLError, YAMLError

from ccnn_torch.errors import InputError

__all__ = ["dump_yaml", "parse_yaml", "read_yaml"]


def read_yaml(path: Path) -> dict[str, Any]:
    """The mapping in a YAML file; an empty file is an empty mapping.

    Raises:
        InputError: the file cannot be read, is no YAML (with the line), or holds something other than a mapping.
    """
    try:
        text = path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError:
        raise InputError(f"{path}: the file is not UTF-8 text") from None
    except OSError as reason:
        raise InputError(f"{path}: cannot be read: {reason.strerror}") from None
    tree = parse_yaml(text, str(path))
    if tree is None:
        return {}
    if not isinstance(tree, dict) or not all(isinstance(key, str) for key in tree):
        raise InputError(f"{path}: a config is a list of lines `key: value`, e.g. `seed: 0`")
    return tree


def parse_yaml(text: str, where: str) -> Any:
    """The value that a YAML text stands for; `where` opens the sentence of an error.

    Raises:
        InputError: it is no YAML.
    """
    try:
        # The pure-Python loader: the C one reads YAML 1.1.
        return YAML(typ="safe", pure=True).load(text)
    except MarkedYAMLError as error:
        mark = error.problem_mark
        line = f"line {mark.line + 1}: " if mark is not None else ""
        raise InputError(f"{where}: {line}not valid YAML: {error.problem}") from None
    except (YAMLError, ValueError) as error:
        raise InputError(f"{where}: not valid YAML: {str(error).splitlines()[0]}") from None


def dump_yaml(tree: dict[str, Any]) -> str:
    """YAML text in block style, keys in the order given; `parse_yaml` gives the same tree back."""
    text = _dumped(tree, unicode=True)
    # The emitter takes NEL for a line break and the parser does not; escaped, both take it for what it is.
    return _dumped(tree, unicode=False) if "\x85" in text else text


def _dumped(tree: dict[str, Any], unicode: bool) -> str:
    yaml = YAML(typ="safe", pure=True)
    yaml.default_flow_style = False
    yaml.allow_unicode = unicode
    setattr(yaml, "sort_base_mapping_type_on_output", False)  # noqa: B010 - ruamel declares its type as None
    buffer = io.StringIO()
    yaml.dump(tree, buffer)
    return buffer.getvalue()
