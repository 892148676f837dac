"""Ordinary causes that the library has names for, by formulas of this source."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np
from scipy.signal import lfilter

from ccnn_validation.sources.adversarial.effect import Effect
from ccnn_validation.sources.adversarial.machine import ARM, Array
from ccnn_validation.sources.adversarial.rig import Rig

__all__ = ["ORDINARY", "backlash", "compliance", "geometry", "lagged", "ordinary", "pick", "thermal", "torque",
           "transmission", "weight_torque"]  # fmt: skip

ORDINARY = ("backlash", "compliance", "thermal", "transmission")


def ordinary(rig: Rig, name: str, textbook: bool | None = None, joints: int | None = None) -> Effect:
    """An ordinary cause by name, with the covariates that it needs recorded.

    Args:
        rig: the machine and its rows.
        name: one of `ORDINARY` or `geometry`.
        textbook: whether the form is exactly the textbook's; drawn when None.
        joints: how many joints have it; drawn when None.
    """
    exact = bool(rig.rng.random() < 0.5) if textbook is None else textbook
    makers: Mapping[str, Callable[[Rig, bool, Sequence[int]], Effect]] = {
        "backlash": backlash,
        "compliance": compliance,
        "thermal": thermal,
        "transmission": transmission,
        "geometry": geometry,
    }
    return makers[name](rig, exact, pick(rig, joints))


def pick(rig: Rig, count: int | None = None) -> list[int]:
    """Some of the joints, in order."""
    many = int(rig.rng.integers(1, rig.machine.count + 1)) if count is None else count
    return sorted(int(i) for i in rig.rng.choice(rig.machine.count, size=many, replace=False))


def _on(rig: Rig, which: Sequence[int]) -> Array:
    """Size of an error by joint, `n`: half to one and a half times for those chosen, else 0."""
    sizes = np.zeros(rig.machine.count)
    sizes[list(which)] = rig.rng.uniform(0.5, 1.5, len(which))
    return sizes


def torque(rig: Rig, load: Array) -> Array:
    """Force or torque of a load `s x p` on each joint by virtual work, `s x n` [N, N*m]."""
    return np.asarray(np.einsum("spn,sp->sn", rig.jacobian, load))


def weight_torque(rig: Rig) -> Array:
    """The same of 1 N of weight at the platform: down is -z, and -y for a machine in the x-y plane."""
    names = rig.machine.pose_names
    down = np.zeros(len(names))
    down[names.index("z") if "z" in names else names.index("y")] = -1.0
    return torque(rig, np.broadcast_to(down, rig.pose.shape))


def backlash(rig: Rig, textbook: bool, which: Sequence[int]) -> Effect:
    """A joint stops half its play short of its command; otherwise the stop varies by 10 % with the tooth in mesh."""
    rig.show("direction")
    play = _on(rig, which)
    if not textbook:
        low, high = rig.machine.span
        play = play * (1 + 0.1 * np.sin(2 * np.pi * 17.3 * (rig.joints - low) / (high - low)))
    return Effect("backlash", joints=-0.5 * play * rig.direction, textbook=textbook)


def compliance(rig: Rig, textbook: bool, which: Sequence[int]) -> Effect:
    """A drive that yields to the load; otherwise it stiffens: c τ / (1 + |τ| / τ1), 15 % less at the typical load."""
    rig.show("load")
    turn = torque(rig, rig.load)
    if not textbook:
        turn = turn / (1 + 0.15 * np.abs(turn) / np.abs(turn).mean(0))
    return Effect("compliance", joints=_on(rig, which) * turn, textbook=textbook)


def thermal(rig: Rig, textbook: bool, which: Sequence[int]) -> Effect:
    """All lengths of the structure grow with its temperature; glass scales do not.

    The structure follows the hall by a lag of 20 to 60 minutes, otherwise by no lag and by 10 % more when warm.
    """
    del which
    rig.show("temperature", "time")
    warm = lagged(rig, float(rig.rng.uniform(1200.0, 3600.0))) if textbook else rig.temperature
    warm = warm - 20.0
    if not textbook:
        warm = warm * (1 + 0.1 * np.tanh(warm / 4.0))
    lengths = np.zeros_like(rig.machine.nominal)
    sized = rig.machine.parameters_like()
    lengths[sized] = rig.machine.nominal[sized]
    return Effect("thermal", parameters=warm[:, None] * lengths, textbook=textbook)


def transmission(rig: Rig, textbook: bool, which: Sequence[int]) -> Effect:
    """An error once a tooth: a sine over 3 to 9 periods of the travel; otherwise with 15 % of its second harmonic.

    A joint that turns has a whole number of periods a turn. Few rows see few periods.
    """
    low, high = rig.machine.span
    periods = rig.rng.uniform(3.0, 9.0 if rig.rows > 60 else 4.5, rig.machine.count)
    rate = 2 * np.pi * periods / (high - low)
    rate = np.where(rig.machine.turning, np.maximum(np.round(rate), 1.0), rate)
    phase = rate * rig.joints + rig.rng.uniform(0, 2 * np.pi, rig.machine.count)
    wave = np.sin(phase)
    if not textbook:
        wave = wave + 0.15 * np.sin(2 * phase + rig.rng.uniform(0, 2 * np.pi, rig.machine.count))
    return Effect("transmission", joints=_on(rig, which) * wave, textbook=textbook)


def geometry(rig: Rig, textbook: bool, which: Sequence[int]) -> Effect:
    """Lengths as built: of some legs, for the arm of links 2 to 4, drawn so that no constant of the joints does it."""
    del textbook, which
    machine = rig.machine
    lengths = machine.parameters_like("a2", "a3", "d4", "d2") if machine.name == ARM else machine.parameters_like()
    names = np.array([g.name for g in machine.model.geometry])
    lengths = np.array([i for i in lengths if not names[i].startswith("offset")])
    slopes = machine.parameter_jacobian(rig.joints, rig.pose, lengths)
    best, most = np.zeros(len(machine.nominal)), -1.0
    for _ in range(12):
        chosen = rig.rng.choice(lengths, size=min(4, len(lengths)), replace=False)
        sizes = rig.rng.choice([-1.0, 1.0], len(chosen)) * rig.rng.uniform(0.5, 1.5, len(chosen))
        change = slopes[..., np.searchsorted(lengths, chosen)] @ sizes
        moved = np.linalg.solve(rig.jacobian, change[..., None])[..., 0]
        # What a constant and a gain of each joint leave, in the poses.
        rest = moved - np.stack(
            [_line(q, d) for q, d in zip((rig.joints - machine.middle).T, moved.T, strict=True)], -1
        )
        left = np.linalg.norm(np.einsum("spn,sn->sp", rig.jacobian, rest)) / np.linalg.norm(change)
        if left > most:
            best, most = np.zeros(len(machine.nominal)), float(left)
            best[chosen] = sizes
    return Effect("geometry", parameters=best)


def _line(joint: Array, error: Array) -> Array:
    """Straight line of an error over its joint, `s`."""
    return np.asarray(np.polyval(np.polyfit(joint, error, 1), joint))


def lagged(rig: Rig, lag: float) -> Array:
    """Temperature of a body that follows the hall by a first-order lag [s], in balance at the first row, `s` [degC]."""
    grid = np.arange(rig.time[0], rig.time[-1] + 20.0, 10.0)
    hall = np.interp(grid, rig.time, rig.temperature)
    share = 1 - np.exp(-10.0 / lag)
    body = lfilter([share], [1.0, share - 1.0], hall, zi=[(1 - share) * hall[0]])[0]
    return np.asarray(np.interp(rig.time, grid, body))
