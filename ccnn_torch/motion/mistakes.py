"""Mistakes in logs that no diagnosis survives: swapped joints, wrong units, a drive that was off, no motion."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ccnn_torch.errors import InputError

if TYPE_CHECKING:
    from ccnn_torch.motion.log import Log

Array = NDArray[np.float64]
# A joint that follows another command by this much more than its own, and at least so well, is that of the other.
_MORE, _WELL = 0.25, 0.8
# Degrees in a radian and millimetres in a metre, and how far from them a ratio of motions may be.
_UNITS, _SLACK = {np.degrees(1.0): ("degrees", "radians"), 1000.0: ("mm", "m")}, 1.6
# A log must last so long, have so many samples, and be so many times as long as the position lags behind.
_SHORTEST, _FEWEST, _LAGS = 1.0, 100, 8.0
# Lags that are tried, as a share of the log.
_LONGEST_LAG = 0.25
# Correlation from which a position is the delayed command.
_ALIKE = 0.9


def refuse_mistakes(logs: Sequence[Log]) -> None:
    """Raise `InputError` with one sentence where the logs cannot be what their headers say."""
    names = ", ".join(log.name for log in logs)
    if not any(log.on.any() for log in logs):
        raise InputError(f"{names}: the drive was off throughout (torque_on); record a motion with the drive on")
    usable = [log for log in logs if log.on.sum() > 1]
    lasted = sum(float(np.diff(log.time)[log.on[1:]].sum()) for log in usable)
    samples = sum(int(log.on.sum()) for log in usable)
    if lasted < _SHORTEST or samples < _FEWEST:
        raise InputError(
            f"{names}: {samples} samples in {lasted:.3g} s with the drive on are too few; record at least {_FEWEST} "
            f"samples in {_SHORTEST:g} s, better ten times as many"
        )
    command = np.concatenate([log.command[log.on] for log in usable])
    position = np.concatenate([log.position[log.on] for log in usable])
    still = [f"command{i + 1}" for i in range(command.shape[1]) if np.ptp(command[:, i]) == 0]
    if len(still) == command.shape[1]:
        raise InputError(f"{names}: no command moves ({', '.join(still)}); record a motion")
    _refuse_units(names, command, position)
    _refuse_swapped(names, command, position)
    for log in usable:
        for i in range(command.shape[1]):
            if np.ptp(log.position[log.on, i]) == 0 and np.ptp(log.command[log.on, i]) > 0:
                raise InputError(
                    f"{log.name}: q{i + 1} never moves while command{i + 1} does; check the encoder's column, or leave "
                    "this log out"
                )
    longest = max(usable, key=lambda log: len(log.time))
    pairs = zip(longest.command[longest.on].T, longest.position[longest.on].T, strict=True)
    lag = max(lag_of(longest.time, u, q) for u, q in pairs)
    if lag * _LAGS > lasted:
        raise InputError(
            f"{names}: the position lags {lag:.3g} s behind the command, and the log lasts {lasted:.3g} s; record at "
            f"least {_LAGS * lag:.2g} s"
        )


def lag_of(time: Array, command: Array, position: Array) -> float:
    """The time shift at which a position is most like its command [s], `s` each; 0 where it does not move."""
    if len(command) < 3 or not np.ptp(command) or not np.ptp(position):
        return 0.0
    step = float(np.median(np.diff(time)))
    c, q = command - command.mean(), position - position.mean()
    size = 1 << (2 * len(c) - 1).bit_length()
    like = np.fft.irfft(np.fft.rfft(q, size) * np.conj(np.fft.rfft(c, size)), size)[
        : max(int(_LONGEST_LAG * len(c)), 1)
    ]
    best = int(np.argmax(like))
    # A position that is not the command at all lags behind it by nothing.
    return best * step if like[best] > _ALIKE * np.linalg.norm(c) * np.linalg.norm(q) else 0.0


def _refuse_units(names: str, command: Array, position: Array) -> None:
    for i in range(command.shape[1]):
        c, q = (float(np.std(np.diff(v[:, i]))) for v in (command, position))
        far = [float(np.std(v[:, i])) for v in (command, position)]
        if not c or not q or not min(far):
            continue
        for factor, (small, large) in _UNITS.items():
            for ratio, first, second in ((far[1] / far[0], "q", "command"), (far[0] / far[1], "command", "q")):
                if factor / _SLACK < ratio < factor * _SLACK:
                    raise InputError(
                        f"{names}: {first}{i + 1} moves {ratio:.3g} times as far as {second}{i + 1}: one of them is in "
                        f"{small} and not in {large}; correct the unit in its header"
                    )


def _refuse_swapped(names: str, command: Array, position: Array) -> None:
    n = command.shape[1]
    moving = [i for i in range(n) if np.ptp(command[:, i]) and np.ptp(position[:, i])]
    if len(moving) < 2:
        return
    like = np.corrcoef(command[:, moving].T, position[:, moving].T)[: len(moving), len(moving) :]
    for a, i in enumerate(moving):
        b = int(np.argmax(like[:, a]))
        if b != a and like[b, a] > _WELL and like[b, a] > like[a, a] + _MORE and like[a, b] > like[b, b] + _MORE:
            raise InputError(
                f"{names}: q{i + 1} follows command{moving[b] + 1} and q{moving[b] + 1} follows command{i + 1}; the "
                "columns of two joints are swapped"
            )
