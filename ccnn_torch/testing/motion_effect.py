"""Conformance checks of an effect of motion. See `ccnn_torch.motion.effects.MotionEffect`."""

from __future__ import annotations

from dataclasses import replace

import torch

from ccnn_torch.errors import InputError
from ccnn_torch.motion.axis import Drive, simulate_axes
from ccnn_torch.motion.effects import Facts, MotionEffect, motion_effects
from ccnn_torch.motion.library import library_of

# A turning and a sliding axis of which all is known, and one of which nothing is.
_KNOWN = {"inertia": 2e-3, "load": 1e-3, "viscous": 0.05, "coulomb": 0.01, "weakness": 1.0}
_TURNING = Facts("rad", _KNOWN | {"gravity_sin": 0.1}, gain=2.0, length=0.1, error=0.6, supply=0.2, temperature=20.0)
_AXES = (_TURNING, replace(_TURNING, unit="m", nominal=_KNOWN, length=None), replace(_TURNING, nominal={}, gain=None))
# Times where a fit begins at which the axis is simulated.
_SIZES = (1.0, 100.0, -100.0)
_ABSENT, _SECONDS, _RATE = 1e-12, 4.0, 100.0


def check_motion_effect(effect: str | MotionEffect) -> None:
    """Check form and names, absence at 0, that it moves an axis that can show it, and that all is finite.

    Args:
        effect: a name, `path/to/file.py:NAME`, or the effect.

    Raises:
        AssertionError: one sentence with the mistake.
    """
    try:
        made = motion_effects([effect])[0] if isinstance(effect, str) else effect
        shown = [axis for axis in _AXES if not made.missing(axis)]
        if not shown:
            raise AssertionError(f"effect '{made.name}': no axis of the check can show it: {made.missing(_AXES[0])}")
        if max(_check(made, axis) for axis in shown) <= _ABSENT:
            raise AssertionError(f"effect '{made.name}': moves nothing, and missing() does not say what lacks")
    except InputError as reason:
        raise AssertionError(str(reason)) from reason


def _check(effect: MotionEffect, axis: Facts) -> float:
    """The largest change of a position where a fit begins."""
    library, time = library_of([effect], [axis]), torch.arange(0, _SECONDS, 1 / _RATE, dtype=torch.float64)[None]
    course = 0.4 * (time / _SECONDS - 0.5)
    command = 0.6 * torch.sin(3 * time) + 0.2 * torch.sin(11 * time)
    drive = Drive(time, command, torch.zeros(1, 2, dtype=torch.float64), course, 50 * (course + 0.2))
    where, zero = f"effect '{effect.name}', an axis in {axis.unit}", torch.zeros(1, library.size, dtype=torch.float64)

    def moved(theta: torch.Tensor) -> torch.Tensor:
        values = library.parameters(theta, torch.zeros(1, dtype=torch.int64))
        return simulate_axes(drive, {name: value[:, None] for name, value in values.items()})

    plain = simulate_axes(drive, {name: value[:, None] for name, value in library.nominal.items()})
    if float((moved(zero) - plain).abs().max()) > _ABSENT:
        raise AssertionError(f"{where}: moves the axis where all its numbers are 0")
    most = 0.0
    for variant in library.variants[0]:
        begin = torch.where(variant.values.abs() < 0.1, 1.0, variant.values)
        for size in _SIZES:
            theta = zero.clone()
            theta[:, list(variant.active)], theta[:, list(variant.held)] = size * begin, variant.shapes
            positions = moved(theta)
            if not bool(torch.isfinite(positions).all()):
                raise AssertionError(f"{where}: at {size:g} times where a fit begins its positions are not finite")
            most = max(most, float((positions - plain).abs().max()) if size == 1.0 else 0.0)
    return most
