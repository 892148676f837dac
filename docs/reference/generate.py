"""Write the reference pages that follow from the package: commands, config keys, file formats."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import typer

from ccnn_torch.cli import app
from ccnn_torch.config.commands import keys_by_section
from ccnn_torch.report.json_files import load_schema

__all__ = ["write_reference"]

SCHEMAS = {
    "results": "`results.json` of `ccnn run`",
    "card": "`card.json` beside every model file",
    "identified": "`identified.json` of `ccnn identify`",
    "diagnosis": "`diagnosis.json` of `ccnn diagnose`",
    "verify": "`verify.json` of `ccnn verify`",
    "suite": "`suite.json` of `ccnn suite`",
    "blind": "`blind.json` of `ccnn blind-check`",
}
CONFIGS = ("run", "identify", "suite", "plan", "diagnose")


def write_reference(folder: Path) -> None:
    """Write `cli.md`, `config_keys.md` and `file_formats.md`; a page that has not changed is left as it is."""
    pages = {"cli": _commands(), "config_keys": _keys(), "file_formats": _formats()}
    for name, text in pages.items():
        path = folder / f"{name}.md"
        if not path.is_file() or path.read_text(encoding="utf-8") != text:
            path.write_text(text, encoding="utf-8")


def _commands() -> str:
    group = typer.main.get_command(app)
    parts = ["# Commands\n", "Every command prints this help with `--help`.\n"]
    for name, command in sorted(group.commands.items()):  # type: ignore[attr-defined]
        with command.make_context(name, [], resilient_parsing=True) as context:
            context.info_name = f"ccnn {name}"
            parts += [f"## ccnn {name}\n", f"```text\n{command.get_help(context)}\n```\n"]
    return "\n".join(parts)


def _keys() -> str:
    parts = [
        "# Config keys\n",
        "`ccnn keys COMMAND` prints the same list; `ccnn keys --schema` writes a JSON Schema.\n",
    ]
    for command in CONFIGS:
        parts.append(f"## ccnn {command}\n")
        for section, keys in keys_by_section(command).items():
            parts += [
                f"### {command}: {section or 'top level'}\n",
                "| key | default | meaning |",
                "| --- | --- | --- |",
            ]
            parts += [f"| `{key}` | `{_cell(default) or ' '}` | {_cell(text)} |" for key, default, text in keys]
            parts.append("")
    return "\n".join(parts)


def _formats() -> str:
    parts = ["# File formats\n", "The JSON Schemas are in the package, in `ccnn_torch/report/*.schema.json`.\n"]
    for name, title in SCHEMAS.items():
        schema = load_schema(name)
        parts += [
            f"## {title}\n",
            f"{schema.get('description', '')}\n",
            "| key | type | meaning |",
            "| --- | --- | --- |",
        ]
        parts += [f"| `{key}` | {kind} | {_cell(text)} |" for key, kind, text in _properties(schema, schema)]
        parts.append("")
    return "\n".join(parts)


def _properties(schema: Mapping[str, Any], node: Mapping[str, Any]) -> Iterator[tuple[str, str, str]]:
    """Key, type and description of every property of an object, one level deep."""
    for key, value in node.get("properties", {}).items():
        value = _resolved(schema, value)
        kind = value.get("type", "object" if "properties" in value else "any")
        yield key, " or ".join(kind) if isinstance(kind, list) else str(kind), value.get("description", "")
        for inner, below in value.get("properties", {}).items():
            below = _resolved(schema, below)
            kind = below.get("type", "any")
            yield (
                f"{key}.{inner}",
                " or ".join(kind) if isinstance(kind, list) else str(kind),
                below.get("description", ""),
            )


def _resolved(schema: Mapping[str, Any], node: Any) -> Mapping[str, Any]:
    if isinstance(node, Mapping) and "$ref" in node:
        found: Mapping[str, Any] = schema["$defs"][node["$ref"].rpartition("/")[2]]
        return found | {key: text for key, text in node.items() if key == "description"}
    return node if isinstance(node, Mapping) else {}


def _cell(text: str) -> str:
    return " ".join(str(text).split()).replace("|", "\\|").replace("*", "\\*").replace("<", "&lt;")
