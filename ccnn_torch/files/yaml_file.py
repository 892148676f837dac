"""YAML 1.2, so that 1e-4 is a number, `no` a word and a repeated key an error.

Only its plain part is read: maps, lists and values. Aliases (`*a`, of an anchor `&a`) can be recursive or expand beyond
all memory, and tags (`!!set`) make types that no key takes.
"""

from __future__ import annotations

import copy
import io
from functools import lru_cache
from pathlib import Path
from typing import Any

from ruamel.yaml import YAML
from ruamel.yaml.error import MarkedYAMLError, YAMLError
from ruamel.yaml.events import AliasEvent, MappingEndEvent, MappingStartEvent, SequenceEndEvent, SequenceStartEvent

from ccnn_torch.errors import InputError
from ccnn_torch.files.read import CONFIG_LIMIT, read_text

_DEEPEST = 30


def read_yaml(path: Path) -> dict[str, Any]:
    """The mapping in a YAML file; an empty file is an empty mapping.

    Raises:
        InputError: the file cannot be read, is no YAML (with the line), or holds something other than a mapping.
    """
    tree = parse_yaml(read_text(path, CONFIG_LIMIT, "give the path of a YAML file"), str(path))
    if tree is None:
        return {}
    if not isinstance(tree, dict) or not all(isinstance(key, str) for key in tree):
        raise InputError(f"{path}: a config is a list of lines `key: value`, e.g. `seed: 0`")
    return tree


def parse_yaml(text: str, where: str) -> Any:
    """The value of a YAML text; `where` begins the error message.

    Raises:
        InputError: it is no YAML, or more than its plain part.
    """
    return copy.deepcopy(_parsed(text, where))


# The file of an arm is read as three kinds, and anew by every step of a command.
@lru_cache(16)
def _parsed(text: str, where: str) -> Any:
    # The pure-Python loader: the C one reads YAML 1.1.
    yaml = YAML(typ="safe", pure=True)
    try:
        _check_plain(yaml, text, where)
        tree = yaml.load(text)
    except MarkedYAMLError as error:
        mark = error.problem_mark
        line = f"line {mark.line + 1}: " if mark is not None else ""
        raise InputError(f"{where}: {line}not valid YAML: {error.problem}") from None
    except (YAMLError, ValueError, OverflowError) as error:
        raise InputError(f"{where}: not valid YAML: {(str(error).splitlines() or ['a value'])[0]}") from None
    check_values(tree, where)
    return tree


def _check_plain(yaml: YAML, text: str, where: str) -> None:
    """Refuse aliases, tags and deep nesting before anything is built of them."""
    depth = 0
    for event in yaml.parse(text):
        line = event.start_mark.line + 1
        if isinstance(event, AliasEvent):
            raise InputError(f"{where}: line {line}: aliases such as *{event.anchor} are not read; write the value out")
        if getattr(event, "anchor", None) is not None:
            raise InputError(f"{where}: line {line}: anchors such as &{event.anchor} are not read; remove it")
        if getattr(event, "ctag", None) is not None:
            raise InputError(f"{where}: line {line}: tags such as {event.ctag} are not read; write the plain value")
        depth += isinstance(event, (MappingStartEvent, SequenceStartEvent))
        depth -= isinstance(event, (MappingEndEvent, SequenceEndEvent))
        if depth > _DEEPEST:
            raise InputError(f"{where}: line {line}: is nested more than {_DEEPEST} deep, which no key takes")


def check_values(tree: Any, where: str) -> None:
    """Refuse lists and maps as keys, and texts that no file could hold.

    Raises:
        InputError: there is one; `where` opens the sentence.
    """
    if isinstance(tree, str) and any(c == "\0" or "\ud800" <= c <= "\udfff" for c in tree):
        raise InputError(f"{where}: {tree!r} has a character that no text holds (NUL or half of a pair); remove it")
    if isinstance(tree, dict):
        strange = [key for key in tree if not isinstance(key, (str, int, float))]
        if strange:
            raise InputError(f"{where}: {strange[0]!r} cannot be a key; write `key: value`, the key a word")
    if isinstance(tree, (dict, list)):
        for value in [*tree, *tree.values()] if isinstance(tree, dict) else tree:
            check_values(value, where)


def dump_yaml(tree: dict[str, Any], width: int | None = None) -> str:
    """YAML text, keys in the order given; `parse_yaml` gives the same tree back.

    Args:
        width: put the innermost lists and mappings in one line each, up to so many characters; block style when None.
    """
    text = _dumped(tree, width, unicode=True)
    # The emitter treats NEL as a line break and the parser does not; escaped, both read the same text.
    return _dumped(tree, width, unicode=False) if "\x85" in text else text


def _dumped(tree: dict[str, Any], width: int | None, unicode: bool) -> str:
    yaml = YAML(typ="safe", pure=True)
    yaml.default_flow_style = False if width is None else None
    if width is not None:
        yaml.width = width
    yaml.allow_unicode = unicode
    setattr(yaml, "sort_base_mapping_type_on_output", False)  # noqa: B010 - ruamel declares its type as None
    # A repeated list is written out twice: aliases are not read.
    yaml.representer.ignore_aliases = lambda _: True
    buffer = io.StringIO()
    yaml.dump(tree, buffer)
    return buffer.getvalue()
