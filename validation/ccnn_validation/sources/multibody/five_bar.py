"""The planar five-bar in MuJoCo: two chains of crank and coupler whose ends are one point; y points up."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from scipy.spatial.transform import Rotation

from ccnn_validation.sources.multibody.arrays import Array
from ccnn_validation.sources.multibody.build import Build, document, drive_joints, inertia, placed
from ccnn_validation.sources.multibody.machine import Machine

__all__ = ["five_bar"]


def five_bar(crank: float = 0.75, coupler: float = 1.1, foot: float = 0.5) -> Machine:
    """The machine with cranks, couplers and feet of these lengths [m]."""
    lengths: dict[str, float] = {}
    for leg, x in ((1, -foot), (2, foot)):
        lengths |= {f"l{leg}": crank, f"L{leg}": coupler, f"A{leg}x": x, f"A{leg}y": 0.0}

    def model(build: Build) -> str:
        now = {**lengths, **build.lengths}
        bodies = "".join(_leg(leg, now, build) for leg in (1, 2))
        return document(bodies, [("end1", "end2")], 2, build, (0.0, -1.0, 0.0))

    def start(joints: Array, pose: Array) -> Mapping[str, Array]:
        feet = np.array([[-foot, 0.0], [foot, 0.0]])
        elbow = feet + crank * np.stack([np.cos(joints), np.sin(joints)], -1)
        rest = pose[:, None, :] - elbow
        turned = np.arctan2(rest[..., 1], rest[..., 0]) - joints
        return {"q1": joints[:, 0], "q2": joints[:, 1], "elbow1": turned[:, 0], "elbow2": turned[:, 1]}

    return Machine(
        name="five_bar",
        mechanism="five_bar",
        keys={"l": crank, "L": coupler, "a": foot},
        units=("rad", "rad"),
        pose=("x", "y"),
        low=None,
        high=None,
        lengths=lengths,
        model=model,
        start=start,
        stiff=np.array([3e5, 3e5]),
        reach=crank + coupler,
    )


def _leg(leg: int, now: Mapping[str, float], build: Build) -> str:
    """Crank and coupler of a leg; the first one's coupler carries the tool."""
    crank, coupler = now[f"l{leg}"], now[f"L{leg}"]
    carried, heavy = inertia(6.0, (0.4 * crank, 0.0, 0.0), build)
    _, light = inertia(3.0, (0.5 * coupler, 0.0, 0.0), build)
    end = (coupler, 0.0, 0.0)
    tool = ""
    if leg == 1:
        # The tool does not turn with the coupler in the records: its shift is not asked for on this machine.
        tool = f'<site name="tool" {placed(end)}/>'
        if build.payload:
            tool += f"<body {placed(end)}>{inertia(build.payload, (0.0, 0.0, 0.0), build)[1]}</body>"
    return (
        f"<body {placed((now[f'A{leg}x'], now[f'A{leg}y'], 0.0), Rotation.identity())} {carried}>{heavy}"
        f"{drive_joints(leg - 1, (0.0, 0.0, 1.0), build)}"
        f'<body {placed((crank, 0.0, 0.0))} {carried}>{light}<joint name="elbow{leg}" axis="0 0 1"/>'
        f'<site name="end{leg}" {placed(end)}/>{tool}</body></body>'
    )
