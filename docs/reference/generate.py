"""Write the reference pages that follow from the package: Python names, commands, config keys, file formats."""

from __future__ import annotations

import inspect
import json
from collections.abc import Iterator, Mapping
from importlib import import_module
from pathlib import Path
from typing import Any

import typer

from ccnn_torch.cli.application import app
from ccnn_torch.config.keys import keys_by_section

__all__ = ["first_line", "public_names", "write_reference"]

CONTRACTS = Path(__file__).parents[2] / "tests" / "contracts"
SCHEMAS = {
    "results": "`results.json` of `ccnn run`",
    "card": "`card.json` beside every model file",
    "identified": "`identified.json` of `ccnn identify`",
    "diagnosis": "`diagnosis.json` of `ccnn diagnose`",
    "verify": "`verify.json` of `ccnn verify`",
    "since": "`since.json` of `ccnn diagnose --since`",
    "suite": "`suite.json` of `ccnn suite`",
    "blind": "`blind.json` of `ccnn blind-check`",
}
PACKAGES = (
    "ccnn_torch",
    *(
        f"ccnn_torch.{name}"
        for name in ("mechanisms", "records", "effects", "learners", "training", "compensation", "identification")
    ),
    *(f"ccnn_torch.{name}" for name in ("planning", "diagnosis", "testing", "sklearn")),
)
CONFIGS = ("run", "identify", "suite", "plan", "diagnose")


def write_reference(folder: Path) -> None:
    """Write `api.md`, `cli.md`, `config_keys.md` and `file_formats.md`, each only where it has changed."""
    pages = {"api": _api(), "cli": _commands(), "config_keys": _keys(), "file_formats": _formats()}
    for name, text in pages.items():
        path = folder / f"{name}.md"
        if not path.is_file() or path.read_text(encoding="utf-8") != text:
            path.write_text(text, encoding="utf-8")


def public_names() -> dict[str, list[tuple[str, Any]]]:
    """By package every public function and class, functions first, each in the first package that gives it."""
    found: dict[str, list[tuple[str, Any]]] = {}
    seen: set[int] = set()
    for package in PACKAGES:
        module = import_module(package)
        names = getattr(module, "__all__", None) or sorted(n for n in vars(module) if not n.startswith("_"))
        things = [(name, getattr(module, name)) for name in names if name != "__version__"]
        own = [
            (name, thing)
            for name, thing in things
            if (inspect.isclass(thing) or inspect.isfunction(thing))
            and getattr(thing, "__module__", "").startswith("ccnn_torch")
            and id(thing) not in seen
        ]
        seen |= {id(thing) for _, thing in own}
        found[package] = sorted(own, key=lambda pair: (inspect.isclass(pair[1]), pair[0].lower()))
    return found


def first_line(thing: Any) -> str:
    """The first paragraph of a docstring, on one line."""
    return " ".join((inspect.getdoc(thing) or "").partition("\n\n")[0].split())


def _api() -> str:
    """A table of all names with a line each, and below it what each is."""
    parts = ["# Python\n", "Arrays are float64 and in SI units; `...` stands for any leading batch dimensions.\n"]
    packages = public_names()
    for package, own in packages.items():
        parts += [f"**{package}**\n", "| name | what it is |", "| --- | --- |"]
        for name, thing in own:
            parts.append(f"| {{py:obj}}`{name} <{package}.{name}>` | {_cell(first_line(thing))} |")
        parts.append("")
    for package, own in packages.items():
        parts += [f"## {package}\n", "```{eval-rst}"]
        for name, thing in own:
            kind = "autoclass" if inspect.isclass(thing) else "autofunction"
            # scikit-learn adds methods of its own to estimators, with links into its pages.
            members = "   :members: fit, predict" if package.endswith("sklearn") else "   :members:"
            parts += [f".. {kind}:: {package}.{name}", members if kind == "autoclass" else "", ""]
        parts.append("```\n")
    return "\n".join(parts)


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
    parts = [
        "# File formats\n",
        "The JSON Schemas are in `tests/contracts/`; the models of `ccnn_torch.report.results` give them, such as "
        "`RunResults.model_json_schema()`.\n",
    ]
    for name, title in SCHEMAS.items():
        schema: dict[str, Any] = json.loads((CONTRACTS / f"{name}.json").read_text(encoding="utf-8"))
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
    """A node with what it refers to; of alternatives the first, with the types of all."""
    if not isinstance(node, Mapping):
        return {}
    own = {key: text for key, text in node.items() if key == "description"}
    if "$ref" in node:
        return _resolved(schema, schema["$defs"][node["$ref"].rpartition("/")[2]]) | own
    if "anyOf" in node:
        options = [_resolved(schema, option) for option in node["anyOf"]]
        return {**options[0], "type": [option.get("type", "any") for option in options]} | own
    return node


def _cell(text: str) -> str:
    return " ".join(str(text).split()).replace("|", "\\|").replace("*", "\\*").replace("<", "&lt;")
