"""The config keys of each command: as a list by section, and as JSON Schema for editors."""

from __future__ import annotations

from typing import Any

from ccnn_torch.config.keys import config_model, list_keys


def keys_by_section(command: str) -> dict[str, list[tuple[str, str, str]]]:
    """Key, default and description of every key, by section; those at the top first, under ``""``."""
    sections: dict[str, list[tuple[str, str, str]]] = {"": []}
    for entry in list_keys(config_model(command)):
        sections.setdefault(entry[0].rpartition(".")[0], []).append(entry)
    return sections


def config_schema(command: str) -> dict[str, Any]:
    """A JSON Schema (draft 2020-12) of a command's config file, with the description of every key."""
    schema = config_model(command).model_json_schema()
    schema["$schema"] = "https://json-schema.org/draft/2020-12/schema"
    for key, _, description in list_keys(config_model(command)):
        node = schema
        for step in key.split("."):
            node = _resolved(schema, node)["properties"][step]
        node.setdefault("description", description)
    return schema


def _resolved(schema: dict[str, Any], node: dict[str, Any]) -> dict[str, Any]:
    """The section that a node refers to, or itself."""
    for choice in (node, *node.get("anyOf", ())):
        if "$ref" in choice:
            found: dict[str, Any] = schema["$defs"][choice["$ref"].rpartition("/")[2]]
            return found
    return node
