"""A MuJoCo model file as a black-box simulator (Todorov 2012): commands in, the pose at rest out."""

from __future__ import annotations

import copy
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ccnn_torch.coordinates import Parameter
from ccnn_torch.errors import InputError
from ccnn_torch.mechanisms.simulator import Joint, Simulator

__all__ = ["ModelParameter", "mujoco_simulator"]

Array = NDArray[np.float64]

# Fields that may be parameters, with their units about a turning and along a sliding joint, and whether they are >= 0.
_FIELDS: dict[tuple[str, str], tuple[str, str, bool]] = {
    ("joint", "stiffness"): ("N*m/rad", "N/m", True),
    ("joint", "damping"): ("N*m*s/rad", "N*s/m", True),
    ("joint", "frictionloss"): ("N*m", "N", True),
    ("joint", "qpos_spring"): ("rad", "m", False),
    ("body", "mass"): ("kg", "kg", True),
    ("body", "pos"): ("m", "m", False),
    ("body", "ipos"): ("m", "m", False),
    ("geom", "pos"): ("m", "m", False),
    ("site", "pos"): ("m", "m", False),
    ("actuator", "kp"): ("N*m/rad", "N/m", True),
    ("tendon", "stiffness"): ("N/m", "N/m", True),
    ("tendon", "frictionloss"): ("N", "N", True),
}
_AXES = "xyz"
# A pose coordinate as an axis of the wrench that its load is: forces, then moments.
_WRENCH = {name: k for k, name in enumerate(("x", "y", "z", "rx", "ry", "rz"))}
# Between two looks at whether everything stands still [s]; models with other parameters that are kept.
_LOOK, _MODELS = 0.1, 256
# What moves faster than this when the time is over is not at rest [rad/s, m/s].
_MOVING = 1e-2


@dataclass(frozen=True)
class ModelParameter:
    """A number of the model that may be wrong.

    Attributes:
        kind, of: the element, ``joint``, ``body``, ``geom``, ``site``, ``actuator`` or ``tendon``, and its name.
        field: ``stiffness``, ``damping``, ``frictionloss``, ``qpos_spring``, ``mass``, ``pos``, ``ipos``, or ``kp`` of
            a position servo.
        scale: plausible error [SI].
        axis: ``x``, ``y`` or ``z`` of a position.
        cause: as `Parameter.cause`.
    """

    kind: str
    of: str
    field: str
    scale: float
    axis: str | None = None
    cause: str | None = None

    @property
    def name(self) -> str:
        """`shoulder kp`, `tool pos x`."""
        return " ".join(part for part in (self.of, self.field, self.axis) if part)


def mujoco_simulator(
    model: str | Path,
    actuators: Mapping[str, tuple[float, float]],
    measured: str,
    pose: Sequence[str] = ("x", "y", "z"),
    parameters: Sequence[ModelParameter] = (),
    *,
    name: str | None = None,
    approach: float = 0.0,
    ramp: float = 0.5,
    settle: float = 3.0,
    still: float = 1e-9,
    step: float = 1e-3,
    threads: int | None = None,
) -> Simulator:
    """A simulator that commands position servos of a MuJoCo model and reads a site when it has come to rest.

    Loads `load_NAME` along the pose coordinates act on the site in the axes of the world. Without equality constraints
    a row starts at its command, or `approach` before it on the side that `direction1` … tell; with them it starts at
    the first keyframe (or qpos0), where the loops must be closed, and goes to its command on a ramp.

    Args:
        model: MJCF file.
        actuators: by name, in the order q1, q2, …: what they are commanded in as a workspace, low and high [rad, m].
        measured: name of the site whose pose is measured, in the world's frame.
        pose: of x, y, z, rx, ry, rz, phi.
        parameters: of the model that may be wrong.
        name: of the simulator; the file's when None.
        approach: last bit of the way, from which side it comes being told by covariates `direction1` … [rad, m].
        ramp: time of the way [s].
        settle: longest time to wait for rest after it [s].
        still: speed below which it is at rest [rad/s, m/s].
        step: see `Simulator.step`.
        threads: how many rows at once; None = one a processor.

    Raises:
        InputError: MuJoCo is not installed, the model cannot be read, or lacks something that is named here.
    """
    machine = _Machine(Path(model), list(actuators), measured, tuple(pose), tuple(parameters), threads)
    machine.approach, machine.ramp, machine.settle, machine.still = approach, ramp, settle, still
    units = ["rad" if turning else "m" for turning in machine.turning]
    return Simulator(
        name=name or Path(model).stem,
        joints=[
            Joint(f"q{i}", u, *limits) for i, (u, limits) in enumerate(zip(units, actuators.values(), strict=True), 1)
        ],
        pose=tuple(pose),
        simulate=machine,
        parameters=machine.declared(),
        covariates=[*machine.loads, *(f"direction{i + 1}" for i in range(len(units)) if approach)],
        step=step,
        remember=True,
    )


class _Machine:
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
        self.mujoco, self.rollout = _imported(path)
        self.path, self.pose, self.parameters = path, pose, parameters
        self.planar = "".join(axis for axis in _AXES if axis not in pose) if "phi" in pose else ""
        wrench = [_WRENCH["r" + self.planar if c == "phi" else c] for c in pose]
        self.loads = [f"load_{c}" for c in pose]
        self.model = self._compiled(measured, wrench)
        self.site = self._id("site", measured)
        self.actuators = [self._id("actuator", a) for a in actuators]
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
        self._models: dict[bytes, Any] = {}
        self.nominal = np.array([self._read(p) for p in parameters])
        self.width = self.mujoco.mjtState.mjSTATE_FULLPHYSICS

    def _compiled(self, measured: str, wrench: list[int]) -> Any:
        """The model with a motor for each load beside its own, which pushes the measured site along the world's axes."""
        try:
            spec = self.mujoco.MjSpec.from_file(str(self.path))
            ground = spec.worldbody.add_site(name="ccnn_torch ground")
            for axis in wrench:
                gear = np.eye(6)[axis].tolist()
                site = self.mujoco.mjtTrn.mjTRN_SITE
                spec.add_actuator(trntype=site, target=measured, refsite=ground.name, gear=gear)
            return spec.compile()
        except ValueError as reason:
            said = " ".join(str(reason).split())
            raise InputError(f"{self.path}: MuJoCo does not take it: {said}") from None

    def _id(self, kind: str, name: str) -> int:
        found = int(self.mujoco.mj_name2id(self.model, getattr(self.mujoco.mjtObj, f"mjOBJ_{kind.upper()}"), name))
        if found < 0:
            names = [getattr(self.model, kind)(i).name for i in range(getattr(self.model, f"n{_COUNTS[kind]}"))]
            known = ", ".join(n for n in names if n and not n.startswith("ccnn_torch ")) or "none with a name"
            raise InputError(f"{self.path}: has no {kind} '{name}'; it has {known}")
        return found

    def declared(self) -> list[Parameter]:
        """Its parameters with unit and nominal value."""
        found = []
        for p, value in zip(self.parameters, self.nominal.tolist(), strict=True):
            turning, sliding, positive = _FIELDS[p.kind, p.field]
            unit = turning if self._turns(p) else sliding
            found.append(
                Parameter(p.name, unit, value, scale=p.scale, low=0.0 if positive else None, cause=p.cause)
            )
        return found

    def _turns(self, p: ModelParameter) -> bool:
        if p.kind not in ("joint", "actuator"):
            return False
        joint = self._id(p.kind, p.of)
        if p.kind == "actuator":
            joint = int(self.model.actuator_trnid[joint, 0])
        return bool(self.model.jnt_type[joint] == self.mujoco.mjtJoint.mjJNT_HINGE)

    def _cells(self, model: Any, p: ModelParameter) -> list[tuple[Array, int, float]]:
        """Where a parameter stands in a model: array, index in it, sign."""
        if (p.kind, p.field) not in _FIELDS:
            known = ", ".join(f"{kind} {field}" for kind, field in _FIELDS)
            raise InputError(f"{self.path}: '{p.kind} {p.field}' is no parameter; there are {known}")
        element = getattr(model, p.kind)(self._id(p.kind, p.of))
        if p.field == "kp":
            # A position servo: force = kp (command - position) - kv speed.
            return [(element.gainprm, 0, 1.0), (element.biasprm, 1, -1.0)]
        array = getattr(element, p.field)
        if len(array) == 3 and p.axis not in tuple(_AXES):
            raise InputError(f"{self.path}: parameter '{p.name}' is a place; give its axis, x, y or z")
        return [(array, _AXES.index(p.axis) if p.axis and len(array) == 3 else 0, 1.0)]

    def _read(self, p: ModelParameter) -> float:
        array, index, sign = self._cells(self.model, p)[0]
        return float(array[index]) * sign

    def _with(self, values: Array) -> Any:
        """The model with these parameters."""
        key = values.tobytes()
        if key not in self._models:
            if len(self._models) >= _MODELS:
                self._models.clear()
            model = copy.copy(self.model)
            for p, value in zip(self.parameters, values.tolist(), strict=True):
                for array, index, sign in self._cells(model, p):
                    array[index] = sign * value
            # Weights and inertias that follow from what was changed.
            self.mujoco.mj_setConst(model, self.mujoco.MjData(model))
            self._models[key] = model
        return self._models[key]

    def __call__(self, commands: Array, covariates: Mapping[str, Array], parameters: Array) -> Array:
        models = [self._with(row) for row in parameters]
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
        look = max(round(_LOOK / time_step), 1)
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
        """`N x steps x nu`: what is not commanded stands as in the first keyframe, or at 0."""
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
        """Largest speed of each row; time and positions stand before the speeds."""
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
        vector = Rotation.from_matrix(turn).as_rotvec()
        columns = dict(zip(_WRENCH, [*place.T, *vector.T], strict=True))
        if self.planar:
            i, j = ((k + _AXES.index(self.planar)) % 3 for k in (1, 2))
            columns["phi"] = np.arctan2(turn[:, j, i], turn[:, i, i])
        return np.stack([columns[c] for c in self.pose], -1)


_COUNTS = {"joint": "jnt", "body": "body", "geom": "geom", "site": "site", "actuator": "u", "tendon": "tendon"}


def _imported(path: Path) -> tuple[Any, Any]:
    try:
        import mujoco
        from mujoco import rollout
    except ImportError:
        raise InputError(f"{path}: is simulated by MuJoCo: pip install 'ccnn-torch[mujoco]'") from None
    if not path.is_file():
        raise InputError(f"{path}: there is no such file")
    return mujoco, rollout
