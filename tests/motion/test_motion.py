"""`ccnn diagnose --motion`: what it names, what it writes, and what it refuses."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import jsonschema
import numpy as np
import pytest
import torch
from frozen import frozen
from motion.servo import GAIN, INERTIA, KEYS, LENGTH, LOAD, MASS, VISCOUS, command, moved, moved_on_a_spring, write_log

from ccnn_torch.diagnosis.verdict.findings import findings
from ccnn_torch.errors import InputError
from ccnn_torch.motion import diagnose_motion, load_identified, load_logs, nominal_of, write_identified
from ccnn_torch.motion.effects import motion_effects
from ccnn_torch.motion.judge import judge_axes, no_worse
from ccnn_torch.motion.search import search
from ccnn_torch.motion.servo import axis_keys
from ccnn_torch.motion.setting import problem_of
from ccnn_torch.records import read_table

Cli = Callable[..., tuple[int, str, str]]
DATA = Path(__file__).parents[2] / "experiments" / "data"
FEW = ["delay", "coulomb", "offset", "backlash"]


def test_what_no_motion_separates_is_a_class(tmp_path: Path) -> None:
    # Of an axis of which nothing is known, a finite gain and viscous friction are one and the same lag.
    log = write_log(tmp_path / "log.csv", (0, 2), 2.0)
    found = diagnose_motion(load_logs([log]), nominal_of("servo", {}, ["rad"]), ["servo_gain", "viscous", "inertia"])
    named = {e["name"]: e["indistinguishable_from"] for e in found.content["effects"]}
    lag = next(n for n in ("servo_gain", "viscous") if n in found.content["verdict"]["effects"])
    assert named[lag] == ["viscous" if lag == "servo_gain" else "servo_gain"]
    assert found.content["next_measurements"] and all(m["gain"] > 0 for m in found.content["next_measurements"])


def test_a_drift_of_the_encoder_is_outside_the_library(tmp_path: Path) -> None:
    log = write_log(tmp_path / "log.csv", (0, 1), 3.0)
    header, *rows = log.read_text().splitlines()
    cells = [row.split(",") for row in rows]
    lines = [f"{t},{r},{u},{float(q) + 0.03 * np.sin(0.9 * float(t)):.17g}" for t, r, u, q in cells]
    log.write_text("\n".join([header, *lines]) + "\n")
    verdict = diagnose_motion(load_logs([log]), nominal_of("servo", KEYS, ["rad"]), ["delay", "coulomb"]).content[
        "verdict"
    ]
    assert verdict["outside_library"] and verdict["driver"] == "time"


def test_a_torque_with_the_cube_of_the_position_is_not_a_sum_of_names(tmp_path: Path) -> None:
    # Gain, gear ratio and weight leave nearly as little, beside friction that is there.
    log = write_log(tmp_path / "log.csv", (0, 2), 2.0, dry=0.02, cube=0.5)
    tried = ["joint_gain", "gravity", "servo_gain", "coulomb"]
    verdict = diagnose_motion(load_logs([log]), nominal_of("servo", KEYS, ["rad"]), tried).content["verdict"]
    assert verdict["outside_library"] and verdict["driver"] == "position" and verdict["effects"] == ["coulomb"]


def test_the_command_on_a_real_servo(tmp_path: Path, cli: Cli) -> None:
    logs = [w for name in ("sin_sin", "up_and_down") for w in ("--motion", DATA / f"servo_{name}.csv")]
    out = tmp_path / "out"
    effects = "gravity,viscous,coulomb"
    code, said, error = cli("diagnose", *logs, "--mechanism", "servo", "--effects", effects, "--out", out)
    assert code == 0 and not error
    results = json.loads((out / "diagnosis.json").read_text())
    jsonschema.validate(results, frozen("diagnosis"))
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


def test_neither_rounding_nor_the_order_of_effects_decides_a_verdict_on_a_real_servo() -> None:
    logs = load_logs([DATA / "servo_sin_sin.csv"])
    nominal, said, ripples = nominal_of("servo", {}, ["rad"]), [], []
    for seed in (0, 1):
        signs = np.random.default_rng(seed).choice([-1, 0, 1], len(logs[0].time))
        moved = [replace(log, command=log.command * (1 + 2e-16 * signs[: len(log.time), None])) for log in logs]
        ripples.append(problem_of(moved, nominal, motion_effects(["cogging"])).library.facts[0].ripples)
        # A lag is a gain or viscous friction: the two tie.
        tried = ["gravity", "servo_gain", "viscous", "stribeck"]
        said.append(diagnose_motion(moved, nominal, tried[:: 1 - 2 * seed]).content)
    assert ripples[0] == ripples[1] != ()
    first, second = said
    assert first["verdict"]["effects"] == second["verdict"]["effects"] != []
    assert first["verdict"]["probability"] == pytest.approx(second["verdict"]["probability"], abs=1e-4)
    assert first["gap"]["after"] == pytest.approx(second["gap"]["after"], rel=1e-4)


def test_nothing_is_named_that_makes_runs_worse_which_it_was_not_fitted_to(tmp_path: Path) -> None:
    log = write_log(tmp_path / "log.csv", (0, 1), 2.4, delay=0.03)
    problem = problem_of(load_logs([log]), nominal_of("servo", KEYS, ["rad"]), motion_effects(["delay", "offset"]))
    found = search(problem)
    verdicts = judge_axes(found)
    assert [found.problem.library.names[m] for m in verdicts[0].best.members] == ["delay"]
    before = problem.residual(problem.nothing, problem.axes)
    assert no_worse(found, verdicts, (0,), torch.stack([before, 0.99 * before])) == (verdicts, {})
    kept, fewer = no_worse(found, verdicts, (0,), torch.stack([before, 1.01 * before]))
    assert fewer == {0: 0} and kept[0].best.members == () and kept[0].probability <= 0.5
    # Name by name: of two the second one alone makes it worse.
    both = next(fit for fit in found.found[0] if fit.members == (0, 1))
    two = [verdicts[0]._replace(best=both, classes={0: (), 1: ()})]
    kept, fewer = no_worse(found, two, (0, 1), torch.stack([before, 0.5 * before, 0.6 * before]))
    assert fewer == {0: 1} and kept[0].best.members == (0,) and kept[0].classes == {0: ()}
    assert no_worse(found, two, (0, 1), torch.stack([before, 0.5 * before, 0.4 * before])) == (two, {})


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


def test_a_limit_that_acts_in_one_run_alone_is_named(tmp_path: Path) -> None:
    # Only the first motion is fast enough; the others do not tell the limit.
    log = write_log(tmp_path / "log.csv", (0, 1, 1), 2.4, limit=0.25)
    found = diagnose_motion(
        load_logs([log]), nominal_of("servo", KEYS, ["rad"]), ["saturation", "speed_limit", "viscous"]
    )
    assert found.content["verdict"]["effects"] == ["saturation"] and found.content["verdict"]["probability"] > 0.9
    assert found.content["verdict"]["shrink"] > 0.9
    assert any("acts in one run alone: 2 parts of the runs were" in note for note in found.content["notes"])


def test_causes_have_their_values_and_a_corrected_command_is_followed(tmp_path: Path, cli: Cli) -> None:
    real = {"dry": 0.1, "delay": 0.03, "weight": 0.3}
    log, out = write_log(tmp_path / "log.csv", (0, 1), 2.4, **real), tmp_path / "out"
    keys = "{gain: 2.0, inertia: 0.004, viscous: 0.09}"
    # Another share of the command is nearly the same, and less improbable before other runs tell.
    effects = "delay,coulomb,gravity,joint_gain"
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
    assert values["gravity"]["q1 torque at 90 degrees"]["value"] == pytest.approx(0.3, rel=0.05)
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
    def wavering(time: np.ndarray, asked: np.ndarray) -> np.ndarray:
        return moved(time, asked, dry=0.0028) + 1e-4 * np.sin(3 * time)

    nominal, tried = nominal_of("servo", KEYS, ["rad"]), ["delay", "coulomb"]
    log = write_log(tmp_path / "log.csv", (0, 1), 2.4, wavering)
    found = diagnose_motion(load_logs([log]), nominal, tried).content
    assert found["verdict"]["none"] and found["verdict"]["probability"] <= 0.5
    allowed = "(gain 3 %, inertia 3 %, viscous 3 %, time 10 % of a step)"
    assert (
        f"most like dry friction, but by less than the form of a model and its values {allowed}" in found["cautions"][0]
    )
    assert "how far to trust gain, inertia and viscous" in found["cautions"][0]
    # A model beside which friction leaves white noise has the right form.
    log = write_log(tmp_path / "log.csv", (0, 1), 2.4, dry=0.0028)
    found = diagnose_motion(load_logs([log]), nominal, tried).content
    assert found["verdict"]["effects"] == ["coulomb"] and found["verdict"]["probability"] > 0.95


def test_of_a_model_whose_values_are_exact_little_friction_is_named(tmp_path: Path, cli: Cli) -> None:
    log, out = write_log(tmp_path / "log.csv", (0, 1), 2.4, dry=0.0024), tmp_path / "out"
    given = ("diagnose", "--motion", log, "--mechanism", "servo", "--effects", "delay,coulomb", "--out", out)
    values = "mechanism_keys={gain: 2.0, inertia: 0.004, viscous: 0.09}"
    code, _, error = cli(*given, values, "exact=gain,inertia,time", "known={viscous: 0.1 %}")
    assert code == 0 and not error
    found = json.loads((out / "diagnosis.json").read_text())
    assert found["verdict"]["effects"] == ["coulomb"] and found["verdict"]["probability"] > 0.95
    assert found["effects"][0]["parameters"]["q1 coulomb"]["value"] == pytest.approx(0.0024, rel=0.2)
    for words, sentence in {
        ("exact=gian",): "exact: there is no value 'gian'; 'gain' is the nearest",
        ("known={mass: 2 mm}",): "known.mass is in 'mm', a length",
        ("known={mass: 120 %}",): "known.mass: must be a share from 0 up to below 1, such as 2 %, not 120 %",
        ("exact=mass", "known={mass: 2 %}"): "known.mass: it stands in exact as well",
    }.items():
        code, _, error = cli(*given, values, *words)
        assert code == 2 and sentence in error and error.count("\n") == 1, error
    code, _, error = cli("diagnose", "--records", log, "--mechanism", "five_bar", "--out", out, "exact=gain")
    assert code == 2 and "exact and known: tell how well" in error


def test_a_joint_that_moves_another_share_of_its_command_is_no_weight(tmp_path: Path) -> None:
    def scaled(time: np.ndarray, asked: np.ndarray) -> np.ndarray:
        return moved(time, 0.97 * asked)

    log = write_log(tmp_path / "log.csv", (0, 1), 2.4, scaled)
    tried = ["joint_gain", "gravity", "offset", "servo_gain"]
    found = diagnose_motion(load_logs([log]), nominal_of("servo", KEYS, ["rad"]), tried).content
    assert found["verdict"]["effects"] == ["joint_gain"] and found["verdict"]["probability"] > 0.9
    assert found["effects"][0]["parameters"]["q1 gain"]["value"] == pytest.approx(-0.03, rel=0.03)


def test_a_limit_that_falls_with_the_speed_is_told_with_the_speed_at_which_it_is_none(tmp_path: Path) -> None:
    def limited(time: np.ndarray, asked: np.ndarray) -> np.ndarray:
        # A direct-current motor without torque at 2.5 rad/s, in 40 steps for each sample.
        step, q, v, found = 0.01 / 40, asked[0], 0.0, []
        for u, after in zip(asked, [*asked[1:], asked[-1]], strict=True):
            found.append(q)
            for k in range(40):
                torque = GAIN * (u + (after - u) * k / 40 - q)
                torque = min(max(torque, -0.25 * (1 + v / 2.5)), 0.25 * (1 - v / 2.5))
                v += step * (torque - VISCOUS * v) / INERTIA
                q += step * v
        return np.array(found)

    write_log(tmp_path / "log.csv", (0, 2), 3.0, limited)
    tried = ["saturation", "speed_limit", "viscous"]
    found = diagnose_motion(load_logs([tmp_path / "log.csv"]), nominal_of("servo", KEYS, ["rad"]), tried).content
    assert found["verdict"]["effects"] == ["saturation"] and found["verdict"]["probability"] > 0.9
    values = {n: v["value"] for n, v in found["effects"][0]["parameters"].items()}
    assert values == pytest.approx({"q1 torque": 0.25, "q1 speed without torque": 2.5}, rel=0.05)


def test_cogging_of_many_poles_is_named_with_its_order(tmp_path: Path) -> None:
    # Of 14 poles and 12 slots.
    log = write_log(tmp_path / "log.csv", (0, 1), 2.4, teeth=0.02)
    found = diagnose_motion(load_logs([log]), nominal_of("servo", KEYS, ["rad"]), ["cogging", "viscous"]).content
    assert found["verdict"]["effects"] == ["cogging"]
    values = found["effects"][0]["parameters"]
    assert values["q1 cogging_order"]["value"] == pytest.approx(84, abs=0.5)
    assert values["q1 sin"]["value"] == pytest.approx(0.02, rel=0.1)


def test_a_run_that_touches_a_wall_does_not_hide_what_all_share(tmp_path: Path) -> None:
    lines = write_log(tmp_path / "log.csv", (0, 1, 2), 2.4, dry=0.1).read_text().splitlines()
    cells = [line.split(",") for line in lines[1:]]
    # The second one stops at 0.3 rad.
    rows = [f"{t},{run},{u},{min(float(q), 0.3) if run == '1' else q}" for t, run, u, q in cells]
    (tmp_path / "log.csv").write_text("\n".join([lines[0], *rows]) + "\n")
    nominal = nominal_of("servo", KEYS, ["rad"])
    found = diagnose_motion(load_logs([tmp_path / "log.csv"]), nominal, ["delay", "coulomb"]).content
    assert found["verdict"]["effects"] == ["coulomb"] and found["verdict"]["probability"] > 0.9
    assert found["effects"][0]["parameters"]["q1 coulomb"]["value"] == pytest.approx(0.1, rel=0.1)
    assert "run 1 leaves" in found["cautions"][0] and "was left out" in found["cautions"][0]


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


def test_a_gain_is_told_as_a_share_of_that_of_the_model(tmp_path: Path) -> None:
    log = write_log(tmp_path / "log.csv", (0,), 2.4)
    found = diagnose_motion(load_logs([log]), nominal_of("servo", KEYS | {"gain": GAIN / 0.8}, ["rad"]), ["servo_gain"])
    parameters = found.content["effects"][0]["parameters"]
    assert [*parameters] == ["q1 proportional gain"]
    assert parameters["q1 proportional gain"]["value"] == pytest.approx(-0.2, abs=0.004)
    assert findings(found.content)[0].text.startswith("wrong servo gain of joint 1: proportional gain -20")


def test_a_dead_band_of_the_drive_is_named_and_is_no_friction(tmp_path: Path) -> None:
    log = write_log(tmp_path / "log.csv", (0, 2), 3.0, band=0.02)
    tried = ["dead_band", "coulomb", "backlash", "viscous", "delay"]
    found = diagnose_motion(load_logs([log]), nominal_of("servo", KEYS, ["rad"]), tried).content
    assert found["verdict"]["effects"] == ["dead_band"] and found["verdict"]["probability"] > 0.9
    numbers = next(e for e in found["effects"] if e["name"] == "dead_band")["parameters"]
    assert numbers["q1 dead band"]["value"] == pytest.approx(0.02, rel=0.03)


def test_a_limit_of_the_set_points_acceleration_is_named(tmp_path: Path) -> None:
    # Steps, of which the drive makes as fast ones as it may: half the way faster and faster, then slower.
    most, time, begin, generator = 6.0, np.arange(0, 5, 0.01), 0.0, np.random.default_rng(4)
    asked, made = np.zeros_like(time), np.zeros_like(time)
    for at, size in ((0.195, 0.5), (1.195, -0.9), (2.295, 0.3), (3.095, 0.7), (4.095, -0.6)):
        half, since = np.sqrt(abs(size) / most), np.maximum(time - at, 0)
        way = np.where(since < half, most * since**2 / 2, abs(size) - most * np.maximum(2 * half - since, 0) ** 2 / 2)
        made += np.sign(size) * way
        asked[time >= at] = begin = begin + size
    q = moved(time, made) + 1e-4 * generator.standard_normal(len(time))
    rows = np.stack([time, asked, q], -1)
    np.savetxt(tmp_path / "log.csv", rows, delimiter=",", header="time[s],command1[rad],q1[rad]", comments="")
    tried = ["acceleration_limit", "speed_limit", "saturation", "inertia", "delay"]
    nominal = nominal_of("servo", KEYS, ["rad"])
    found = diagnose_motion(load_logs([tmp_path / "log.csv"]), nominal, tried).content
    assert found["verdict"]["effects"] == ["acceleration_limit"] and found["verdict"]["probability"] > 0.9
    number = next(e for e in found["effects"] if e["name"] == "acceleration_limit")["parameters"]["q1 acceleration"]
    # Between which samples a step was made is not known.
    assert number["value"] == pytest.approx(most, rel=0.05) and number["unit"] == "rad/s^2"
    keys = axis_keys(nominal, [{"ramp": 1 / most}], [0.0])
    assert keys["acceleration_limit"] == [pytest.approx(most)]


def test_a_derivative_gain_is_told_in_seconds_over_the_proportional_one(tmp_path: Path) -> None:
    log = write_log(tmp_path / "log.csv", (0, 1), 2.4, derivative=0.02)
    found = diagnose_motion(load_logs([log]), nominal_of("servo", KEYS, ["rad"]), ["servo_gain", "delay", "viscous"])
    assert found.content["verdict"]["effects"] == ["servo_gain"]
    assert found.content["verdict"]["probability"] > 0.95
    parameters = found.content["effects"][0]["parameters"]
    assert [*parameters] == ["q1 derivative gain"]
    assert parameters["q1 derivative gain"]["value"] == pytest.approx(0.02, rel=0.03)


def test_gains_that_are_many_times_too_high_in_the_model_are_told_as_such(tmp_path: Path) -> None:
    # In a unit that is 2 pi too large: the velocity gain is part of the model's viscous friction.
    log = write_log(tmp_path / "log.csv", (0, 1), 2.4, dry=0.02)
    model = KEYS | {"gain": 2 * np.pi * GAIN, "viscous": VISCOUS + (2 * np.pi - 1) * 0.07, "coulomb": 0.02}
    tried = ["servo_gain", "viscous", "inertia", "coulomb"]
    found = diagnose_motion(load_logs([log]), nominal_of("servo", model, ["rad"]), tried).content
    assert sorted(found["verdict"]["effects"]) == ["servo_gain", "viscous"]
    effects = {e["name"]: e for e in found["effects"]}
    gain, viscous = (effects[name]["parameters"] for name in ("servo_gain", "viscous"))
    assert gain["q1 proportional gain"]["value"] == pytest.approx(1 / (2 * np.pi) - 1, abs=0.005)
    assert viscous["q1 viscous"]["value"] == pytest.approx(-(2 * np.pi - 1) * 0.07, rel=0.03)
    assert any("is the same as inertia, friction and weight 6.2" in note for note in found["notes"])


def test_integral_action_is_named_with_its_integral_gain(tmp_path: Path) -> None:
    log = write_log(tmp_path / "log.csv", (0, 1), 2.4, integral=2.0, weight=0.3)
    nominal = nominal_of("servo", KEYS | {"gravity_sin": 0.3}, ["rad"])
    tried = ["integral_action", "servo_gain", "gravity"]
    found = diagnose_motion(load_logs([log]), nominal, tried)
    assert found.content["verdict"]["effects"] == ["integral_action"]
    assert found.content["verdict"]["probability"] > 0.95
    value = found.content["effects"][0]["parameters"]["q1 integral gain"]
    assert value["unit"] == "1/s" and value["value"] == pytest.approx(2.0, rel=0.03)
    # Form errors are in the standard deviation; the noise of the encoder alone would give a tenth of it.
    assert abs(value["value"] - 2.0) < 3 * value["sd"] < 0.3
    # The identified servo has it as a key, and goes where the real one went.
    write_identified(tmp_path, found, nominal, KEYS | {"gravity_sin": 0.3})
    keys = json.loads((tmp_path / "identified_motion.json").read_text())["mechanism_keys"]
    left = diagnose_motion(load_logs([log]), nominal_of("servo", keys, ["rad"]), ["integral_action", "viscous"])
    assert left.content["verdict"]["none"] and left.content["gap"]["before"] < 0.1 * found.content["gap"]["before"]


def test_the_part_of_an_inertia_that_is_the_load_is_a_key_and_is_kept() -> None:
    keys = {"gain": 2.0, "inertia": 10.0, "load_inertia": 6.0, "mass": 3.0, "length": 0.5}
    nominal = nominal_of("servo", keys, ["rad"])
    assert nominal.axes[0]["load"] == pytest.approx((6.0 + 0.75) / 2) and nominal.axes[0]["inertia"] == 10.75 / 2
    told = axis_keys(nominal, nominal.axes, [0.5])
    assert told["load_inertia"] == [pytest.approx(6.0)] and told["mass"] == [3.5]
    assert told["inertia"] == [pytest.approx(10.0 - 0.5 * 0.25)]
    # Less inertia than the model says its load has: what is written is a servo all the same.
    less = axis_keys(nominal, [{**nominal.axes[0], "inertia": 4.75 / 2}], [0.0])
    assert less["load_inertia"] == less["inertia"] == [pytest.approx(4.0)]
    assert nominal_of("servo", less, ["rad"]).axes[0]["load"] == pytest.approx(4.75 / 2)
    with pytest.raises(InputError, match="load_inertia is a part of inertia"):
        nominal_of("servo", keys | {"inertia": 5.0}, ["rad"])
