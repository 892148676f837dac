"""An MJCF with new values of its joints, actuators and bodies."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from ccnn_torch.files.write import write_whole

# No body is lighter [kg].
_LEAST = 1e-9


def write_mjcf(
    source: str,
    path: Path,
    axes: Sequence[Mapping[str, float]],
    gains: Sequence[float | None],
    added: Sequence[float],
    levers: Sequence[float | None],
) -> None:
    """Write a copy of a model with new gains, damping, friction loss, armature, force range and masses.

    Args:
        source: the MJCF.
        path: of the copy; meshes and textures are looked for where they were.
        axes: `gain`, `inertia`, `viscous`, `coulomb`, `weakness` of each actuator's joint, over its gain in `source`.
        gains: those gains [N m/rad].
        added: mass that is added to the body that the joint moves, at its centre of mass [kg].
        levers: from the joint to there [m].
    """
    import mujoco

    spec = mujoco.MjSpec.from_file(source)
    model = spec.compile()
    for k, (axis, gain, mass, lever) in enumerate(zip(axes, gains, added, levers, strict=True)):
        unit = gain or 1.0
        number = int(model.actuator_trnid[k, 0])
        joint = next(j for j in spec.joints if j.id == number)
        dof = int(model.jnt_dofadr[number])
        body = int(model.jnt_bodyid[number])
        actuator = spec.actuators[k]
        # The gain stands for itself and for the position's part of the force.
        actuator.gainprm[0], actuator.biasprm[1] = unit * axis["gain"], -unit * axis["gain"]
        kv = -float(model.actuator_biasprm[k, 2])
        damping = np.asarray(joint.damping, dtype=np.float64)
        new = max(unit * axis["viscous"] - kv, 0.0)
        joint.damping = [new, *damping[1:]] if damping.ndim else new
        joint.frictionloss = unit * axis["coulomb"]
        if mass:
            own = next(b for b in spec.bodies if b.id == body)
            own.explicitinertial, own.mass = True, max(float(model.body_mass[body]) + mass, _LEAST)
            own.ipos, own.iquat = model.body_ipos[body], model.body_iquat[body]
            # A point mass at the centre leaves the inertia about it as it is.
            own.inertia = model.body_inertia[body]
        more = unit * axis["inertia"] - float(model.dof_M0[dof]) - mass * (lever or 0.0) ** 2
        joint.armature = max(float(model.dof_armature[dof]) + more, 0.0)
        if axis["weakness"]:
            most = unit / axis["weakness"]
            actuator.forcelimited, actuator.forcerange = 1, [-most, most]
    spec.modelfiledir = str(Path(source).resolve().parent)
    write_whole(path, spec.to_xml())
