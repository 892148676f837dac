"""The keys that a config may have, and one message for all its wrong keys."""

from __future__ import annotations

import dataclasses
import inspect
import json
import re
from collections.abc import Collection, Iterator, Mapping
from importlib import import_module
from pathlib import Path
from typing import Any, get_args

from pydantic import BaseModel, ValidationError

from ccnn_torch.files.yaml_file import read_yaml
from ccnn_torch.spelling import nearest

# Maximum number of wrong keys in one message.
_FEW = 8

# The model of each command's config, by name: they are loaded when asked for, as each of them imports this module.
_COMMANDS = {
    "run": "ccnn_torch.calibration.config:RunConfig",
    "identify": "ccnn_torch.identification.config:IdentifyConfig",
    "suite": "ccnn_torch.study.suite:SuiteFile",
    "plan": "ccnn_torch.planning.config:PlanConfig",
    "diagnose": "ccnn_torch.diagnosis.config:DiagnoseConfig",
}
# Commands that take their config by an option.
_OPTION = {"plan": " --config", "diagnose": " --config"}


def config_model(command: str) -> type[BaseModel]:
    """The pydantic model of a command's config."""
    module, _, name = _COMMANDS[command].partition(":")
    model: type[BaseModel] = getattr(import_module(module), name)
    return model


def list_keys(model: type[BaseModel], prefix: str = "") -> Iterator[tuple[str, str, str]]:
    """Every key of a config, dotted, with its default as YAML has it and its description."""
    for name, info in model.model_fields.items():
        kind = _section(info.annotation)
        if isinstance(kind, type) and issubclass(kind, BaseModel):
            yield from list_keys(kind, f"{prefix}{name}.")
        elif isinstance(kind, type) and dataclasses.is_dataclass(kind):
            yield from _list_dataclass(kind, f"{prefix}{name}.")
        else:
            default = info.get_default(call_default_factory=True)
            yield f"{prefix}{name}", _yaml(default), info.description or ""


def _section(kind: Any) -> Any:
    """The model of a section that may be left out (`Model | None`); any other annotation as it is."""
    models = [k for k in get_args(kind) if isinstance(k, type) and issubclass(k, BaseModel)]
    return models[0] if models and type(None) in get_args(kind) else kind


def _list_dataclass(kind: type[Any], prefix: str) -> Iterator[tuple[str, str, str]]:
    """Keys of a section that is a plain dataclass; descriptions from its docstring's ``Attributes:``."""
    default = kind()
    documented = _attributes(inspect.getdoc(kind) or "")
    for field in dataclasses.fields(kind):
        yield f"{prefix}{field.name}", _yaml(getattr(default, field.name)), documented.get(field.name, "")


def _attributes(text: str) -> dict[str, str]:
    """Name -> description from the ``Attributes:`` part of a docstring; `a, b: text` describes both."""
    _, _, part = text.partition("Attributes:\n")
    part = re.split(r"\n(?=\S)", "\n" + part)[0] if part else ""
    found: dict[str, str] = {}
    for entry in re.split(r"\n {4}(?=\S)", part):
        names, colon, description = entry.partition(":")
        if colon:
            found |= dict.fromkeys((name.strip() for name in names.split(",")), " ".join(description.split()))
    return found


def _yaml(value: Any) -> str:
    return value if isinstance(value, str) else json.dumps(value, default=str, ensure_ascii=False)


def explain(error: ValidationError, model: type[BaseModel], file: str, given: Mapping[str, str]) -> str:
    """One line for all errors, each with its key, what is wrong and what would be right.

    Args:
        error: of pydantic.
        model: the model that was validated.
        file: the config's name.
        given: key -> override, for keys that were set on the command line.
    """
    keys = {key: description for key, _, description in list_keys(model)}
    also = config_model("run").model_fields if getattr(model, "of_a_run", ()) else ()
    parts: dict[str, None] = {}
    for item in error.errors():
        key = ".".join(str(step) for step in item["loc"])
        # Of `ccnn={…}` and `ccnn.hidden=…` the one that says more of the key.
        above = max((name for name in given if f"{key}.".startswith(f"{name}.")), key=len, default="")
        override = given.get(above)
        override = override or next((text for name, text in given.items() if key and name.startswith(f"{key}.")), None)
        source = f"'{override}': " if override else ""
        parts[source + _sentence(key, item["type"], item["msg"], item["input"], keys, also)] = None
    other = _other_command(file, model)
    if other:
        return f"{file}: this looks like {other}"
    listed: list[str] = []
    for part in parts:
        head, _, keys_there = part.partition("; the keys ")
        listed.append(head if keys_there and any(part.endswith(keys_there) for part in listed) else part)
    return f"{file}: " + "; ".join(listed[:_FEW]) + (f"; and {len(listed) - _FEW} more" if len(listed) > _FEW else "")


def _other_command(file: str, model: type[BaseModel]) -> str:
    """Name what a file with other keys is: a mechanism, or another command's config; empty if neither."""
    if not Path(file).is_file():
        return ""
    there = set(read_yaml(Path(file)))
    if there >= {"convention", "alpha"} or "machine" in there:
        return f"the file of a machine, no config; write mechanism={file}"
    known = set(model.model_fields)
    # A command that takes the config of a run, of records, does not fail for that.
    if getattr(model, "of_a_run", ()) and not there.isdisjoint(("records", "mechanism")):
        known |= set(config_model("run").model_fields)
    # A single unknown key is more likely a typing error than another command's file.
    if len(there) < 2 or there <= known:
        return ""
    names = (name for name in _COMMANDS if there <= set(config_model(name).model_fields))
    return next((f"a config for `ccnn {name}{_OPTION.get(name, '')}`" for name in names), "")


def _sentence(key: str, kind: str, message: str, value: Any, keys: Mapping[str, str], also: Collection[str]) -> str:
    if kind in ("extra_forbidden", "unexpected_keyword_argument"):
        return f"there is no key '{key}'; {_hint(key, keys, also)}"
    if kind in ("model_type", "dataclass_type", "dict_type"):
        return f"{key}: must hold the keys {', '.join(_below(key, keys))}, not {_short(value)}"
    if kind == "value_error":
        return (f"{key}: " if key else "") + message.removeprefix("Value error, ")
    if kind == "string_pattern_mismatch":
        return f"{key}: must be {keys[key]}, not {_short(value)}"
    if kind in ("too_short", "too_long"):
        return f"{key}: must have{message.partition('should have')[2].replace(' after validation', '')}"
    text = message.replace("Input should be", "must be")
    for technical in ("a valid tuple", "a valid list"):
        text = text.replace(technical, "a list")
    return f"{key}: {text}, not {_short(value)}"


def _hint(key: str, keys: Mapping[str, str], also: Collection[str]) -> str:
    if key in also:
        return "only `ccnn run` has it; leave it out"
    section, _, last = key.rpartition(".")
    beside = _below(section, keys)
    near = nearest(last, beside, 0.65)
    if near is not None:
        return f"did you mean '{section + '.' if section else ''}{near}'?"
    shared = nearest(key, [*also], 0.65)
    if shared is not None:
        return f"did you mean '{shared}'?"
    # The right word in the wrong section, such as generations for ccnn.generations.
    ends = {other.rpartition(".")[2]: other for other in reversed(list(keys))}
    elsewhere = nearest(last, list(ends), 0.8)
    if elsewhere is not None:
        return f"did you mean '{ends[elsewhere]}'?"
    return f"the keys {'of ' + section if section else ''} are {', '.join(beside)}".replace("  ", " ")


def _below(section: str, keys: Mapping[str, str]) -> list[str]:
    prefix = f"{section}." if section else ""
    names = [key.removeprefix(prefix).partition(".")[0] for key in keys if key.startswith(prefix)]
    return list(dict.fromkeys(names))


def _short(value: Any) -> str:
    text = _yaml(value) if isinstance(value, str | int | float | list | dict | None) else str(value)
    return text if len(text) <= 60 else f"{text[:57]}…"


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
