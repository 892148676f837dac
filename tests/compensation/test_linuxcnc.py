"""`ccnn export --to linuxcnc`: kinematics against ours, compiled for themselves and in LinuxCNC's simulator."""

from __future__ import annotations

import ctypes
import os
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from machines import known
from stand_ins import tripod_compensator
from torch import Tensor

from ccnn_torch import export_model
from ccnn_torch.compensation import load_model
from ccnn_torch.compensation.targets.from_model import form_of
from ccnn_torch.compensation.targets.linuxcnc import print_linuxcnc
from ccnn_torch.errors import MethodFailedError
from ccnn_torch.mechanisms import Mechanism, SerialArm, load_mechanism
from ccnn_torch.numerics.rotations import (
    euler_zyx_to_matrix,
    geodesic_angle,
    matrix_to_euler_zyx,
    matrix_to_rotation_vector,
)

COMPILER = shutil.which("gcc") or shutil.which("cc")
MODULES = Path("/usr/lib/linuxcnc/modules")
SHIPPED = Path(__file__).parents[2] / "checkpoints" / "tripod" / "model.safetensors"

# What the component takes from LinuxCNC: its pose, the types of the functions, and what halcompile defines.
INTERFACE = """
#include <math.h>
typedef struct { double x, y, z; } PmCartesian;
typedef struct EmcPose { PmCartesian tran; double a, b, c, u, v, w; } EmcPose;
typedef unsigned long KINEMATICS_FORWARD_FLAGS, KINEMATICS_INVERSE_FLAGS;
typedef enum { KINEMATICS_BOTH = 4 } KINEMATICS_TYPE;
#define KINS_NOT_SWITCHABLE
#define EXPORT_SYMBOL(name) typedef int name##_is_known
#define FUNCTION(name) void name(void)
int state;
"""


class Compiled:
    """The component as a library, for poses of LinuxCNC: x, y, z [mm], a, b, c [degrees]."""

    def __init__(self, content: str, folder: Path) -> None:
        for name in ("rtapi", "rtapi_app", "rtapi_math", "hal"):
            (folder / f"{name}.h").write_text("")
        (folder / "kinematics.h").write_text(INTERFACE)
        (folder / "kins.c").write_text(content.partition("\n;;\n")[2])
        words = [str(COMPILER), "-O1", "-Wall", "-Werror", "-fPIC", "-shared", f"-I{folder}", str(folder / "kins.c")]
        subprocess.run([*words, "-o", str(folder / "kins.so"), "-lm"], check=True)
        self._library = ctypes.CDLL(str(folder / "kins.so"))

    def _call(self, name: str, given: np.ndarray, size: int) -> tuple[int, np.ndarray]:
        first, second, flags = np.zeros(16), np.zeros(16), np.zeros(1, np.uint64)
        first[: len(given)] = given
        pointers = [v.ctypes.data_as(ctypes.c_void_p) for v in (first, second, flags, flags)]
        return getattr(self._library, name)(*pointers), second[:size]

    def inverse(self, world: np.ndarray) -> tuple[int, np.ndarray]:
        return self._call("kinematicsInverse", world, 6)

    def forward(self, joints: np.ndarray) -> tuple[int, np.ndarray]:
        return self._call("kinematicsForward", joints, 6)


def of_tripod(pose: Tensor) -> Tensor:
    y, z, phi = (pose * torch.tensor([1e3, 1e3, 180 / torch.pi], dtype=torch.float64)).unbind(-1)
    zero = torch.zeros_like(y)
    return torch.stack([zero, y, z, phi, zero, zero], -1)


def of_delta(pose: Tensor) -> Tensor:
    return torch.nn.functional.pad(1e3 * pose, (0, 3))


def drawn(machine: Mechanism, world: Callable[[Tensor], Tensor]) -> tuple[np.ndarray, np.ndarray]:
    pose = machine.sample_workspace(20, torch.Generator().manual_seed(1))
    return world(pose).numpy(), machine.solve_inverse(pose).numpy()


def turned(machine: Mechanism, position: Tensor, turns: Tensor) -> tuple[np.ndarray, np.ndarray]:
    """Poses of a mechanism with a rotation vector out of positions [m] and roll, pitch, yaw [rad]."""
    pose = torch.cat([position, matrix_to_rotation_vector(euler_zyx_to_matrix(turns.flip(-1)))], -1)
    world = torch.cat([1e3 * position, torch.rad2deg(turns)], -1)
    return world.numpy(), machine.solve_inverse(pose).numpy()


@pytest.mark.skipif(COMPILER is None, reason="no C compiler here")
def test_compensated_kinematics_of_the_tripod(tmp_path: Path) -> None:
    machine, compensator = load_mechanism("tripod"), tripod_compensator()
    form = form_of(compensator)
    files = print_linuxcnc(form, machine, "a test")
    kins = Compiled(files["ccnnkins.comp"], tmp_path)
    world, ideal = drawn(machine, of_tripod)
    with torch.no_grad():
        command = compensator(torch.from_numpy(ideal))[0].numpy()
    assert np.abs(command - ideal).max() > 1e-5
    for pose, joints in zip(world, command, strict=True):
        code, found = kins.inverse(pose)
        assert code == 0
        np.testing.assert_allclose(found[:3] / 1e3, joints, rtol=0, atol=1e-14)
        code, back = kins.forward(1e3 * joints)
        assert code == 0
        np.testing.assert_allclose(back, pose, rtol=0, atol=1e-8)
    # A pose that the machine cannot take, and one that is none.
    assert kins.inverse(np.array([0, 0, 2e3]))[0] == kins.inverse(np.array([0, np.nan, 550]))[0] == -1
    assert kins.forward(np.array([9e3, 1e3, 1e3]))[0] == -1
    assert "Y = y, Z = z, A = phi" in files["README.md"] and "JOINTS = 3" in files["README.md"]


@pytest.mark.skipif(COMPILER is None, reason="no C compiler here")
@pytest.mark.parametrize("name", ["delta", "stewart", "arm"])
def test_kinematics_of_other_machines(name: str, tmp_path: Path) -> None:
    generator = torch.Generator().manual_seed(2)
    draw = 0.4 * torch.rand(10, 6, generator=generator, dtype=torch.float64) - 0.2
    machine = known("arm").mechanism if name == "arm" else load_mechanism(name)
    if isinstance(machine, SerialArm):
        near = known("arm").joints[:10]
        position, turn = machine.forward_frame(near)
        angles = [torch.atan2(turn[:, 2, 1], turn[:, 2, 2]), torch.asin(-turn[:, 2, 0])]
        angles.append(torch.atan2(turn[:, 1, 0], turn[:, 0, 0]))
        world = torch.cat([1e3 * position, torch.rad2deg(torch.stack(angles, -1))], -1).numpy()
        joints = near.numpy()
    elif name == "stewart":
        world, joints = turned(machine, draw[:, :3] / 4 + machine.home_pose[:3], draw[:, 3:])
    else:
        world, joints = drawn(machine, of_delta)
    kins = Compiled(print_linuxcnc(None, machine, "a test")["ccnnkins.comp"], tmp_path)
    scale = [1e3 if c.unit == "m" else 180 / np.pi for c in machine.joints]
    for pose, ideal in zip(world, joints, strict=True):
        code, back = kins.forward(ideal * scale)
        assert code == 0
        np.testing.assert_allclose(back, pose, rtol=0, atol=1e-6)
        # A search starts where the last one ended.
        kins.forward((ideal + 0.01) * scale)
        code, found = kins.inverse(pose)
        assert code == 0
        np.testing.assert_allclose(found[: len(ideal)] / scale, ideal, rtol=0, atol=1e-8)


def turn_of(world: np.ndarray) -> Tensor:
    """Rotation of roll, pitch, yaw on A, B, C."""
    return euler_zyx_to_matrix(torch.deg2rad(torch.from_numpy(world[..., 3:]).flip(-1)))


@pytest.mark.skipif(COMPILER is None, reason="no C compiler here")
def test_no_accepted_inverse_has_another_orientation(tmp_path: Path) -> None:
    """From everywhere to everywhere in SO(3), half turns and upright pitches among them."""
    arm = known("arm").mechanism
    kins = Compiled(print_linuxcnc(None, arm, "a test")["ccnnkins.comp"], tmp_path)
    generator = np.random.default_rng(3)
    accepted = {"near": 0, "far": 0}
    for k in range(400):
        start, end = np.radians(generator.uniform(-120, 120, (2, 6)))
        if k % 4 == 0:
            # The wrist turned half a turn, about one of its axes or two.
            end = start + np.pi * np.eye(6)[5] + (k % 8 == 0) * 1e-7 * generator.normal(size=6)
        position, turn = (v[0] for v in arm.forward_frame(torch.from_numpy(end)[None]))
        upright = torch.tensor([0.3, np.pi / 2, k], dtype=torch.float64)
        turn = euler_zyx_to_matrix(upright) if k % 4 == 1 else turn
        angles = matrix_to_euler_zyx(turn).flip(-1)
        world = np.concatenate([1e3 * position.numpy(), np.degrees(angles.numpy())])
        code, stood = kins.forward(np.degrees(start))
        assert code == 0
        code, found = kins.inverse(world)
        assert code in (0, -1)
        if code == 0:
            code, back = kins.forward(found)
            off = float(geodesic_angle(turn_of(back), turn_of(world)))
            assert code == 0 and off < 1e-7 and np.abs(back[:3] - world[:3]).max() < 1e-5, (k, off)
            far = float(geodesic_angle(turn_of(stood), turn_of(world))) > np.pi / 2
            accepted["far" if far else "near"] += 1
    assert accepted["near"] > 30 and accepted["far"] > 150, accepted


@pytest.mark.skipif(COMPILER is None, reason="no C compiler here")
def test_a_platform_may_be_turned_by_half_a_turn(tmp_path: Path) -> None:
    machine = load_mechanism("stewart")
    kins = Compiled(print_linuxcnc(None, machine, "a test")["ccnnkins.comp"], tmp_path)
    for angles in ((180, 0, 0), (0, 0, 180), (180, 0, 90), (0, 90, 180), (179.9999999, 0, 0), (0, 0, -179.99999)):
        world = np.array([10.0, -20.0, 1e3 * float(machine.home_pose[2]), *angles])
        vector = matrix_to_rotation_vector(turn_of(world))
        pose = torch.cat([torch.from_numpy(world[:3]) / 1e3, vector])
        code, found = kins.inverse(world)
        assert code == 0
        np.testing.assert_allclose(found / 1e3, machine.solve_inverse(pose[None])[0].numpy(), rtol=0, atol=1e-8)


def test_which_axes_a_component_serves_is_said() -> None:
    for machine, sentence in (
        (known("sliding arm").mechanism, "X, Y, Z alone"),
        (known("arm").mechanism, "A, B, C: roll, pitch, yaw"),
        (load_mechanism("tripod"), "Y = y, Z = z, A = phi; others are not followed"),
    ):
        files = print_linuxcnc(None, machine, "a test")
        assert sentence in files["README.md"] and sentence in files["ccnnkins.comp"].partition("\n;;\n")[0]


def test_what_linuxcnc_cannot_have() -> None:
    own = Path(__file__).parents[2] / "experiments" / "my_mechanism.py"
    with pytest.raises(MethodFailedError, match="of 'planar_3rrr' are no closed form"):
        print_linuxcnc(None, load_mechanism(f"{own}:Planar3RRR", allow_code=True), "a test")
    form = form_of(tripod_compensator(), "float32")
    with pytest.raises(MethodFailedError, match="leave out --dtype float32"):
        print_linuxcnc(form, load_mechanism("tripod"), "a test")


DRIVE = """#!/usr/bin/python3
import linuxcnc, time
command, stat = linuxcnc.command(), linuxcnc.stat()
def wait(reached):
    for _ in range(1000):
        stat.poll()
        if reached():
            return
        time.sleep(0.01)
time.sleep(0.5)
command.state(linuxcnc.STATE_ESTOP_RESET)
wait(lambda: stat.task_state == linuxcnc.STATE_ESTOP_RESET)
command.state(linuxcnc.STATE_ON)
wait(lambda: stat.task_state == linuxcnc.STATE_ON)
command.mode(linuxcnc.MODE_MANUAL)
command.teleop_enable(0)
command.wait_complete()
command.home(-1)
wait(lambda: all(stat.homed[:3]))
command.teleop_enable(1)
wait(lambda: stat.motion_mode == linuxcnc.TRAJ_MODE_TELEOP)
command.mode(linuxcnc.MODE_MDI)
wait(lambda: stat.task_mode == linuxcnc.MODE_MDI)
with open("said.txt", "w") as said:
    for y, z, a in ((0, 550, 0), (50, 500, 5), (-100, 600, -10)):
        command.mdi(f"G53 G0 Y{y} Z{z} A{a}")
        command.wait_complete(10)
        wait(lambda: stat.inpos and stat.interp_state == linuxcnc.INTERP_IDLE)
        time.sleep(0.1)
        stat.poll()
        print(y, z, a, *stat.joint_position[:3], file=said)
"""

HAL = """loadrt [KINS]KINEMATICS
loadrt [EMCMOT]EMCMOT servo_period_nsec=[EMCMOT]SERVO_PERIOD num_joints=[KINS]JOINTS
addf motion-command-handler servo-thread
addf motion-controller servo-thread
addf ccnnkins.serve servo-thread
net j0 joint.0.motor-pos-cmd => joint.0.motor-pos-fb
net j1 joint.1.motor-pos-cmd => joint.1.motor-pos-fb
net j2 joint.2.motor-pos-cmd => joint.2.motor-pos-fb
net estop iocontrol.0.user-enable-out iocontrol.0.emc-enable-in
"""

AXIS = "MAX_VELOCITY = 500\nMAX_ACCELERATION = 5000\nMIN_LIMIT = -2000\nMAX_LIMIT = 2000\n"
INI = (
    "[EMC]\nVERSION = 1.1\n[DISPLAY]\nDISPLAY = ./drive.py\n[TASK]\nTASK = milltask\nCYCLE_TIME = 0.001\n"
    "[RS274NGC]\nPARAMETER_FILE = sim.var\n[EMCIO]\nEMCIO = io\nCYCLE_TIME = 0.1\n"
    "[EMCMOT]\nEMCMOT = motmod\nSERVO_PERIOD = 1000000\n[HAL]\nHALFILE = sim.hal\n"
    "[TRAJ]\nCOORDINATES = YZA\nLINEAR_UNITS = mm\nANGULAR_UNITS = degree\nMAX_LINEAR_VELOCITY = 500\n"
    "[KINS]\nJOINTS = 3\nKINEMATICS = ccnnkins\n"
    + "".join(f"[AXIS_{a}]\n{AXIS}" for a in "YZA")
    + "".join(
        f"[JOINT_{j}]\nTYPE = LINEAR\nHOME = 1072\nHOME_OFFSET = 1072\nHOME_SEQUENCE = 0\n{AXIS}" for j in range(3)
    )
)


@pytest.mark.skipif(
    shutil.which("halcompile") is None or not os.access(MODULES, os.W_OK) or (MODULES / "ccnnkins.so").exists(),
    reason="needs Debian's linuxcnc-uspace and linuxcnc-uspace-dev, and write access to LinuxCNC's modules",
)
def test_the_simulator_of_linuxcnc_moves_the_compensated_machine() -> None:
    # Where anybody may read: LinuxCNC does not run as root.
    folder = Path(subprocess.run(["mktemp", "-d"], capture_output=True, text=True, check=True).stdout.strip())
    try:
        export_model(SHIPPED, "linuxcnc", folder)
        subprocess.run(["halcompile", "--compile", "ccnnkins.comp"], cwd=folder, check=True, capture_output=True)
        shutil.copy(folder / "ccnnkins.so", MODULES)
        for name, content in (("sim.ini", INI), ("sim.hal", HAL), ("drive.py", DRIVE)):
            (folder / name).write_text(content)
        for path in (folder, folder / "drive.py"):
            path.chmod(0o777)
        words = ["linuxcnc", str(folder / "sim.ini")]
        words = words if os.geteuid() else ["setpriv", "--reuid=65534", "--regid=65534", "--clear-groups", *words]
        home = {"HOME": str(folder), "PATH": os.environ["PATH"]}
        subprocess.run(
            words, cwd=folder, env=home, timeout=60, check=True, capture_output=True, stdin=subprocess.DEVNULL
        )
        rows = np.loadtxt(folder / "said.txt")
    finally:
        (MODULES / "ccnnkins.so").unlink(missing_ok=True)
        shutil.rmtree(folder, ignore_errors=True)
    pose = torch.from_numpy(rows[:, :3]) * torch.tensor([1e-3, 1e-3, torch.pi / 180], dtype=torch.float64)
    ideal = load_mechanism("tripod").solve_inverse(pose).numpy()
    command = load_model(SHIPPED)(ideal)["command"]
    assert len(rows) == 3 and np.abs(command - ideal).max() > 1e-5
    np.testing.assert_allclose(rows[:, 3:] / 1e3, command, rtol=0, atol=1e-9)
