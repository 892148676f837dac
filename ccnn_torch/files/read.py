"""Read files from outside: regular files of a bounded size, text in UTF-8."""

from __future__ import annotations

import json
import os
import stat
import xml.etree.ElementTree as ElementTree
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element

from ccnn_torch.errors import InputError

CONFIG_LIMIT = 1_000_000
"""Largest config or geometry file in bytes. Usual ones have some kB; the limit bounds the time of the parser."""

_DEEPEST = 100


def read_bytes(path: str | Path, largest: int, remedy: str = "give the path of a file") -> bytes:
    """The content of a regular file. Pipes and devices are not opened: reading a pipe without a writer never ends.

    Args:
        path: the file.
        largest: bytes beyond which it is refused.
        remedy: what to give instead, the end of the error message.

    Raises:
        InputError: there is no such file, it is a folder, pipe or device, it cannot be read, or it is too large.
    """
    try:
        about = os.stat(path)
        if not stat.S_ISREG(about.st_mode):
            raise InputError(f"{path}: is {_kind(about.st_mode)} and no file; {remedy}")
        if about.st_size > largest:
            size, most = (f"{number / 1e6:,.0f} MB" for number in (about.st_size, largest))
            raise InputError(f"{path}: has {size}, and more than {most} are not read; give a smaller file")
        return Path(path).read_bytes()
    except FileNotFoundError:
        raise InputError(f"{path}: there is no such file; {remedy}") from None
    except OSError as reason:
        raise InputError(f"{path}: cannot be read: {reason.strerror}; {remedy}") from None
    except ValueError:
        raise InputError(f"{path}: is no path (it has a NUL character); {remedy}") from None


def read_text(path: str | Path, largest: int, remedy: str = "give the path of a file") -> str:
    """As `read_bytes`, decoded; a byte-order mark is removed, and every line ends in a line feed.

    Raises:
        InputError: as `read_bytes`, or it is not UTF-8.
    """
    content = read_bytes(path, largest, remedy)
    try:
        return content.decode("utf-8-sig").replace("\r\n", "\n").replace("\r", "\n")
    except UnicodeDecodeError as reason:
        line = content.count(b"\n", 0, reason.start) + 1
        raise InputError(f"{path}: the file is not UTF-8 text (line {line}); save it as UTF-8") from None


def parse_json(text: str, where: str) -> Any:
    """The value of a JSON text; `where` begins the error message.

    Raises:
        InputError: it is no JSON, holds NaN or infinity, names a key twice, or is nested more than 100 deep.
    """
    depth = deepest = 0
    # Brackets in strings count as well; no file of this package has that many.
    for character in text:
        depth += (character in "[{") - (character in "]}")
        deepest = max(deepest, depth)
    if deepest > _DEEPEST:
        raise InputError(f"{where}: is nested more than {_DEEPEST} deep, which no file of this package is")
    try:
        return json.loads(text, parse_constant=_no_number, object_pairs_hook=_once)
    except ValueError as reason:
        raise InputError(f"{where}: is no JSON file: {str(reason).splitlines()[0]}") from None


def _no_number(word: str) -> None:
    raise ValueError(f"{word} is no number")


def _once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) < len(pairs):
        names = [name for name, _ in pairs]
        raise ValueError(f"the key '{next(name for name in names if names.count(name) > 1)}' occurs twice")
    return found


def _kind(mode: int) -> str:
    kinds = ((stat.S_ISDIR, "a folder"), (stat.S_ISFIFO, "a pipe"), (stat.S_ISSOCK, "a socket"))
    return next((word for test, word in kinds if test(mode)), "a device")


class _WithoutDoctype(ElementTree.TreeBuilder):
    """Entities are declared in a document type, which no robot has and which can unfold to gigabytes or name a file."""

    def doctype(self, name: str, pubid: str, system: str) -> None:
        """Called before anything of it is unfolded."""
        raise InputError("has a document type (<!DOCTYPE …>), which is not read; remove it")


def read_xml(path: str, largest: int, remedy: str) -> Element:
    """The root of an XML file of at most `largest` bytes.

    Raises:
        InputError: as `read_bytes`, it is no valid XML, or has a document type.
    """
    content = read_bytes(path, largest, remedy)
    parser = ElementTree.XMLParser(target=_WithoutDoctype())
    try:
        parser.feed(content)
        root: Element = parser.close()
    except InputError as reason:
        raise InputError(f"{path}: {reason}") from None
    # An encoding that is unknown or has several bytes a character is no error of the parser's own.
    except (ElementTree.ParseError, LookupError, ValueError) as error:
        raise InputError(f"{path}: is no valid XML in UTF-8: {error}") from None
    return root
