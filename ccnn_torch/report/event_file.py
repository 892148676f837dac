"""An event file for TensorBoard. It grows with the run, so it cannot be replaced whole; it ends with a whole record."""

from __future__ import annotations

import io
import itertools
import os
import socket
import struct
import time
from pathlib import Path
from typing import Any, Self

_numbers = itertools.count()


class EventFile:
    """One event file, written by the calling thread.

    torch's own `SummaryWriter` writes in a thread of its own, whose exception on a full disk cannot be caught. Here the
    file ends with the last whole record, `failed` gives the reason, and later records are dropped: the run continues.
    """

    def __init__(self, folder: Path, purge_step: int | None = None) -> None:
        """Open a new file.

        Args:
            folder: made where it is not there.
            purge_step: TensorBoard ignores the records of older files of this folder from this step on.
        """
        # Only runs that write curves should pay for the import; torch's own `summary` costs more than all of these.
        from tensorboard.compat.proto import event_pb2, summary_pb2
        from tensorboard.summary.writer.record_writer import RecordWriter

        self._event: Any = event_pb2.Event
        self._summary: Any = summary_pb2.Summary
        self._pending = io.BytesIO()
        self._records = RecordWriter(self._pending)
        self._file: io.FileIO | None = None
        self.failed: str | None = None
        # TensorBoard reads the files of a folder in the order of their names, and two may begin within a second.
        seconds, rest = divmod(time.time_ns(), 1_000_000_000)
        name = f"events.out.tfevents.{seconds:010}.{rest:09}.{socket.gethostname()}.{os.getpid()}.{next(_numbers):06}"
        try:
            folder.mkdir(parents=True, exist_ok=True)
            self._file = io.FileIO(folder / name, "w")
        except OSError as reason:
            self.failed = reason.strerror
        self._add(None, file_version="brain.Event:2")
        if purge_step is not None:
            self._add(None, step=purge_step, file_version="brain.Event:2")
            self._add(None, step=purge_step, session_log={"status": event_pb2.SessionLog.START})

    def add_scalar(self, tag: str, number: float, step: int, walltime: float | None = None) -> None:
        self._add_value(step, walltime, tag=tag, simple_value=number)

    def add_image(self, tag: str, png: bytes, step: int) -> None:
        """png: content of a PNG file, whose header has the size."""
        width, height = struct.unpack(">II", png[16:24])
        self._add_value(step, tag=tag, image={"width": width, "height": height, "encoded_image_string": png})

    def flush(self) -> None:
        """Write the added records to the file, so that TensorBoard sees them."""
        content = memoryview(self._pending.getvalue())
        self._pending.seek(0)
        self._pending.truncate()
        if self._file is None:
            return
        whole = self._file.tell()
        try:
            while content:
                # A disk that fills up may accept a part.
                content = content[self._file.write(content) or 0 :]
        except OSError as reason:
            self.failed = reason.strerror
            self._file.truncate(whole)
            self._file.close()
            self._file = None

    def close(self) -> None:
        self.flush()
        if self._file is not None:
            self._file.close()
            self._file = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _add_value(self, step: int, walltime: float | None = None, **content: Any) -> None:
        self._add(walltime, step=step, summary=self._summary(value=[self._summary.Value(**content)]))

    def _add(self, walltime: float | None, **content: Any) -> None:
        event = self._event(wall_time=time.time() if walltime is None else walltime, **content)
        self._records.write(event.SerializeToString())
