"""Files that outsiders script against keep their keys and types, and schemas are schemas."""

from __future__ import annotations

from copy import deepcopy

import pytest
from frozen import FOLDER, MODELS, broken, derived, frozen, keys
from jsonschema import Draft202012Validator


@pytest.mark.parametrize("name", MODELS)
def test_a_result_has_the_keys_and_types_of_its_frozen_schema(name: str) -> None:
    now, there = derived(MODELS[name]), frozen(name)
    assert broken(there, now) == []
    assert dict(keys(now)) == dict(keys(there)), "keys were added: python tests/frozen.py writes the schema anew"


def test_a_lost_key_and_a_changed_type_are_told() -> None:
    there = frozen("verify")
    lost, changed = deepcopy(there), deepcopy(there)
    del lost["$defs"]["Size"]["properties"]["max"]
    changed["properties"]["kept"]["type"] = "string"
    assert "position.after.max is lost" in broken(there, lost)
    assert broken(there, changed) == ["kept: boolean is now string"]


@pytest.mark.parametrize("path", sorted(FOLDER.glob("*.json")), ids=lambda path: path.stem)
def test_schemas_are_schemas(path) -> None:
    Draft202012Validator.check_schema(frozen(path.stem))
