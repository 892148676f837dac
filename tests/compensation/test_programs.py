"""Programs with corrected positions: read by a reader of their own, run on a machine of its own formulas."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from machines import AROUND, SIX, known
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation
from stand_ins import fields, tripod_compensator

from ccnn_torch.compensation import save_model
from ccnn_torch.compensation.fit import all_over, machine_alone
from ccnn_torch.compensation.programs.gcode import GCode
from ccnn_torch.compensation.programs.literals import Krl, Rapid
from ccnn_torch.errors import InputError
from ccnn_torch.mechanisms import Mechanism, SerialArm, load_mechanism
from ccnn_torch.mechanisms.kinds.machine_file import template
from ccnn_torch.mechanisms.mechanism_file import mechanism_text

Array = NDArray[np.float64]
Cli = Callable[..., tuple[int, str, str]]

# In the form of https://linuxcnc.org/docs/html/gcode/g-code.html: modal words, comments, both ways to count.
NC = b"""%\r
O0017 (POCKET)\r
(M\xfcnster, part 7) G21 G90 G54\r
N10 G0 Z150.\r
N20 G00 X100 Y200.5 F3000 ; not G1 X999\r
N30 G1 X150.25 (Y0) F1200\r
Y300 z100.5\r
N40 g91 G1 X-10 Y5\r
X10\r
N50 G4 P0.5\r
G90 G20 X4 Y5.5 Z3\r
/N60 G21 X+120.5 S8000 M3\r
START_PRINT X=5\r
N70 G28 X0\r
N80 G1 Z140\r
M2\r
%\r
"""
NC_POSITIONS = [
    *((100, 200.5, 150), (150.25, 200.5, 150), (150.25, 300, 100.5), (140.25, 305, 100.5), (150.25, 305, 100.5)),
    *((101.6, 139.7, 76.2), (120.5, 139.7, 76.2)),
]


def run_nc(text: str) -> list[tuple[float, float, float]]:
    """Positions of a control, once all three axes are known [mm]."""
    at: dict[str, float] = {}
    unit, absolute, found = 1.0, True, []
    for line in text.upper().splitlines():
        words = re.findall(r"([A-Z]) *([-+]?[\d.]+)", re.sub(r"\(.*?\)|;.*", "", line))
        if line.startswith("START") or ("G", "4") in words:
            continue
        for letter, number in words:
            if letter == "G":
                unit = {20: 25.4, 21: 1.0}.get(int(number), unit)
                absolute = {90: True, 91: False}.get(int(number), absolute)
        if ("G", "28") in words:
            at = {}
            continue
        moved = [(letter, unit * float(number)) for letter, number in words if letter in "XYZ"]
        for letter, value in moved:
            at[letter] = value if absolute else at[letter] + value
        if moved and len(at) == 3:
            found.append((at["X"], at["Y"], at["Z"]))
    return found


def gantry(folder: Path) -> Path:
    """An identified.yaml: leads of x, y too long, y leans towards x, z towards y."""
    (folder / "gantry.yaml").write_text(template("gantry").replace("base_frame: unknown", "base_frame: identity"))
    nominal = load_mechanism(str(folder / "gantry.yaml"))
    values = dict(zip((p.name for p in nominal.geometry), nominal.nominal.tolist(), strict=True))
    changed = values | {"lead_x": 3e-4, "lead_y": 2e-4, "squareness_xy": -4e-4, "squareness_yz": 5e-4}
    real = nominal.with_nominal(torch.tensor([*changed.values()], dtype=torch.float64))
    (folder / "identified.yaml").write_text(mechanism_text(real, values))
    return folder / "identified.yaml"


def gantry_goes(x: float, y: float, z: float) -> Array:
    """Where the true gantry is when it is commanded there [mm]."""
    return x * (1 + 3e-4) * np.array([1, 0, 0]) + y * (1 + 2e-4) * np.array([-4e-4, 1, 0]) + z * np.array([0, 5e-4, 1])


def test_g_code_reaches_its_positions_and_keeps_every_other_byte(tmp_path: Path, cli: Cli) -> None:
    (tmp_path / "part.nc").write_bytes(NC)
    model = gantry(tmp_path)
    code, screen, err = cli("compensate", model, tmp_path / "part.nc", tmp_path / "out.nc")
    # Two moves are made before all axes are known: nothing is wrong with them.
    assert code == 0 and not err and "not all axes are known yet: lines 4, 15." in screen
    assert "7 of 9 positions corrected, by 0." in screen and "words of axes were added" in screen
    assert "1 lines begin with a word of letters" in screen
    found = (tmp_path / "out.nc").read_bytes().decode("latin-1")
    np.testing.assert_allclose(run_nc(NC.decode("latin-1")), NC_POSITIONS, atol=1e-9)
    positions = run_nc(found)
    assert len(positions) == len(NC_POSITIONS)
    for position, wanted in zip(positions, NC_POSITIONS, strict=True):
        # Numbers are rounded to 0.1 um, those in inches to a millionth.
        np.testing.assert_allclose(gantry_goes(*position), wanted, atol=2e-4)
        assert np.abs(gantry_goes(*wanted) - wanted).max() > 0.02
    for before, after in zip(NC.decode("latin-1").splitlines(True), found.splitlines(True), strict=True):
        bare = re.sub(r"[-+]?\d[\d.]*", "#", re.sub(r"(?<=\d) [XYZ][-\d.]+(?=[ \r])(?=.*\r)", "", after))
        same = re.sub(r"[-+]?\d[\d.]*", "#", re.sub(r"(?<=\d) [XYZ][-\d.]+(?=[ \r])(?=.*\r)", "", before))
        assert bare == same
    # What a machine does not turn stays as it is written.
    (tmp_path / "part.src").write_text("LIN {X 400,Y 300.0,Z 100,A 10,B 20.5,C -30}\n")
    assert cli("compensate", model, tmp_path / "part.src", tmp_path / "out.src")[0] == 0
    frame = r"LIN \{X ([\d.]+),Y ([\d.]+),Z ([\d.]+),A 10,B 20\.5,C -30\}\n"
    place = re.fullmatch(frame, (tmp_path / "out.src").read_text())
    assert place
    np.testing.assert_allclose(gantry_goes(*map(float, place.groups())), [400, 300, 100], atol=2e-4)
    for kept in (
        "(M\xfcnster, part 7) G21",
        "F3000 ; not G1 X999\r\n",
        "(Y0) F1200",
        "START_PRINT X=5",
        "G28 X0",
        "+12",
    ):
        assert kept in found


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("G0 X1 Y1 Z1\nG2 X5 Y5 I2 J0\n", "line 2: G2 is an arc, whose centre and radius do not follow"),
        ("G81 X1 Y2 Z3 R1\n", "line 1: G81 is a cycle"),
        ("G1 X#1 Y2\n", "line 1: has a position that is computed"),
        ("o100 while [1]\n", "line 1: has a position that is computed, or a loop"),
        ("G54 G0 X1 Y1 Z1\nG55 X2\n", "line 2: has a second work offset, G55 after G54"),
        ("G92 X0\n", "line 1: sets another zero of the axes"),
        ("M98 P7\n", "line 1: calls another program"),
        ("G68 X0 Y0 R30\n", "line 1: G68 is another frame of the axes"),
        ("N3 G1 X1 Y1 Z1 *57\n", "line 1: has a checksum"),
    ],
)
def test_what_straight_moves_do_not_follow_is_refused(text: str, said: str) -> None:
    with pytest.raises(InputError, match=re.escape(said)):
        GCode(text, False)


def test_nothing_is_written_of_a_program_that_is_refused(tmp_path: Path, cli: Cli) -> None:
    model, path = gantry(tmp_path), tmp_path / "part.ngc"
    for text, said in (
        ("M3 S1000\n", "part.ngc: has no position"),
        ("G0 X1\0", "part.ngc: is no text of one byte a letter"),
        ("G3 X1 I2\n", "part.ngc: line 1: G3 is an arc"),
    ):
        path.write_text(text)
        code, _, err = cli("compensate", model, path, tmp_path / "out.ngc")
        assert code == 2 and said in err and err.count("\n") == 1 and not (tmp_path / "out.ngc").exists()


LIMITS = [[float(m) - 0.9, float(m) + 0.9] for m in AROUND]
FLANGE = [0.02, -0.03, 0.15, 0.0, 0.6, 0.0]


def goes(links: Array, tool: Array, joints: Array) -> Array:
    """Frame of the tool by standard Denavit-Hartenberg links a, alpha, d, theta, `4 x 4` [m]."""
    frame = np.eye(4)
    for (a, alpha, d, theta), q in zip(links, joints, strict=True):
        turn = Rotation.from_euler("z", q + theta) * Rotation.from_euler("x", alpha)
        link = np.eye(4)
        link[:3, :3] = turn.as_matrix()
        link[:3, 3] = a * math.cos(q + theta), a * math.sin(q + theta), d
        frame = frame @ link
    end = np.eye(4)
    end[:3, :3], end[:3, 3] = Rotation.from_rotvec(tool[3:]).as_matrix(), tool[:3]
    return np.asarray(frame @ end)


class Arm:
    """A true arm, the program's positions of it, and where it goes when a corrected one is commanded."""

    def __init__(self, folder: Path) -> None:
        self.nominal = SerialArm("six", "standard", SIX, limits=LIMITS, tool=FLANGE, goal_tool=FLANGE)
        draw = torch.randn(self.nominal.nominal.shape, generator=torch.Generator().manual_seed(4), dtype=torch.float64)
        self.real = self.nominal.with_nominal(self.nominal.nominal + 3e-4 * draw * (torch.arange(len(draw)) >= 6))
        made = machine_alone(all_over(self.nominal), self.real.nominal, margin=0.0)
        about = fields() | {"mechanism": self.nominal.describe()}
        self.model = save_model(folder, made, about, forms=("safetensors",))["safetensors"]
        self.joints = AROUND.numpy() + np.random.default_rng(3).uniform(-0.7, 0.7, (6, 6))

    def at(self, machine: Mechanism, joints: Array) -> Array:
        values = machine.nominal.numpy()
        return goes(values[6:-6].reshape(6, 4), values[-6:], joints)

    def commanded(self, frame: Array, near: Array) -> Array:
        """Joints of the controller, which has the nominal kinematics, for a frame."""

        def gap(q: Array) -> Array:
            there = self.at(self.nominal, q)
            turn = Rotation.from_matrix(frame[:3, :3] @ there[:3, :3].T).as_rotvec()
            return np.concatenate([frame[:3, 3] - there[:3, 3], turn])

        return np.asarray(least_squares(gap, near, xtol=1e-15, ftol=1e-15, gtol=1e-15).x)

    def assert_reached(self, frame: Array, joints: Array) -> None:
        """That the true arm, commanded a frame, is where the nominal one would be, but for rounding."""
        reached = self.at(self.real, self.commanded(frame, joints))
        np.testing.assert_allclose(reached, self.at(self.nominal, joints), atol=5e-7)
        assert np.abs(self.at(self.real, joints) - self.at(self.nominal, joints)).max() > 1e-4


@pytest.fixture(scope="module")
def arm(tmp_path_factory: pytest.TempPathFactory) -> Arm:
    return Arm(tmp_path_factory.mktemp("arm"))


def krl(frame: Array) -> str:
    a, b, c = Rotation.from_matrix(frame[:3, :3]).as_euler("ZYX", degrees=True)
    x, y, z = 1e3 * frame[:3, 3]
    return f"X {x:.6f},Y {y:.6f}, Z {z:.6f},A {a:.7f},B {b:.7f},C {c:.7f}"


def read_krl(text: str) -> list[Array]:
    """Frames in the order of the text, by KUKA's angles: z, then the new y, then the new x."""
    found = []
    for group in re.findall(r"\{[^{}]*X [^{}]*C [^{}]*\}", text):
        numbers = {k: float(v) for k, v in re.findall(r"\b([XYZABC]) ([-\d.]+)", group)}
        frame = np.eye(4)
        frame[:3, 3] = [1e-3 * numbers[k] for k in "XYZ"]
        frame[:3, :3] = Rotation.from_euler("ZYX", [numbers[k] for k in "ABC"], degrees=True).as_matrix()
        found.append(frame)
    return found


def test_krl_reaches_its_frames_and_axes(tmp_path: Path, cli: Cli, arm: Arm) -> None:
    frames = [arm.at(arm.nominal, q) for q in arm.joints]
    axes = ",".join(f"A{i + 1} {math.degrees(q):.6f}" for i, q in enumerate(arm.joints[3]))
    # In the form of KUKA's System Software manuals; a sample of such files is in ros-industrial/kuka_experimental.
    base = "$BASE={X 1.5,Y 0,Z 0,A 0,B 0,C 10}"
    text = (
        f"&ACCESS RVP\r\nDEF weld( ) ; {{X 1,Y 2,Z 3,A 0,B 0,C 0}}\r\n{base}\r\n"
        "TOOL_DATA[2]={X 0,Y 0,Z 9,A 0,B 0,C 0}\r\nDECL FRAME F1={X 0,Y 0,Z 9,A 0,B 0,C 0}\r\n"
        f"PTP {{{krl(frames[0])},S 2,T 35,E1 0.0}} C_PTP\r\n"
        f"LIN {{E6POS: {krl(frames[1])}}}\r\nPTP {{E6AXIS: {axes},E1 5}}\r\nLIN_REL {{X 10,Y 0,Z 0,A 0,B 0,C 0}}\r\n"
        f"DECL E6POS XP3={{{krl(frames[2])},S 6,T 27}}\r\nLIN {{X 100}}\r\n$VEL.CP=0.25\r\nEND\r\n"
        "LIN XP3\r\nCIRC XAUX, XP3\r\n"
    )
    (tmp_path / "weld.src").write_bytes(text.encode("latin-1"))
    code, screen, err = cli("compensate", arm.model, tmp_path / "weld.src", tmp_path / "out.src")
    assert code == 2 and "2 of 6 positions" in err and "a relative motion: line 9" in err
    assert "not all of its numbers are there: line 11" in err and "4 of 6 positions corrected, by " in screen
    assert "(Offs, RelTool, names): 1 move, line 15." in screen
    found = (tmp_path / "out.src").read_bytes().decode("latin-1")
    moved = re.findall(r"^(?:PTP|LIN|DECL E6POS)\b(?!.*E6AXIS).*\{.*X .*\}", found, re.MULTILINE)
    for frame, k in zip(read_krl("\n".join(moved)), (0, 1, 2), strict=True):
        arm.assert_reached(frame, arm.joints[k])
    turned = np.radians(
        [float(v) for v in re.findall(r"A\d ([-\d.]+)", found.partition("E6AXIS:")[2].partition("}")[0])]
    )
    np.testing.assert_allclose(arm.at(arm.real, turned), arm.at(arm.nominal, arm.joints[3]), atol=5e-7)
    # All but the numbers of these positions.
    number = r"(?<=[XYZABC] )-?\d[\d.]*|(?<=A\d )-?\d[\d.]*"
    assert re.sub(number, "#", found) == re.sub(number, "#", text)
    for k in (0, 1, 2, 3, 4, 8, 10, 11, 12):
        assert found.splitlines()[k] == text.splitlines()[k]


def test_orientations_that_were_not_measured_stay(tmp_path: Path, arm: Arm, cli: Cli) -> None:
    nominal = arm.nominal.with_orientation("none")
    made = machine_alone(all_over(nominal), nominal.with_nominal(arm.real.nominal).nominal, margin=0.0)
    about = fields() | {"mechanism": nominal.describe()}
    model = save_model(tmp_path, made, about, forms=("safetensors",))["safetensors"]
    frame = arm.at(arm.nominal, arm.joints[0])
    (tmp_path / "p.src").write_text(f"LIN {{{krl(frame)}}}\n")
    code, screen, _ = cli("compensate", model, tmp_path / "p.src", tmp_path / "o.src")
    assert code == 0 and "Orientations stay as written" in screen
    (found,) = read_krl((tmp_path / "o.src").read_text())
    np.testing.assert_allclose(found[:3, :3], frame[:3, :3], atol=1e-7)
    assert np.abs(found[:3, 3] - frame[:3, 3]).max() > 1e-5


def quaternion(frame: Array) -> Array:
    x, y, z, w = Rotation.from_matrix(frame[:3, :3]).as_quat()
    return np.array([w, x, y, z])


def test_rapid_reaches_its_targets(tmp_path: Path, cli: Cli, arm: Arm) -> None:
    targets = []
    for k in (0, 1):
        frame = arm.at(arm.nominal, arm.joints[k])
        place, turn = 1e3 * frame[:3, 3], (-1) ** k * quaternion(frame)
        targets.append(f"[[{place[0]:.5f}, {place[1]:.5f},{place[2]:.5f}],[{','.join(f'{v:.9f}' for v in turn)}]")
    axes = ",".join(f"{math.degrees(q):.6f}" for q in arm.joints[3])
    # In the form of ABB's Technical reference manual, RAPID (3HAC050917): data types robtarget, jointtarget, tooldata.
    text = (
        "MODULE Weld\n  ! p0 is [[1,2,3],[1,0,0,0],[0,0,0,0],[9E9,9E9,9E9,9E9,9E9,9E9]]\n"
        "  PERS tooldata t1:=[TRUE,[[0,0,100],[1,0,0,0]],[1,[0,0,1],[1,0,0,0],0,0,0]];\n"
        '  PERS wobjdata w1:=[FALSE,TRUE,"",[[1,2,3],[1,0,0,0]],[[0,0,0],[1,0,0,0]]];\n'
        f"  CONST robtarget p10:={targets[0]},[0,-1,0,1],[9E9,9E9,9E9,9E9,9E9,9E9]];\n"
        f"  CONST jointtarget home:=[[{axes}],[9E9,9E9,9E9,9E9,9E9,9E9]];\n"
        "  PROC main()\n    MoveL [[x0,0,0],[1,0,0,0],[0,0,0,0],[9E9,9E9,9E9,9E9,9E9,9E9]],v10,fine,t1;\n"
        f"    MoveL {targets[1]},[0,0,0,0],[9E9,9E9,9E9,9E9,9E9,9E9]],v100,z1,t1\\WObj:=w1;\n  ENDPROC\nENDMODULE\n"
        "MoveL Offs(p10,0,0,50),v100,z1,t1;\n"
    )
    (tmp_path / "weld.mod").write_text(text)
    code, screen, err = cli("compensate", arm.model, tmp_path / "weld.mod", tmp_path / "out.mod")
    assert code == 2 and "not all of its numbers are there: line 8" in err and "3 of 4 positions corrected" in screen
    assert "1 move, line 12." in screen
    found = (tmp_path / "out.mod").read_text().splitlines()
    for k, line in ((0, 4), (1, 8)):
        x, y, z, *turn = (float(v) for v in re.findall(r"-?\d[\d.]*(?=[,\]])", found[line].partition("[[")[2])[:7])
        assert (
            abs(np.linalg.norm(turn) - 1) < 1e-8
            and float(np.array(turn) @ quaternion(arm.at(arm.nominal, arm.joints[k]))) * (-1) ** k > 0
        )
        frame = np.eye(4)
        frame[:3, 3], frame[:3, :3] = 1e-3 * np.array([x, y, z]), Rotation.from_quat([*turn[1:], turn[0]]).as_matrix()
        arm.assert_reached(frame, arm.joints[k])
    turned = np.radians([float(v) for v in re.findall(r"-?\d+\.\d+", found[5])])
    np.testing.assert_allclose(arm.at(arm.real, turned), arm.at(arm.nominal, arm.joints[3]), atol=5e-7)
    for k in (0, 1, 2, 3, 6, 7, 9, 10):
        assert found[k] == text.splitlines()[k]
    assert found[8].endswith(",[0,0,0,0],[9E9,9E9,9E9,9E9,9E9,9E9]],v100,z1,t1\\WObj:=w1;")


def test_positions_outside_are_left_and_listed_and_a_frame_may_be_given(tmp_path: Path, cli: Cli, arm: Arm) -> None:
    base = np.eye(4)
    base[:3, 3], base[:3, :3] = [0.1, -0.2, 0.05], Rotation.from_rotvec([0, 0, 0.5]).as_matrix()
    tool = np.array([0.0, 0.05, 0.2, 0.3, 0.0, 0.0])
    links = np.array(SIX, dtype=float)
    frames = [np.linalg.inv(base) @ goes(links, tool, q) for q in arm.joints[:2]]
    far = frames[0].copy()
    far[:3, 3] += 5.0
    low = ",".join(f"A{i + 1} {v:.3f}" for i, v in enumerate(np.degrees(AROUND.numpy() + 1.3)))
    lines = [*(f"LIN {{{krl(frame)}}}" for frame in (*frames, far)), f"PTP {{{low}}}", "PTP {A1 1,A2 2}"]
    (tmp_path / "a.src").write_text("\n".join(lines) + "\n")
    words = ("--base", "100mm,-200mm,50mm,0,0,0.5rad", "--tool", "0,50mm,200mm,0.3rad,0,0")
    code, _, err = cli("compensate", arm.model, tmp_path / "a.src", tmp_path / "b.src", *words)
    assert code == 2 and "3 of 5 positions" in err and "out of reach: line 3" in err
    assert "outside what was measured: line 4" in err and "has 2 axes, and the machine 6: line 5" in err
    found = (tmp_path / "b.src").read_text().splitlines()
    assert found[2:] == lines[2:]
    for k, frame in enumerate(read_krl("\n".join(found[:2]))):
        near = np.linalg.norm(frame[:3, 3] - frames[k][:3, 3])
        assert 1e-5 < near < 5e-3
        # At the flange the true arm is where the nominal one would be, its own tool's errors aside.
        wanted = base @ frame @ np.linalg.inv(goes(np.zeros((0, 4)), tool, np.zeros(0)))
        flange = goes(np.zeros((0, 4)), np.array(FLANGE), np.zeros(0))
        arm.assert_reached(wanted @ flange, arm.joints[k])


def test_a_model_that_has_learned_and_one_with_covariates_correct_programs(tmp_path: Path, cli: Cli) -> None:
    about = known("arm with effects")
    made = about.compensator(1e-5)
    model = save_model(tmp_path, made, fields() | {"mechanism": about.mechanism.describe()}, forms=("safetensors",))[
        "safetensors"
    ]
    joints = about.joints[:4].numpy()
    text = "".join("PTP {" + ",".join(f"A{i + 1} {v:.7f}" for i, v in enumerate(np.degrees(q))) + "}\n" for q in joints)
    (tmp_path / "a.src").write_text(text)
    code, screen, _ = cli("compensate", model, tmp_path / "a.src", tmp_path / "b.src")
    assert code == 0 and "4 of 4 positions corrected" in screen and "the middle of what was measured: load_x" in screen
    found = re.findall(r"A\d ([-\d.]+)", (tmp_path / "b.src").read_text())
    centre = made.domain.centre[6:].expand(4, -1)
    given = torch.from_numpy(np.radians(np.round(np.degrees(joints), 7)))
    wanted = made(given, centre)[0].detach().numpy()
    np.testing.assert_allclose(np.radians(np.array(found, float)).reshape(4, 6), wanted, atol=2e-9)


def test_a_program_is_for_machines_with_positions(tmp_path: Path, cli: Cli) -> None:
    model = save_model(tmp_path, tripod_compensator(), fields(), forms=())
    (tmp_path / "a.nc").write_text("G0 X1 Y1 Z1\n")
    code, _, err = cli("compensate", model["safetensors"], tmp_path / "a.nc", tmp_path / "b.nc")
    assert code == 2 and "has no positions x, y, z" in err
    for option in ("--pose", "--back", "--sd"):
        code, _, err = cli("compensate", model["safetensors"], tmp_path / "a.nc", tmp_path / "b.nc", option)
        assert code == 2 and "a program takes none of --pose, --back and --sd" in err


def test_a_program_that_was_cut_up_stays_as_it_is_or_is_refused() -> None:
    sources = [NC.decode("latin-1"), "LIN {X 1,Y 2,Z 3,A 4,B 5,C 6}\nPTP {A1 1,A2 2}\n"]
    sources.append("MoveL [[1,2,3],[1,0,0,0],[0,0,0,0],[9E9,9E9]],v1;\nMoveAbsJ [[1,2,3,4,5,6],[9,9,9,9,9,9]],v1;\n")
    draw = np.random.default_rng(0)
    for make, source in zip((lambda t: GCode(t, True), Krl, Rapid), sources, strict=True):
        for _ in range(150):
            text = source
            for _ in range(draw.integers(1, 5)):
                a, b = sorted(draw.integers(0, len(text) + 1, 2))
                text = str(draw.choice([text[:a] + text[b:], text[:b] + text[a:], text[:a] + "{[(X1.;" + text[a:]]))
            try:
                program = make(text)
            except InputError as reason:
                assert "\n" not in str(reason)
                continue
            same, _ = program.written([None] * len(program.points))
            assert same == text
            changed, _ = program.written([p.frame if p.frame is not None else p.joints for p in program.points])
            assert len(changed) >= len(text) - 40
