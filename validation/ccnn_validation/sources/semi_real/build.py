"""A case from a family and a seed: rows, a cause at its strength, and the columns as a user would record them."""

from __future__ import annotations

import zlib
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from ccnn_torch.errors import InputError

from ..case import SourceCase, Truth
from .arm import Pose
from .causes import Cause
from .choose import MAKERS, draw_cause, shown_already
from .kinds import Floats
from .robots import ROBOTS, robot_of
from .situation import Rows, draw_rows

__all__ = ["FAMILIES", "make"]

FAMILIES = tuple(MAKERS)
DECOYS = ("time", "temperature", "load", "direction")


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
    # Outliers are not scaled to a root mean square: each is off by its own multiple of the arm's error.
    size = strength_for(cause, before, relative * robot.seen.own_error) if relative else robot.seen.own_error
    after = cause.pose(size)
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


def strength_for(cause: Cause, before: Pose, wanted: float) -> float:
    """The strength at which positions change by `wanted` [m], root mean square of the distance."""
    strength = 1e-4
    for _ in range(5):  # nearly proportional: each round squares what is missing
        moved = cause.pose(strength).position - before.position
        strength *= wanted / float(np.sqrt((moved**2).sum(-1).mean()))
    return strength


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
