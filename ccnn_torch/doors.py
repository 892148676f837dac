"""Packages whose public names are loaded on first use, so that a command imports only what it needs."""

from __future__ import annotations

import sys
from importlib import import_module

# As of `typing`, whose import takes longer than all that is needed here; Ctrl-C in it would be a traceback.
TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Callable
    from typing import Any


def door(package: str) -> tuple[Callable[[str], Any], list[str]]:
    """`__getattr__` and `__all__` of a package: the names that its source imports for type checkers, `NAME as NAME`."""
    homes: dict[str, str] = {}
    module = ""
    for line in sys.modules[package].__loader__.get_source(package).splitlines():  # type: ignore[union-attr]
        words = line.replace(",", " ").split()
        if words[:1] == ["from"]:
            module = words[1]
        homes |= {name: module for k, name in enumerate(words) if words[k + 1 : k + 3] == ["as", name]}

    def load(name: str) -> Any:
        if name not in homes:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        value = getattr(import_module(homes[name]), name)
        setattr(sys.modules[package], name, value)
        return value

    return load, sorted(homes)
