"""A case from a family and a seed: rows, a cause that nothing else explains, its strength, the columns."""

from __future__ import annotations

import zlib
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from ccnn_torch.errors import InputError

from ..case import SourceCase, Truth
from .absorb import left_over, stack
from .arm import Pose
from .causes import Cause
from .device import added_nothing, added_outliers, added_scale
from .drives import added_backlash, added_friction, added_latency, added_transmission
from .joints import added_coupling, added_joint_gain, added_local, added_product
from .kinds import Floats
from .loads import added_compliance, added_gravity_sag
from .robots import ROBOTS, robot_of
from .situation import Rows, draw_rows
from .slow import added_drift, added_jump, added_thermal

__all__ = ["FAMILIES", "make"]

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
FAMILIES = tuple(MAKERS)
DECOYS = ("time", "temperature", "load", "direction")
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


def make(family: str, seed: int) -> SourceCase:
    """The case of a family and seed; the robot is that of the seed modulo four.

    Raises:
        InputError: the family is none of `FAMILIES`, or the robot's data is not there.
    """
    if family not in MAKERS:
        raise InputError(f"there is no family {family!r}; one of {', '.join(FAMILIES)}.")
    rng = np.random.default_rng([seed, zlib.crc32(family.encode())])
    robot = robot_of(ROBOTS[seed % len(ROBOTS)])
    drawn = draw_cause(family, draw_rows(robot, rng), rng)
    rows, cause, relative = drawn.rows, drawn.cause, drawn.strength
    before = rows.arm.pose(rows.joints)
    after = cause.pose(
        strength_for(cause, before, relative * robot.seen.own_error) if relative else robot.seen.own_error
    )
    named = [c for c in DECOYS if c not in cause.columns and c not in cause.clashes]
    decoys = tuple(c for c in named if rng.random() < (0.75 if family == "added_nothing" else 0.35))
    if family == "added_nothing":
        rows, decoys = unrelated(rows, rng), decoys or ("load",)
    beside = covariates(rows, (*cause.columns, *decoys))
    joints = {f"q{j + 1}[rad]": rows.joints[:, j] for j in range(rows.joints.shape[-1])}
    measured = {**joints, **pose_columns(rows, before, before)}
    strength = f" at {relative:g} of the arm's own error" if relative else ""
    return SourceCase(
        family=family,
        mechanism=robot.text,
        columns={**joints, **pose_columns(rows, before, after), **beside},
        noise=None,
        truth=Truth(
            kind="none" if family == "added_nothing" else "outside" if cause.outside else "single",
            causes=() if family == "added_nothing" else (f"{cause.words}{strength} ({robot.name})",),
            accepted=(*drawn.accepted, frozenset()) if shown_already(rows, cause) else drawn.accepted,
            outside=cause.outside,
            drivers=cause.drivers,
        ),
        # Where nothing is added, the question is what the columns alone bring.
        baseline=measured if family == "added_nothing" else {**measured, **beside},
        noise_kind="measured",
    )


def draw_cause(family: str, rows: Rows, rng: np.random.Generator) -> Drawn:
    """A cause and its strength, such that enough is left of it beside the arm's own errors; the clearest draw else."""
    own = left_over(rows.arm, rows.joints, own_shift(rows))
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


def strength_for(cause: Cause, before: Pose, wanted: float) -> float:
    """The strength at which positions change by `wanted` [m], root mean square of the distance."""
    strength = 1e-4
    for _ in range(5):  # nearly proportional: each round squares what is missing
        moved = cause.pose(strength).position - before.position
        strength *= wanted / float(np.sqrt((moved**2).sum(-1).mean()))
    return strength


def shown_already(rows: Rows, cause: Cause) -> bool:
    """Whether the measured arm itself has the cause: a part of what geometry leaves of its own errors."""
    if not cause.own:
        return False
    without, with_it = (left_over(rows.arm, rows.joints, own_shift(rows), more) for more in ((), cause.own))
    return with_it**2 < (1 - SHOWN) * without**2


def own_shift(rows: Rows) -> Floats:
    """The measured arm's own errors of position in its base frame, up to the frames, `s x 3` [m]."""
    out: Floats = rows.position @ rows.robot.seen.base - rows.arm.pose(rows.joints).position
    return out


def pose_columns(rows: Rows, before: Pose, after: Pose) -> dict[str, Floats]:
    """Measured poses moved by the difference of two sets of poses in the base frame."""
    base = rows.robot.seen.base
    position = rows.position + (after.position - before.position) @ base.T
    out = {f"{axis}[m]": position[:, i] for i, axis in enumerate("xyz")}
    if rows.turn is not None:
        turned = base @ after.rotation @ before.rotation.swapaxes(-1, -2) @ base.T
        vector = (Rotation.from_matrix(turned) * Rotation.from_rotvec(rows.turn)).as_rotvec()
        out |= {f"r{axis}[rad]": vector[:, i] for i, axis in enumerate("xyz")}
    return out


def covariates(rows: Rows, chosen: tuple[str, ...]) -> dict[str, Floats]:
    """Columns beside joints and pose."""
    out: dict[str, Floats] = {}
    if "time" in chosen:
        out["time[s]"] = rows.time
    if "temperature" in chosen:
        out["temperature[degC]"] = rows.temperature
    if "load" in chosen:
        out |= {f"load_{axis}[N]": rows.load[:, i] for i, axis in enumerate("xyz")}
    for name, values, unit in (("direction", rows.direction, "1"), ("speed", rows.speed, "rad/s")):
        if name in chosen:
            out |= {f"{name}{j + 1}[{unit}]": values[:, j] for j in range(values.shape[-1])}
    return out


def unrelated(rows: Rows, rng: np.random.Generator) -> Rows:
    """Rows with times and directions of another measurement: the arm's own errors cannot follow them."""
    order = rng.permutation(len(rows.time))
    direction = rng.choice([-1.0, 1.0], rows.direction.shape)
    return replace(rows, time=rows.time[order], temperature=rows.temperature[order], direction=direction)
