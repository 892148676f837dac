"""Which cause a case has: drawn until geometry and what else could explain it leave enough of it to be found."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from .absorb import left_over, stack
from .causes import Cause
from .device import added_nothing, added_outliers, added_scale
from .drives import added_backlash, added_friction, added_latency, added_transmission
from .joints import added_coupling, added_joint_gain, added_local, added_product
from .kinds import Floats
from .loads import added_compliance, added_gravity_sag
from .situation import Rows
from .slow import added_drift, added_jump, added_thermal

__all__ = ["MAKERS", "Drawn", "draw_cause", "shown_already"]

MAKERS: dict[str, Callable[[Rows, np.random.Generator], Cause]] = {
    maker.__name__: maker
    for maker in (
        added_backlash,
        added_friction,
        added_transmission,
        added_compliance,
        added_gravity_sag,
        added_thermal,
        added_drift,
        added_outliers,
        added_latency,
        added_joint_gain,
        added_coupling,
        added_scale,
        added_jump,
        added_local,
        added_product,
        added_nothing,
    )
}
DRAWS = 40
# What geometry leaves of the added error, against what it leaves of the arm's own: below this it is not looked for.
LEAST_VISIBLE = 0.3
# Share of the variance that geometry leaves of the arm's own errors above which the arm has a cause already.
SHOWN = 0.03


@dataclass(frozen=True)
class Drawn:
    """Rows, a cause, its strength in units of the arm's own error, and the names that are right."""

    rows: Rows
    cause: Cause
    strength: float
    accepted: tuple[frozenset[str], ...]


def draw_cause(family: str, rows: Rows, rng: np.random.Generator) -> Drawn:
    """A cause and its strength, such that enough is left of it beside the arm's own errors; the clearest draw else."""
    shift = own_shift(rows)
    # What geometry leaves of the arm's own errors, in units of what the frames leave, as the strength is.
    own = left_over(rows.arm, rows.joints, shift) * np.sqrt((shift**2).sum(-1).mean()) / rows.robot.seen.own_error
    best: tuple[float, Drawn] | None = None
    for _ in range(DRAWS):
        cause = MAKERS[family](rows, rng)
        relative = float(rng.choice(cause.strengths))
        if not relative:
            return Drawn(cause.rows or rows, cause, relative, cause.accepted)
        error = stack(rows.arm.pose(rows.joints), cause.pose(1e-4), rows.turn is not None)
        left = left_over(rows.arm, rows.joints, error)
        least = left_over(rows.arm, rows.joints, error, cause.others) if cause.others else left
        clear = min(least * relative / own - LEAST_VISIBLE, least / left - cause.least_share, 0.0)
        clear -= 0.0 if cause.fit else 10.0
        if best is None or clear > best[0]:
            accepted = cause.accepted
            # Where geometry takes most of it, naming geometry beside it is no mistake.
            if left < 0.5:
                accepted += tuple(names | {"geometry"} for names in cause.accepted)
            best = clear, Drawn(cause.rows or rows, cause, relative, accepted)
        if clear == 0:
            break
    assert best is not None
    return best[1]


def shown_already(rows: Rows, cause: Cause) -> bool:
    """Whether the measured arm itself has the cause: a part of what geometry leaves of its own errors."""
    if not cause.own:
        return False
    without, with_it = (left_over(rows.arm, rows.joints, own_shift(rows), more) for more in ((), cause.own))
    return with_it**2 < (1 - SHOWN) * without**2


def own_shift(rows: Rows) -> Floats:
    """The measured arm's own errors of position in its base frame, up to the frames, `s x 3` [m]."""
    shift: Floats = rows.position @ rows.robot.seen.base - rows.arm.pose(rows.joints).position
    shift -= shift.mean(0)
    return shift
