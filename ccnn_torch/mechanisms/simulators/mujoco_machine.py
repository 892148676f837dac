"""A MuJoCo model that is commanded and loaded until it is at rest."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ccnn_torch.errors import InputError
from ccnn_torch.mechanisms.simulators.mujoco_file import compiled, mujoco_spec
from ccnn_torch.mechanisms.simulators.mujoco_parameters import Array, ModelNumbers, ModelParameter
from ccnn_torch.numerics.rotations import matrix_to_rotation_vector

_AXES = "xyz"
# A pose coordinate as an axis of the wrench that its load is: forces, then moments.
_WRENCH = {name: k for k, name in enumerate(("x", "y", "z", "rx", "ry", "rz"))}
# Time between two checks of whether everything is at rest [s].
_LOOK = 0.1
# What moves faster than this when the time is over is not at rest [rad/s, m/s].
_MOVING = 1e-2


class MujocoMachine:
    """The model with what is commanded, pushed and measured; a callable as `Simulator.simulate`."""

    approach = ramp = settle = still = 0.0

    def __init__(
        self,
        path: Path,
        actuators: list[str],
        measured: str,
        pose: tuple[str, ...],
        parameters: tuple[ModelParameter, ...],
        threads: int | None,
    ) -> None:
        """See `mujoco_simulator`."""
        self.mujoco, spec = mujoco_spec(path)
        from mujoco import rollout

        self.rollout = rollout
        self.path, self.pose = path, pose
        self.planar = "".join(axis for axis in _AXES if axis not in pose) if "phi" in pose else ""
        strange = [c for c in pose if c not in _WRENCH and (c != "phi" or len(self.planar) != 1)]
        if strange:
            raise InputError(
                f"{path}: pose: '{strange[0]}' is none of x, y, z, rx, ry, rz, or phi beside two of x, y, z"
            )
        wrench = [_WRENCH["r" + self.planar if c == "phi" else c] for c in pose]
        self.loads = [f"load_{c}" for c in pose]
        self.model = self._compiled(spec, measured, wrench)
        self.numbers = ModelNumbers(self.mujoco, path, self.model, parameters)
        self.site = self.numbers.element("site", measured)
        self.actuators = [self.numbers.element("actuator", a) for a in actuators]
        joints = [int(self.model.actuator_trnid[a, 0]) for a in self.actuators]
        for a, actuator in enumerate(self.actuators):
            if self.model.actuator_trntype[actuator] != self.mujoco.mjtTrn.mjTRN_JOINT:
                raise InputError(f"{path}: actuator '{actuators[a]}' must drive a joint")
        self.turning = [self.model.jnt_type[j] == self.mujoco.mjtJoint.mjJNT_HINGE for j in joints]
        self.places = self.model.jnt_qposadr[joints]
        self.gear = self.model.actuator_gear[self.actuators, 0]
        self.extra = np.arange(self.model.nu - len(self.loads), self.model.nu)
        self.home = np.array(self.model.key_qpos[0] if self.model.nkey else self.model.qpos0)
        count = threads or len(os.sched_getaffinity(0))
        self.data = [self.mujoco.MjData(self.model) for _ in range(count)]
        self.width = self.mujoco.mjtState.mjSTATE_FULLPHYSICS

    def _compiled(self, spec: Any, measured: str, wrench: list[int]) -> Any:
        """The model with a motor more for each load, which pushes the measured site along an axis of the world."""
        if not any(site.name == measured for site in spec.sites):
            names = ", ".join(site.name for site in spec.sites if site.name) or "none with a name"
            raise InputError(f"{self.path}: has no site '{measured}'; it has {names}")
        ground = spec.worldbody.add_site(name="ccnn_torch ground")
        for axis in wrench:
            gear = np.eye(6)[axis].tolist()
            site = self.mujoco.mjtTrn.mjTRN_SITE
            spec.add_actuator(trntype=site, target=measured, refsite=ground.name, gear=gear)
        return compiled(self.mujoco, self.path, spec)

    def __call__(self, commands: Array, covariates: Mapping[str, Array], parameters: Array) -> Array:
        """As `Simulator.simulate`."""
        models = [self.numbers.model_with(row) for row in parameters]
        loads = np.stack([covariates[name] for name in self.loads], -1)
        side = np.zeros_like(commands)
        if self.approach:
            side = np.stack([covariates[f"direction{i + 1}"] for i in range(commands.shape[1])], -1)
        qpos = np.repeat(self.home[None], len(commands), 0)
        begin = qpos[:, self.places] * self.gear
        if not self.model.neq:
            begin = commands - self.approach * side
            qpos[:, self.places] = begin / self.gear
        state = self._states(qpos)
        time_step = float(self.model.opt.timestep)
        way = round(self.ramp / time_step) if np.any(begin != commands) else 0
        if way:
            share = np.linspace(0.0, 1.0, way + 1)[1:]
            share = (share * share * (3 - 2 * share))[:, None]
            control = self._control(begin[:, None] + share * (commands - begin)[:, None], loads[:, None])
            state = self._moved(models, state, control)
        look = max(round(min(_LOOK, self.settle) / time_step), 1)
        hold = self._control(commands[:, None], loads[:, None])
        moving = np.arange(len(commands))
        for _ in range(max(round(self.settle / _LOOK), 1)):
            held = np.repeat(hold[moving], look, 1)
            state[moving] = self._moved([models[i] for i in moving], state[moving], held)
            moving = moving[self._speed(state[moving]) > self.still]
            if len(moving) == 0:
                break
        self._refuse_moving(commands, state)
        return self._read_poses(models, state)

    def _control(self, commands: Array, loads: Array) -> Array:
        """`N x steps x nu`: what is not commanded is as in the first keyframe, or 0."""
        rows, steps = np.broadcast_shapes(commands.shape[:2], loads.shape[:2])
        control = np.zeros((rows, steps, self.model.nu))
        if self.model.nkey:
            control[:] = self.model.key_ctrl[0]
        control[..., self.actuators] = commands
        control[..., self.extra] = loads
        return control

    def _states(self, qpos: Array) -> Array:
        data = self.data[0]
        state = np.zeros((len(qpos), self.mujoco.mj_stateSize(self.model, self.width)))
        self.mujoco.mj_resetData(self.model, data)
        for row, q in enumerate(qpos):
            data.qpos[:] = q
            self.mujoco.mj_getState(self.model, data, state[row], self.width)
        return state

    def _moved(self, models: list[Any], state: Array, control: Array) -> Array:
        states, _ = self.rollout.rollout(models, self.data, state, control)
        return np.array(states[:, -1])

    def _speed(self, state: Array) -> Array:
        """Largest speed of each row; time and positions come before the speeds."""
        start = 1 + self.model.nq
        speed: Array = np.abs(state[:, start : start + self.model.nv]).max(-1, initial=0.0)
        return speed

    def _refuse_moving(self, commands: Array, state: Array) -> None:
        speed = np.nan_to_num(self._speed(state), nan=np.inf)
        worst = int(speed.argmax())
        if speed[worst] > _MOVING:
            at = ", ".join(f"q{i} = {q:.4g}" for i, q in enumerate(commands[worst], 1))
            raise InputError(
                f"{self.path}: is not at rest {self.settle:g} s after the command {at} (it moves at {speed[worst]:.2g} "
                "rad/s or m/s): give its joints more damping, make settle longer, the time step shorter, or the "
                "workspace narrower"
            )

    def _read_poses(self, models: list[Any], state: Array) -> Array:
        data = self.data[0]
        place, turn = np.empty((len(state), 3)), np.empty((len(state), 3, 3))
        for row, model in enumerate(models):
            data.qpos[:] = state[row, 1 : 1 + self.model.nq]
            self.mujoco.mj_kinematics(model, data)
            place[row] = data.site_xpos[self.site]
            turn[row] = data.site_xmat[self.site].reshape(3, 3)
        vector = matrix_to_rotation_vector(torch.from_numpy(turn)).numpy()
        columns = dict(zip(_WRENCH, [*place.T, *vector.T], strict=True))
        if self.planar:
            i, j = ((k + _AXES.index(self.planar)) % 3 for k in (1, 2))
            columns["phi"] = np.arctan2(turn[:, j, i], turn[:, i, i])
        return np.stack([columns[c] for c in self.pose], -1)
