"""A black-box simulator as its owner declares it: joints, pose, parameters, covariates, and one Python callable."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from ccnn_torch.coordinates import Condition, Coordinate, Parameter, plausible_error
from ccnn_torch.errors import InputError

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
