"""Training curves and masks for TensorBoard, as a callback of the trainer."""

from __future__ import annotations

import io
import itertools
import math
import os
import socket
import statistics
import struct
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike
from PIL import Image
from torch import Tensor

from ccnn_torch.calibration.dataset import Dataset
from ccnn_torch.learners import Learner, TrainingData
from ccnn_torch.report.screen import progress_bar
from ccnn_torch.training import Scaling

_PER_SUBPOPULATION = ("density", "diversity")
_CELL, _MASKS_EVERY = 16, 20
"""Pixels a connection gets in the picture of a mask, which is written each so many steps."""


class TensorBoardCallback:
    """Write event files into `RUN/tensorboard`.

    A scalar of `r` repeats gives its median over the repeats under its tag (`fitness/best`, `heldout/mse_q1`,
    `density/subpopulation_1`) and, when there are several repeats, that of the first one under `repeat_0/…`: a median
    curve hides how a single run moves, thirty curves hide everything.

    Every event carries the time inside the learner as its wall time, so that TensorBoard's relative axis compares
    methods whose steps are different things.

    The writer opens at the first step it is given and purges what was written at or after that step, so that a run
    resumed from a checkpoint shows no step twice.
    """

    def __init__(
        self,
        folder: str | Path,
        *,
        every: int = 1,
        tell: Callable[[str], None] = lambda sentence: None,
    ) -> None:
        """Make the callback.

        Args:
            folder: where the event files go.
            every: write scalars each so many steps.
            tell: is given the sentence when the curves cannot be written any further.
        """
        self._folder = Path(folder)
        self._masks: Callable[[], Sequence[ArrayLike]] | None = None
        self._every = every
        self._tell, self._told = tell, False
        self._writer: EventFile | None = None

    def on_start(self, learner: Any, data: Any, step: int) -> None:
        """Take the learner's masks where it has some; the writer waits for the first step."""
        genome = getattr(learner, "genome", None)
        self._origin = time.time()
        if genome is not None:
            self._masks = lambda: [mask.cpu().numpy() for mask in genome(0)[0]]

    def on_step(self, step: int, metrics: Mapping[str, Tensor]) -> None:
        """Write the metrics of one step.

        Args:
            metrics: by name, each `r`, `r x k` or a plain number.
        """
        if self._writer is None:
            self._writer = EventFile(self._folder, purge_step=step)
            self._origin -= _seconds(metrics) or 0.0
        seconds = _seconds(metrics)
        if step % self._every == 0 or step == 1:
            tags = (tags_of(name, value) for name, value in metrics.items())
            self._writer.add_scalars({tag: n for own in tags for tag, n in own.items()}, step, self._walltime(seconds))
        if self._masks is not None and (step % _MASKS_EVERY == 0 or step == 1):
            for layer, mask in enumerate(self._masks(), start=1):
                picture = np.kron(np.asarray(mask, dtype=np.uint8), np.ones((_CELL, _CELL), dtype=np.uint8)) * 255
                png = io.BytesIO()
                Image.fromarray(picture).save(png, "PNG")
                self._writer.add_image(f"masks/layer_{layer}", png.getvalue(), step)
        if self._writer.failed is not None and not self._told:
            self._told = True
            self._tell(f"{self._folder}: the curves end at step {step} ({self._writer.failed}); the run goes on")

    def _walltime(self, seconds: float | None) -> float | None:
        """As if nothing but the learner took time; None = now."""
        return None if seconds is None else self._origin + seconds

    def on_end(self) -> None:
        """Write out and close."""
        if self._writer is not None:
            self._writer.close()
            self._writer = None


def _seconds(metrics: Mapping[str, Tensor]) -> float | None:
    """Time inside the learner so far, the same for all repeats; None where it was not measured."""
    return float(metrics["seconds"].max()) if "seconds" in metrics else None


def tags_of(name: str, value: Tensor | float) -> dict[str, float]:
    """TensorBoard tags of one metric, and their numbers.

    The part before the first underscore is the group: `fitness_best` becomes `fitness/best`, and the elements of
    `density` (`r x k`) become `density/subpopulation_1` and so on. What is not finite is left out.

    Args:
        name: the metric's name.
        value: `r`, `r x k`, or a single number.
    """
    numbers = torch.as_tensor(value, dtype=torch.float64).detach().cpu()
    group, _, rest = name.partition("_")
    repeats = numbers.shape[0] if numbers.dim() else 1
    table = numbers.reshape(repeats, -1)
    tags: dict[str, float] = {}
    for k in range(table.shape[1]):
        if numbers.dim() > 1:
            part = f"{'subpopulation' if name in _PER_SUBPOPULATION else 'part'}_{k + 1}"
            tag = f"{group}/{rest}_{part}" if rest else f"{group}/{part}"
        else:
            tag = f"{group}/{rest}" if rest else f"training/{name}"
        # In plain numbers: a call of torch or numpy takes longer than the median of a few repeats.
        finite = [number for number in table[:, k].tolist() if math.isfinite(number)]
        if finite:
            tags[tag] = statistics.median(finite)
        if repeats > 1 and math.isfinite(first := float(table[0, k])):
            tags[f"repeat_0/{tag}"] = first
    return tags


_files = itertools.count()


class EventFile:
    """One event file, written by the calling thread.

    torch's own `SummaryWriter` writes in a thread of its own, whose exception on a full disk cannot be caught. Here
    `failed` gives the reason, and later records are dropped: the run continues.
    """

    def __init__(self, folder: Path, purge_step: int | None = None) -> None:
        """Open a new file.

        Args:
            folder: made where it is not there.
            purge_step: TensorBoard ignores the records of older files of this folder from this step on.
        """
        # Only runs that write curves should pay for the import; torch's own `summary` costs more than all of these.
        from tensorboard.compat.proto import event_pb2
        from tensorboard.summary.writer.record_writer import RecordWriter

        self._event: Any = event_pb2.Event
        self.failed: str | None = None
        # TensorBoard reads the files of a folder in the order of their names, and two may begin within a second.
        seconds, rest = divmod(time.time_ns(), 1_000_000_000)
        name = f"events.out.tfevents.{seconds:010}.{rest:09}.{socket.gethostname()}.{os.getpid()}.{next(_files):06}"
        try:
            folder.mkdir(parents=True, exist_ok=True)
            # Without a buffer: what a full disk does not take is not tried again.
            self._records = RecordWriter(io.FileIO(folder / name, "w"))
        except OSError as reason:
            self.failed = reason.strerror
        self._add(None, file_version="brain.Event:2")
        if purge_step is not None:
            self._add(None, step=purge_step, file_version="brain.Event:2")
            self._add(None, step=purge_step, session_log={"status": event_pb2.SessionLog.START})

    def add_scalars(self, numbers: Mapping[str, float], step: int, walltime: float | None = None) -> None:
        """In one record: its checksum and its frame take longer than a number."""
        self._add(walltime, step=step, summary={"value": [{"tag": t, "simple_value": n} for t, n in numbers.items()]})

    def add_image(self, tag: str, png: bytes, step: int) -> None:
        """png: content of a PNG file, whose header has the size."""
        width, height = struct.unpack(">II", png[16:24])
        image = {"width": width, "height": height, "encoded_image_string": png}
        self._add(None, step=step, summary={"value": [{"tag": tag, "image": image}]})

    def close(self) -> None:
        if self.failed is None:
            self._records.close()

    def _add(self, walltime: float | None, **content: Any) -> None:
        event = self._event(wall_time=time.time() if walltime is None else walltime, **content)
        if self.failed is not None:
            return
        try:
            self._records.write(event.SerializeToString())
        except OSError as reason:
            self.failed = reason.strerror
            self._records.close()


class ProgressBar:
    """One line on stderr: what is trained, steps done, time left, the error so far. Silent off a terminal."""

    def __init__(self, label: str, quiet: bool) -> None:
        self._label = label
        self._progress = progress_bar(quiet, steps=True)

    def on_start(self, learner: Learner, data: TrainingData, step: int) -> None:
        self._task = self._progress.add_task(self._label, total=learner.steps, completed=step, note="")
        self._progress.start()

    def on_step(self, step: int, metrics: dict[str, Tensor]) -> None:
        note = ""
        for name, text in (("error_validation", "validation mse"), ("error_train", "training error")):
            if name in metrics:
                note = f"{text} {float(metrics[name].median()):.4g} (standardised)"
                break
        self._progress.update(self._task, completed=step, note=note)

    def on_end(self) -> None:
        self._progress.stop()


@dataclass
class HeldOut:
    """Adds the held-out mse [SI²], mae [SI] and sse [SI²] of every joint to the metrics of a step, to be watched.

    Nothing is chosen by these figures: they are for the curves alone.
    """

    dataset: Dataset
    scaling: Scaling
    joints: tuple[str, ...]
    one_unit: bool
    every: int = 1
    last: dict[str, Tensor] = field(default_factory=dict)

    def on_start(self, learner: Learner, data: TrainingData, step: int) -> None:
        rows = self.dataset.usable_rows("test")
        device = data.inputs.device
        inputs = rows.take(self.dataset.inputs)
        self._learner = learner
        self._features = self.scaling.features(inputs).to(device)
        self._truth = rows.take(self.dataset.deviation)
        self._weights = rows.weights

    def on_step(self, step: int, metrics: dict[str, Tensor]) -> None:
        if step % self.every == 0 or not self.last or self._learner.finished:
            self.last = self._errors()
        metrics.update(self.last)

    def on_end(self) -> None:
        pass

    def _errors(self) -> dict[str, Tensor]:
        predicted = self.scaling.restore(self._learner.predict(self._features).cpu())
        error = (predicted - self._truth) * self._weights.unsqueeze(-1)
        rows = self._weights.sum(-1, keepdim=True)
        squared, absolute = error.square().sum(1), error.abs().sum(1)
        errors: dict[str, Tensor] = {}
        for j, joint in enumerate(self.joints):
            errors[f"heldout_mse_{joint}"] = squared[:, j] / rows[:, 0]
            errors[f"heldout_mae_{joint}"] = absolute[:, j] / rows[:, 0]
            errors[f"heldout_sse_{joint}"] = squared[:, j]
        if self.one_unit:
            errors["heldout_mse_all"] = squared.mean(-1) / rows[:, 0]
        return {name: value.to(torch.float64) for name, value in errors.items()}
