"""XML of others, without document types."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from xml.etree.ElementTree import Element

from ccnn_torch.errors import InputError
from ccnn_torch.files.read import read_bytes


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
