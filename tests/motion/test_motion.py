"""`ccnn diagnose --motion`: what it names, what it writes, and what it refuses."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import ClassVar

import jsonschema
import numpy as np
import pytest
from motion.servo import GAIN, INERTIA, KEYS, LENGTH, LOAD, MASS, VISCOUS, command, moved, moved_on_a_spring, write_log

from ccnn_torch.diagnosis.verdict.findings import findings
from ccnn_torch.errors import InputError
from ccnn_torch.motion import (
    Nominal,
    diagnose_motion,
    feed_forward,
    load_identified,
    load_logs,
    nominal_of,
    write_identified,
)
from ccnn_torch.motion.mujoco_write import write_mjcf as write_new_values
from ccnn_torch.motion.simulators import Simulator
from ccnn_torch.records import read_table, write_table
from ccnn_torch.report.json_files import load_schema

Cli = Callable[..., tuple[int, str, str]]
DATA = Path(__file__).parents[2] / "experiments" / "data"
FEW = ["delay", "coulomb", "offset", "backlash"]


def test_a_right_model_leaves_no_claim_and_its_error_says_where(tmp_path: Path) -> None:
    log = write_log(tmp_path / "log.csv", (0, 1), 2.4, dry=0.02 * GAIN)
    # A friction that is 5 % off is nearly as right as values are known (3 %).
    keys = KEYS | {"coulomb": 0.02 * GAIN, "viscous": 1.05 * KEYS["viscous"]}
    right = diagnose_motion(load_logs([log]), nominal_of("servo", keys, ["rad"]), [*FEW, "viscous"])
    assert right.content["verdict"]["none"] and right.content["verdict"]["effects"] == []


def test_what_no_motion_separates_is_a_class(tmp_path: Path) -> None:
    # Of an axis of which nothing is known, a finite gain and viscous friction are one and the same lag.
    log = write_log(tmp_path / "log.csv", (0, 2), 3.0)
    found = diagnose_motion(load_logs([log]), nominal_of("servo", {}, ["rad"]), ["servo_gain", "viscous", "inertia"])
    named = {e["name"]: e["indistinguishable_from"] for e in found.content["effects"]}
    lag = next(n for n in ("servo_gain", "viscous") if n in found.content["verdict"]["effects"])
    assert named[lag] == ["viscous" if lag == "servo_gain" else "servo_gain"]
    assert found.content["next_measurements"] and all(m["gain"] > 0 for m in found.content["next_measurements"])


def test_a_drift_of_the_encoder_is_outside_the_library(tmp_path: Path) -> None:
    log = write_log(tmp_path / "log.csv", (0, 1))
    header, *rows = log.read_text().splitlines()
    cells = [row.split(",") for row in rows]
    lines = [f"{t},{r},{u},{float(q) + 0.03 * np.sin(0.9 * float(t)):.17g}" for t, r, u, q in cells]
    log.write_text("\n".join([header, *lines]) + "\n")
    verdict = diagnose_motion(load_logs([log]), nominal_of("servo", KEYS, ["rad"]), FEW).content["verdict"]
    assert verdict["outside_library"] and verdict["driver"] == "time"


def test_the_command_on_a_real_servo(tmp_path: Path, cli: Cli) -> None:
    logs = [w for name in ("sin_sin", "up_and_down") for w in ("--motion", DATA / f"servo_{name}.csv")]
    out = tmp_path / "out"
    effects = "gravity,viscous,coulomb"
    code, said, error = cli("diagnose", *logs, "--mechanism", "servo", "--effects", effects, "--out", out)
    assert code == 0 and not error
    results = json.loads((out / "diagnosis.json").read_text())
    jsonschema.validate(results, load_schema("diagnosis"))
    assert results["motion"] and results["gap"]["unit"] == "rad"
    # A pendulum of 0.49 kg at 0.1 m sags: that carries most of the gap, and the joint is the only one.
    assert "gravity" in results["verdict"]["effects"] and results["where"]["joints"] == {"q1": 1.0}
    assert results["gap"]["after"] < 0.5 * results["gap"]["before"]
    assert sum(p["share"] for p in results["where"]["phases"].values()) == pytest.approx(1)
    assert "What is wrong: " in said and "runs not used for fitting" in said
    page = (out / "report.html").read_text()
    assert "course" in page and "What should be recorded next?" in page
    assert (out / "next_measurements.csv").read_text().startswith("time[s],command1[rad]\n")
    assert (out / "diagnosis.md").is_file()


def test_a_mechanism_file_gives_joints_that_follow_their_commands(tmp_path: Path) -> None:
    arm = tmp_path / "arm.yaml"
    arm.write_text(
        "dof: 3\nconvention: standard Denavit-Hartenberg\nunits: {length: m, angle: rad}\na: [0.3, 0.2, 0.1]\n"
        "alpha: [0, 0, 0]\nd: [0, 0, 0]\ntheta: [0, 0, 0]\njoint_sign: [1, 1, 1]\n"
        "base_frame: identity\ntool_frame: identity\n"
    )
    time = np.arange(0, 2.4, 0.01)
    # The last one is held, and its encoder always gives the same.
    asked, late = (np.stack([0.5 * np.sin((2 + i) * (time - t) * (i < 2)) for i in range(3)], -1) for t in (0.0, 0.03))
    rows = np.concatenate([time[:, None], asked, late], 1)
    head = "time[s],command1[rad],command2[rad],command3[rad],q1[rad],q2[rad],q3[rad]"
    np.savetxt(tmp_path / "log.csv", rows, delimiter=",", header=head, comments="")
    logs = load_logs([tmp_path / "log.csv"])
    found = diagnose_motion(logs, nominal_of(str(arm), {}, logs[0].units), ["delay"]).content
    assert found["verdict"]["effects"] == ["delay"] and len(found["where"]["joints"]) == 3
    assert "no log moves q3: of such joints little can be told" in found["notes"]
    values = next(e for e in found["effects"] if e["name"] == "delay")["parameters"]
    assert [v["value"] for v in values.values()] == pytest.approx([0.03, 0.03], rel=0.02)


OWN = """
import numpy as np
class SERVO:
    parameters = {"gain": 2.0, "viscous": 0.05}
    def simulate(self, time, commands, parameters):
        q, v = commands.copy(), np.zeros(commands.shape[1])
        for k in range(1, len(time)):
            h = (time[k] - time[k - 1]) / 2
            q[k] = q[k - 1]
            for part in (0.5, 1.0):
                u = commands[k - 1] + part * (commands[k] - commands[k - 1])
                push = 0.004 / h * v + parameters["gain"] * (u - q[k])
                v = push / (0.004 / h + parameters["viscous"] + parameters["gain"] * h)
                q[k] = q[k] + h * v
        return q
class BROKEN:
    def simulate(self, time, commands, parameters):
        return commands[1:]
"""


def write_mjcf(
    path: Path, joint: str = "", mass: float = 0.2, actuator: str = f'<position joint="q" kp="{GAIN}"/>'
) -> Path:
    """A pendulum of `mass` at 0.1 m whose inertia is that of the servo of the tests."""
    armature, damping = KEYS["inertia"] - mass * 0.1**2, KEYS["viscous"]
    path.write_text(
        '<mujoco><compiler angle="radian"/><option timestep="0.001" integrator="implicitfast"/><worldbody><body>'
        f'<joint name="q" axis="0 1 0" armature="{armature}" damping="{damping}"/>'
        f'<geom type="sphere" size="0.001" pos="0 0 -0.1" mass="0.2"/></body></worldbody>'
        f"<actuator>{actuator}</actuator></mujoco>"
    )
    return path


def left_on(kind: int, nominal: Nominal, axes: Sequence[Mapping[str, float]], **real: float) -> float:
    """RMS of a model on a motion that no diagnosis saw [rad]."""
    time = np.arange(0, 4, 0.01)
    asked = command(kind, time)
    error = feed_forward.moved(nominal, axes, time, asked[None, :, None])[0, :, 0] - moved(time, asked, **real)
    return float(np.sqrt(np.square(error).mean()))


def test_a_simulator_of_ones_own_is_a_model_whose_parameters_are_causes(tmp_path: Path) -> None:
    log, own = write_log(tmp_path / "log.csv", (0, 1), 2.0), tmp_path / "mine.py"
    own.write_text(OWN)
    logs, nominal = load_logs([log]), nominal_of(f"{own}:SERVO", {}, ["rad"])
    found = diagnose_motion(logs, nominal, ["offset"])
    assert found.content["verdict"]["effects"] == ["parameter viscous"]
    assert "viscous 0.0500 → 0.0" in findings(found.content)[0].text
    write_identified(tmp_path, found, nominal, {})
    with pytest.raises(InputError, match="names Python code, "):
        load_identified(tmp_path / "identified_motion.json")
    better = load_identified(tmp_path / "identified_motion.json", allow_code=True)
    assert better.nominal.simulator is not None
    assert better.nominal.simulator.parameters["viscous"] == pytest.approx(KEYS["viscous"], rel=0.1)
    assert left_on(2, better.nominal, better.axes) < 0.2 * left_on(2, nominal, nominal.axes)
    with pytest.raises(InputError, match="must return a position for each"):
        diagnose_motion(logs, nominal_of(f"{own}:BROKEN", {}, ["rad"]), ["delay"])


def test_a_mujoco_model_is_a_model_and_gets_the_new_values(tmp_path: Path) -> None:
    # A load of 0.3 N m at 90 degrees, where the model has 0.2 kg at 0.1 m.
    real = {"weight": 0.3, "dry": 0.06}
    log, model = write_log(tmp_path / "log.csv", (0, 1), 2.4, **real), write_mjcf(tmp_path / "servo.xml")
    nominal = nominal_of(str(model), {}, ["rad"])
    found = diagnose_motion(load_logs([log]), nominal, ["gravity", "delay", "coulomb"])
    assert sorted(found.content["verdict"]["effects"]) == ["coulomb", "gravity"]
    sag = next(e for e in found.content["effects"] if e["name"] == "gravity")["parameters"]["q1 sin"]
    assert sag["value"] == pytest.approx(0.3 - 0.2 * 9.80665 * 0.1, rel=0.15) and sag["unit"] == "N*m"
    assert write_identified(tmp_path, found, nominal, {}) == ["identified_motion.json", "identified.xml"]
    better = load_identified(tmp_path / "identified_motion.json")
    before, after = left_on(2, nominal, nominal.axes, **real), left_on(2, better.nominal, better.axes, **real)
    said = found.content["verdict"]["shrink"]
    assert after < 0.15 * before and 1 - (after / before) ** 2 == pytest.approx(said, abs=0.02)
    import mujoco

    written = mujoco.MjModel.from_xml_path(str(tmp_path / "identified.xml"))
    assert written.dof_frictionloss[0] == pytest.approx(0.06, rel=0.1)
    # A tenth of a kilogram more: the body is heavier, and the motor's armature as it was.
    axis = {name: KEYS[name] / GAIN for name in ("inertia", "viscous")} | {"gain": 1.0, "coulomb": 0.0, "weakness": 0.0}
    write_new_values(str(model), tmp_path / "identified.xml", [axis], nominal.gains, 0.1)
    heavier = mujoco.MjModel.from_xml_path(str(tmp_path / "identified.xml"))
    assert heavier.body_mass[1] == pytest.approx(0.3)
    assert heavier.dof_M0[0] == pytest.approx(KEYS["inertia"] + 0.1 * 0.1**2)
    assert heavier.dof_armature[0] == pytest.approx(KEYS["inertia"] - 0.2 * 0.1**2, abs=1e-6)
    write_mjcf(model, actuator='<motor joint="q"/>')
    with pytest.raises(InputError, match="<position joint=…/> for each command"):
        nominal_of(str(model), {}, ["rad"])


def arm(path: Path, payload: float = 0.0) -> Path:
    """Two links in a vertical plane, with a site at the flange and a payload there [kg]."""
    link = '<body pos="{x} 0 0"><joint name="{name}" axis="0 1 0" armature="0.05" damping="{damping}"/>'
    link += '<geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.02" mass="{mass}"/>'
    load = f'<body pos="0.3 0 0"><geom type="sphere" size="0.01" mass="{payload}"/></body>' if payload else ""
    inner = link.format(x=0.3, name="q2", damping=6.0, mass=1.0) + f'<site pos="0.3 0 0"/>{load}</body>'
    path.write_text(
        '<mujoco><compiler angle="radian"/><option timestep="0.002" integrator="implicitfast"/><worldbody>'
        f"{link.format(x=0, name='q1', damping=20.0, mass=2.0)}{inner}</body></worldbody>"
        '<actuator><position joint="q1" kp="600"/><position joint="q2" kp="200"/></actuator></mujoco>'
    )
    return path


def test_a_payload_at_the_tool_of_an_arm_is_named_and_written_into_its_model(tmp_path: Path) -> None:
    import mujoco

    time = np.arange(0, 4, 0.008)
    asked = np.stack([command(0, time), command(1, time)], -1)
    nominal, loaded = (nominal_of(str(arm(tmp_path / f"{m}.xml", m)), {}, ["rad", "rad"]) for m in (0.0, 0.4))
    assert loaded.loaded is not None
    table = {"time[s]": time} | {f"command{i + 1}[rad]": asked[:, i] for i in range(2)}
    noise = 1e-4 * np.random.default_rng(0).standard_normal(asked.shape)
    measured = loaded.loaded(time, asked, None).positions + noise
    write_table(tmp_path / "log.csv", table | {f"q{i + 1}[rad]": measured[:, i] for i in range(2)})
    logs = load_logs([tmp_path / "log.csv"])
    found = diagnose_motion(logs, nominal, ["payload", "gravity", "inertia", "offset"])
    assert found.content["verdict"]["effects"] == ["payload"] and found.content["verdict"]["shrink"] > 0.95
    told = next(e for e in found.content["effects"] if e["name"] == "payload")["parameters"]
    assert {name: v["unit"] for name, v in told.items()} == {"q1 mass": "kg", "q2 mass": "kg"}
    assert [v["value"] for v in told.values()] == pytest.approx([0.4, 0.4], rel=0.1)
    write_identified(tmp_path, found, nominal, {})
    better = mujoco.MjModel.from_xml_path(str(tmp_path / "identified.xml"))
    true = mujoco.MjModel.from_xml_path(str(tmp_path / "0.4.xml"))
    assert better.body_mass.sum() == pytest.approx(true.body_mass.sum(), rel=0.02)
    # The mass is where it is: the inertia about each joint is that of the loaded arm.
    assert better.dof_M0 == pytest.approx(true.dof_M0, rel=0.03)


def test_a_limit_that_acts_in_one_run_alone_is_named(tmp_path: Path) -> None:
    # Only the first motion is fast enough; the others do not tell the limit.
    log = write_log(tmp_path / "log.csv", (0, 1, 1), 2.4, limit=0.25)
    found = diagnose_motion(
        load_logs([log]), nominal_of("servo", KEYS, ["rad"]), ["saturation", "speed_limit", "viscous"]
    )
    assert found.content["verdict"]["effects"] == ["saturation"] and found.content["verdict"]["probability"] > 0.9
    assert found.content["verdict"]["shrink"] > 0.9
    assert any("acts in one run alone: 2 parts of the runs were" in note for note in found.content["notes"])


def test_what_one_joint_of_an_arm_does_is_no_finding_at_the_others(tmp_path: Path) -> None:
    # Behind the friction of the second joint the first one moves otherwise than in the simulation.
    time = np.arange(0, 4, 0.008)
    asked = np.stack([command(1, time), command(0, time)], -1)
    model, real = arm(tmp_path / "model.xml"), arm(tmp_path / "real.xml")
    real.write_text(real.read_text().replace('damping="6.0"', 'damping="16.0"'))
    nominal, true = (nominal_of(str(path), {}, ["rad", "rad"]) for path in (model, real))
    assert true.loaded is not None
    measured = true.loaded(time, asked, None).positions + 2e-5 * np.random.default_rng(0).standard_normal(asked.shape)
    table = {"time[s]": time} | {f"command{i + 1}[rad]": asked[:, i] for i in range(2)}
    write_table(tmp_path / "log.csv", table | {f"q{i + 1}[rad]": measured[:, i] for i in range(2)})
    found = diagnose_motion(load_logs([tmp_path / "log.csv"]), nominal, ["viscous", "gravity", "inertia", "delay"])
    first, second = found.verdicts
    names = found.problem.library.names
    assert [names[m] for m in second.best.members] == ["viscous"]
    assert first.best.members == () and first.probability > 0.9
    told = next(e for e in found.content["effects"] if e["name"] == "viscous")["parameters"]
    assert {name: v["value"] for name, v in told.items()} == {"q2 viscous": pytest.approx(10.0, rel=0.02)}


def test_causes_have_their_values_and_a_corrected_command_is_followed(tmp_path: Path, cli: Cli) -> None:
    real = {"dry": 0.1, "delay": 0.03, "weight": 0.3}
    log, out = write_log(tmp_path / "log.csv", (0, 1), 2.4, **real), tmp_path / "out"
    keys = "{gain: 2.0, inertia: 0.004, viscous: 0.09}"
    effects = "delay,coulomb,gravity"
    given = ("--motion", log, "--mechanism", "servo", "--effects", effects, "--out", out, f"mechanism_keys={keys}")
    code, said, error = cli("diagnose", *given)
    assert code == 0 and not error and "ccnn compensate" in said
    found = json.loads((out / "diagnosis.json").read_text())
    assert sorted(found["verdict"]["effects"]) == ["coulomb", "delay", "gravity"]
    assert found["verdict"]["probability"] >= 0.95 and found["verdict"]["shrink"] > 0.99
    values = {e["name"]: e["parameters"] for e in found["effects"]}
    assert values["delay"]["q1 delay"]["value"] == pytest.approx(0.03, rel=0.05)
    assert values["coulomb"]["q1 coulomb"]["value"] == pytest.approx(0.1, rel=0.1)
    assert values["coulomb"]["q1 coulomb"]["unit"] == "N*m"
    assert values["gravity"]["q1 sin"]["value"] == pytest.approx(0.3, rel=0.05)
    time = np.arange(0, 4, 0.01)
    wanted = command(2, time)
    lines = [f"{t:.12g},{np.degrees(u):.12g}" for t, u in zip(time, wanted, strict=True)]
    (tmp_path / "in.csv").write_text("\n".join(["time[s],command1[deg]", *lines]) + "\n")
    model, sent = out / "identified_motion.json", tmp_path / "out.csv"
    code, said, error = cli("compensate", model, tmp_path / "in.csv", sent)
    assert code == 0 and not error and "q1: predicted" in said
    table = read_table(sent)
    errors = [wanted - moved(time, u, **real) for u in (wanted, table.column("corrected1", "rad"))]
    before, after = (float(np.sqrt(np.square(e).mean())) for e in errors)
    predicted = float(np.sqrt(np.square(wanted - table.column("predicted1", "rad")).mean()))
    assert after < 0.1 * before and predicted / 2 < after < 2 * predicted + load_identified(model).left[0]
    (tmp_path / "in.csv").write_text("\n".join(["time[s],command1[deg]", lines[1], lines[0]]) + "\n")
    for arguments, sentence in {(): "time does not increase", ("--back",): "takes none of --pose"}.items():
        code, _, error = cli("compensate", model, tmp_path / "in.csv", sent, *arguments)
        assert code == 2 and sentence in error and error.count("\n") == 1
    good = json.loads(model.read_text())
    for change, sentence in {
        "units": (["K"], "joints in rad or m"),
        "mechanism_keys": (3, "is no identified_motion.json"),
        "axes": ([{"delay": "nan"}], "no number 'delay'"),
    }.items():
        model.write_text(json.dumps(good | {change: sentence[0]}))
        code, _, error = cli("compensate", model, tmp_path / "in.csv", sent)
        assert code == 2 and str(sentence[1]) in error and error.count("\n") == 1


def test_what_is_less_than_models_are_known_to_is_not_said_to_be_noise(tmp_path: Path) -> None:
    log = write_log(tmp_path / "log.csv", (0, 1), 2.4, dry=0.0024)
    nominal = nominal_of("servo", KEYS, ["rad"])
    found = diagnose_motion(load_logs([log]), nominal, ["delay", "coulomb"]).content
    assert found["verdict"]["none"] and found["verdict"]["probability"] <= 0.5
    assert "most like dry friction, but by less than the form of a model and time stamps" in found["cautions"][0]


class Stiff:
    """A servo whose positions are far from linear in its parameters; only their ratios show."""

    parameters: ClassVar[dict[str, float]] = {"gain": 2.0, "damping": 0.09, "inertia": 0.004}

    @staticmethod
    def simulate(time: np.ndarray, commands: np.ndarray, given: dict[str, float]) -> np.ndarray:
        step = (time[-1] - time[0]) / (4 * (len(time) - 1))
        clock = time[0] + step * np.arange(4 * len(time))
        q, v, found = float(commands[0, 0]), 0.0, np.empty(len(clock))
        for k, u in enumerate(np.interp(clock, time, commands[:, 0]).tolist()):
            found[k] = q
            v += (given["gain"] * (u - q) - given["damping"] * v) / given["inertia"] * step
            q += v * step
        return np.interp(time, clock, found)[:, None]


def test_a_simulator_is_simulated_where_it_is_not_linear(tmp_path: Path) -> None:
    time = np.arange(0, 2.4, 0.01)
    lines = ["time[s],run[1],command1[rad],q1[rad]"]
    for run in (0, 1):
        asked = command(run, time)
        q = Stiff.simulate(time, asked[:, None], Stiff.parameters | {"gain": 1.0})[:, 0]
        q = np.round(q * 16384 / (2 * np.pi)) * 2 * np.pi / 16384
        lines += [f"{t:.17g},{run},{u:.17g},{x:.17g}" for t, u, x in zip(time, asked, q, strict=True)]
    (tmp_path / "log.csv").write_text("\n".join(lines) + "\n")
    simulator = Simulator("stiff", Stiff.simulate, Stiff.parameters)
    nominal = Nominal("stiff", ({},), (None,), (None,), simulator=simulator)
    found = diagnose_motion(load_logs([tmp_path / "log.csv"]), nominal, ["delay", "inertia"]).content
    assert found["verdict"]["effects"] == ["parameter gain"] and found["verdict"]["probability"] > 0.95
    assert found["effects"][0]["parameters"]["q1 gain"]["value"] == pytest.approx(-1.0, rel=0.02)


def test_a_flexible_joint_is_seen_from_the_motor(tmp_path: Path) -> None:
    spring, seen = 1.5, {"damping": 0.01, "at_motor": True}
    log = write_log(tmp_path / "log.csv", (0, 1), 2.4, moved_on_a_spring, spring=spring, **seen)
    keys = {"gain": GAIN, "inertia": INERTIA - LOAD, "mass": MASS, "length": LENGTH, "viscous": VISCOUS}
    some = ["delay", "payload", "viscous", "flexible_joint"]
    found = diagnose_motion(load_logs([log]), nominal_of("servo", keys, ["rad"]), some).content
    assert found["verdict"]["effects"] == ["flexible_joint"] and found["verdict"]["probability"] > 0.9
    values = found["effects"][0]["parameters"]
    assert values["q1 inertia over stiffness"]["value"] == pytest.approx(LOAD / spring, rel=0.05)
    assert values["q1 encoder_at_motor"]["value"] == 1


def test_a_file_that_cannot_be_is_refused_in_one_sentence(tmp_path: Path, cli: Cli) -> None:
    t = np.arange(0, 4, 0.01)
    u, w = np.sin(2 * t), 0.7 * np.sin(3.1 * t + 1)
    one = {"time[s]": t, "command1[rad]": u, "q1[rad]": 0.98 * u}
    both = {**one, "command2[rad]": w, "q2[rad]": w}
    swapped = both | {"q1[rad]": w, "q2[rad]": 0.98 * u}
    early = t[:260]
    bump = {lag: np.exp(-(((early - 1.0 - lag) / 0.3) ** 2)) for lag in (0.0, 0.5)}
    short = {"time[s]": early, "command1[rad]": bump[0.0], "q1[rad]": bump[0.5]}
    back = t.copy()
    back[50] = t[48]
    cases = {
        "time does not increase at line 52 (row 51)": one | {"time[s]": back},
        "its samples are 10 s apart, which shows no motion; if the times are in ms, write": one | {"time[s]": 1e3 * t},
        "q1 moves against command1; multiply one": one | {"q1[rad]": -0.98 * u},
        "one of them is in degrees and not in radians": one | {"q1[rad]": np.degrees(u)},
        "the columns of two joints are swapped": swapped,
        "the drive was off throughout": one | {"torque_on[1]": 0 * t},
        "too few; record at least 100 samples": {n: v[:80] for n, v in one.items()},
        "and the log lasts 2.59 s; record at least 3.9 s": short,
        "no command moves": one | {"command1[rad]": 0 * t},
        "q1 never moves while command1 does": one | {"q1[rad]": 0 * t},
        "there is no column 'q1'": {n: v for n, v in one.items() if n != "q1[rad]"},
        "must be an angle or a length": {n.replace("q1[rad]", "q1[K]"): v for n, v in one.items()},
    }
    for sentence, columns in cases.items():
        path = tmp_path / "log.csv"
        rows = zip(*columns.values(), strict=True)
        path.write_text("\n".join([",".join(columns), *(",".join(f"{v:.12g}" for v in row) for row in rows)]) + "\n")
        code, _, error = cli("diagnose", "--motion", path, "--mechanism", "servo", "--out", tmp_path / "out")
        assert code == 2 and sentence in error and error.count("\n") == 1, (sentence, error)
        assert not (tmp_path / "out").exists()
    assert cli("diagnose", "--motion", path, "--out", tmp_path / "out")[0] == 2
    path = write_log(tmp_path / "log.csv", (0,))
    for model, sentence in {
        DATA / "ur10.yaml": "ur10.yaml: has 6 joints (rad, rad, rad, rad, rad, rad), and the logs 1 (rad)",
        "five_bar": "five_bar: has 2 joints (rad, rad), and the logs 1 (rad)",
        tmp_path / "none.xml": "none.xml",
        f"{tmp_path / 'none.py'}:SERVO": "there is no file",
    }.items():
        code, _, error = cli("diagnose", "--motion", path, "--mechanism", model, "--out", tmp_path / "out")
        assert code == 2 and sentence in error and error.count("\n") == 1, (sentence, error)
    with pytest.raises(InputError, match="'gian'; 'gain' is the nearest"):
        nominal_of("servo", {"gian": 2.0}, ["rad"])
    with pytest.raises(InputError, match="inertia is given without gain"):
        nominal_of("servo", {"inertia": 2.0}, ["rad"])
    with pytest.raises(InputError, match="no effect of motion 'delai'; 'delay' is the nearest"):
        diagnose_motion(
            load_logs([write_log(tmp_path / "fine.csv", (0,))]), nominal_of("servo", {}, ["rad"]), ["delai"]
        )


@pytest.mark.parametrize("both", [False, True])
def test_gaps_wrapped_counters_and_drives_that_are_off_are_left_out(tmp_path: Path, both: bool) -> None:
    t = np.arange(0, 6, 0.01)
    u = 2.5 * np.sin(2 * t) + 2
    q = u - 0.02
    pwm = 100 * (u - q) + np.sin(40 * t)
    q[200:260], pwm[200:260] = q[200] + 1.0, 0.0
    q = (q + np.pi) % (2 * np.pi) - np.pi
    keep = np.r_[0:480, 530:600]
    sent = (u + np.pi) % (2 * np.pi) - np.pi if both else u
    lines = ["time[s],command1[rad],q1[rad],pwm1[1]"]
    lines += [f"{t[k]},{sent[k]},{q[k]},{pwm[k]}" for k in keep]
    path = tmp_path / "log.csv"
    path.write_text("\n".join(lines) + "\n")
    log = load_logs([path])[0]
    said = " ".join(log.notes)
    assert "1 gap of 0.51 s in all, left out" in said and "the counter of q1 wrapped" in said
    assert "the drive was off for 0.6 s (pwm1" in said and int((~log.on).sum()) == 60
    assert np.allclose((log.position[:, 0] - u[keep])[log.on], -0.02)
    assert np.allclose(log.command[:, 0], u[keep]) and ("command1 wrapped" in said) == both
    # A command may jump by a turn, which the axis then follows.
    step = 2 * np.pi * (t > 3)
    rows = zip(t, step, step * (1 - np.exp(-5 * np.abs(t - 3))), strict=True)
    path.write_text("\n".join([lines[0].removesuffix(",pwm1[1]"), *(f"{a},{b},{c}" for a, b, c in rows)]) + "\n")
    assert np.allclose(load_logs([path])[0].command[:, 0], step)


def test_rows_of_a_run_need_not_be_adjacent(tmp_path: Path) -> None:
    path = write_log(tmp_path / "log.csv", (0, 1), 1.2)
    plain, (head, *rows) = load_logs([path]), path.read_text().splitlines()
    path.write_text("\n".join([head, *sorted(rows, key=lambda row: float(row.split(",")[0]))]) + "\n")
    mixed = load_logs([path])
    for one, other in zip(plain, sorted(mixed, key=lambda log: log.name), strict=True):
        assert one.name == other.name and np.array_equal(one.position, other.position)
        assert not one.notes and "they were gathered" in other.notes[0]


def test_a_gain_is_told_as_a_share_of_that_of_the_model(tmp_path: Path) -> None:
    log = write_log(tmp_path / "log.csv", (0,), 2.4)
    found = diagnose_motion(load_logs([log]), nominal_of("servo", KEYS | {"gain": GAIN / 0.8}, ["rad"]), ["servo_gain"])
    assert found.content["effects"][0]["parameters"]["q1 proportional gain"]["value"] == pytest.approx(-0.2, abs=0.004)
    assert findings(found.content)[0].text.startswith("wrong servo gain of joint 1: proportional gain -20")
