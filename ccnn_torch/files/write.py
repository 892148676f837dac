"""Write files atomically."""

from __future__ import annotations

import csv
import errno
import io
import os
import shutil
import stat
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryFile
from typing import BinaryIO
from uuid import uuid4

from ccnn_torch.errors import WriteError

_FORMULA = ("=", "+", "-", "@", "\t", "\r", "\n")


def csv_text(rows: Iterable[Iterable[object]]) -> str:
    """Lines of a CSV file: numbers with 17 significant digits, None as an empty cell, texts as `csv_cell`."""
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows([csv_cell(value) for value in row] for row in rows)
    return text.getvalue()


def csv_cell(value: object) -> str:
    """The text of one cell; a text that a spreadsheet would run as a formula gets a leading apostrophe."""
    if value is None:
        return ""
    if isinstance(value, float | int):
        return f"{value:.17g}"
    text = str(value)
    return f"'{text}" if text.startswith(_FORMULA) and not _is_number(text) else text


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


_PREFIX, _SUFFIX = ".ccnn-", ".part"


def write_whole(path: str | Path, content: bytes | str) -> None:
    """Write a file through a temporary one beside it; a reader sees the old content or the new, never a part.

    Its folder is made where it is not there; text is written as UTF-8. A link stays a link, a file keeps its rights,
    and a pipe or device, such as /dev/stdout, is written to directly.

    Raises:
        WriteError: it cannot be written (disk full, no permission, a folder of that name …); an old file is as it was.
    """
    with writing_whole(path) as stream:
        stream.write(content.encode() if isinstance(content, str) else content)


@contextmanager
def writing_whole(path: str | Path) -> Iterator[BinaryIO]:
    """As `write_whole`, bit by bit: gives a stream. What was written to it is at the path once all of it is written.

    Raises as `write_whole`; any other error leaves the old content.
    """
    path = Path(path)
    with _as_write_error(path):
        kind = _kind(path)
        if kind is not None and stat.S_ISDIR(kind):
            raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR))
        if kind is not None and not stat.S_ISREG(kind):
            with TemporaryFile() as stream:
                yield stream
                stream.seek(0)
                with path.open("wb") as there:
                    shutil.copyfileobj(stream, there)
            return
        if kind is not None and not os.access(path, os.W_OK):
            raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))
        target = Path(os.path.realpath(path))
        target.parent.mkdir(parents=True, exist_ok=True)
        # A name of fixed length: that of the file may already have the maximum length.
        temporary = target.with_name(f"{_PREFIX}{uuid4().hex}{_SUFFIX}")
        try:
            with temporary.open("xb") as stream:
                yield stream
                stream.flush()
                os.fsync(stream.fileno())
            if kind is not None:
                shutil.copymode(target, temporary)
            os.replace(temporary, target)
        finally:
            temporary.unlink(missing_ok=True)


def make_folder(path: str | Path) -> None:
    """Make a folder and its parents, if missing.

    Raises:
        WriteError: it cannot be made.
    """
    try:
        Path(path).mkdir(parents=True, exist_ok=True)
    except OSError as reason:
        raise WriteError(f"{path}: cannot be made ({reason.strerror}); give another place") from None


def sweep(folder: Path, below: bool = True) -> None:
    """Remove the temporary files of a killed process in a folder and below; no other process may be writing there."""
    for leftover in (folder.rglob if below else folder.glob)(f"{_PREFIX}*{_SUFFIX}"):
        leftover.unlink(missing_ok=True)


def _kind(path: Path) -> int | None:
    """The file mode of a path; None if it does not exist."""
    try:
        return path.stat().st_mode
    except FileNotFoundError:
        return None


@contextmanager
def _as_write_error(path: Path) -> Iterator[None]:
    try:
        yield
    except OSError as reason:
        raise WriteError(f"{path}: cannot be written ({reason.strerror}); the old content is unchanged") from None


def write_rows(path: str | Path, header: Sequence[str], rows: Iterable[Sequence[str | float | None]]) -> None:
    """Write a CSV file; numbers have 17 significant digits, None is an empty cell.

    Raises:
        WriteError: it cannot be written.
    """
    write_whole(path, csv_text([header, *rows]))
