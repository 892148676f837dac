"""The five-bar in MuJoCo: bodies, servos, a loop held closed by a constraint, payload and dry friction (Todorov 2012).

An independent simulator as a source of blind cases: it has no notion of effects. A pose is read half a
second after the command has stopped, as one does at a machine: its dry friction creeps.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ccnn_torch.errors import InputError
from ccnn_torch.mechanisms import FiveBar

__all__ = ["Servo", "settled"]

_STEP = 5e-4
_RAMP, _HOLD = 0.2, 0.5
"""Time of the last bit of the way, and of waiting before the pose is read [s]."""
_WAY = 2e-3
"""Length of that last bit [rad]."""
_GRAVITY = 9.80665
# Held as stiffly as MuJoCo lets a constraint be: time constant of two steps, the largest impedance that it takes.
_STIFF = (f'"{2 * _STEP:g} 1"', '"0.9999 0.9999 0.001 0.5 2"')
_CLOSED = f"solref={_STIFF[0]} solimp={_STIFF[1]}"
_STUCK = f"solreffriction={_STIFF[0]} solimpfriction={_STIFF[1]}"


@dataclass(frozen=True)
class Servo:
    """The dynamics of the machine.

    Attributes:
        stiffness: of both servos [N·m/rad].
        friction: dry, at the cranks' axes, `2` [N·m].
        payload: at the tool [kg].
        crank, coupler: masses [kg].
        weight: whether gravity acts, along -y.
    """

    stiffness: float = 1e5
    friction: tuple[float, float] = (0.0, 0.0)
    payload: float = 2.0
    crank: float = 1.0
    coupler: float = 0.5
    weight: bool = False


def settled(
    servo: Servo, parameters: Tensor, command: Tensor, direction: Tensor, load: Tensor
) -> tuple[Tensor, Tensor]:
    """Where the machine is half a second after a command.

    Args:
        servo: its dynamics.
        parameters: of `FiveBar`, as built, `12` [SI].
        command: crank angles commanded, `s x 2` [rad].
        direction: from which side they are approached, `s x 2` [1]; 0 = from above.
        load: force on the tool, `s x 2` [N].

    Returns:
        Position of the tool, `s x 2` [m], and the angles of the cranks there, `s x 2` [rad].

    Raises:
        InputError: MuJoCo is not installed.
    """
    mujoco, rollout = _imported()
    model = mujoco.MjModel.from_xml_string(_xml(servo, parameters))
    way = _WAY * torch.where(direction == 0, 1.0, direction)
    start = command - way
    data, width = mujoco.MjData(model), mujoco.mjtState.mjSTATE_FULLPHYSICS
    state = np.zeros((len(command), mujoco.mj_stateSize(model, width)))
    for row, (angles, elbows) in enumerate(zip(start.tolist(), _elbows(start, parameters).tolist(), strict=True)):
        # The tree is crank 1, coupler 1, crank 2, coupler 2.
        data.qpos[:] = (angles[0], elbows[0] - angles[0], angles[1], elbows[1] - angles[1])
        data.qvel[:] = 0.0
        mujoco.mj_getState(model, data, state[row], width)
    steps = round((_RAMP + _HOLD) / _STEP)
    # Slower towards the end: what arrives at speed swings to the other side of its friction.
    share = 1 - (1 - np.clip(np.arange(1, steps + 1) * _STEP / _RAMP, 0.0, 1.0)[None, :, None]) ** 2
    goal = start.numpy()[:, None] + share * way.numpy()[:, None]
    force = np.broadcast_to(load.numpy()[:, None], goal.shape)
    states, _ = rollout.rollout(model, data, state, np.concatenate([goal, force], axis=-1))
    ends = torch.as_tensor(np.ascontiguousarray(states[:, -1, 1:5]))
    cranks = ends[:, [0, 2]]
    crank, coupler, foot = (parameters[k] for k in (0, 1, slice(2, 4)))
    angle = ends[:, 0] + ends[:, 1]
    tool = foot + crank * _ray(ends[:, 0]) + coupler * _ray(angle)
    return tool, cranks


def _ray(angle: Tensor) -> Tensor:
    return torch.stack([angle.cos(), angle.sin()], dim=-1)


def _elbows(joints: Tensor, parameters: Tensor) -> Tensor:
    """Directions of the couplers in the closed loop, `s x 2` [rad]; gains and offsets of the drives do not enter."""
    body = parameters.clone()
    body[[4, 10]], body[[5, 11]] = 1.0, 0.0
    tool = FiveBar().forward_kinematics(joints, body)
    legs = body.reshape(2, 6)
    elbow = legs[:, 2:4] + legs[:, :1] * _ray(joints)
    along = tool[:, None] - elbow
    return torch.atan2(along[..., 1], along[..., 0])


def _xml(servo: Servo, parameters: Tensor) -> str:
    """MJCF of the machine in the x-y plane."""
    legs = parameters.reshape(2, 6).tolist()
    # Critical damping of about the inertia that a servo sees.
    seen = (servo.payload / 2 + servo.crank + servo.coupler) * legs[0][0] ** 2
    damping = 2 * (servo.stiffness * seen) ** 0.5
    bodies, actuators = "", ""
    for i, (crank, coupler, x, y, _, _) in enumerate(legs, 1):
        bodies += f"""
      <body pos="{x!r} {y!r} 0">
        <joint name="q{i}" axis="0 0 1" frictionloss="{servo.friction[i - 1]!r}" {_STUCK}/>
        <geom type="capsule" size="0.02" fromto="0 0 0 {crank!r} 0 0" mass="{servo.crank!r}"/>
        <body pos="{crank!r} 0 0">
          <joint axis="0 0 1"/>
          <geom type="capsule" size="0.015" fromto="0 0 0 {coupler!r} 0 0" mass="{servo.coupler!r}"/>
          <geom type="sphere" size="0.03" pos="{coupler!r} 0 0" mass="{servo.payload / 2!r}"/>
          <site name="tool{i}" pos="{coupler!r} 0 0"/>
        </body>
      </body>"""
        actuators += f'<position joint="q{i}" kp="{servo.stiffness!r}" kv="{damping!r}"/>'
    for axis in ("1 0 0", "0 1 0"):
        actuators += f'<general site="tool1" refsite="ground" gear="{axis} 0 0 0"/>'
    return f"""
    <mujoco>
      <compiler angle="radian"/>
      <option timestep="{_STEP!r}" integrator="implicitfast" tolerance="1e-12"
              gravity="0 {-_GRAVITY * servo.weight!r} 0"/>
      <default><geom contype="0" conaffinity="0"/></default>
      <worldbody><site name="ground"/>{bodies}</worldbody>
      <equality><connect site1="tool1" site2="tool2" {_CLOSED}/></equality>
      <actuator>{actuators}</actuator>
    </mujoco>"""


def _imported() -> tuple[Any, Any]:
    try:
        import mujoco
        from mujoco import rollout
    except ImportError:
        raise InputError(
            "mechanism 'mujoco_five_bar' is simulated by MuJoCo: pip install 'ccnn-torch[mujoco]'"
        ) from None
    return mujoco, rollout
