"""Cases: a machine, motions, a cause, and the log of its controller."""

from __future__ import annotations

import zlib
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ccnn_torch.errors import InputError
from ccnn_validation.sources.case import SourceCase
from ccnn_validation.sources.motion.families import FAMILIES, truth_of
from ccnn_validation.sources.motion.machine import Axis, arm_xml, drawn_axis, pendulum_xml

__all__ = ["RealMachine", "log_of", "machine_of", "make"]

Array = NDArray[np.float64]
_SECONDS, _RATE, _RUNS = 8.0, 200.0, 4
# Steps of the encoder in a turn, and white noise of its reading in steps.
_STEPS, _NOISE = 16384, 0.3
_VOLTS = 24.0
Told = Callable[[Array, Array], Array]
Pushed = Callable[[float, float, float], float]


def make(family: str, seed: int) -> SourceCase:
    """The case of a family and seed.

    Raises:
        InputError: MuJoCo is not installed, or there is no such family.
    """
    if family not in FAMILIES:
        raise InputError(f"motion: there is no family '{family}'; known: {', '.join(FAMILIES)}")
    generator = np.random.default_rng([seed, zlib.crc32(family.encode())])
    return _arm(family, generator) if family.startswith("six_") else _pendulum(family, generator)


class RealMachine(NamedTuple):
    """One axis with a cause, and what is known of it.

    Attributes:
        nominal: the axis as the model has it.
        commands: the motions that were recorded, `t -> rad`.
        measure: `(time, command, run)` -> encoder positions `s`, and the supply [V], or None.
    """

    nominal: Axis
    commands: list[Callable[[Array], Array]]
    measure: Callable[[Array, Array, int], tuple[Array, Array | None]]

    @property
    def keys(self) -> dict[str, Any]:
        """Of the nominal servo."""
        own = self.nominal
        known = {"gain": own.kp, "mass": own.mass, "length": own.length, "inertia": own.armature}
        return known | {"viscous": own.damping, "coulomb": own.dry}


def machine_of(family: str, generator: np.random.Generator) -> RealMachine:
    """A pendulum on a servo with the cause of a family."""
    nominal = drawn_axis(generator)
    commands = [_motion(k, generator, 1.2) for k in range(_RUNS)]
    # The largest torque of the nominal machine on these motions: a limit has to be below it to act.
    most = max(_torque(nominal, command) for command in commands)
    real, told, push, voltage, drift = _changed(family, nominal, generator, most)

    def measure(time: Array, asked: Array, run: int) -> tuple[Array, Array | None]:
        volts = None if voltage is None else voltage(time)
        q = _simulated(pendulum_xml(real), time, told(time, asked)[:, None], push, volts, real)[:, :1]
        return _read(q + drift(time, run)[:, None], generator)[:, 0], volts

    return RealMachine(nominal, commands, measure)


def _pendulum(family: str, generator: np.random.Generator) -> SourceCase:
    machine = machine_of(family, generator)
    columns = log_of(machine, range(_RUNS), generator)
    return SourceCase(family, "servo", columns, None, truth_of(family), machine.keys)


def log_of(machine: RealMachine, runs: Sequence[int], generator: np.random.Generator) -> dict[str, Array]:
    """The log of some runs, by header."""
    columns: dict[str, list[Array]] = {}
    for run in runs:
        time = _times(generator)
        asked = machine.commands[run](time)
        q, volts = machine.measure(time, asked, run)
        own = {"time[s]": time, "run[1]": np.full(len(time), float(run)), "command1[rad]": asked, "q1[rad]": q}
        for name, values in (own | ({} if volts is None else {"supply[V]": volts})).items():
            columns.setdefault(name, []).append(values)
    return {name: np.concatenate(parts) for name, parts in columns.items()}


def _changed(
    family: str, nominal: Axis, generator: np.random.Generator, most: float
) -> tuple[Axis, Told, Pushed | None, Callable[[Array], Array] | None, Callable[[Array, int], Array]]:
    """The real machine, what its controller is told, a torque that is applied, the supply, and the encoder's drift."""
    real = nominal
    pushes: list[Pushed] = []
    told: Told = lambda time, command: command  # noqa: E731
    voltage: Callable[[Array], Array] | None = None
    drift: Callable[[Array, int], Array] = lambda time, run: np.zeros_like(time)  # noqa: E731
    kp = nominal.kp
    sign = generator.choice([-1.0, 1.0])
    inertia = nominal.armature + nominal.mass * nominal.length**2
    for cause in family.split("+"):
        size = generator.uniform(0.5, 1.5)
        if cause == "delay":
            told = _then(told, _late(0.02 * size))
        elif cause == "servo_gain":
            real = replace(real, kp=kp * float(np.exp(sign * 0.35 * size)))
        elif cause == "offset":
            told = _then(told, _shifted(sign * 0.02 * size))
        elif cause == "gravity":
            real = replace(real, tilt=sign * 0.3 * size)
        elif cause == "payload":
            real = replace(real, mass=real.mass * (1 + 0.5 * size))
        elif cause == "inertia":
            real = replace(real, armature=real.armature + 0.6 * size * inertia)
        elif cause == "viscous":
            real = replace(real, damping=real.damping * (1 + 0.4 * size))
        elif cause == "coulomb":
            real = replace(real, dry=real.dry + 0.02 * size * kp)
        elif cause == "stribeck":
            pushes.append(_sticky(0.02 * size * kp, generator.uniform(0.1, 0.4)))
        elif cause == "backlash":
            real = replace(real, play=0.03 * size)
        elif cause == "flexible_joint":
            load = nominal.mass * nominal.length**2
            stiffness = load * (2 * np.pi * generator.uniform(5.0, 10.0)) ** 2
            ratio = generator.uniform(0.03, 0.15)
            real = replace(real, spring=stiffness, extra={"spring_damping": 2 * ratio * np.sqrt(stiffness * load)})
        elif cause == "speed_limit":
            told = _then(told, _slow(generator.uniform(1.0, 3.0)))
        elif cause == "saturation":
            real = replace(real, force=generator.uniform(0.35, 0.6) * most)
        elif cause == "supply":
            low = generator.uniform(0.5, 0.75)
            voltage = _drooping(low)
        elif cause == "derivative_gain":
            share = 0.3 * size * nominal.damping / kp
            real, told = replace(real, damping=real.damping + share * kp), _then(told, _leading(share))
        elif cause == "integral_action":
            real = replace(real, integral=generator.uniform(0.5, 4.0))
        elif cause == "cogging":
            pushes.append(_toothed(0.02 * size * kp, float(generator.integers(6, 20)), generator.uniform(0, 6.28)))
        elif cause == "rubber_stop":
            pushes.append(_rubber(2.0 * size * kp, generator.uniform(0.6, 0.8)))
        elif cause == "drifting_encoder":
            drift = _creeping(0.02 * size * sign)
        elif cause == "dragging_brake":
            pushes.append(_brake(0.05 * size * kp, generator.uniform(2.0, 4.0), generator.uniform(5.0, 7.0)))
    return real, told, _together(pushes) if pushes else None, voltage, drift


def _together(pushes: Sequence[Pushed]) -> Pushed:
    return lambda t, q, v: float(sum(p(t, q, v) for p in pushes))


def _drooping(low: float) -> Callable[[Array], Array]:
    return lambda time: _VOLTS * (low + (1 - low) * 0.5 * (1 + np.cos(2 * np.pi * time / 6.3)))


def _creeping(size: float) -> Callable[[Array, int], Array]:
    return lambda time, run: size * (1 - np.exp(-time / 2.0))


def _torque(nominal: Axis, command: Callable[[Array], Array]) -> float:
    """The largest torque of the motor on a motion [N m], jumps left out."""
    time = np.arange(0, _SECONDS, 1 / _RATE)
    asked = command(time)
    q = _simulated(pendulum_xml(nominal), time, asked[:, None], None, None, nominal)[:, 0]
    return float(nominal.kp * np.quantile(np.abs(asked - q), 0.99))


def _then(first: Told, second: Told) -> Told:
    return lambda time, command: second(time, first(time, command))


def _late(delay: float) -> Told:
    return lambda time, command: np.interp(time - delay, time, command)


def _shifted(amount: float) -> Told:
    return lambda time, command: command + amount


def _leading(seconds: float) -> Told:
    return lambda time, command: command + seconds * np.gradient(command, time)


def _slow(fastest: float) -> Told:
    def told(time: Array, command: Array) -> Array:
        found = command.copy()
        for k in range(1, len(time)):
            reach = fastest * (time[k] - time[k - 1])
            found[k] = found[k - 1] + np.clip(command[k] - found[k - 1], -reach, reach)
        return found

    return told


def _sticky(torque: float, speed: float) -> Pushed:
    # Falls with the speed itself, not with its square.
    return lambda t, q, v: float(-torque * np.exp(-abs(v) / speed) * np.tanh(v / 0.005))


def _toothed(torque: float, teeth: float, phase: float) -> Pushed:
    return lambda t, q, v: float(torque * np.sin(teeth * q + phase))


def _rubber(stiffness: float, begin: float) -> Pushed:
    return lambda t, q, v: float(-stiffness * max(q - begin, 0.0) ** 1.5)


def _brake(torque: float, begin: float, end: float) -> Pushed:
    return lambda t, q, v: float(-torque * np.tanh(v / 0.01)) if begin < t < end else 0.0


def _motion(kind: int, generator: np.random.Generator, most: float) -> Callable[[Array], Array]:
    """Sines, a chirp, steps with ramps, a slow triangle; all begin at rest."""
    amplitude = generator.uniform(0.6, 1.0) * most
    rate = generator.uniform(0.8, 1.25)

    def soft(time: Array) -> Array:
        return np.clip(time / 0.7, 0, 1)

    if kind == 0:
        return lambda t: soft(t) * amplitude * (0.6 * np.sin(2.1 * rate * t) + 0.4 * np.sin(5.3 * rate * t))
    if kind == 1:
        return lambda t: soft(t) * 0.35 * amplitude * np.sin(2 * np.pi * (0.2 * t + 0.13 * rate * t**2))
    if kind == 2:
        levels = generator.uniform(-1, 1, 9) * amplitude
        return lambda t: np.interp(
            t,
            np.repeat(np.arange(9.0), 2)[1:-1] + np.tile([-0.12, 0.12], 9)[1:-1],
            np.repeat(np.concatenate([[0.0], levels[1:]]), 2)[:-2],
        )
    period = 4.0 / rate
    return lambda t: amplitude * (2 / np.pi) * np.arcsin(np.sin(2 * np.pi * t / period))


def _times(generator: np.random.Generator) -> Array:
    """Sample times: 200 a second, some jitter."""
    count = int(_SECONDS * _RATE)
    return np.arange(count) / _RATE + np.sort(generator.uniform(0, 0.1 / _RATE, count))


def _read(q: Array, generator: np.random.Generator) -> Array:
    step = 2 * np.pi / _STEPS
    return np.round(q / step + _NOISE * generator.standard_normal(q.shape)) * step


def _simulated(
    xml: str, time: Array, sent: Array, push: Pushed | None, volts: Array | None, axis: Axis | None
) -> Array:
    """Link positions of a model that is sent commands, `s x n`."""
    try:
        import mujoco
    except ImportError:
        raise InputError("motion: this source needs MuJoCo; pip install 'ccnn-torch[mujoco]'") from None
    model = mujoco.MjModel.from_xml_string(xml)
    data = mujoco.MjData(model)
    n = sent.shape[1]
    at = [model.jnt_qposadr[mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_JOINT, f"q{i + 1}")] for i in range(n)]
    # The encoder sits on the driven side, behind a play or a spring.
    far = [mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_JOINT, name) for name in (["far"] if n == 1 else [])]
    far += [mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_JOINT, f"far{i + 1}") for i in range(n if n > 1 else 0)]
    behind = [model.jnt_qposadr[j] if j >= 0 else -1 for j in far]
    step = model.opt.timestep
    found = np.zeros((len(time), n))
    kp = model.actuator_gainprm[:, 0].copy()
    # One second at the first command, so that it begins at rest.
    now, k, memory = float(time[0]) - 1.0, 0, 0.0
    while k < len(time):
        data.ctrl[:] = sent[max(k - 1, 0)] + (
            (sent[k] - sent[k - 1]) * (now - time[k - 1]) / (time[k] - time[k - 1]) if k else 0.0
        )
        if volts is not None and axis is not None:
            share = volts[k] / _VOLTS
            model.actuator_gainprm[:, 0], model.actuator_biasprm[:, 1] = kp * share, -kp * share
        if axis is not None and axis.integral:
            memory += step * axis.kp * axis.integral * float(data.ctrl[0] - data.qpos[0])
        pushed = 0.0 if push is None else push(now, float(data.qpos[0]), float(data.qvel[0]))
        data.qfrc_applied[0] = pushed + memory
        mujoco.mj_step(model, data)
        now += step
        while k < len(time) and now >= time[k]:
            found[k] = [data.qpos[a] + (data.qpos[b] if b >= 0 else 0.0) for a, b in zip(at, behind, strict=True)]
            k += 1
    return found


def _arm(family: str, generator: np.random.Generator) -> SourceCase:
    """Six axes; the model is the MJCF as it should be."""
    cause = family.removeprefix("six_")
    joint = int(generator.integers(6))
    size = generator.uniform(0.5, 1.5)
    kps = (1500.0, 2500.0, 1200.0, 250.0, 200.0, 100.0)
    dry, play = [0.0] * 6, [0.0] * 6
    if cause == "coulomb":
        dry[joint] = 0.02 * size * kps[joint]
    if cause == "backlash":
        play[joint] = 0.03 * size
    tellers = {
        "delay": _late(0.03 * size),
        "offset": _shifted(0.02 * size),
        "speed_limit": _slow(0.6),
    }
    names = ["time[s]", "run[1]", *(f"command{i + 1}[rad]" for i in range(6)), *(f"q{i + 1}[rad]" for i in range(6))]
    columns: dict[str, list[Array]] = {name: [] for name in names}
    for run in range(_RUNS):
        time = _times(generator)
        asked = np.stack([_motion((run + i) % 4, generator, 0.5)(time) for i in range(6)], -1)
        sent = asked.copy()
        for i in range(6):
            # A delay is that of the bus, the rest that of one axis.
            if cause in tellers and (cause == "delay" or i == joint):
                sent[:, i] = tellers[cause](time, asked[:, i])
        q = _read(_simulated(arm_xml(tuple(dry), tuple(play)), time, sent, None, None, None), generator)
        columns["time[s]"].append(time)
        columns["run[1]"].append(np.full(len(time), float(run)))
        for i in range(6):
            columns[f"command{i + 1}[rad]"].append(asked[:, i])
            columns[f"q{i + 1}[rad]"].append(q[:, i])
    return SourceCase(
        family, arm_xml(), {name: np.concatenate(parts) for name, parts in columns.items()}, None, truth_of(family)
    )
