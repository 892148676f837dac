"""A MuJoCo model file as a black-box simulator (Todorov 2012): commands in, the pose at rest out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from ccnn_torch.mechanisms.simulators.mujoco_machine import MujocoMachine
from ccnn_torch.mechanisms.simulators.mujoco_parameters import ModelParameter
from ccnn_torch.mechanisms.simulators.simulator import Joint, Simulator


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
