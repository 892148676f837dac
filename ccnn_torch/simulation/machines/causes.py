"""Causes of pose error: geometry, compliance, transmission, heat and backlash, drawn for each repeat by its seed.

A value of strength 1 gives pose errors of about 0.05 to 0.3 mm. Every cause is drawn even if its strength is 0, so
that the cause of a machine does not depend on which others act.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ccnn_torch.simulation.machines.structure import Structure

CAUSES = ("geometry", "compliance", "transmission", "thermal", "backlash", "mixed")
_MIXED = 0.5
"""Of each cause's strength where all act together."""
REFERENCE = 293.15
"""Temperature at which a machine has its dimensions, 20 degC [K]."""
SESSION = 8 * 3600.0
"""Rows are measured evenly over one working day [s], however many they are."""
_GRID = 10.0
_LINKED = 0.4
"""Share of the drives' own warmth that the legs or links take on."""

# Streams of random numbers of a seed; 1 is the noise of the paper's cases.
_GEOMETRY, _COMPLIANCE, _WAVE_SIZE, _WAVE_PLACE, _GROWTH, _SCREW_GROWTH, _BACKLASH, _CLIMATE = range(11, 19)

Array = NDArray[np.float64]


def draw(seeds: list[int], stream: int, function: Callable[[np.random.Generator], Array]) -> Tensor:
    """One draw a repeat, each from its own seed and stream; `r x ...`."""
    return torch.as_tensor(np.stack([function(np.random.default_rng([seed, stream])) for seed in seeds]))


@dataclass(frozen=True)
class Climate:
    """Temperatures while the rows are measured.

    Attributes:
        time: since the start, `r x s` [s].
        surroundings: `r x s` [K], what a thermometer in the hall shows.
        structure: of frame, legs or links, and their bending difference (surroundings less frame), as departures from
            the reference temperature, `r x s x 3` [K].
        drives: of the drives, warmed by their own work, `r x s x n` [K].
    """

    time: Tensor
    surroundings: Tensor
    structure: Tensor
    drives: Tensor


@dataclass(frozen=True)
class Causes:
    """Errors of each repeat's machine; a cause that does not act is all zeros.

    Attributes:
        geometry: errors of the parameters, `r x 1 x k` [SI].
        drive_compliance: of the drives, `r x 1 x n` [joint's unit per N or N·m].
        member_compliance: factor on that of the members, `r x 1 x 1`.
        amplitude, frequency, phase: of the drives' periodic errors, `r x n x h` [joint's unit], [rad per joint's unit],
            [rad]; h harmonics.
        growth: of each parameter, as in `Structure`, `r x k x 3` [SI/K].
        drive_growth: of the drives' travel, `r x 1 x n` [1/K].
        backlash: half the backlash of each drive, `r x 1 x n` [joint's unit].
        friction: force by which friction holds a drive against its flank, in units of its typical force, `r x 1 x n`.
    """

    geometry: Tensor
    drive_compliance: Tensor
    member_compliance: Tensor
    amplitude: Tensor
    frequency: Tensor
    phase: Tensor
    growth: Tensor
    drive_growth: Tensor
    backlash: Tensor
    friction: Tensor


def draw_causes(structure: Structure, cause: str, strength: float, seeds: list[int]) -> Causes:
    """The machine of each repeat.

    Args:
        structure: its nominal parameters and tolerances.
        cause: one of `CAUSES`; `mixed` has all, each at half the strength.
        strength: 1 = 0.05 to 0.3 mm of pose error.
        seeds: one a repeat.
    """
    k, n = len(structure.parameters), len(structure.drive_compliance)

    def factor(name: str) -> float:
        return strength * (_MIXED if cause == "mixed" else float(cause == name))

    normal = draw(seeds, _GEOMETRY, lambda g: g.standard_normal((1, k)))
    give = draw(seeds, _COMPLIANCE, lambda g: g.uniform(0.5, 1.5, (1, n + 1))) * factor("compliance")
    amplitude, frequency, phase = _waves(structure, seeds)
    uneven = draw(seeds, _GROWTH, lambda g: np.concatenate([g.uniform(0.5, 1.5, (k, 2)), g.normal(size=(k, 1))], -1))
    screws = draw(seeds, _SCREW_GROWTH, lambda g: g.uniform(0.5, 1.5, (1, n)))
    backlash = draw(seeds, _BACKLASH, lambda g: g.uniform(0.5, 1.5, (2, 1, n)))
    return Causes(
        geometry=normal * structure.tolerances * factor("geometry"),
        drive_compliance=give[..., :n] * structure.drive_compliance,
        member_compliance=give[..., n:],
        amplitude=amplitude * factor("transmission"),
        frequency=frequency,
        phase=phase,
        growth=uneven * structure.growth * factor("thermal"),
        drive_growth=screws * structure.drive_growth * factor("thermal"),
        backlash=backlash[:, 0] * structure.backlash / 2 * factor("backlash"),
        friction=backlash[:, 1],
    )


def _waves(structure: Structure, seeds: list[int]) -> tuple[Tensor, Tensor, Tensor]:
    """Two harmonics a drive: 3 to 6 and twice as many periods over a screw's travel, 1 to 4 and twice as many per turn
    of a gear (whole numbers, so that it is periodic)."""
    n = len(structure.wave)
    size = draw(seeds, _WAVE_SIZE, lambda g: g.uniform(0.6, 1.4, (n, 2)))
    rest = draw(seeds, _WAVE_PLACE, lambda g: g.uniform(0.0, 1.0, (n, 3)))
    span = structure.travel[:, 1] - structure.travel[:, 0]
    screws = (3 + 3 * rest[..., 0]) * 2 * torch.pi / span
    gears = 1 + torch.floor(4 * rest[..., 0])
    base = torch.where(structure.screw, screws, gears)
    amplitude = size * structure.wave[:, None] * torch.tensor([1.0, 0.5], dtype=torch.float64)
    frequency = base[..., None] * torch.tensor([1.0, 2.0], dtype=torch.float64)
    return amplitude, frequency, 2 * torch.pi * rest[..., 1:]


def draw_climate(seeds: list[int], rows: int, drives: int) -> Climate:
    """A working day: the hall drifts by a few kelvin, the structure follows hours or half an hour behind, drives warm
    up by their own work. The `rows` rows are evenly spaced in time."""
    grid = np.arange(0.0, SESSION + _GRID, _GRID)
    time = np.linspace(0.0, SESSION, rows)

    def day(g: np.random.Generator) -> Array:
        start, drift = g.normal(0.0, 2.0), g.uniform(3.0, 8.0) * g.choice([-1.0, 1.0])
        swing, period, phase = g.uniform(1.0, 3.0), g.uniform(1.5, 4.0) * 3600, g.uniform(0, 2 * np.pi)
        hall = start + drift * grid / SESSION + swing * (np.sin(2 * np.pi * grid / period + phase) - np.sin(phase))
        frame = _follow(hall, g.uniform(2.0, 4.0) * 3600, hall[0])
        legs = _follow(hall, g.uniform(0.3, 0.8) * 3600, hall[0])
        warm = g.uniform(8.0, 16.0, drives) * (1 - np.exp(-grid[:, None] / g.uniform(0.3, 1.0, drives) / 3600))
        legs = legs + _LINKED * warm.mean(1)
        states = np.concatenate([hall[:, None], frame[:, None], legs[:, None], legs[:, None] + warm], axis=1)
        return np.stack([np.interp(time, grid, column) for column in states.T], axis=-1)

    found = draw(seeds, _CLIMATE, day)
    hall, frame, legs = found[..., 0], found[..., 1], found[..., 2]
    return Climate(
        time=torch.as_tensor(time).expand(len(seeds), -1),
        surroundings=REFERENCE + hall,
        structure=torch.stack([frame, legs, hall - frame], dim=-1),
        drives=found[..., 3:],
    )


def _follow(hall: Array, lag: float, start: float) -> Array:
    """Temperature of a body of one heat capacity behind that of its surroundings: T' = (hall - T) / lag."""
    # Only here: scipy.signal takes a quarter of a second to load, which no other run should pay.
    from scipy.signal import lfilter

    keep = np.exp(-_GRID / lag)
    followed, _ = lfilter([1 - keep], [1.0, -keep], hall, zi=[keep * start])
    return np.asarray(followed, dtype=np.float64)
