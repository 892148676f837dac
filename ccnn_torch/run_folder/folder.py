"""The run folder: its lock against a second process, the paths of its files, and what an interrupt leaves behind."""

from __future__ import annotations

import errno
import os
import sys
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Any

from ccnn_torch.errors import InputError, WriteError
from ccnn_torch.files.write import make_folder, sweep, write_whole

NOTHING_WRITTEN = "interrupted; nothing was written"


class Stopped(Exception):
    """Ctrl-C was pressed; its text is the message to print."""


@contextmanager
def if_stopped(sentence: str) -> Iterator[None]:
    """Within it Ctrl-C ends the command with this sentence and the exit code 130."""
    try:
        yield
    except KeyboardInterrupt:
        raise Stopped(sentence) from None


if sys.platform == "win32":
    import msvcrt
else:
    import fcntl

LOCK = ".lock"

# Offset of the locked byte, far beyond the process number, which others must be able to read (Windows).
_BYTE = 1 << 30
# Error numbers of a lock that another process holds.
_HELD = (errno.EAGAIN, errno.EACCES, errno.EDEADLK)
# Some network drives have no locks; a run there is not locked.
_NO_LOCKS = (errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP)


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Lock a folder, which is made if missing.

    Raises:
        InputError: another process holds it.
        WriteError: it cannot be made or written to.
    """
    make_folder(folder)
    held = _taken(folder)
    try:
        yield
    finally:
        # The file is removed before it is unlocked: a process that opens it from now on makes a new one.
        if sys.platform != "win32":
            (folder / LOCK).unlink(missing_ok=True)
        os.close(held)


def _taken(folder: Path) -> int:
    """The open lock file, held by this process, with the number of the process in it."""
    path = folder / LOCK
    while True:
        try:
            held = os.open(path, os.O_RDWR | os.O_CREAT, 0o666)
        except OSError as reason:
            raise WriteError(f"{path}: cannot be written ({reason.strerror}); give another folder") from None
        try:
            _lock(held)
            if os.path.samestat(os.fstat(held), path.stat()):
                os.ftruncate(held, 0)
                with suppress(OSError):  # A full disk: the lock holds without the number.
                    os.write(held, str(os.getpid()).encode())
                return held
        except FileNotFoundError:
            pass  # Released by another process between opening and locking.
        except OSError as reason:
            if reason.errno in _HELD:
                number = os.read(held, 20).decode(errors="replace").strip()
                os.close(held)
                raise InputError(
                    f"{folder} is in use by another run (process {number or 'unknown'}); wait until it has ended, or "
                    "give another folder"
                ) from None
            if reason.errno in _NO_LOCKS:
                return held
            os.close(held)
            raise WriteError(f"{path}: cannot be locked ({reason.strerror}); give another folder") from None
        os.close(held)


def _lock(file: int) -> None:
    if sys.platform == "win32":
        os.lseek(file, _BYTE, os.SEEK_SET)
        msvcrt.locking(file, msvcrt.LK_NBLCK, 1)
        os.lseek(file, 0, os.SEEK_SET)
    else:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)


@contextmanager
def resume_hint(command: str) -> Iterator[None]:
    """If a file cannot be written, add to the error the command that resumes the work."""
    try:
        yield
    except WriteError as problem:
        raise WriteError(f"{problem}; what was computed is kept, and {command} resumes from it") from None


def check_own_folder(folder: Path, own: Collection[str]) -> None:
    """Refuse a folder whose files are not those of the command that writes there.

    Args:
        folder: where a command is going to write, replacing what it wrote there before.
        own: names of which the command's folder holds one.

    Raises:
        InputError: the folder is a file, or holds files and none of these names.
    """
    held = {LOCK} if not folder.exists() else {file.name for file in folder.iterdir()} if folder.is_dir() else {""}
    if held - {LOCK} and not held & set(own):
        raise InputError(f"{folder} holds files already; give a folder of its own with --out DIR")


@dataclass(frozen=True)
class RunFolder:
    """Paths inside one run folder. `results.json` is written last: a folder that has it is finished.

    Attributes:
        facts: what the checkpoints are made with, as `fingerprint` gives it.
    """

    path: Path
    facts: Mapping[str, Any] = field(default_factory=dict)

    @classmethod
    @contextmanager
    def fresh(cls, out: str | None, name: str, resume: str = "ccnn run --resume") -> Iterator[RunFolder]:
        """Make the folder `out`, or `runs/NAME-STAMP`, and lock it; `resume` is the command that resumes a run.

        A folder in which a run was killed before it wrote a file counts as empty. A folder that stays empty is removed.

        Raises:
            InputError: the folder holds files already, is in use, or cannot be made.
        """
        path = Path(out) if out else Path("runs") / f"{name}-{datetime.now():%Y%m%d-%H%M%S}"
        resumes = f", or resume that run: {resume} {path}" if cls(path).config.is_file() else ""
        taken = InputError(f"{path} holds files already; give another folder with out=…{resumes}")
        if path.exists() and not path.is_dir():
            raise taken
        try:
            with locked(path):
                sweep(path)
                if any(file.name != LOCK for file in path.iterdir()):
                    raise taken
                yield cls(path)
        except BaseException:
            with suppress(OSError):
                path.rmdir()
            raise

    @classmethod
    @contextmanager
    def existing(cls, path: Path, command: str = "ccnn run") -> Iterator[RunFolder]:
        """Lock a folder to resume; `command` is the one that made it.

        Raises:
            InputError: there is no run in it, or it is in use.
        """
        if not (path / "config.yaml").is_file():
            raise InputError(
                f"{path} has no config.yaml, so there is nothing to resume; name a folder made by {command}, or, if "
                "it was stopped before it wrote a file, repeat the command that started it"
            )
        with locked(path):
            sweep(path)
            yield cls(path)

    @property
    def config(self) -> Path:
        return self.path / "config.yaml"

    @property
    def results(self) -> Path:
        return self.path / "results.json"

    @property
    def finished(self) -> bool:
        return self.results.is_file()

    @property
    def tensorboard(self) -> Path:
        return self.path / "tensorboard"

    @property
    def models(self) -> Path:
        return self.path / "models"

    @property
    def checkpoints(self) -> list[Path]:
        return sorted((self.path / "checkpoints").glob("*.safetensors"))

    def checkpoint(self, method: str, phase: str) -> Path:
        return self.path / "checkpoints" / f"{method}-{phase}.safetensors"

    def write(self, name: str, content: str) -> None:
        write_whole(self.path / name, content)
