"""The frozen schemas of result files, `contracts/*.json`: outsiders script against these files.

Those of the models of `ccnn_torch/report/results/`, and of the card in `compensation/model_files/`, are derived.
After a key was added, write them again with

    python tests/frozen.py

which refuses a lost key and a changed type, as `test_contracts.py` does.
"""

from __future__ import annotations

import ast
import inspect
import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from pydantic import BaseModel

from ccnn_torch.compensation.model_files.metadata import Card
from ccnn_torch.report.results.base import Result
from ccnn_torch.report.results.diagnosis import DiagnosisResults
from ccnn_torch.report.results.identified import IdentifiedResults
from ccnn_torch.report.results.run import RunResults
from ccnn_torch.report.results.suite import SuiteResults
from ccnn_torch.report.results.verify import SinceResults, VerifyResults

FOLDER = Path(__file__).parent / "contracts"
MODELS: dict[str, type[BaseModel]] = {
    "card": Card,
    "results": RunResults,
    "identified": IdentifiedResults,
    "diagnosis": DiagnosisResults,
    "since": SinceResults,
    "suite": SuiteResults,
    "verify": VerifyResults,
}


def frozen(name: str) -> dict[str, Any]:
    """The frozen schema of `NAME.json`."""
    found: dict[str, Any] = json.loads((FOLDER / f"{name}.json").read_text())
    return found


def derived(model: type[BaseModel]) -> dict[str, Any]:
    """A model's schema, with the texts that document its fields."""
    schema = model.model_json_schema()
    texts = {name: text for part in _models(model) for name, text in _texts(part)}
    for name, node in {model.__name__: schema, **schema["$defs"]}.items():
        node.pop("title")
        for key, field in node.get("properties", {}).items():
            field.pop("title", None)
            if text := texts.get(f"{name.partition('_')[0]}.{key}"):
                field["description"] = text
    return schema


def keys(schema: dict[str, Any], node: Any = None, path: str = "") -> Iterator[tuple[str, str]]:
    """Every key of a schema and its types, such as `methods.*.seconds.values[]` and `null number`."""
    node = schema if node is None else node
    options = [_target(schema, option) for option in node.get("anyOf", [node])]
    kinds = {str(option.get("enum") or option.get("const") or option.get("type", "any")) for option in options}
    yield path, " ".join(sorted(kinds | {"optional"} if node.get("optional") else kinds))
    for option in options:
        for key, below in option.get("properties", {}).items():
            optional = {"optional": key not in option.get("required", [])}
            yield from keys(schema, _target(schema, below) | optional, f"{path}.{key}".strip("."))
        for key, mark in (("additionalProperties", ".*"), ("items", "[]")):
            if isinstance(option.get(key), dict):
                yield from keys(schema, _target(schema, option[key]), f"{path}{mark}")
        for below in option.get("prefixItems", [])[:1]:
            yield from keys(schema, _target(schema, below), f"{path}[]")


def broken(old: dict[str, Any], new: dict[str, Any]) -> list[str]:
    """What outsiders would miss in the new schema: lost keys and changed types."""
    there, now = dict(keys(old)), dict(keys(new))
    lost = [f"{path} is lost" for path in there if path not in now]
    return lost + [
        f"{path}: {there[path]} is now {now[path]}" for path in there if now.get(path, there[path]) != there[path]
    ]


def _target(schema: dict[str, Any], node: dict[str, Any]) -> dict[str, Any]:
    if "$ref" not in node:
        return node
    return schema["$defs"][node["$ref"].rpartition("/")[2]] | {k: v for k, v in node.items() if k != "$ref"}


def _models(model: type[BaseModel]) -> Iterator[type[BaseModel]]:
    """All models of its module and of the base."""
    for module in (sys.modules[model.__module__], sys.modules[Result.__module__]):
        for part in vars(module).values():
            if inspect.isclass(part) and issubclass(part, BaseModel) and part is not BaseModel:
                yield part


def _texts(model: type[BaseModel]) -> Iterator[tuple[str, str]]:
    """`Model.key` and the text below the field."""
    body = ast.parse(inspect.getsource(model)).body[0]
    assert isinstance(body, ast.ClassDef)
    for field, below in zip(body.body, body.body[1:], strict=False):
        if isinstance(field, ast.AnnAssign) and isinstance(below, ast.Expr) and isinstance(below.value, ast.Constant):
            assert isinstance(field.target, ast.Name)
            name = model.model_fields[field.target.id].serialization_alias or field.target.id
            yield f"{model.__name__}.{name}", " ".join(str(below.value.value).split())


def main() -> None:
    for name, model in MODELS.items():
        path, schema = FOLDER / f"{name}.json", derived(model)
        problems = broken(frozen(name), schema) if path.is_file() else []
        if problems:
            sys.exit(f"{path.name}: {'; '.join(problems)}; outsiders script against it (DESIGN, sections 10 to 12)")
        path.write_text(json.dumps(schema, indent=1) + "\n")


if __name__ == "__main__":
    main()
