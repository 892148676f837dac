"""Simulators as models of a motion: a Python function and MJCF files, and what is written back into them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest
from motion.servo import GAIN, KEYS, command, moved, write_log

from ccnn_torch.diagnosis.page.data import About
from ccnn_torch.diagnosis.page.first_screen import first_screen
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
from ccnn_torch.motion.mujoco_motion import write_mjcf as write_new_values
from ccnn_torch.motion.nominal import Simulator
from ccnn_torch.records import write_table

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
    log, own = write_log(tmp_path / "log.csv", (0, 1), 1.5), tmp_path / "mine.py"
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


LAG = """
import numpy as np
class LAG:
    parameters = {"lag": 0.05}
    def simulate(self, time, commands, parameters):
        keep, q = np.exp(-np.diff(time) / parameters["lag"])[:, None], commands.copy()
        for k in range(1, len(time)):
            q[k] = commands[k] + (q[k - 1] - commands[k]) * keep[k - 1]
        return q
"""


def test_an_axis_delays_also_what_a_simulators_parameter_changes(tmp_path: Path) -> None:
    """The written model leaves on its own log what the file says that it leaves."""
    own, time = tmp_path / "lag.py", np.arange(0, 8, 0.004)
    own.write_text(LAG)
    nominal = nominal_of(f"{own}:LAG", {}, ["rad"])
    assert nominal.simulator is not None
    asked = command(0, time)
    real = Simulator("real", nominal.simulator.simulate, {"lag": 0.065})
    noise = 1e-5 * np.random.default_rng(1).standard_normal(len(time))
    moved_so = real.positions(time, np.interp(time - 0.03, time, asked)[:, None])[:, 0]
    log = tmp_path / "log.csv"
    write_table(log, {"time[s]": time, "command1[rad]": asked, "q1[rad]": moved_so + noise})
    found = diagnose_motion(load_logs([log]), nominal, ["delay"])
    write_identified(tmp_path, found, nominal, {})
    better = load_identified(tmp_path / "identified_motion.json", allow_code=True)
    assert better.nominal.simulator is not None and better.effects == ("delay", "parameter lag")
    assert better.nominal.simulator.parameters["lag"] == pytest.approx(0.065, rel=2e-3)
    assert better.axes[0]["delay"] == pytest.approx(0.03, abs=2e-4)
    there = feed_forward.moved(better.nominal, better.axes, time, asked[None, :, None])[0, :, 0]
    assert np.square(there - moved_so)[50:].mean() ** 0.5 < 3 * better.left[0] < 1e-4


def test_a_mujoco_model_is_a_model_and_gets_the_new_values(tmp_path: Path) -> None:
    # A load of 0.3 N m at 90 degrees, where the model has 0.2 kg at 0.1 m.
    real = {"weight": 0.3, "dry": 0.06}
    log, model = write_log(tmp_path / "log.csv", (0, 1), 2.4, **real), write_mjcf(tmp_path / "servo.xml")
    nominal = nominal_of(str(model), {}, ["rad"])
    found = diagnose_motion(load_logs([log]), nominal, ["gravity", "delay", "coulomb"])
    assert sorted(found.content["verdict"]["effects"]) == ["coulomb", "gravity"]
    sag = next(e for e in found.content["effects"] if e["name"] == "gravity")["parameters"]["q1 torque at 90 degrees"]
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


@pytest.mark.parametrize(
    "form",
    [
        'diaginertia="1e-3 2e-3 2.5e-3"',
        'diaginertia="1e-3 2e-3 2.5e-3" euler="0.1 0.2 0.3"',
        'diaginertia="1e-3 2e-3 2.5e-3" quat="0.8 0 0.6 0"',
        'fullinertia="1e-3 2e-3 2.5e-3 1e-4 0 0"',
    ],
)
def test_a_body_whose_inertia_the_file_tells_gets_a_mass_at_the_tool(tmp_path: Path, form: str) -> None:
    mujoco = pytest.importorskip("mujoco")
    model, new = write_mjcf(tmp_path / "model.xml"), tmp_path / "new.xml"
    told = f'<inertial pos="0 0 -0.05" mass="0.2" {form}/><site pos="0 0 -0.1"/><geom'
    model.write_text(model.read_text().replace("<geom", told))
    nominal = nominal_of(str(model), {}, ["rad"])
    axis = {"gain": 1.0, "coulomb": 0.0, "weakness": 0.0, **nominal.axes[0]}
    write_new_values(str(model), new, [axis], nominal.gains, 0.1)
    old, heavier = (mujoco.MjModel.from_xml_path(str(path)) for path in (model, new))
    assert heavier.body_mass[1] == pytest.approx(0.3)
    assert heavier.dof_M0[0] == pytest.approx(old.dof_M0[0] + 0.1 * 0.1**2, abs=1e-7)


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
    found = diagnose_motion(logs, nominal, ["payload", "gravity", "inertia"])
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
    found = diagnose_motion(load_logs([tmp_path / "log.csv"]), nominal, ["viscous", "inertia"])
    first, second = found.verdicts
    names = found.problem.library.names
    assert [names[m] for m in second.best.members] == ["viscous"]
    assert first.best.members == () and first.probability > 0.9
    # Each joint has a verdict, and a line of a table.
    each = found.content["joints"]
    assert [j["effects"] for j in each] == [[], ["viscous"]] and each[1]["gap_after"] < 0.1 * each[1]["gap_before"]
    assert found.content["verdict"]["probability"] == min(first.probability, second.probability)
    table = next(a.table for a in first_screen(found.content, About()) if a.label == "How sure")
    assert table is not None and [row[:2] for row in table.rows] == [("q1", "–"), ("q2", "viscous friction")]
    assert table.rows[1][2].startswith("10") and "at the least sure joint" in found.content["verdict"]["text"]
    told = next(e for e in found.content["effects"] if e["name"] == "viscous")["parameters"]
    assert {name: v["value"] for name, v in told.items()} == {"q2 viscous": pytest.approx(10.0, rel=0.02)}


def test_a_base_that_is_free_is_held_in_mid_air_and_free_in_what_is_written(tmp_path: Path) -> None:
    mujoco = pytest.importorskip("mujoco")
    fixed, model, new = write_mjcf(tmp_path / "fixed.xml"), tmp_path / "model.xml", tmp_path / "new.xml"
    # The pendulum would hit the floor; the ball beside it is no base.
    base = '<body name="trunk" pos="0 0 0.05"><freejoint/><geom type="sphere" size="0.02" mass="3"/><body>'
    ball = '<body pos="1 0 1"><freejoint/><geom size="0.01"/></body>'
    keys = '<keyframe><key qpos="0 0 0.05 1 0 0 0 0 1 0 1 1 0 0 0"/></keyframe>'
    text = fixed.read_text().replace("<body>", f'<geom type="plane" size="1 1 1"/>{base}')
    text = text.replace("</body></worldbody>", f"</body></body>{ball}</worldbody>{keys}")
    model.write_text(text)
    time = np.arange(0, 2, 0.01)
    asked = command(0, time)[:, None]
    nominal, plain = (nominal_of(str(path), {}, ["rad"]) for path in (model, fixed))
    assert nominal.loaded is not None and plain.loaded is not None
    assert nominal.loaded(time, asked, None).positions == pytest.approx(plain.loaded(time, asked, None).positions)
    assert any("'trunk' is free, and was held in mid-air" in note for note in nominal.notes)
    write_new_values(str(model), new, [{"gain": 1.0, "weakness": 0.0, "coulomb": 0.1, **nominal.axes[0]}], [GAIN], 0.0)
    old, better = (mujoco.MjModel.from_xml_path(str(path)) for path in (model, new))
    assert better.nq == old.nq == 15 and better.dof_frictionloss[6] == pytest.approx(0.1 * GAIN)
    assert better.dof_armature == pytest.approx(old.dof_armature)


class Stiff:
    """A servo whose positions are far from linear in its parameters; only their ratios show."""

    parameters: ClassVar[dict[str, float]] = {"gain": 2.0, "damping": 0.09, "inertia": 0.004}

    @staticmethod
    def simulate(time: np.ndarray, commands: np.ndarray, given: dict[str, float]) -> np.ndarray:
        step = (time[-1] - time[0]) / (2 * (len(time) - 1))
        clock = time[0] + step * np.arange(2 * len(time))
        q, v, found = float(commands[0, 0]), 0.0, np.empty(len(clock))
        for k, u in enumerate(np.interp(clock, time, commands[:, 0]).tolist()):
            found[k] = q
            v += (given["gain"] * (u - q) - given["damping"] * v) / given["inertia"] * step
            q += v * step
        return np.interp(time, clock, found)[:, None]


def test_a_simulator_is_simulated_where_it_is_not_linear(tmp_path: Path) -> None:
    time = np.arange(0, 1.6, 0.01)
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
