"""Mistakes in logs that no diagnosis survives: swapped joints, wrong units, a drive that was off, no motion."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
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
# Samples farther apart show no motion [s]; what they are farther apart than where their times are in a smaller unit.
_SPACING, _SMALLER = 0.1, {"ns": 1e5, "us": 100.0, "ms": 0.0}
# A position that is the command delayed by up to so much [s], or moves by less than that share of it, is not the
# command with the other sign.
_TURNED_LAG, _TURNED_SHARE = 1.0, 0.5


def refuse_mistakes(logs: Sequence[Log]) -> None:
    """Raise `InputError` with one sentence where the logs cannot be what their headers say."""
    for mistake in _mistakes(logs):
        raise InputError(mistake)


def _mistakes(logs: Sequence[Log]) -> Iterator[str]:
    """What is wrong with the logs, in the order in which it is looked for; each rests on what is before it."""
    names = ", ".join(log.name for log in logs)
    usable = [log for log in logs if log.on.sum() > 1]
    if not any(log.on.any() for log in logs):
        yield f"{names}: the drive was off throughout (torque_on); record a motion with the drive on"
    lasted = sum(float(np.diff(log.time)[log.on[1:]].sum()) for log in usable)
    samples = sum(int(log.on.sum()) for log in usable)
    if lasted < _SHORTEST or samples < _FEWEST:
        yield (
            f"{names}: {samples} samples in {lasted:.3g} s with the drive on are too few; record at least {_FEWEST} "
            f"samples in {_SHORTEST:g} s, better ten times as many"
        )
    for log in usable:
        yield from _too_far_apart(log)
    command = np.concatenate([log.command[log.on] for log in usable])
    position = np.concatenate([log.position[log.on] for log in usable])
    still = [f"command{i + 1}" for i in range(command.shape[1]) if np.ptp(command[:, i]) == 0]
    if len(still) == command.shape[1]:
        yield f"{names}: no command moves ({', '.join(still)}); record a motion"
    for rule in (_wrong_units, _swapped):
        yield from (f"{names}: {mistake}" for mistake in rule(command, position))
    yield from _turned(usable)
    for log in usable:
        for i in range(command.shape[1]):
            if np.ptp(log.position[log.on, i]) == 0 and np.ptp(log.command[log.on, i]) > 0:
                yield (
                    f"{log.name}: q{i + 1} never moves while command{i + 1} does; check the encoder's column, or leave "
                    "this log out"
                )
    longest = max(usable, key=lambda log: len(log.time))
    pairs = zip(longest.command[longest.on].T, longest.position[longest.on].T, strict=True)
    lag = max(_lag_of(longest.time, u, q) for u, q in pairs)
    if lag * _LAGS > lasted:
        yield (
            f"{names}: the position lags {lag:.3g} s behind the command, and the log lasts {lasted:.3g} s; record at "
            f"least {_LAGS * lag:.2g} s"
        )


def _lag_of(time: Array, command: Array, position: Array) -> float:
    """The time shift at which a position is most like its command [s], `s` each; 0 where it does not move."""
    like = _likeness(command, position)
    best = int(np.argmax(like))
    # A position that is not the command at all lags behind it by nothing.
    return best * float(np.median(np.diff(time))) if like[best] > _ALIKE else 0.0


def _likeness(command: Array, position: Array) -> Array:
    """Correlation of a position with its command at each lag, in samples; 0 where one of them does not move."""
    if len(command) < 3 or not np.ptp(command) or not np.ptp(position):
        return np.zeros(1)
    c, q = command - command.mean(), position - position.mean()
    size = 1 << (2 * len(c) - 1).bit_length()
    like = np.fft.irfft(np.fft.rfft(q, size) * np.conj(np.fft.rfft(c, size)), size)
    found: Array = like[: max(int(_LONGEST_LAG * len(c)), 1)] / (np.linalg.norm(c) * np.linalg.norm(q))
    return found


def _too_far_apart(log: Log) -> Iterator[str]:
    step = float(np.median(np.diff(log.time)))
    if step > _SPACING:
        unit = next(unit for unit, beyond in _SMALLER.items() if step > beyond)
        yield (
            f"{log.name}: its samples are {step:.3g} s apart, which shows no motion; if the times are in {unit}, "
            f"write time[{unit}], else record at least {1 / _SPACING:.0f} samples in a second"
        )


def _turned(logs: Sequence[Log]) -> Iterator[str]:
    for i in range(logs[0].command.shape[1]):
        # Where the joint moves most.
        log = max(logs, key=lambda log: float(np.ptp(log.command[log.on, i])))
        command, position = log.command[log.on, i], log.position[log.on, i]
        like = _likeness(command, position)
        late = like[: max(int(_TURNED_LAG / float(np.median(np.diff(log.time)))), 1)]
        far = np.std(position) > _TURNED_SHARE * np.std(command)
        if far and like[0] < -_WELL and float(late.max()) < -like[0] - _MORE:
            yield (
                f"{log.name}: q{i + 1} moves against command{i + 1}; multiply one of them by -1, so that both count in "
                "one direction"
            )


def _wrong_units(command: Array, position: Array) -> Iterator[str]:
    for i in range(command.shape[1]):
        steps = [float(np.std(np.diff(v[:, i]))) for v in (command, position)]
        far = [float(np.std(v[:, i])) for v in (command, position)]
        if not min(*steps, *far):
            continue
        for factor, (small, large) in _UNITS.items():
            for ratio, first, second in ((far[1] / far[0], "q", "command"), (far[0] / far[1], "command", "q")):
                if factor / _SLACK < ratio < factor * _SLACK:
                    yield (
                        f"{first}{i + 1} moves {ratio:.3g} times as far as {second}{i + 1}: one of them is in {small} "
                        f"and not in {large}; correct the unit in its header"
                    )


def _swapped(command: Array, position: Array) -> Iterator[str]:
    moving = [i for i in range(command.shape[1]) if np.ptp(command[:, i]) and np.ptp(position[:, i])]
    if len(moving) < 2:
        return
    like = np.corrcoef(command[:, moving].T, position[:, moving].T)[: len(moving), len(moving) :]
    for a, i in enumerate(moving):
        b = int(np.argmax(like[:, a]))
        if b != a and like[b, a] > _WELL and like[b, a] > like[a, a] + _MORE and like[a, b] > like[b, b] + _MORE:
            yield (
                f"q{i + 1} follows command{moving[b] + 1} and q{moving[b] + 1} follows command{i + 1}; the columns of "
                "two joints are swapped"
            )
