"""The job in memory: rows, methods, figures; then what is written."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from torch import Tensor

from ccnn_torch.identification import ParameterChoice, Progress, bootstrap
from ccnn_torch.mechanisms import Framed, Mechanism, load_mechanism
from ccnn_torch.runs.identification._assemble import assemble
from ccnn_torch.runs.identification._counts import count_study
from ccnn_torch.runs.identification._measured import Measured
from ccnn_torch.runs.identification._records import from_records
from ccnn_torch.runs.identification._simulate import simulate
from ccnn_torch.runs.identification._solve import Outcome, frames_first, is_apart, pieces_of, run_method, solver_of
from ccnn_torch.runs.identification._store import load_outcome, save_outcome
from ccnn_torch.runs.identify_config import IdentifyConfig

__all__ = ["Identification", "Watch", "identify"]

Watch = Callable[[str], Progress]
"""Given a label, somewhere to report the share that is done."""


@dataclass
class Identification:
    """What an identification found.

    Attributes:
        measured: mechanism and rows.
        outcomes: by method; the first is the result.
        results: the content of `identified.json`.
        arrays: tensors behind the pictures, by name.
    """

    config: IdentifyConfig
    measured: Measured
    outcomes: dict[str, Outcome]
    results: dict[str, Any]
    arrays: dict[str, Tensor]

    def mechanism(self, machine: int = 0, method: str | None = None) -> Mechanism:
        """The mechanism with the identified parameters of one machine; by default the first method's."""
        outcome = self.outcomes[method or next(iter(self.outcomes))]
        return self.measured.mechanism.with_nominal(outcome.values[machine])

    def nominal(self) -> dict[str, float]:
        """What the parameters were before, by name [SI]: nominal, or with the frames fitted."""
        names = [p.name for p in self.measured.mechanism.geometry]
        return dict(zip(names, self.measured.start[0].tolist(), strict=True))


def prepare(config: IdentifyConfig) -> tuple[Mechanism, Measured]:
    """Mechanism and rows of a config.

    Raises:
        InputError: the mechanism or the data cannot be used.
    """
    mechanism = load_mechanism(config.mechanism, **config.mechanism_keys)
    if config.frame.base or config.frame.tool:
        mechanism = Framed(mechanism, base=config.frame.base, tool=config.frame.tool)
    measured = from_records(config, mechanism) if config.records is not None else simulate(config, mechanism)
    return mechanism, frames_first(measured, config)


def identify(config: IdentifyConfig, store: Path | None = None, watch: Watch | None = None) -> Identification:
    """Identify the parameters of a config by every method.

    Args:
        store: folder in which each method's outcome is kept, and from which finished ones are taken.
        watch: where progress goes.

    Raises:
        InputError: the config, the mechanism or the data cannot be used; one sentence.
    """
    mechanism, measured = prepare(config)
    for method in config.methods:  # what cannot be solved is said before anything takes minutes
        solver_of(method, config)
        pieces_of(measured, config, is_apart(method, config), _first(measured))
    mark = _fingerprint(measured)
    outcomes: dict[str, Outcome] = {}
    for method in config.methods:
        path = None if store is None else store / f"{method}.safetensors"
        outcome = None if path is None else load_outcome(path, mark)
        if outcome is None:
            outcome = run_method(method, measured, config, None if watch is None else watch(method))
            if path is not None:
                save_outcome(path, outcome, mark)
        outcomes[method] = outcome
    counts = count_study(config, mechanism)
    done = assemble(config, measured, outcomes, counts, _bootstrap(config, measured))
    return Identification(config, measured, outcomes, done.results, done.arrays)
