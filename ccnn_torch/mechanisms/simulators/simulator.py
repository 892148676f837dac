"""A black-box simulator as its owner declares it: joints, pose, parameters, covariates, and one Python callable."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ccnn_torch.coordinates import Condition, Coordinate, Parameter, plausible_error
from ccnn_torch.display import count_text
from ccnn_torch.errors import InputError
from ccnn_torch.numerics.batching import leading_shape
from ccnn_torch.plugins import users_code

Simulate = Callable[[Any, dict[str, Any], Any], Any]
"""`(commands N x n, {name: N}, parameters N x k) -> pose N x p`, all in SI, every row independently."""

_ANGLES = ("rx", "ry", "rz", "phi")
_REFERENCE = 293.15
# Lengths and angles; anything else that is wrong is a cause of its own.
_GEOMETRIC = ("m", "rad")


@dataclass(frozen=True)
class Joint(Coordinate):
    """A commanded joint and the part of its travel that is the workspace, `low` to `high` [its unit]."""

    low: float = -1.0
    high: float = 1.0


@dataclass(frozen=True)
class Simulator:
    """A simulator as the nominal machine.

    Attributes:
        name: for people.
        joints: q1, q2, … in the order of the commands.
        pose: names of what comes out, in order: of x, y, z [m] and rx, ry, rz (a rotation vector [rad]); or two of
            x, y, z and phi, the angle about the third axis. Any others, as `Coordinate`, need `frame`.
        simulate: `(commands, covariates, parameters) -> pose`, as `Simulate`; NaN in rows that have no pose.
        parameters: its named parameters with unit, nominal value and plausible error (`scale`), in the order of the
            columns that `simulate` gets.
        covariates: what else it takes: `load_NAME`, `temperature`, `time`, `direction1` … by name, or any as
            `Condition`.
        frame: pose `... x p` (tensor) -> position `... x 3` [m] and rotation matrix or None, differentiable in torch.
        home: commands of an ordinary configuration; the middle of the joints' workspace when None.
        step: of the finite differences that replace derivatives, as a share of half a joint's workspace; parameters
            move by a tenth of their scale. A simulator that is exact to 1e-9 only wants 1e-3.
        tensors: whether `simulate` gets float64 tensors rather than numpy arrays.
        remember: whether rows that come again are looked up; for one that takes more than some 10 µs a row.
    """

    name: str
    joints: Sequence[Joint]
    pose: Sequence[str | Coordinate]
    simulate: Simulate
    parameters: Sequence[Parameter] = ()
    covariates: Sequence[str | Condition] = ()
    frame: Callable[[Tensor], tuple[Tensor, Tensor | None]] | None = None
    home: Sequence[float] | None = None
    step: float = 1e-4
    tensors: bool = False
    remember: bool = False

    def __deepcopy__(self, memo: object) -> Simulator:
        """Itself: nothing in it changes, and `simulate` need not be something that can be copied."""
        return self

    def checked(self) -> Simulator:
        """With covariates, pose coordinates and causes spelled out.

        Raises:
            InputError: something in the declaration cannot be.
        """
        pose = tuple(c if isinstance(c, Coordinate) else _coordinate(c, self.name) for c in self.pose)
        conditions = tuple(c if isinstance(c, Condition) else _condition(c, pose, self) for c in self.covariates)
        made = replace(
            self, pose=pose, covariates=conditions, parameters=tuple(_with_cause(p) for p in self.parameters)
        )
        wrong = _wrong(made)
        if wrong:
            raise InputError(f"simulator '{self.name}': {wrong}")
        return made


def rowwise(function: Callable[..., Sequence[float]]) -> Simulate:
    """A simulator of one row, called row after row.

    Args:
        function: `(commands n, {name: value}, parameters k) -> pose p`, numpy arrays and floats [SI].

    Returns:
        What `Simulator.simulate` wants; set `remember=True` with it.
    """

    def simulate(
        commands: NDArray[np.float64], covariates: dict[str, NDArray[np.float64]], parameters: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        conditions = [dict(zip(covariates, row, strict=True)) for row in zip(*covariates.values(), strict=True)]
        rows = zip(commands, conditions or [{} for _ in commands], parameters, strict=True)
        return np.array([np.asarray(function(*row), dtype=np.float64) for row in rows])

    return simulate


def _coordinate(name: str, simulator: str) -> Coordinate:
    if name not in ("x", "y", "z", *_ANGLES):
        raise InputError(
            f"simulator '{simulator}': pose: '{name}' is none of x, y, z, {', '.join(_ANGLES)}; give it as "
            "Coordinate(name, unit), and frame to say where it puts the platform"
        )
    return Coordinate(name, "rad" if name in _ANGLES else "m")


def _condition(name: str, pose: Sequence[Coordinate], simulator: Simulator) -> Condition:
    units = {f"load_{c.name}": "N" if c.unit == "m" else "N*m" for c in pose}
    for i, joint in enumerate(simulator.joints, 1):
        units |= {f"direction{i}": "1", f"speed{i}": f"{joint.unit}/s"}
    units |= {"time": "s", "temperature": "K"}
    if name not in units:
        raise InputError(
            f"simulator '{simulator.name}': covariates: '{name}' is none of {', '.join(units)}; give it as "
            "Condition(name, unit, usual value, spread)"
        )
    return Condition(name, units[name], _REFERENCE if name == "temperature" else 0.0)


def _with_cause(parameter: Parameter) -> Parameter:
    if parameter.cause is not None or parameter.unit in _GEOMETRIC:
        return parameter
    return replace(parameter, cause=parameter.name)


def _wrong(simulator: Simulator) -> str:
    for joint in simulator.joints:
        if not (math.isfinite(joint.low) and math.isfinite(joint.high) and joint.low < joint.high):
            return f"joint {joint.name}: low must be below high, not {joint.low:g} and {joint.high:g}"
    for p in simulator.parameters:
        low, high = p.low if p.low is not None else -math.inf, p.high if p.high is not None else math.inf
        if not (math.isfinite(p.nominal) and low <= p.nominal <= high and low < high):
            return f"parameter '{p.name}': its nominal value {p.nominal:g} must lie between low and high"
        if not 0 < plausible_error(p) < math.inf:
            return f"parameter '{p.name}': scale must be above 0, not {p.scale!r}"
    if simulator.home is not None and len(simulator.home) != len(simulator.joints):
        return f"home: gives {len(simulator.home)} commands for {len(simulator.joints)} joints"
    if not 0 < simulator.step < 1:
        return f"step: a share of half a joint's workspace is above 0 and below 1, not {simulator.step!r}"
    taken = [c.name for c in (*simulator.joints, *_named(simulator.pose))]
    twice = [c.name for c in _named(simulator.covariates) if c.name in taken]
    if twice:
        return f"covariates: '{twice[0]}' is a joint or a pose coordinate already"
    lengths = [c.name for c in _named(simulator.pose) if c.name in "xyz"]
    if simulator.frame is None and any(c.name == "phi" for c in _named(simulator.pose)) and len(lengths) != 2:
        return "pose: phi needs two of x, y, z beside it, and turns about the third axis; else give frame"
    return ""


def _named(things: Sequence[Any]) -> list[Coordinate]:
    return [t for t in things if isinstance(t, Coordinate)]


_ROWS = 4
# Of the change over a step: what differs by more from call to call spoils every derivative.
_REPEATS = 0.01


def try_simulator(simulator: Simulator, calls: Calls, home: Tensor, joints: Tensor, nominal: Tensor) -> None:
    """Ask twice about the same rows, the second time in the reverse order and with another row among them.

    Args:
        home: a configuration with a pose, `n` [SI].
        joints: configurations, `s x n` [SI].
        nominal: parameters, `k` [SI].
    """
    some = torch.cat([joints[:_ROWS], home[None]])
    usual = [c.usual for c in simulator.covariates if isinstance(c, Condition)]
    fixed = torch.cat([torch.tensor(usual, dtype=torch.float64), nominal])
    rows = torch.cat([some, fixed.expand(len(some), -1)], -1).numpy()
    first = calls.ask(rows)
    again = calls.ask(rows[::-1][1:])[::-1]
    step = simulator.step * torch.tensor([j.high - j.low for j in simulator.joints], dtype=torch.float64) / 2
    moved = np.concatenate([calls.ask(rows + np.eye(1, rows.shape[1], i) * float(s)) for i, s in enumerate(step)])
    change = np.abs(moved.reshape(len(step), *first.shape) - first)
    typical = float(np.nanmedian(change.max(axis=(0, 2))))
    if not typical > 0:
        raise InputError(
            f"simulator '{simulator.name}': no joint changes the pose, by steps of {float(step[0]):.2g}; check that "
            "simulate uses its commands, or give a larger step"
        )
    apart = np.nan_to_num(np.abs(again - first[: len(again)]), nan=0.0).max(-1)
    worst = int(apart.argmax())
    if apart[worst] > _REPEATS * typical:
        at = described(simulator, some[worst], {})
        raise InputError(
            f"simulator '{simulator.name}' is not deterministic: evaluated twice at {at} it gave poses that differ by "
            f"{apart[worst]:.2g} m or rad, and a step of a joint changes them by {typical:.2g}; seed its random "
            "numbers, let no row depend on others or on earlier calls, or give a larger step"
        )


# Rows in one call, so that memory suffices; of a simulator that remembers, so that its user sees it move on.
_AT_MOST, _AT_ONCE = 50_000, 512
# Rows that are kept.
_MOST_KEPT = 500_000
_WATCHER: ContextVar[Callable[[int], None] | None] = ContextVar("watcher", default=None)


@contextmanager
def simulated_rows(tell: Callable[[int], None]) -> Iterator[None]:
    """Context in which `tell` receives the number of rows that a slow simulator has simulated so far."""
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
        with users_code(f"simulator '{simulator.name}'", f"simulate on {count_text(len(rows), 'row')} "):
            if simulator.tensors:
                tensors = {name: torch.from_numpy(value) for name, value in covariates.items()}
                answer = simulator.simulate(torch.from_numpy(commands), tensors, torch.from_numpy(parameters))
            else:
                answer = simulator.simulate(commands, covariates, parameters)
            plain = answer.detach().numpy() if isinstance(answer, Tensor) else answer
            pose = np.array(plain, dtype=np.float64)
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
