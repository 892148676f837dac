"""Records as they stand in the file of a workshop: mm, degrees, ten digits."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from ccnn_validation.sources.shop.machine import Array, Machine, Pose, Rows

__all__ = ["file_columns", "pose_columns"]


def pose_columns(machine: Machine, pose: Pose, full: bool, unit: str = "m") -> dict[str, Array]:
    """Measured columns by header, in m or mm, and rad."""
    size = {"m": 1.0, "mm": 1e3}[unit]
    columns = {f"{axis}[{unit}]": size * pose[0][:, i] for i, axis in enumerate(machine.axes)}
    if full:
        turn = Rotation.from_matrix(pose[1]).as_rotvec()
        columns |= {f"r{axis}[rad]": turn[:, i] for i, axis in enumerate("xyz")}
    return columns


def file_columns(machine: Machine, rows: Rows, pose: Pose, turn: Rotation, full: bool) -> dict[str, Array]:
    """The columns of the file, with the ten digits of a workshop's; loads are along the tracker's axes."""
    columns = {}
    for i, unit in enumerate(machine.joint_units):
        at = rows.joints[:, i]
        columns[f"q{i + 1}[{'deg' if unit == 'rad' else 'mm'}]"] = np.rad2deg(at) if unit == "rad" else 1e3 * at
    columns |= pose_columns(machine, pose, full, "mm")
    load = turn.apply(rows.load)
    for name, values in rows.columns.items():
        of = name.rstrip("0123456789")
        if of == "speed":
            unit = f"{machine.joint_units[int(name.removeprefix(of)) - 1]}/s"
        else:
            unit = {"time": "s", "temperature": "degC", "direction": "1"}.get(of.split("_")[0], "N")
        columns[f"{name}[{unit}]"] = load[:, "xyz".index(name[-1])] if of.startswith("load") else values
    return {name: np.char.mod("%.10g", values).astype(float) for name, values in columns.items()}
