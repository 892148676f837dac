"""Calls of a simulator: checked shapes, errors as one sentence, a cache of rows."""

from __future__ import annotations

import traceback
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ccnn_torch.coordinates import Condition
from ccnn_torch.display import count_text
from ccnn_torch.errors import CcnnError, InputError
from ccnn_torch.mechanisms.simulators.simulator import Simulator
from ccnn_torch.numerics.batching import leading_shape

# Rows in one call, so that memory suffices; of a simulator that remembers, so that its user sees it move on.
_AT_MOST, _AT_ONCE = 50_000, 512
# Rows that are kept.
_MOST_KEPT = 500_000
_PACKAGE = str(Path(__file__).parents[1])
_WATCHER: ContextVar[Callable[[int], None] | None] = ContextVar("watcher", default=None)


@contextmanager
def simulated_rows(tell: Callable[[int], None]) -> Iterator[None]:
    """Within it, `tell` is called with the number of rows a slow simulator (one with a cache) has simulated so far."""
    count = 0

    def more(rows: int) -> None:
        nonlocal count
        count += rows
        tell(count)

    token = _WATCHER.set(more)
    try:
        yield
    finally:
        _WATCHER.reset(token)


class Calls:
    """A simulator with its memory."""

    def __init__(self, simulator: Simulator) -> None:
        """simulator: as `Simulator.checked` returns it."""
        self.simulator = simulator
        self._kept: dict[bytes, NDArray[np.float64]] = {}
        low = [-np.inf if p.low is None else p.low for p in simulator.parameters]
        high = [np.inf if p.high is None else p.high for p in simulator.parameters]
        self.low = torch.tensor(low, dtype=torch.float64)
        self.high = torch.tensor(high, dtype=torch.float64)

    def __deepcopy__(self, memo: object) -> Calls:
        """Itself: copies of a machine share what was simulated."""
        return self

    def pose(self, joints: Tensor, parameters: Tensor, conditions: Mapping[str, Tensor]) -> Tensor:
        """Pose of joints `... x n` with parameters `... x k` under conditions `...` each, all broadcast; `... x p`.

        Parameters beyond their bounds are taken at the bound; rows that are not finite are returned as NaN without a
        call.
        """
        covariates = [
            conditions.get(c.name, torch.tensor(c.usual, dtype=torch.float64))[..., None] for c in self._conditions
        ]
        lead = leading_shape(joints, parameters, *covariates)
        values = torch.minimum(torch.maximum(parameters, self.low), self.high)
        n, m = joints.shape[-1], len(covariates)
        parts = [t.detach().expand(*lead, t.shape[-1]) for t in (joints, *covariates, values)]
        rows = torch.cat(parts, -1).reshape(-1, n + m + values.shape[-1]).numpy()
        found = np.full((len(rows), len(self.simulator.pose)), np.nan)
        asked = np.flatnonzero(np.isfinite(rows).all(-1))
        if len(asked):
            found[asked] = self._remembered(rows[asked]) if self.simulator.remember else self._in_parts(rows[asked])
        return torch.from_numpy(found).reshape(*lead, found.shape[-1])

    @property
    def _conditions(self) -> list[Condition]:
        return [c for c in self.simulator.covariates if isinstance(c, Condition)]

    def _in_parts(self, rows: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.concatenate([self.ask(rows[i : i + _AT_MOST]) for i in range(0, len(rows), _AT_MOST)])

    def _remembered(self, rows: NDArray[np.float64]) -> NDArray[np.float64]:
        keys = [row.tobytes() for row in rows]
        new = {key: i for i, key in enumerate(keys) if key not in self._kept}
        if len(self._kept) + len(new) > _MOST_KEPT:
            self._kept.clear()
            new = {key: i for i, key in enumerate(keys)}
        names, places = list(new), np.array(list(new.values()), dtype=np.int64)
        for start in range(0, len(names), _AT_ONCE):
            part = slice(start, start + _AT_ONCE)
            self._kept.update(zip(names[part], self.ask(rows[places[part]]), strict=True))
            tell = _WATCHER.get()
            if tell is not None:
                tell(len(names[part]))
        return np.stack([self._kept[key] for key in keys])

    def ask(self, rows: NDArray[np.float64]) -> NDArray[np.float64]:
        """The callable itself: rows of commands, covariates and parameters -> pose, NaN where it has none."""
        simulator, n = self.simulator, len(self.simulator.joints)
        names = [c.name for c in self._conditions]
        # Copies: a simulator that writes into what it is given must not change what it is compared with.
        commands, parameters = rows[:, :n].copy(), rows[:, n + len(names) :].copy()
        covariates = {name: rows[:, n + i].copy() for i, name in enumerate(names)}
        try:
            if simulator.tensors:
                tensors = {name: torch.from_numpy(value) for name, value in covariates.items()}
                answer = simulator.simulate(torch.from_numpy(commands), tensors, torch.from_numpy(parameters))
            else:
                answer = simulator.simulate(commands, covariates, parameters)
            plain = answer.detach().numpy() if isinstance(answer, Tensor) else answer
            pose = np.array(plain, dtype=np.float64)
        except CcnnError:
            raise
        except (Exception, SystemExit) as error:  # a user's code may raise anything
            said = (str(error).strip().splitlines() or [""])[0]
            raise InputError(
                f"simulator '{simulator.name}': simulate fails{_line(error)} on {count_text(len(rows), 'row')}: "
                f"{type(error).__name__}: {said}"
            ) from error
        wanted = (len(rows), len(simulator.pose))
        if pose.shape != wanted:
            raise InputError(
                f"simulator '{simulator.name}': simulate returned shape {pose.shape} for "
                f"{count_text(len(rows), 'row')}, expected {wanted}: a row for each row of commands and a column for "
                f"each of {_names(simulator)}; wrap a function of one row in rowwise(…)"
            )
        pose[~np.isfinite(pose).all(-1)] = np.nan
        return pose


def described(simulator: Simulator, joints: Tensor, conditions: Mapping[str, Tensor]) -> str:
    """`q1 = 0.3 rad, load_y = -40 N`: a row in words; joints `n`, conditions 0-dim each."""
    units = {c.name: c.unit for c in simulator.covariates if isinstance(c, Condition)}
    parts = [f"{j.name} = {float(v):.5g} {j.unit}" for j, v in zip(simulator.joints, joints, strict=True)]
    return ", ".join([*parts, *(f"{n} = {float(v):.5g} {units[n]}" for n, v in conditions.items() if n in units)])


def _names(simulator: Simulator) -> str:
    return ", ".join(c if isinstance(c, str) else c.name for c in simulator.pose)


def _line(error: BaseException) -> str:
    """` at line N of FILE`, of the innermost call outside this package and others."""
    frames = traceback.extract_tb(error.__traceback__)
    users = [f for f in frames if "site-packages" not in f.filename and not f.filename.startswith(_PACKAGE)]
    return f" at line {users[-1].lineno} of {users[-1].filename}" if users else ""
