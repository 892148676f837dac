"""One process at a time in a folder: the operating system holds the lock, so that a kill leaves none behind."""

from __future__ import annotations

import errno
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from ccnn_torch.errors import InputError, WriteError
from ccnn_torch.files.write import make_folder

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
