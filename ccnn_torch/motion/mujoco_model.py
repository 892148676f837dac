"""An MJCF with position actuators as a nominal model."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ccnn_torch.errors import InputError
from ccnn_torch.mechanisms.simulators.mujoco_model import compiled, mujoco_spec
from ccnn_torch.motion.mujoco_motion import NONE, loaded_motion
from ccnn_torch.motion.nominal import Nominal

Array = NDArray[np.float64]


def mujoco_nominal(path: str, keys: Mapping[str, Any], units: Sequence[str]) -> Nominal:
    """The model of an MJCF whose actuators hold the positions of joints, one for each command in their order.

    Raises:
        InputError: MuJoCo is not installed, the model cannot be read, or it has other actuators.
    """
    if keys:
        raise InputError(f"mechanism_keys: an MJCF takes none, and {', '.join(keys)} was given; write it in {path}")
    mujoco, spec = mujoco_spec(path)
    model = compiled(mujoco, path, spec)
    held = [k for k in range(model.nu) if model.actuator_trntype[k] == mujoco.mjtTrn.mjTRN_JOINT]
    position = [k for k in held if model.actuator_biasprm[k, 1] < 0 and model.actuator_gainprm[k, 0] > 0]
    if len(position) != model.nu or model.nu != len(units):
        raise InputError(
            f"{path}: has {model.nu} actuators, {len(position)} of which hold the position of a joint, and the logs "
            f"have {len(units)} commands; give it one <position joint=…/> for each command, in their order"
        )
    joints = [int(model.actuator_trnid[k, 0]) for k in position]
    own = ["m" if model.jnt_type[j] == mujoco.mjtJoint.mjJNT_SLIDE else "rad" for j in joints]
    if own != list(units):
        raise InputError(f"{path}: its joints are in {', '.join(own)}, and the logs in {', '.join(units)}")
    if any(model.actuator_gear[k, 0] != 1 for k in position):
        raise InputError(f"{path}: an actuator has a gear; give it gear 1, so that its command is the joint's position")
    dofs = [int(model.jnt_dofadr[j]) for j in joints]
    gain, limit = model.actuator_gainprm[position, 0], model.actuator_forcerange[position, 1]
    values = {
        "inertia": model.dof_M0[dofs] / gain,
        "load": (model.dof_M0[dofs] - model.dof_armature[dofs]) / gain,
        "viscous": (model.dof_damping[dofs] - model.actuator_biasprm[position, 2]) / gain,
        "drive_damping": -model.actuator_biasprm[position, 2] / gain,
        "coulomb": model.dof_frictionloss[dofs] / gain,
        "weakness": model.actuator_forcelimited[position] * gain / np.maximum(limit, NONE),
    }
    return Nominal(
        path,
        tuple({name: float(v[i]) for name, v in values.items() if v[i]} for i in range(len(joints))),
        tuple(gain.tolist()),
        (None,) * len(joints),
        heaviest=float(model.body_mass.sum()),
        loaded=lambda time, commands, measured: loaded_motion(path, model, joints, values, time, commands, measured),
        notes=(f"{Path(path).name}: simulated from rest at each log's first command",),
    )
