"""An MJCF with position actuators as a nominal model."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ccnn_torch.errors import InputError
from ccnn_torch.files.read import CONFIG_LIMIT, read_text
from ccnn_torch.motion.simulators import Simulator

__all__ = ["is_mjcf", "mujoco_simulator"]

Array = NDArray[np.float64]
# Seconds at the first command before a log begins: the machine rests there.
_SETTLING = 1.0


def is_mjcf(path: Path) -> bool:
    """Whether an XML file is a MuJoCo model."""
    return "<mujoco" in read_text(str(path), CONFIG_LIMIT, "write an MJCF")


def mujoco_simulator(path: str, keys: Mapping[str, Any], units: Sequence[str]) -> Simulator:
    """The simulator of an MJCF whose actuators hold the positions of joints, one for each command in their order.

    Raises:
        InputError: MuJoCo is not installed, the model cannot be read, or it has other actuators.
    """
    try:
        import mujoco
    except ImportError:
        raise InputError(f"{path}: a MuJoCo model needs MuJoCo; pip install 'ccnn-torch[mujoco]'") from None
    if keys:
        raise InputError(f"mechanism_keys: an MJCF takes none, and {', '.join(keys)} was given; write it in {path}")
    try:
        model = mujoco.MjModel.from_xml_path(path)
    except ValueError as error:
        raise InputError(f"{path}: is no model that MuJoCo reads: {str(error).splitlines()[0]}") from None
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
    address = [int(model.jnt_qposadr[j]) for j in joints]

    def simulate(time: Array, commands: Array, parameters: dict[str, float]) -> Array:
        data = mujoco.MjData(model)
        data.qpos[address] = commands[0]
        mujoco.mj_forward(model, data)
        step = float(model.opt.timestep)
        clock = np.arange(time[0] - _SETTLING, time[-1] + step, step)
        controls = np.stack([np.interp(clock, time, c) for c in commands.T], -1)
        found = np.empty_like(controls)
        for k, control in enumerate(controls):
            found[k] = data.qpos[address]
            data.ctrl[:] = control
            mujoco.mj_step(model, data)
        return np.stack([np.interp(time, clock, q) for q in found.T], -1)

    notes = (f"{Path(path).name}: simulated from rest at each log's first command",)
    return Simulator(path, simulate, {}, notes)
