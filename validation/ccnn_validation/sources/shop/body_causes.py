"""Causes of the library in sizes, frames and instrument, in the forms of somebody who had read its documentation."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from ccnn_validation.sources.shop.arms import Arm
from ccnn_validation.sources.shop.cause import Cause, Random, shifted
from ccnn_validation.sources.shop.machine import Array, Errors, Machine, Pose, Rows

__all__ = ["frame", "geometry", "instrument", "thermal", "tool"]


def geometry(machine: Machine, rng: Random) -> Cause:
    """Sizes; of an arm the table of two inner links (the others are base and tool), of one with parallel axes a."""
    if isinstance(machine, Arm):
        links = {6: [1, 2], 7: [2, 4]}.get(machine.count, [0, 1])

        def drawn(size: float) -> Array:
            return np.array(
                [rng.uniform(0.5, 1.2) * rng.choice([-1, 1]) * size if i in links else 0 for i in range(machine.count)]
            )

        crossed = machine.count > 4
        errors = {"a": drawn(6e-4), "d": drawn(6e-4) * crossed, "alpha": drawn(4e-4) * crossed}
    else:
        errors = {name: rng.normal(0, size, shape) for name, (size, shape) in machine.sizes.items()}
    return Cause(("geometry",), lambda rows, k: {name: k * change for name, change in errors.items()})


def thermal(machine: Machine, rng: Random) -> Cause:
    """Steel or aluminium that follows the air late: all lengths grow, an arm's unevenly, or the drives' screws do."""
    expansion = rng.choice([11.7e-6, 23e-6])
    uneven = 1 + 0.4 * rng.uniform(-1, 1, machine.count)
    late = rng.uniform(600, 4000)
    screws = machine.joint_units[0] == "m" and rng.random() < 0.4

    def growth(rows: Rows, k: float) -> Errors:
        body = _body(rows.columns["time"], rows.columns["temperature"], late) - 20
        share = k * expansion * body
        if screws:
            return {"joints": share[:, None] * rows.joints}
        return {"growth": share[:, None] * uneven if isinstance(machine, Arm) else share}

    return Cause(("thermal",), growth, needs=("temperature", "time"))


def _body(time: Array, air: Array, late: float, steps: int = 20) -> Array:
    """Temperature of a body of the first order, settled at the first row; exact to within `steps` for each row."""
    found = np.empty_like(air)
    found[0] = air[0]
    for i in range(1, len(time)):
        share = 1 - np.exp(-(time[i] - time[i - 1]) / steps / late)
        now = found[i - 1]
        for j in range(steps):
            now += share * (air[i - 1] + (air[i] - air[i - 1]) * (j + 0.5) / steps - now)
        found[i] = now
    return found


def frame(machine: Machine, rng: Random) -> Cause:
    """The base is elsewhere."""
    shift, turn = rng.normal(0, 2e-4, 3), rng.normal(0, 2e-4, 3)
    if machine.axes == "xy":
        shift, turn = shift * [1, 1, 0], turn * [0, 0, 1]
    return Cause(("frame",), moved=lambda pose, rows, k: shifted(pose, k * shift, k * turn))


def tool(machine: Machine, rng: Random) -> Cause:
    """The tool is elsewhere, in half the cases turned as well."""
    shift, turn = rng.normal(0, 2e-4, 3), rng.normal(0, 2e-4, 3) * (rng.random() < 0.5)

    def moved(pose: Pose, rows: Rows, k: float) -> Pose:
        return pose[0] + pose[1] @ (k * shift), pose[1] @ Rotation.from_rotvec(k * turn).as_matrix()

    return Cause(("tool",), moved=moved)


def instrument(machine: Machine, rng: Random) -> Cause:
    """The tracker's scale, of all axes or of each, or a shear.

    A gantry always has a shear: its own axes out of square, or coupled, are the same.
    """
    kind = rng.integers(3)
    scale = np.eye(3) * 1e-4 if kind == 0 else np.diag(rng.normal(0, 1.2e-4, 3)) if kind == 1 else np.zeros((3, 3))
    if kind == 2 or machine.name == "gantry":
        scale = np.zeros((3, 3))
        scale[0, 1] = scale[1, 0] = 1.5e-4

    def moved(pose: Pose, rows: Rows, k: float) -> Pose:
        return pose[0] + k * (pose[0] - machine.pose(rows.joints)[0].mean(0)) @ scale, pose[1]

    also = ("geometry", "coupling") if machine.name == "gantry" else ()
    return Cause(("instrument", *also), moved=moved)
