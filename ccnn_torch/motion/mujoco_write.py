"""An MJCF with new values of its joints, actuators and bodies."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ccnn_torch.files.write import write_whole
from ccnn_torch.motion.mujoco_motion import Tool, tools_of

# No body is lighter [kg].
_LEAST = 1e-9


def write_mjcf(
    source: str,
    path: Path,
    axes: Sequence[Mapping[str, float]],
    gains: Sequence[float | None],
    added: float,
) -> None:
    """Write a copy of a model with new gains, damping, friction loss, armature, force range and masses.

    Args:
        source: the MJCF.
        path: of the copy; meshes and textures are looked for where they were.
        axes: `gain`, `inertia`, `viscous`, `coulomb`, `weakness` of each actuator's joint, over its gain in `source`.
        gains: those gains [N m/rad].
        added: mass at the tool (that of the last joint, `tools_of`) beyond that of `source` [kg].
    """
    import mujoco

    spec = mujoco.MjSpec.from_file(source)
    model = spec.compile()
    joints = [int(number) for number in model.actuator_trnid[: len(axes), 0]]
    for k, (axis, gain) in enumerate(zip(axes, gains, strict=True)):
        unit = gain or 1.0
        joint = next(j for j in spec.joints if j.id == joints[k])
        dof = int(model.jnt_dofadr[joints[k]])
        actuator = spec.actuators[k]
        # The gain stands for itself and for the position's part of the force.
        actuator.gainprm[0], actuator.biasprm[1] = unit * axis["gain"], -unit * axis["gain"]
        kv = -float(model.actuator_biasprm[k, 2])
        damping = np.asarray(joint.damping, dtype=np.float64)
        new = max(unit * axis["viscous"] - kv, 0.0)
        joint.damping = [new, *damping[1:]] if damping.ndim else new
        joint.frictionloss = unit * axis["coulomb"]
        more = unit * axis["inertia"] - float(model.dof_M0[dof])
        joint.armature = max(float(model.dof_armature[dof]) + more, 0.0)
        if axis["weakness"]:
            most = unit / axis["weakness"]
            actuator.forcelimited, actuator.forcerange = 1, [-most, most]
    if added:
        _loaded(spec, model, tools_of(model, joints)[-1], added)
    spec.modelfiledir = str(Path(source).resolve().parent)
    write_whole(path, spec.to_xml())


def _loaded(spec: Any, model: Any, tool: Tool, added: float) -> None:
    """Give the tool's body the mass, centre and inertia that it has with a point mass."""
    import mujoco

    body = next(b for b in spec.bodies if b.id == tool.body)
    mass, centre, turn = float(model.body_mass[tool.body]), model.body_ipos[tool.body], np.empty(9)
    mujoco.mju_quat2Mat(turn, model.body_iquat[tool.body])
    axes = turn.reshape(3, 3)
    added = max(added, _LEAST - mass)
    between, reduced = tool.place - centre, mass * added / (mass + added)
    inertia = axes @ np.diag(model.body_inertia[tool.body]) @ axes.T
    inertia += reduced * (between @ between * np.eye(3) - np.outer(between, between))
    # No more than is there can be taken away.
    sizes, turned = np.linalg.eigh(inertia)
    inertia = (turned * np.maximum(sizes, _LEAST)) @ turned.T
    body.explicitinertial, body.mass = True, mass + added
    body.ipos = centre + added / (mass + added) * between
    body.fullinertia = inertia[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
