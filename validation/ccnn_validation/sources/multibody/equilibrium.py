"""Where a MuJoCo machine comes to rest: all forces in balance and all loops closed, by Newton's method.

Forces, Jacobians and loops are MuJoCo's; only the search for rest is not left to its time steps, whose soft loops and
creeping friction would cost more than the noise. Friction, play and damping are those that stand in the model.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import mujoco
import numpy as np

from ccnn_validation.sources.multibody.arrays import Array

__all__ = ["Rest", "settle"]

_ROUNDS = 60
# After these rounds a link that balances between its flanks stays on one.
_CHOOSING = 15
# In rad and m: far below all noise, and above the rounding of forces in stiff servos.
_STILL = 1e-11
# A link's own bearing holds it against pushes as small as rounding makes in stiff servos [N*m, N].
_HOLD = 1e-3
# What keeps the system solvable where a loop is closed twice, as across the plane of a planar machine.
_SLACK = 1e-13


@dataclass(frozen=True)
class Rest:
    """Machines at rest.

    Attributes:
        position: of the tool, `s x 3` [m].
        rotation: of the tool, `s x 3 x 3`.
        joints: all joints of the model, `s x v`.
    """

    position: Array
    rotation: Array
    joints: Array


def settle(
    model: mujoco.MjModel,
    commands: Array,
    start: Array,
    load: Array | None = None,
    motion: Array | None = None,
    speed: Array | None = None,
    vary: Callable[[int], None] | None = None,
) -> Rest:
    """Solve for rest, row by row of commands.

    Args:
        model: with joints of one degree of freedom, actuators in the order of the commands, and a site `tool`.
        commands: of the servos, `s x n` [rad, m].
        start: all joints, near to the answer, `s x v`.
        load: force and moment on the tool in the world's axes, `s x 6` [N, N*m].
        motion: sign of each drive's last motion, `s x n`: dry friction acts against it, play lags behind it.
        speed: of the drives, `s x n` [rad/s, m/s]: they move evenly, and viscous damping acts against it.
        vary: changes the model to that of a row.

    Raises:
        RuntimeError: no rest was found.
    """
    data, joints = mujoco.MjData(model), start.copy()
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_LIMIT | mujoco.mjtDisableBit.mjDSBL_FRICTIONLOSS
    drive = model.actuator_trnid[:, 0]
    held = np.zeros(start.shape)
    if motion is not None:
        held[:, drive] -= model.dof_frictionloss[drive] * motion
    if speed is not None:
        held[:, drive] -= model.dof_damping[drive] * speed
    play, behind = _play(model, drive)
    half = model.jnt_range[play, 1]
    if len(play):
        joints[:, play] = 0.0 if motion is None else -half * motion[:, behind]
    for number in range(_ROUNDS):
        force, stiffness, gap, slope = _balance(model, data, commands, joints, load, vary)
        force = force + held
        step, pull = _newton(force, stiffness, gap, slope, play)
        joints += step
        flank = joints[:, play]
        if len(play) and number < _CHOOSING:
            # What weight, load and loops push with decides the flank, unless the friction of the link holds it.
            pushed = (force + (slope.swapaxes(1, 2) @ pull[..., None])[..., 0])[:, play]
            flank = np.where(np.abs(pushed) > _HOLD, half * np.sign(pushed), flank)
        moved = max(np.abs(step).max(), np.abs(flank - joints[:, play]).max(initial=0.0))
        joints[:, play] = flank
        if moved < _STILL:
            return _tool(model, data, joints, vary)
    raise RuntimeError(f"no rest was found: the last step was {moved:.1e}")


def _play(model: mujoco.MjModel, drive: Array) -> tuple[Array, Array]:
    """Joints that are play, `k`, and the number of the drive before each, `k`."""
    names = [model.joint(i).name for i in range(model.njnt)]
    play = [i for i, name in enumerate(names) if name.startswith("play")]
    behind = [int(np.flatnonzero(drive == names.index(names[i].replace("play", "q")))[0]) for i in play]
    return np.array(play, dtype=int), np.array(behind, dtype=int)


def _balance(
    model: mujoco.MjModel,
    data: mujoco.MjData,
    commands: Array,
    joints: Array,
    load: Array | None,
    vary: Callable[[int], None] | None,
) -> tuple[Array, Array, Array, Array]:
    """Forces `s x v`, stiffness `s x v x v`, gaps of the loops `s x c` and their slopes `s x c x v`.

    One row after the other, as MuJoCo's function takes one state.
    """
    rows, size = joints.shape
    tool = model.site("tool")
    forces, stiffness, gaps, slopes = np.empty((rows, size)), np.zeros((rows, size, size)), [], []
    drive = model.actuator_trnid[:, 0]
    for row in range(rows):
        if vary is not None:
            vary(row)
        data.qpos[:], data.qvel[:], data.ctrl[:] = joints[row], 0.0, commands[row]
        mujoco.mj_fwdPosition(model, data)
        mujoco.mj_fwdVelocity(model, data)
        mujoco.mj_fwdActuation(model, data)
        applied = np.zeros(size)
        if load is not None:
            body = int(tool.bodyid[0])
            mujoco.mj_applyFT(model, data, load[row, :3], load[row, 3:], data.site_xpos[tool.id], body, applied)
        forces[row] = data.qfrc_passive + data.qfrc_actuator + applied - data.qfrc_bias
        own = stiffness[row]
        own[drive, drive] = model.actuator_gainprm[:, 0]
        own[np.diag_indices(size)] += model.jnt_stiffness
        for number in range(model.ntendon):
            low, high = model.tendon_lengthspring[number]
            if not low <= data.ten_length[number] <= high:
                across = _tendon_slope(model, data, number)
                own += model.tendon_stiffness[number] * np.outer(across, across)
        gaps.append(data.efc_pos[: data.ne].copy())
        slopes.append(np.array(data.efc_J).reshape(-1, size)[: data.ne].copy())
    return forces, stiffness, np.array(gaps).reshape(rows, -1), np.array(slopes).reshape(rows, -1, size)


def _tendon_slope(model: mujoco.MjModel, data: mujoco.MjData, number: int) -> Array:
    """Length of a tendon by all joints, `v`."""
    dense = np.zeros(model.nv)
    begin, count = int(model.ten_J_rowadr[number]), int(model.ten_J_rownnz[number])
    columns = np.array(model.ten_J_colind).ravel()[begin : begin + count]
    dense[columns] = np.array(data.ten_J).ravel()[begin : begin + count]
    return dense


def _newton(force: Array, stiffness: Array, gap: Array, slope: Array, fixed: Array) -> tuple[Array, Array]:
    """Steps of the joints, `s x v`, and forces in the loops, `s x c`; fixed joints do not move."""
    rows, size = force.shape
    loops = gap.shape[1]
    # Forces in units of the stiffest drive, so that servos of any stiffness keep the matrix well scaled.
    scale = stiffness.max(axis=(1, 2))
    whole = np.zeros((rows, size + loops, size + loops))
    whole[:, :size, :size] = stiffness / scale[:, None, None]
    whole[:, :size, size:] = -slope.swapaxes(1, 2)
    whole[:, size:, :size] = slope
    whole[:, np.arange(size, size + loops), np.arange(size, size + loops)] = _SLACK
    right = np.concatenate([force / scale[:, None], -gap], axis=1)
    whole[:, fixed, :] = 0.0
    whole[:, fixed, fixed] = 1.0
    right[:, fixed] = 0.0
    found = np.linalg.solve(whole, right[..., None])[..., 0]
    return found[:, :size], found[:, size:] * scale[:, None]


def _tool(model: mujoco.MjModel, data: mujoco.MjData, joints: Array, vary: Callable[[int], None] | None) -> Rest:
    """The tool's frame of all rows."""
    position, rotation = np.empty((len(joints), 3)), np.empty((len(joints), 3, 3))
    tool = model.site("tool").id
    for row, state in enumerate(joints):
        if vary is not None:
            vary(row)
        data.qpos[:] = state
        mujoco.mj_kinematics(model, data)
        position[row], rotation[row] = data.site_xpos[tool], data.site_xmat[tool].reshape(3, 3)
    return Rest(position, rotation, joints)
