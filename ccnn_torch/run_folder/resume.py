"""The config and data that a run was started with, kept in its checkpoints; it can be resumed with these alone."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

from pydantic import BaseModel

from ccnn_torch.errors import InputError
from ccnn_torch.training import load_checkpoint
from ccnn_torch.version import __version__

# Keys that may differ: the folder may have been moved, and where it runs and what is written last change no result.
_FREE = ("out", "save_models", "save_report", "engine", "max_bytes")
_MOST = 3


def facts_of(config: BaseModel, data: str | None = None) -> dict[str, Any]:
    """Version, keys of the config, and the hash of the data where it is known; JSON-able."""
    keys = {key: value for key, value in config.model_dump(mode="json").items() if key not in _FREE}
    facts = {"version": __version__, "config": _place_free(json.loads(json.dumps(keys)))}
    return facts if data is None else {**facts, "data": data}


def refuse_changes(checkpoints: Iterable[Path], facts: Mapping[str, Any], config: Path) -> None:
    """Compare facts with those in the checkpoints; what `facts` does not hold is not compared.

    Raises:
        InputError: a checkpoint is damaged, or was made with other keys, data or another version.
    """
    for path in checkpoints:
        made = load_checkpoint(path)[1].get("facts", {})
        if made.get("version") != facts["version"]:
            raise InputError(
                f"{path}: was made by ccnn_torch {made.get('version', 'of an unknown version')}, this is "
                f"{facts['version']}; resume with that version, or start anew in another folder"
            )
        changed = list(_changed(facts["config"], made.get("config", {}), ""))
        if changed:
            more = f" and {len(changed) - _MOST} more keys differ" if len(changed) > _MOST else ""
            raise InputError(
                f"{config}: {', '.join(changed[:_MOST])}{more}; restore it to resume, or start anew in another folder"
            )
        if "data" in facts and made.get("data") != facts["data"]:
            raise InputError(
                f"{path}: is of other data than the config's; the records were changed: restore them to resume, or "
                "start anew in another folder"
            )


def _changed(now: Any, then: Any, key: str) -> Iterator[str]:
    """`key is X, the checkpoint was made with Y` for each key that differs."""
    if isinstance(now, dict) and isinstance(then, dict):
        for name in sorted({*now, *then}):
            yield from _changed(now.get(name), then.get(name), f"{key}.{name}" if key else name)
    elif now != then:
        yield f"{key} is {json.dumps(now)}, the checkpoint was made with {key} {json.dumps(then)}"


def _place_free(value: Any) -> Any:
    """A file by its name alone: it may have been moved with the folder, and its content has a hash of its own."""
    if isinstance(value, dict):
        return {key: _place_free(one) for key, one in value.items()}
    if isinstance(value, list):
        return [_place_free(one) for one in value]
    return value.replace("\\", "/").rpartition("/")[2] if isinstance(value, str) else value
