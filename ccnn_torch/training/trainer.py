"""The one training loop: steps, validation, early stopping per repeat, checkpoints, resume."""

from __future__ import annotations

import hashlib
import json
import signal
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from types import FrameType
from typing import Any, Protocol

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor

from ccnn_torch.errors import InputError, MethodFailedError
from ccnn_torch.files.write import write_whole
from ccnn_torch.learners.protocol import Learner, TrainingData, weighted_mse
from ccnn_torch.numerics.trees import below, chosen


class Callback(Protocol):
    """Called by `train` in the order given; may add metrics for those after it, must not change the learner."""

    def on_start(self, learner: Learner, data: TrainingData, step: int) -> None:
        """step: steps already done, more than 0 when a training was resumed."""

    def on_step(self, step: int, metrics: dict[str, Tensor]) -> None:
        """step: 1 for the first; metrics by name, each `r` or `r x k`."""

    def on_end(self) -> None:
        """After the last step, also when the training was interrupted."""


def tensor_digest(tensors: dict[str, Tensor]) -> str:
    """SHA-256 over names, types, shapes and bytes; safetensors itself does not notice a flipped byte."""
    digest = hashlib.sha256()
    for name in sorted(tensors):
        tensor = tensors[name].detach().cpu().contiguous()
        digest.update(f"{name}|{tensor.dtype}|{tuple(tensor.shape)}|".encode())
        digest.update(tensor.numpy().tobytes())
    return digest.hexdigest()


def save_checkpoint(path: Path, tensors: dict[str, Tensor], about: dict[str, Any]) -> None:
    """Write tensors (any device) and JSON-able facts about them, all under one hash.

    Raises:
        WriteError: it cannot be written; an older one is as it was.
    """
    held = {name: tensor.detach().cpu().contiguous().clone() for name, tensor in tensors.items()}
    facts = json.dumps({"about": about, "sha256": _seal(held, about)}, sort_keys=True)
    write_whole(path, save(held, metadata={"ccnn_torch": facts}))


def load_checkpoint(path: Path) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Read what `save_checkpoint` wrote.

    Raises:
        InputError: the file is damaged or is not a checkpoint of this package.
    """
    try:
        with safe_open(path, framework="pt") as file:
            metadata = file.metadata() or {}
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (not a mapping)
    except (SafetensorError, OSError) as problem:
        raise InputError(
            f"{path}: this checkpoint cannot be read ({problem}); delete it and resume, which starts its phase again"
        ) from None
    try:
        facts = json.loads(metadata["ccnn_torch"])
        about: dict[str, Any] = facts["about"]
        whole = isinstance(about, dict) and facts["sha256"] == _seal(tensors, about)
    except (KeyError, TypeError, ValueError, RecursionError):
        whole = False
    if not whole:
        raise InputError(
            f"{path}: this checkpoint was altered after it was written; delete it and resume, "
            "which starts its phase again"
        )
    return tensors, about


def _seal(tensors: dict[str, Tensor], about: dict[str, Any]) -> str:
    """SHA-256 over the tensors and their metadata."""
    return hashlib.sha256((tensor_digest(tensors) + json.dumps(about, sort_keys=True)).encode()).hexdigest()


@contextmanager
def interrupts_held_back() -> Iterator[None]:
    """Within it an interrupt (SIGINT) waits; it acts once the block is left, as if it had come then.

    A callback is not left halfway: a record of an event file that was cut off would hide all later ones, and an
    interrupt inside a finalizer is dropped by Python. Only the main thread gets signals, so that elsewhere, or where a
    program has a handler of its own, nothing is changed.
    """
    main = threading.current_thread() is threading.main_thread()
    if not main or signal.getsignal(signal.SIGINT) is not signal.default_int_handler:
        yield
        return
    came: list[int] = []

    def note(number: int, frame: FrameType | None) -> None:
        came.append(number)

    signal.signal(signal.SIGINT, note)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, signal.default_int_handler)
        if came:
            raise KeyboardInterrupt


@dataclass
class Training:
    """Result of a training: history and times; the learner itself holds the chosen state.

    Attributes:
        step: steps done.
        best_step: the step whose state each repeat was left in, `r` int64.
        best_validation: validation error of that state, `r` (mean square of standardised outputs); inf without any.
        history: metrics by name, `steps x r [x k]`.
        seconds: time spent inside the learner.
        clock: the same after each step, `steps` [s].
        converged: what the learner reports after its last step, before the chosen state is taken, `r` bool; a
            training that was ended before the learner's own end counts as converged. None = it does not report it.
        ended: false where the budget ended it before the learner, `stop_at` or `patience` did.
    """

    step: int
    best_step: Tensor
    best_validation: Tensor
    history: dict[str, Tensor] = field(default_factory=dict)
    seconds: float = 0.0
    clock: Tensor = field(default_factory=lambda: torch.zeros(0, dtype=torch.float64))
    converged: Tensor | None = None
    ended: bool = True


def train(
    learner: Learner,
    data: TrainingData,
    *,
    callbacks: Sequence[Callback] = (),
    checkpoint: Path | None = None,
    facts: Mapping[str, Any] | None = None,
    every: int = 20,
    patience: int | None = None,
    stop_at: Tensor | None = None,
    folds: int = 1,
    budget: float | None = None,
    begin_from: dict[str, Tensor] | None = None,
) -> Training:
    """Train a learner with early stopping, and leave it in the chosen state of every repeat.

    With `data.validation`, each repeat is left in the state of its lowest validation error, and the loop ends early
    once no repeat has improved for `patience` steps. With `stop_at`, each repeat is left in the state after that many
    steps (a refit on all rows for as long as validation found best). Else the last state stays.

    Callbacks see the seconds inside the learner so far as the metric `seconds`, `r`; the history does not keep it, as
    it differs from run to run (`Training.clock` has it).

    Args:
        checkpoint: file to write every `every` steps and before the first; if it is there, the training continues from
            it and ends in the same tensors as one that was never stopped.
        facts: JSON-able, kept in the checkpoint under its hash: what the training was begun with.
        stop_at: steps of each repeat, `r` int64.
        folds: so many neighbouring repeats are the folds of one: they share the step of their lowest mean validation
            error.
        budget: seconds inside the learner after which no further step begins.
        begin_from: state of an earlier training to go on from, for a learner with the verb of this name.

    Raises:
        InputError: the checkpoint is damaged or belongs to other data.
        MethodFailedError: the learner cannot go on.
    """
    began = time.perf_counter()
    with _told(learner, "at the start"):
        learner.start(data)
        if begin_from is not None:
            learner.begin_from(begin_from)  # type: ignore[attr-defined]
    repeats = data.inputs.shape[0]
    run = _Run(learner, data, repeats, patience, stop_at, folds, time.perf_counter() - began)
    if checkpoint is not None and checkpoint.exists():
        run.restore(checkpoint)
    elif checkpoint is not None:
        run.save(checkpoint, facts)
    with interrupts_held_back():
        for callback in callbacks:
            callback.on_start(learner, data, run.step)
    try:
        while not run.done and (budget is None or run.seconds < budget):
            with _told(learner, f"in step {run.step + 1}"):
                metrics = run.advance()
            metrics["seconds"] = torch.full((repeats,), run.seconds, dtype=torch.float64)
            with interrupts_held_back():
                for callback in callbacks:
                    callback.on_step(run.step, metrics)
            del metrics["seconds"]
            run.note(metrics)
            if checkpoint is not None and run.step % every == 0:
                run.save(checkpoint, facts)
    finally:
        with interrupts_held_back():
            for callback in callbacks:
                callback.on_end()
    if checkpoint is not None:
        run.save(checkpoint, facts)
    return run.finish()


class _Run:
    """State of one training. Every tensor of a learner's state that has a dimension leads with the repeats, so the
    states of different steps can be mixed, one step a repeat."""

    def __init__(
        self,
        learner: Learner,
        data: TrainingData,
        repeats: int,
        patience: int | None,
        stop_at: Tensor | None,
        folds: int,
        seconds: float,
    ) -> None:
        self.learner, self.data, self.patience, self.stop_at = learner, data, patience, stop_at
        self.folds = folds
        self.step = 0
        self.seconds = seconds
        self.clock: list[float] = []
        device = data.inputs.device
        self.best_step = torch.zeros(repeats, dtype=torch.int64, device=device)
        self.best_validation = torch.full((repeats,), torch.inf, dtype=data.inputs.dtype, device=device)
        self.kept = self._copy_state()
        self.history: list[dict[str, Tensor]] = []

    @property
    def chooses(self) -> bool:
        return self.data.validation is not None or self.stop_at is not None

    @property
    def done(self) -> bool:
        if self.learner.finished:
            return True
        if self.stop_at is not None:
            return self.step >= int(self.stop_at.max())
        if self.data.validation is None or self.patience is None or self.step == 0:
            return False
        return self.step - int(self.best_step.max()) >= self.patience

    def advance(self) -> dict[str, Tensor]:
        began = time.perf_counter()
        metrics = dict(self.learner.step())
        self.step += 1
        improved = None
        if self.stop_at is not None:
            improved = self.stop_at == self.step
        elif self.data.validation is not None:
            held = self.data.validation
            error = weighted_mse(self.learner.predict(held.inputs), held.targets, held.weights)
            metrics["error_validation"] = error
            error = error.view(-1, self.folds).mean(1).repeat_interleave(self.folds)
            improved = error < self.best_validation
            if self.patience is not None:
                # A repeat that would have stopped alone takes no more steps, whatever runs beside it.
                improved &= self.step - self.best_step <= self.patience
            self.best_validation = torch.where(improved, error, self.best_validation)
        if improved is not None and bool(improved.any()):
            self._keep(improved)
        self.seconds += time.perf_counter() - began
        return metrics

    def note(self, metrics: dict[str, Tensor]) -> None:
        self.history.append({name: value.detach().clone() for name, value in metrics.items()})
        self.clock.append(self.seconds)

    def finish(self) -> Training:
        if self.stop_at is not None and bool((self.stop_at > self.step).any()):
            # The learner ended before that step: its last state is the nearest one.
            self._keep(self.stop_at > self.step)
        ended, converged = self.done, getattr(self.learner, "converged", None)
        if converged is not None:
            converged = converged.clone() if self.learner.finished else torch.ones_like(converged)
        if self.chooses:
            self.learner.load_state_dict({name: value.clone() for name, value in self.kept.items()})
        else:
            self.best_step = torch.full_like(self.best_step, self.step)
        clock = torch.tensor(self.clock, dtype=torch.float64)
        return Training(
            self.step,
            self.best_step,
            self.best_validation,
            _stack(self.history),
            self.seconds,
            clock,
            converged,
            ended,
        )

    def save(self, path: Path, facts: Mapping[str, Any] | None) -> None:
        tensors = {f"state.{name}": value for name, value in self.learner.state_dict().items()}
        tensors |= {f"history.{name}": value for name, value in _stack(self.history).items()}
        tensors |= {"best_step": self.best_step, "best_validation": self.best_validation}
        if self.chooses:
            tensors |= {f"kept.{name}": value for name, value in self.kept.items()}
        progress = {"step": self.step, "seconds": self.seconds, "clock": self.clock}
        save_checkpoint(path, tensors, {**self._identity(), **progress, "facts": dict(facts or {})})

    def restore(self, path: Path) -> None:
        tensors, about = load_checkpoint(path)
        mine = self._identity()
        for key, value in mine.items():
            if about.get(key) != value:
                raise InputError(
                    f"{path}: this checkpoint has {key} {about.get(key)!r}, this run {value!r}; resume the run folder "
                    "that it belongs to, with its records unchanged"
                )
        device = self.data.inputs.device
        tensors = {name: value.to(device) for name, value in tensors.items()}
        self.learner.load_state_dict(below(tensors, "state."))
        self.best_step, self.best_validation = tensors["best_step"], tensors["best_validation"]
        if self.chooses:
            self.kept = below(tensors, "kept.")
        self.step, self.seconds, self.clock = int(about["step"]), float(about["seconds"]), list(about["clock"])
        history = below(tensors, "history.")
        self.history = [{name: value[i] for name, value in history.items()} for i in range(self.step)]

    def _identity(self) -> dict[str, Any]:
        data = self.data
        return {
            "learner": self.learner.name,
            "rows": list(data.inputs.shape),
            "validation": None if data.validation is None else list(data.validation.inputs.shape),
            "data": tensor_digest({"inputs": data.inputs, "targets": data.targets, "weights": data.weights}),
        }

    def _copy_state(self) -> dict[str, Tensor]:
        return {name: value.detach().clone() for name, value in self.learner.state_dict().items()}

    def _keep(self, improved: Tensor) -> None:
        self.kept = chosen(improved, self._copy_state(), self.kept)
        self.best_step = torch.where(improved, torch.full_like(self.best_step, self.step), self.best_step)


@contextmanager
def _told(learner: Learner, when: str) -> Iterator[None]:
    """A factorisation that fails inside a learner is the learner's failure, not the run's."""
    try:
        yield
    except torch.linalg.LinAlgError as problem:  # type: ignore[attr-defined]
        # Its first line is the reason; the others are for callers of the routine.
        sentence = str(problem).splitlines()[0].removeprefix("linalg.")
        raise MethodFailedError(f"{learner.name} met a matrix that cannot be factorised {when} ({sentence})") from None


def _stack(history: list[dict[str, Tensor]]) -> dict[str, Tensor]:
    if not history:
        return {}
    return {name: torch.stack([metrics[name] for metrics in history]) for name in history[0]}
