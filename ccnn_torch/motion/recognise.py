"""What a log shows beside the motion: counters that wrap, and a drive that is off."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
# A position that jumps by a whole turn, to this share, was wrapped by its counter.
_TURN, _TURN_SLACK = 2 * np.pi, 0.1
# Samples with no output of the drive at all from which it is taken to be off, and the error that it then must have, as
# a share of the motion.
_OFF, _OFF_ERROR = 20, 0.1


def unwrapped(command: Array, position: Array) -> tuple[Array, Array, tuple[int, int]]:
    """A command and a position without jumps by whole turns, and how many each had."""
    jump = np.diff(command)
    turns = _turns(jump, jump)
    whole = command - _TURN * np.cumsum(np.r_[0.0, turns])
    # A command may jump by a turn, and the position then goes there.
    tried = [(u, _followed(u, position)) for u in ((command, whole) if turns.any() else (command,))]
    u, (q, count) = min(reversed(tried), key=lambda one: round(float(np.std(one[0] - one[1][0])), 6))
    if u is whole or count:
        # One of them may have wrapped before the log began.
        q = q + _TURN * np.round(np.median(u - q) / _TURN)
    return u, q, (int(np.count_nonzero(turns)) if u is whole else 0, count)


def _followed(command: Array, position: Array) -> tuple[Array, int]:
    """The position without jumps by whole turns beside those of its command, and how many it had."""
    moved = np.diff(position)
    # Beside what the command moves, which across a gap may be much.
    turns = _turns(moved - np.diff(command), moved)
    q = position - _TURN * np.cumsum(np.r_[0.0, turns])
    return q, int(np.count_nonzero(turns))


def _turns(beyond: Array, moved: Array) -> Array:
    """Whole turns of each step, 0 where it moves less than half a turn or is no whole turn but what is beyond them."""
    turns = np.round(beyond / _TURN)
    near = (np.abs(beyond - turns * _TURN) < _TURN_SLACK * _TURN) & (np.abs(moved) > _TURN / 2)
    return np.where(near, turns, 0.0)


def drive_on(
    name: str, time: Array, command: Array, position: Array, beside: Mapping[str, Array], notes: list[str]
) -> NDArray[np.bool_]:
    """Where the drive was on: as recorded; else where it gives no output at all although the position is off."""
    from scipy.ndimage import binary_opening

    on = np.ones(len(time), dtype=np.bool_)
    if "torque_on" in beside:
        on = beside["torque_on"] > 0.5
        source = "torque_on"
    else:
        source = ""
        for i in range(command.shape[1]):
            for kind in ("pwm", "current", "torque"):
                output = beside.get(f"{kind}{i + 1}")
                error = np.abs(command[:, i] - position[:, i])
                if output is None or not np.any(output):
                    continue
                off = binary_opening((output == 0) & (error > _OFF_ERROR * np.ptp(command[:, i])), np.ones(_OFF))
                if off.any():
                    on &= ~off
                    source = f"{kind}{i + 1}, which is 0 although the position is off"
    if not on.all() and on.any():
        lost = float(np.diff(time, append=time[-1])[~on].sum())
        notes.append(f"{name}: the drive was off for {lost:.3g} s ({source}), left out")
    return on
