"""Causes that the effects library has no name for, and what each follows."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.spatial.transform import Rotation

from ccnn_validation.sources.shop.body_causes import frame
from ccnn_validation.sources.shop.cause import Cause, Random, one_joint, ordinary, picked
from ccnn_validation.sources.shop.machine import Array, Machine, Pose, Rows, of_load

__all__ = ["OUTSIDE"]


def _bump(machine: Machine, rng: Random) -> Cause:
    """A fork lift hits the base after 55 % of the time."""
    moved = frame(machine, rng).moved
    assert moved is not None

    def bumped(pose: Pose, rows: Rows, k: float) -> Pose:
        time = rows.columns["time"]
        after, (place, rotation) = time > 0.55 * time[-1], moved(pose, rows, k)
        return np.where(after[:, None], place, pose[0]), np.where(after[:, None, None], rotation, pose[1])

    return Cause(("time",), moved=bumped, needs=("time",))


def _sun(machine: Machine, rng: Random) -> Cause:
    """The sun shines on the column for a while: the base tilts about a point at its foot, and back."""
    turn = rng.normal(0, 2e-4, 3) * ([0, 0, 1] if machine.axes == "xy" else [1, 1, 0])
    foot = -machine.down * 1.5 + [0.6, 0, 0]

    def tilted(pose: Pose, rows: Rows, k: float) -> Pose:
        share = rows.columns["time"] / rows.columns["time"][-1]
        warm = np.exp(-(((share - 0.5) / 0.12) ** 2))
        rotation = Rotation.from_rotvec(k * warm[:, None] * turn).as_matrix()
        return (rotation @ (pose[0] + foot)[..., None])[..., 0] - foot, rotation @ pose[1]

    return Cause(("time",), moved=tilted, needs=("time",))


def _wear(machine: Machine, rng: Random) -> Cause:
    """A worn section of one rack or gear."""
    joint = one_joint(machine, rng)
    size, middle = ordinary(machine)[joint] * 3, rng.uniform(0.35, 0.65)
    return _along(machine, joint, lambda share: size * np.exp(-(((share - middle) / 0.12) ** 2)))


def _slack(machine: Machine, rng: Random) -> Cause:
    """A hose package goes taut beyond 60 % of a joint's range, and pulls it."""
    joint = one_joint(machine, rng)
    size = ordinary(machine)[joint] * 3
    return _along(machine, joint, lambda share: size * 6 * np.maximum(0, share - 0.6) ** 2 / 0.16)


def _along(machine: Machine, joint: int, bent: Callable[[Array], Array]) -> Cause:
    """An error of a joint by its share of the range that the rows span; any joint is a right driver."""

    def errors(rows: Rows, k: float) -> dict[str, Array]:
        at, found = rows.joints[:, joint], np.zeros_like(rows.joints)
        found[:, joint] = k * bent((at - at.min()) / (at.max() - at.min()))
        return {"joints": found}

    every = (f"q{i + 1}" for i in range(machine.count))
    return Cause((f"q{joint + 1}", "position", *every), errors)


def _clampslip(machine: Machine, rng: Random) -> Cause:
    """The tool slips in its clamp above a load of 45 N."""
    shift = rng.normal(0, 1.5e-4, 3) * ([1, 1, 0] if machine.axes == "xy" else 1)
    axis = {"five_bar": "y", "planar3r": "x"}.get(machine.name, "z")

    def slipped(pose: Pose, rows: Rows, k: float) -> Pose:
        heavy = np.abs(rows.columns[f"load_{axis}"]) > 45
        return pose[0] + k * (pose[1] @ shift) * heavy[:, None], pose[1]

    return Cause(("load",), moved=slipped, needs=("load",))


def _reclamp(machine: Machine, rng: Random) -> Cause:
    """The target is clamped anew in each of five sessions."""
    shifts = rng.normal(0, 1.5e-4, (5, 3)) * ([1, 1, 0] if machine.axes == "xy" else 1)

    def clamped(pose: Pose, rows: Rows, k: float) -> Pose:
        time = rows.columns["time"]
        session = np.minimum(4, (5 * time / (time[-1] + 1)).astype(int))
        return pose[0] + k * (pose[1] @ shifts[session][..., None])[..., 0], pose[1]

    return Cause(("time",), moved=clamped, needs=("time",))


def _loose(machine: Machine, rng: Random) -> Cause:
    """A loose bolt: a joint rocks to the side to which the load pushes it."""
    joint = one_joint(machine, rng)
    size = ordinary(machine)[joint] * 2

    def rocked(rows: Rows, k: float) -> dict[str, Array]:
        torque, found = of_load(machine, rows)[:, joint], np.zeros_like(rows.joints)
        found[:, joint] = k * size * np.tanh(20 * torque / (np.abs(torque).mean() + 1e-12))
        return {"joints": found}

    return Cause(("load", f"q{joint + 1}", "position"), rocked, needs=("load",))


def _warmplay(machine: Machine, rng: Random) -> Cause:
    """Play that opens with the temperature."""
    joints = {"painter6": [0, 3], "arm7": [0, 2], "scara": [0, 1]}.get(machine.name)
    play = np.abs(picked(machine, rng, joints)) * ordinary(machine)

    def opened(rows: Rows, k: float) -> dict[str, Array]:
        warm = rows.columns["temperature"]
        return {"joints": -k * play * rows.of_joints("direction") * ((warm - warm.mean()) / 2)[:, None]}

    return Cause(("direction", "temperature"), opened, needs=("direction", "temperature", "time"))


OUTSIDE: dict[str, Callable[[Machine, Random], Cause]] = {
    "bump": _bump,
    "sun": _sun,
    "wear": _wear,
    "slack": _slack,
    "clampslip": _clampslip,
    "reclamp": _reclamp,
    "loose": _loose,
    "warmplay": _warmplay,
}
"""In this order they are dealt."""
