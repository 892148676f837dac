"""`ccnn diagnose --motion`: what it names, what it writes, and what it refuses."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import jsonschema
import numpy as np
import pytest
from motion.servo import GAIN, KEYS, write_log

from ccnn_torch.errors import InputError
from ccnn_torch.motion import diagnose_motion, load_logs, nominal_of
from ccnn_torch.report.json_files import load_schema

Cli = Callable[..., tuple[int, str, str]]
DATA = Path(__file__).parents[2] / "experiments" / "data"
FEW = ["delay", "coulomb", "offset", "backlash"]


def test_two_causes_are_named_with_their_values(tmp_path: Path) -> None:
    log = write_log(tmp_path / "log.csv", (0, 1), 4.0, dry=0.1, delay=0.03)
    found = diagnose_motion(load_logs([log]), nominal_of("servo", KEYS, ["rad"]), FEW).content
    assert sorted(found["verdict"]["effects"]) == ["coulomb", "delay"] and found["verdict"]["probability"] >= 0.9
    values = {e["name"]: e["parameters"] for e in found["effects"]}
    assert values["delay"]["q1 delay"]["value"] == pytest.approx(0.03, rel=0.05)
    assert values["coulomb"]["q1 coulomb"]["value"] == pytest.approx(0.1, rel=0.1)
    assert values["coulomb"]["q1 coulomb"]["unit"] == "N*m"
    assert found["verdict"]["shrink"] > 0.99 and found["gap"]["after"] < 0.05 * found["gap"]["before"]


def test_a_right_model_leaves_no_claim_and_its_error_says_where(tmp_path: Path) -> None:
    log = write_log(tmp_path / "log.csv", (0, 1), 4.0, dry=0.02 * GAIN)
    right = diagnose_motion(load_logs([log]), nominal_of("servo", KEYS | {"coulomb": 0.02 * GAIN}, ["rad"]), FEW)
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
    effects = "delay,gravity,viscous,coulomb"
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


def test_a_simulator_of_ones_own_is_a_model(tmp_path: Path) -> None:
    log = write_log(tmp_path / "log.csv", (0, 1), 3.0, delay=0.05)
    own = tmp_path / "mine.py"
    own.write_text(
        "import numpy as np\n"
        "class SERVO:\n"
        "    parameters = {'lag': 0.045}\n"
        "    def simulate(self, time, commands, parameters):\n"
        "        q = commands.copy()\n"
        "        for k in range(1, len(time)):\n"
        "            h = time[k] - time[k - 1]\n"
        "            q[k] = q[k - 1] + (commands[k] - q[k - 1]) * h / (h + parameters['lag'])\n"
        "        return q\n"
        "class BROKEN:\n"
        "    def simulate(self, time, commands, parameters):\n"
        "        return commands[1:]\n"
    )
    logs = load_logs([log])
    found = diagnose_motion(logs, nominal_of(f"{own}:SERVO", {}, ["rad"]), ["delay", "offset"]).content
    assert found["verdict"]["effects"] == ["delay"]
    with pytest.raises(InputError, match="must return a position for each"):
        diagnose_motion(logs, nominal_of(f"{own}:BROKEN", {}, ["rad"]), ["delay"])


def test_a_mujoco_model_is_a_model(tmp_path: Path) -> None:
    log = write_log(tmp_path / "log.csv", (0,), seconds=4.0, weight=0.3)
    model = tmp_path / "servo.xml"
    joint = f'<joint axis="0 1 0" armature="{KEYS["inertia"]}" damping="{KEYS["viscous"]}"/>'
    body = f'<body>{joint}<geom type="sphere" size="0.01" mass="1e-6"/></body>'
    text = "<mujoco><worldbody>{}</worldbody><actuator>{}</actuator></mujoco>"
    model.write_text(text.format(body.replace("<joint ", '<joint name="q" '), f'<position joint="q" kp="{GAIN}"/>'))
    found = diagnose_motion(load_logs([log]), nominal_of(str(model), {}, ["rad"]), ["gravity", "delay"]).content
    assert found["verdict"]["effects"] == ["gravity"]
    sag = next(e for e in found["effects"] if e["name"] == "gravity")["parameters"]["q1 sin"]
    assert sag["value"] == pytest.approx(0.3, rel=0.03) and sag["unit"] == "N*m"
    model.write_text(text.format(body.replace("<joint ", '<joint name="q" '), '<motor joint="q"/>'))
    with pytest.raises(InputError, match="<position joint=…/> for each command"):
        nominal_of(str(model), {}, ["rad"])


def test_a_file_that_cannot_be_is_refused_in_one_sentence(tmp_path: Path, cli: Cli) -> None:
    t = np.arange(0, 4, 0.01)
    u, w = np.sin(2 * t), 0.7 * np.sin(3.1 * t + 1)
    one = {"time[s]": t, "command1[rad]": u, "q1[rad]": 0.98 * u}
    both = {**one, "command2[rad]": w, "q2[rad]": w}
    swapped = both | {"q1[rad]": w, "q2[rad]": 0.98 * u}
    back = t.copy()
    back[50] = t[48]
    cases = {
        "time does not increase at line 52 (row 51)": one | {"time[s]": back},
        "one of them is in degrees and not in radians": one | {"q1[rad]": np.degrees(u)},
        "the columns of two joints are swapped": swapped,
        "the drive was off throughout": one | {"torque_on[1]": 0 * t},
        "too few; record at least 100 samples": {n: v[:80] for n, v in one.items()},
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
    with pytest.raises(InputError, match="'gian'; 'gain' is the nearest"):
        nominal_of("servo", {"gian": 2.0}, ["rad"])
    with pytest.raises(InputError, match="inertia is given without gain"):
        nominal_of("servo", {"inertia": 2.0}, ["rad"])
    with pytest.raises(InputError, match="no effect of motion 'delai'; 'delay' is the nearest"):
        diagnose_motion(
            load_logs([write_log(tmp_path / "fine.csv", (0,))]), nominal_of("servo", {}, ["rad"]), ["delai"]
        )


def test_gaps_wrapped_counters_and_drives_that_are_off_are_left_out(tmp_path: Path) -> None:
    t = np.arange(0, 6, 0.01)
    u = 2.5 * np.sin(2 * t) + 2
    q = u - 0.02
    pwm = 100 * (u - q) + np.sin(40 * t)
    q[200:260], pwm[200:260] = q[200] + 1.0, 0.0
    q = (q + np.pi) % (2 * np.pi) - np.pi
    keep = np.r_[0:400, 450:600]
    lines = ["time[s],command1[rad],q1[rad],pwm1[1]"]
    lines += [f"{t[k]},{u[k]},{q[k]},{pwm[k]}" for k in keep]
    path = tmp_path / "log.csv"
    path.write_text("\n".join(lines) + "\n")
    log = load_logs([path])[0]
    said = " ".join(log.notes)
    assert "1 gap of 0.51 s in all, left out" in said and "the counter of q1 wrapped" in said
    assert "the drive was off for 0.6 s (pwm1" in said and int((~log.on).sum()) == 60
    assert np.allclose((log.position[:, 0] - u[keep])[log.on], -0.02)
