"""An error of the machine at each row, and how large it must be for a given strength in units of the noise."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass

import numpy as np

from ccnn_validation.sources.adversarial.machine import Array
from ccnn_validation.sources.adversarial.rig import Rig

__all__ = ["Effect", "absorbed", "combined", "measured", "scaled", "strength_of"]

_FRAMES = ("base_", "tool_")
"""What parameters of an arm's frames begin with: none of the cause `geometry`."""


@dataclass(frozen=True)
class Effect:
    """An error, linear in its size.

    Attributes:
        name: the library's name, or words of this source.
        joints: what is added to the joints, `s x n`.
        parameters: what is added to the parameters, `k` or `s x k`.
        twist: what the pose is moved by, `s x p`.
        textbook: whether its form is the textbook's; other forms leave a rest that may be called outside.
    """

    name: str
    joints: Array | None = None
    parameters: Array | None = None
    twist: Array | None = None
    textbook: bool = True

    def times(self, factor: float) -> Effect:
        """The same error, larger."""
        return self.changed(lambda part: np.asarray(part * factor))

    def changed(self, change: Callable[[Array], Array]) -> Effect:
        """The same error with each part changed."""
        joints, parameters, twist = (
            None if x is None else change(x) for x in (self.joints, self.parameters, self.twist)
        )
        return Effect(self.name, joints, parameters, twist, self.textbook)


def combined(name: str, effects: Sequence[Effect]) -> Effect:
    """Several errors as one."""

    def total(parts: Sequence[Array | None]) -> Array | None:
        there = [p for p in parts if p is not None]
        return np.asarray(sum(there[1:], start=there[0])) if there else None

    return Effect(
        name,
        total([e.joints for e in effects]),
        total([e.parameters for e in effects]),
        total([e.twist for e in effects]),
        all(e.textbook for e in effects),
    )


def measured(rig: Rig, effect: Effect | None) -> Array:
    """True poses with the error, `s x p` [SI]."""
    if effect is None:
        return rig.pose
    joints = rig.joints if effect.joints is None else rig.joints + effect.joints
    parameters = None if effect.parameters is None else rig.machine.nominal + effect.parameters
    pose = rig.machine.forward(joints, parameters, rig.pose)
    return pose if effect.twist is None else rig.machine.moved(pose, effect.twist)


def strength_of(rig: Rig, pose: Array) -> float:
    """RMS over rows and coordinates of what a pose differs from the nominal one, in units of the noise."""
    return float(np.sqrt(np.mean((rig.machine.twist(pose, rig.pose) / rig.sigma) ** 2)))


def scaled(rig: Rig, effect: Effect, strength: float) -> Effect:
    """The error at a size that makes the poses differ by `strength` times the noise (RMS)."""
    parts = [x for x in (effect.joints, effect.parameters, effect.twist) if x is not None]
    found = effect.times(1e-6 / max(float(np.abs(x).max()) for x in parts))
    for _ in range(6):
        factor = strength / strength_of(rig, measured(rig, found))
        found = found.times(factor)
        if abs(factor - 1) < 1e-3:
            break
    return found


def absorbed(rig: Rig, effect: Effect, names: Collection[str]) -> float:
    """RMS share of an error that smooth errors of the machine leave, fitted to the rows, 0 to 1.

    names: some of `joint_offset`, `joint_gain` and `geometry`. An answer of these is right where they leave nothing.
    """
    machine = rig.machine
    small = scaled(rig, effect, 1.0)
    error = (machine.twist(measured(rig, small), rig.pose) / rig.sigma).reshape(-1)
    by_joint = rig.jacobian / rig.sigma[:, None]
    by_gain = by_joint * (rig.joints - machine.middle)[:, None, :]
    which = np.array([i for i, g in enumerate(machine.model.geometry) if not g.name.startswith(_FRAMES)])
    by_parameter = machine.parameter_jacobian(rig.joints, rig.pose, which) / rig.sigma[:, None]
    # A gain may be 0 elsewhere than in the middle.
    parts = {"joint_offset": by_joint, "joint_gain": np.concatenate([by_joint, by_gain], -1), "geometry": by_parameter}
    basis = np.concatenate([parts[n] for n in names], -1).reshape(len(error), -1)
    # Redundant parameters must not fit noise of rounding.
    norm = np.linalg.norm(basis, axis=0)
    kept = basis[:, norm > 0] / norm[norm > 0]
    rest = error - kept @ np.linalg.lstsq(kept, error, rcond=1e-8)[0]
    return float(np.linalg.norm(rest) / np.linalg.norm(error))
