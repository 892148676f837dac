"""Jobs that turn a config into a folder; one that was stopped is finished with the same config and data alone."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, Protocol, Self, TypeVar

from ccnn_torch.errors import InputError, WriteError
from ccnn_torch.report.screen import say_place
from ccnn_torch.run_folder.folder import LOCK, RunFolder
from ccnn_torch.training import load_checkpoint
from ccnn_torch.version import __version__

# Keys that may differ: the folder may have been moved, and where it runs and what is written last change no result.
_FREE = ("out", "save_models", "save_report", "max_bytes")
_MOST = 3


class FolderConfig(Protocol):
    """What a `FolderJob` needs of its config; a `JobConfig` with a name and a folder."""

    @property
    def name(self) -> str: ...
    @property
    def out(self) -> str | None: ...
    @classmethod
    def from_file(cls, path: Path) -> Self: ...
    def to_yaml(self, folder: Path) -> str: ...
    def model_dump(self, *, mode: str) -> dict[str, Any]: ...


_Config = TypeVar("_Config", bound=FolderConfig)
_Data = TypeVar("_Data")


@dataclass(frozen=True)
class FolderJob(Generic[_Config, _Data]):
    """A command that turns a config into a folder, and finishes one that was stopped.

    Attributes:
        command: as it is typed.
        model: class of its config.
        results: the file that is written last.
        checkpoints: pattern of the files that hold the fingerprint of the config.
        prepare: checks a config before anything is written; gives its data.
        compute: fills a folder from config and data; then `quiet` and `details`, whether tables are shown
            as well; None: no result at all.
    """

    command: str
    model: type[_Config]
    results: str
    checkpoints: str
    prepare: Callable[[_Config], _Data]
    compute: Callable[[_Config, _Data, RunFolder, bool, bool | None], None]

    def start(self, config: _Config, quiet: bool = False, details: bool | None = False) -> RunFolder:
        """Fill a fresh folder.

        Raises:
            InputError: the config or its data cannot be used, or the folder is taken or in use.
            WriteError: a file cannot be written; what was computed until then is kept.
        """
        # A folder that is taken is refused before records are read, which may take a minute.
        with RunFolder.fresh(config.out, config.name, f"{self.command} --resume") as folder:
            # First of all, so that what is stopped while rows are read and effects are weighed can be resumed.
            folder.write("config.yaml", config.to_yaml(folder.path))
            try:
                self.compute(config, self.prepare(config), folder, quiet, details)
            except WriteError:
                raise
            except InputError:
                # Nothing was computed: the next try may take the same name.
                if {file.name for file in folder.path.rglob("*") if file.is_file()} <= {LOCK, folder.config.name}:
                    folder.config.unlink(missing_ok=True)
                raise
        return folder

    def resume(self, path: Path, quiet: bool = False, details: bool | None = False) -> RunFolder:
        """Finish what a folder holds, as if it was never stopped. What is finished stays as it is.

        Raises:
            InputError: the folder was not made by the command or is in use; its config, records or checkpoints changed.
            WriteError: as `start`.
        """
        if (path / self.results).is_file():
            if not quiet:
                say_place(f"{path} is finished; nothing to do")
            return RunFolder(path)
        with RunFolder.existing(path, self.command) as folder:
            config = self.model.from_file(folder.config)
            check_fingerprint(sorted(path.glob(self.checkpoints)), fingerprint(config), folder.config)
            self.compute(config, self.prepare(config), folder, quiet, details)
        return folder

    def finish(self, config: _Config, quiet: bool = False, details: bool | None = False) -> RunFolder:
        """Resume the folder of a config where there is one, else start it."""
        folder = RunFolder(Path(str(config.out)))
        if folder.config.is_file():
            return self.resume(folder.path, quiet, details)
        return self.start(config, quiet, details)


def fingerprint(config: FolderConfig, data: str | None = None) -> dict[str, Any]:
    """Version, keys of the config, and the hash of the data where it is known; JSON-able."""
    keys = {key: value for key, value in config.model_dump(mode="json").items() if key not in _FREE}
    facts = {"version": __version__, "config": _place_free(json.loads(json.dumps(keys)))}
    return facts if data is None else {**facts, "data": data}


def check_fingerprint(checkpoints: Iterable[Path], facts: Mapping[str, Any], config: Path) -> None:
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
