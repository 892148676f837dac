"""A run in blocks of repeats: each an ordinary run in `blocks/`, and their figures put together.

Repeat k has seed + k however many run side by side, so a block of repeats from k on is a run of seed + k.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ccnn_torch.calibration.config import RunConfig
from ccnn_torch.calibration.page.tables import write_tables
from ccnn_torch.calibration.statistics import spread
from ccnn_torch.errors import InputError
from ccnn_torch.report.json_files import plain, read_json, write_json
from ccnn_torch.report.results.run import RmsMax, RunResults
from ccnn_torch.run_folder.folder import RunFolder

_SPREAD = {"median", "low", "high", "values"}
# What the exported repeat's block has, and its run. Checkpoints, curves of TensorBoard and the config stay there.
_KEPT = ("arrays.safetensors", "history-*.safetensors", "model.*", "card.json", "models")


def blocks_of(config: RunConfig, folder: RunFolder) -> dict[str, RunConfig]:
    """The blocks of a run by name, in the order of their seeds."""
    if config.methods == ["auto"]:
        raise InputError(
            "methods=auto chooses a method for all repeats together; name the methods, or write block=null"
        )
    assert config.block is not None
    size, digits = config.block, len(str(config.repeats - 1))
    found = {}
    for first in range(0, config.repeats, size):
        name = f"{first:0{digits}}"
        path = Path(os.path.abspath(folder.path)) / "blocks" / name
        own = {
            "name": f"{config.name}-{name}",
            "seed": config.seed + first,
            "repeats": min(size, config.repeats - first),
            "out": str(path),
            "engine": "local",
            "block": None,
            # Only one block has the model that is exported.
            "save_models": False,
            "save_report": False,
        }
        found[name] = config.model_copy(update=own)
    return found


def write_blocks(
    config: RunConfig, folder: RunFolder, blocks: Sequence[RunConfig], again: Callable[[Path], object]
) -> None:
    """Put the figures of finished blocks together, and export the best repeat of all."""
    found = [read_json(RunFolder(Path(str(block.out))).results) for block in blocks]
    for key, of in (("methods", _methods), ("geometry", _geometry)):
        if len({of(results) for results in found}) > 1:
            chosen = ", ".join(sorted({of(results) for results in found}))
            raise InputError(
                f"the blocks of repeats differ in {key}, which their rows chose ({chosen}); write {key}=… to have the "
                "same in all"
            )
    whole = merged(found)
    scores = {name: block["score"]["values"] for name, block in whole["methods"].items() if block["test"] is not None}
    best = min(scores, key=lambda name: float(np.median(scores[name])))
    if any(part["best_method"] != best for part in found):
        # Of other methods in some blocks, and not known of this one.
        whole["pose"].pop("energy", None)
    results = RunResults.model_validate(
        whole | {"name": config.name, "seed": config.seed, "repeats": config.repeats, "best_method": best}
    )
    for kind, left in results.methods[best].pose.items():
        if left is not None:
            results.pose[kind].after = RmsMax(rms=left.rms, max=left.max)
    first = int(np.argmin(scores[best]))
    exported = next(block for block in blocks if first < block.seed - config.seed + block.repeats)
    there = RunFolder(Path(str(exported.out)))
    if config.save_models:
        _export(exported, there, again)
        results.model = RunResults.read(there.results).model
    for pattern in _KEPT:
        for path in there.path.glob(pattern):
            if path.is_dir():
                shutil.copytree(path, folder.path / path.name, dirs_exist_ok=True)
            else:
                shutil.copy(path, folder.path / path.name)
    if config.save_report:
        from ccnn_torch.calibration.page.report import write_report

        write_report(folder.path, results)
    else:
        write_tables(folder.path, results)
    write_json(folder.results, results)


def merged(parts: Sequence[Any]) -> Any:
    """Figures of several runs as those of one: spreads get the values of all, lists each entry once, the rest is the
    first run's."""
    first = parts[0]
    if isinstance(first, dict) and set(first) == _SPREAD:
        return plain(spread([np.nan if v is None else v for part in parts for v in part["values"]]))
    if isinstance(first, dict):
        common = {key: merged([part[key] for part in parts]) for key in first if all(key in part for part in parts)}
        if "spread" in common:
            # Plain numbers beside a spread are its medians.
            common |= {key: block["median"] for key, block in common["spread"].items()}
        return common
    if isinstance(first, list) and all(isinstance(entry, str) for entry in first):
        return list(dict.fromkeys(entry for part in parts for entry in part))
    return first


def _export(config: RunConfig, folder: RunFolder, again: Callable[[Path], object]) -> None:
    """Write the model files of a finished block; its training is in its checkpoints."""
    if (folder.path / "card.json").is_file():
        return
    folder.write("config.yaml", config.model_copy(update={"save_models": True}).to_yaml(folder.path))
    folder.results.unlink()
    again(folder.path)


def _methods(results: Mapping[str, Any]) -> str:
    return "+".join(sorted(name for name, block in results["methods"].items() if block["test"] is not None))


def _geometry(results: Mapping[str, Any]) -> str:
    return str(results["geometry"]["chosen"])
