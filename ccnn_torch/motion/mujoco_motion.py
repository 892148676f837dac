"""MuJoCo models in motion: as a nominal model, what loads their motors, and the model with what was identified."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ccnn_torch.errors import InputError
from ccnn_torch.files.write import write_whole
from ccnn_torch.mechanisms.simulators.mujoco_model import compiled, mujoco_spec
from ccnn_torch.motion.nominal import Loaded, Nominal

Array = NDArray[np.float64]
# Seconds at the first command before a log begins: the machine rests there.
_SETTLING = 1.0
# Of the Gaussian by which what is measured beside the simulated motion is smoothed [s].
_SMOOTH = 0.02
# Steps of one log, some minutes; numbers that are kept of them, 800 MB.
_MOST_STEPS, _MOST_CELLS = 2e6, 1e8
# A limit of 1/this or more is none.
NONE = 1e-9


class Tool(NamedTuple):
    """Where a payload is: a body, and the point in its frame, `3` [m]."""

    body: int
    place: Array


def tools_of(model: Any, joints: Sequence[int]) -> list[Tool]:
    """Of each joint the tool that it carries: the last site of the last body of its chain, or its centre of mass."""
    import mujoco

    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    moved = [int(model.jnt_bodyid[j]) for j in joints]
    chains = {body: _down(model, body) for body in moved}
    ends = [body for body in moved if not any(body in chain for other, chain in chains.items() if other != body)]
    tools = []
    for body in moved:
        last = next(end for end in ends if body in chains[end])
        fixed = [b for b in range(model.nbody) if model.body_weldid[b] == model.body_weldid[last]]
        sites = [s for s in range(model.nsite) if model.site_bodyid[s] in fixed]
        place = data.site_xpos[sites[-1]] if sites else data.subtree_com[last]
        tools.append(Tool(last, data.xmat[last].reshape(3, 3).T @ (place - data.xpos[last])))
    return tools


def _down(model: Any, body: int) -> list[int]:
    """A body and those that carry it."""
    chain = [body]
    while chain[-1]:
        chain.append(int(model.body_parentid[chain[-1]]))
    return chain


class _Motion(NamedTuple):
    """Of all joints of a model, `s x nq` and `s x nv` twice."""

    position: Array
    speed: Array
    acceleration: Array


def loaded_motion(
    path: str,
    model: Any,
    joints: Sequence[int],
    own: Mapping[str, Array],
    time: Array,
    commands: Array,
    measured: Array | None,
) -> Loaded:
    """Simulate commands.

    Args:
        path: of the model.
        model: of MuJoCo.
        joints: of the actuators, in their order.
        own: parameters of the axes.
        time: of the samples, `s` [s].
        commands: `s x n` [rad or m].
        measured: positions, `s x n`; None: those that are simulated.

    Raises:
        InputError: the simulation has too many steps, or is unstable.
    """
    address, dofs = model.jnt_qposadr[joints], model.jnt_dofadr[joints]
    motion, there = _simulated(path, model, joints, own, time, commands)
    positions, gain = motion.position[:, address], model.actuator_gainprm[: len(joints), 0]
    moved = _Motion(*(part.copy() for part in motion))
    if measured is not None:
        # What is measured is too rough for an acceleration; what it differs by from the simulated motion is smooth.
        for part, places, change in zip(moved, (address, dofs, dofs), _smooth(time, measured - positions), strict=True):
            part[:, places] += change
    before, _ = _resisting(model, joints, own, time, motion)
    after, carried = _resisting(model, joints, own, time, moved)
    return Loaded(positions, there, there + (after - before) / gain, carried / gain)


def _simulated(
    path: str, model: Any, joints: Sequence[int], own: Mapping[str, Array], time: Array, commands: Array
) -> tuple[_Motion, Array]:
    """The motion at the log's samples, and what resists each actuator there beside its joint's friction and inertia,
    over its gain, `s x n`: weights, and the other joints."""
    import mujoco

    data = mujoco.MjData(model)
    address, dofs = model.jnt_qposadr[joints], model.jnt_dofadr[joints]
    data.qpos[address] = commands[0]
    mujoco.mj_forward(model, data)
    step = float(model.opt.timestep)
    count, most = (time[-1] - time[0] + _SETTLING) / step, min(_MOST_STEPS, _MOST_CELLS / (model.nq + 2 * model.nv))
    if count > most:
        raise InputError(
            f"{path}: the simulation of a log would take {count:,.0f} steps of {step:g} s; write an option timestep "
            f"of at least {step * count / most:.2g} s, or shorten the log"
        )
    clock = np.arange(time[0] - _SETTLING, time[-1] + step, step)
    controls = _at(clock, time, commands)
    motion = _Motion(*(np.empty((len(clock), k)) for k in (model.nq, model.nv, model.nv)))
    torque, gain = np.empty_like(controls), model.actuator_gainprm[: len(joints), 0]
    limit = 1 / np.maximum(own["weakness"], NONE)
    for k, control in enumerate(controls):
        motion.position[k], motion.speed[k] = data.qpos, data.qvel
        data.ctrl[:] = control
        mujoco.mj_step(model, data)
        motion.acceleration[k] = (data.qvel - motion.speed[k]) / step
        v = data.qvel[dofs]
        motor = np.clip(control - motion.position[k, address] - own["drive_damping"] * v, -limit, limit)
        # What a joint's own friction takes, up to all that holds it.
        dry = np.clip(-data.qfrc_constraint[dofs] / gain, -own["coulomb"], own["coulomb"])
        passive = (own["viscous"] - own["drive_damping"]) * v + dry
        torque[k] = motor - passive - own["inertia"] * motion.acceleration[k, dofs]
    bad = mujoco.mjtWarning
    if any(data.warning[w].number for w in (bad.mjWARN_BADQPOS, bad.mjWARN_BADQVEL, bad.mjWARN_BADQACC)):
        raise InputError(
            f"{path}: MuJoCo's simulation of a log is unstable at an option timestep of {step:g} s; write a shorter "
            "one, or correct the gains and masses"
        )
    position, speed, acceleration, resisting = (_at(time, clock, table) for table in (*motion, torque))
    return _Motion(position, speed, acceleration), resisting


def _at(time: Array, clock: Array, table: Array) -> Array:
    """Rows of a table at other times."""
    return np.stack([np.interp(time, clock, column) for column in table.T], -1)


def _smooth(time: Array, values: Array) -> tuple[Array, Array, Array]:
    """Values without what is fast, and their first two derivatives, `s x n` each."""
    from scipy.ndimage import gaussian_filter1d

    step = float(np.median(np.diff(time)))
    clock = np.arange(time[0], time[-1] + step, step)
    even = gaussian_filter1d(_at(clock, time, values), _SMOOTH / step, axis=0)
    speed = np.gradient(even, step, axis=0)
    return _at(time, clock, even), _at(time, clock, speed), _at(time, clock, np.gradient(speed, step, axis=0))


def _resisting(
    model: Any, joints: Sequence[int], own: Mapping[str, Array], time: Array, motion: _Motion
) -> tuple[Array, Array]:
    """Torques of weights, springs and the other joints on a motion, and of 1 kg at the tool, `s x n` each [N m]."""
    import mujoco

    data, dofs, tools = mujoco.MjData(model), model.jnt_dofadr[joints], tools_of(model, joints)
    torque, jacobian, whole = np.empty((len(time), len(joints))), np.empty((3, model.nv)), np.empty(model.nv)
    # Of each tool what its point moves by with each joint, and its speed.
    bent, speed = np.empty((len(time), len(joints), 3)), np.empty((len(time), len(joints), 3))
    for k in range(len(time)):
        data.qpos, data.qvel, data.qacc = motion.position[k], motion.speed[k], motion.acceleration[k]
        for stage in (mujoco.mj_kinematics, mujoco.mj_comPos, mujoco.mj_comVel, mujoco.mj_passive):
            stage(model, data)
        mujoco.mj_rne(model, data, 1, whole)
        whole += model.dof_armature * data.qacc - data.qfrc_spring - data.qfrc_gravcomp
        torque[k] = whole[dofs]
        for i, tool in enumerate(tools):
            if i == 0 or tool.body != tools[i - 1].body:
                point = data.xpos[tool.body] + data.xmat[tool.body].reshape(3, 3) @ tool.place
                mujoco.mj_jac(model, data, jacobian, None, point, tool.body)
            bent[k, i], speed[k, i] = jacobian[:, dofs[i]], jacobian @ data.qvel
    gain = model.actuator_gainprm[: len(joints), 0]
    pulled = np.gradient(speed, time, axis=0) - model.opt.gravity
    return torque - own["inertia"] * gain * motion.acceleration[:, dofs], (bent * pulled).sum(-1)


def mujoco_nominal(path: str, keys: Mapping[str, Any], units: Sequence[str]) -> Nominal:
    """The model of an MJCF whose actuators hold the positions of joints, one for each command in their order.

    Raises:
        InputError: MuJoCo is not installed, the model cannot be read, or it has other actuators.
    """
    if keys:
        raise InputError(f"mechanism_keys: an MJCF takes none, and {', '.join(keys)} was given; write it in {path}")
    mujoco, spec = mujoco_spec(path)
    free = _hold_base(mujoco, spec, compiled(mujoco, path, spec))
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
        notes=(
            f"{Path(path).name}: simulated from rest at each log's first command",
            *(
                f"{Path(path).name}: '{body}' is free, and was held in mid-air; so must it be in the logs"
                for body in free
            ),
        ),
    )


def _hold_base(mujoco: Any, spec: Any, model: Any) -> list[str]:
    """Fix bodies that carry actuators and are free, which no log tells the pose of, in mid-air; their names."""
    moved = {body for joint in model.actuator_trnid[:, 0] for body in _down(model, int(model.jnt_bodyid[joint]))}
    free = [j for j in spec.joints if j.type == mujoco.mjtJoint.mjJNT_FREE and model.jnt_bodyid[j.id] in moved]
    names = [joint.parent.name for joint in free]
    if free:
        spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
    # A keyframe has a place for the pose of each.
    for element in (*free, *(spec.keys if free else ())):
        spec.delete(element)
    return names


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

    spec, held = mujoco.MjSpec.from_file(source), mujoco.MjSpec.from_file(source)
    full = spec.compile()
    # What is identified is what an axis has while its base is held.
    _hold_base(mujoco, held, held.compile())
    model = held.compile()
    joints = [int(number) for number in model.actuator_trnid[: len(axes), 0]]
    for k, (axis, gain) in enumerate(zip(axes, gains, strict=True)):
        unit = gain or 1.0
        joint = next(j for j in spec.joints if j.id == full.actuator_trnid[k, 0])
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
    # MuJoCo takes one form of it: what an <inertial> of the file has, diagonal and turned, goes.
    body.inertia, body.ialt.type = np.zeros(3), mujoco.mjtOrientation.mjORIENTATION_QUAT
    body.fullinertia = inertia[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
