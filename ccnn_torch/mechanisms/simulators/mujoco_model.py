"""A MuJoCo model file as a black-box simulator (Todorov 2012): commands in, the pose at rest out."""

from __future__ import annotations

import copy
import math
import os
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element

import numpy as np
import torch
from numpy.typing import NDArray

from ccnn_torch.coordinates import Parameter
from ccnn_torch.display import visible
from ccnn_torch.errors import InputError
from ccnn_torch.files.read import CONFIG_LIMIT, read_xml
from ccnn_torch.mechanisms.simulators.simulator import Joint, Simulator
from ccnn_torch.numerics.rotations import matrix_to_rotation_vector

# Machines have some tens of bodies; MuJoCo's memory for a step fails from some thousands.
_MOST_BODIES = 500
# Points of a height field, pixels of a texture.
_MOST_POINTS = 20_000_000
# Beyond any stiffness, mass or length of a machine in SI; a range may be wider.
_LARGEST = 1e12
# Of the time step [s]: MuJoCo's default is 0.002, and 0.01 is coarse.
_STEPS = (1e-5, 0.1)
# Attributes whose product is how many points or bodies an element makes.
_SIZES = {
    "hfield": ("nrow", "ncol"),
    "texture": ("width", "height"),
    "replicate": ("count",),
    "composite": ("count",),
    "flexcomp": ("count",),
}


def mujoco_spec(path: str | Path) -> tuple[Any, Any]:
    """MuJoCo, and the specification in an MJCF, to be changed and compiled by `compiled`.

    Raises:
        InputError: MuJoCo is not installed or does not take the file, a number is none or beyond any machine, it has
            too many bodies or points, or its time step is out of range.
    """
    try:
        import mujoco
    except ImportError:
        raise InputError(f"{path}: is simulated by MuJoCo: pip install 'ccnn-torch[mujoco]'") from None
    _check_text(Path(path))
    with _taken(mujoco, path):
        spec = mujoco.MjSpec.from_file(str(path))
    step = float(spec.option.timestep)
    if not _STEPS[0] <= step <= _STEPS[1]:
        raise InputError(f"{path}: option timestep is {step:g} s; write one from {_STEPS[0]:g} to {_STEPS[1]:g}")
    return mujoco, spec


def compiled(mujoco: Any, path: str | Path, spec: Any) -> Any:
    """The model of a specification.

    Raises:
        InputError: MuJoCo does not take it, or it is too large for a step.
    """
    with _taken(mujoco, path):
        model = spec.compile()
        mujoco.mj_forward(model, mujoco.MjData(model))
    return model


@contextmanager
def _taken(mujoco: Any, path: str | Path) -> Iterator[None]:
    try:
        with warnings.catch_warnings():
            # Of an inertia that no body has: what it then gives is no motion.
            warnings.filterwarnings("error", ".*Check model")
            yield
    except (ValueError, mujoco.FatalError, UserWarning) as reason:
        raise InputError(f"{path}: MuJoCo does not take it: {' '.join(str(reason).split())}") from None


def _check_text(path: Path) -> None:
    """Numbers and sizes of a file and those that it includes, before MuJoCo makes anything of them."""
    files, bodies = [path], 0
    for file in files:
        # Deep models would end the recursion of Python: elements wait in a list, with how often they are made.
        waiting = [(read_xml(str(file), CONFIG_LIMIT, "give the path of an MJCF"), 1)]
        while waiting:
            element, times = waiting.pop()
            _check_numbers(file, element)
            points = _points(element)
            bodies += times * (points if element.tag in ("composite", "flexcomp") else element.tag == "body")
            times *= points if element.tag == "replicate" else 1
            if bodies > _MOST_BODIES or times > _MOST_BODIES:
                raise InputError(f"{path}: has more than {_MOST_BODIES} bodies; leave out what does not move the pose")
            if points > _MOST_POINTS:
                raise InputError(f"{file}: a <{element.tag}> has {points:,} points; write at most {_MOST_POINTS:,}")
            included = path.parent / element.get("file", "") if element.tag in ("include", "model") else path
            if included.is_file() and included not in files:
                files.append(included)
            waiting.extend((child, times) for child in element)


def _check_numbers(file: Path, element: Element) -> None:
    for key, text in element.attrib.items():
        for word in text.split() if key != "name" and not key.endswith("range") else ():
            if not abs(_number(word)) <= _LARGEST:
                name = visible(element.get("name") or element.get("joint") or "", 40)
                raise InputError(
                    f"{file}: {key} of <{element.tag}{f' {name}' if name else ''}> is {visible(word, 40)}; write a "
                    f"number of at most {_LARGEST:g}"
                )


def _number(word: str) -> float:
    try:
        return float(word)
    except ValueError:
        return 0.0


def _points(element: Element) -> int:
    sizes = [_number(word) for key in _SIZES.get(element.tag, ()) for word in element.get(key, "").split()]
    return int(math.prod(max(size, 1.0) for size in sizes))


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
_COUNTS = {"joint": "njnt", "body": "nbody", "geom": "ngeom", "site": "nsite", "actuator": "nu", "tendon": "ntendon"}
# Models with other parameters that are kept.
_MODELS = 256


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


class ModelNumbers:
    """The parameters of a compiled model."""

    def __init__(self, mujoco: Any, path: Path, model: Any, parameters: tuple[ModelParameter, ...]) -> None:
        """mujoco: the package; path: of the model, for sentences."""
        self.mujoco, self.path, self.model, self.parameters = mujoco, path, model, parameters
        self._models: dict[bytes, Any] = {}
        cells = [self._cells(model, p)[0] for p in parameters]
        self.nominal = [float(array[index]) * sign for array, index, sign in cells]

    def element(self, kind: str, name: str) -> int:
        """Its number."""
        wanted = getattr(self.mujoco.mjtObj, f"mjOBJ_{kind.upper()}")
        found = int(self.mujoco.mj_name2id(self.model, wanted, name))
        if found < 0:
            names = [self.mujoco.mj_id2name(self.model, wanted, i) for i in range(getattr(self.model, _COUNTS[kind]))]
            known = ", ".join(n for n in names if n and not n.startswith("ccnn_torch ")) or "none with a name"
            raise InputError(f"{self.path}: has no {kind} '{name}'; it has {known}")
        return found

    def declared(self) -> list[Parameter]:
        """Them with unit and nominal value."""
        found = []
        for p, value in zip(self.parameters, self.nominal, strict=True):
            turning, sliding, positive = _FIELDS[p.kind, p.field]
            unit = turning if self._turns(p) else sliding
            found.append(Parameter(p.name, unit, value, scale=p.scale, low=0.0 if positive else None, cause=p.cause))
        return found

    def model_with(self, values: Array) -> Any:
        """The model with these parameters, `k`; kept, since the same come again."""
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

    def _turns(self, p: ModelParameter) -> bool:
        if p.kind not in ("joint", "actuator"):
            return False
        joint = self.element(p.kind, p.of)
        if p.kind == "actuator":
            joint = int(self.model.actuator_trnid[joint, 0])
        return bool(self.model.jnt_type[joint] == self.mujoco.mjtJoint.mjJNT_HINGE)

    def _cells(self, model: Any, p: ModelParameter) -> list[tuple[Array, int, float]]:
        """Place of a parameter in a model: array, index in it, sign."""
        if (p.kind, p.field) not in _FIELDS:
            known = ", ".join(f"{kind} {field}" for kind, field in _FIELDS)
            raise InputError(f"{self.path}: '{p.kind} {p.field}' is no parameter; there are {known}")
        element = getattr(model, p.kind)(self.element(p.kind, p.of))
        if p.field == "kp":
            # A position servo: force = kp (command - position) - kv speed.
            return [(element.gainprm, 0, 1.0), (element.biasprm, 1, -1.0)]
        array = getattr(element, p.field)
        if len(array) == 3 and p.axis not in tuple(_AXES):
            raise InputError(f"{self.path}: parameter '{p.name}' is a place; give its axis, x, y or z")
        return [(array, _AXES.index(p.axis) if p.axis and len(array) == 3 else 0, 1.0)]


_CARTESIAN = "xyz"
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
        self.planar = "".join(axis for axis in _CARTESIAN if axis not in pose) if "phi" in pose else ""
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
        # Windows and macOS do not tell which cores a process may use.
        cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
        count = threads or cores
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
        self._check_at_rest(commands, state)
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

    def _check_at_rest(self, commands: Array, state: Array) -> None:
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
            i, j = ((k + _CARTESIAN.index(self.planar)) % 3 for k in (1, 2))
            columns["phi"] = np.arctan2(turn[:, j, i], turn[:, i, i])
        return np.stack([columns[c] for c in self.pose], -1)


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
    a row starts at its command, or `approach` before it on the side that `direction1` … give; with them it starts at
    the first keyframe (or qpos0), where the loops must be closed, and goes to its command on a ramp.

    Args:
        model: MJCF file.
        actuators: by name, in the order q1, q2, …: what they are commanded in as a workspace, low and high [rad, m].
        measured: name of the site whose pose is measured, in the world's frame.
        pose: of x, y, z, rx, ry, rz, phi.
        parameters: of the model that may be wrong.
        name: of the simulator; the file's when None.
        approach: last bit of the way, from the side being given by the covariates `direction1` … [rad, m].
        ramp: time of the way [s].
        settle: longest time to wait for rest after it [s].
        still: speed below which it is at rest [rad/s, m/s].
        step: see `Simulator.step`.
        threads: how many rows at once; None = one a processor.

    Raises:
        InputError: MuJoCo is not installed, the model cannot be read, or lacks something that is named here.
    """
    machine = MujocoMachine(Path(model), list(actuators), measured, tuple(pose), tuple(parameters), threads)
    machine.approach, machine.ramp, machine.settle, machine.still = approach, ramp, settle, still
    units = ["rad" if turning else "m" for turning in machine.turning]
    return Simulator(
        name=name or Path(model).stem,
        joints=[
            Joint(f"q{i}", u, *limits) for i, (u, limits) in enumerate(zip(units, actuators.values(), strict=True), 1)
        ],
        pose=tuple(pose),
        simulate=machine,
        parameters=machine.numbers.declared(),
        covariates=[*machine.loads, *(f"direction{i + 1}" for i in range(len(units)) if approach)],
        step=step,
        remember=True,
    )
