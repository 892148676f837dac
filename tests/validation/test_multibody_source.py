"""The multibody source: its models agree with the nominal mechanisms, rest is MuJoCo's, and cases are as they say."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

mujoco = pytest.importorskip("mujoco", reason="needs pip install 'ccnn-torch[mujoco]'")

from ccnn_validation.sources.multibody import FAMILIES, make  # noqa: E402
from ccnn_validation.sources.multibody.build import Build  # noqa: E402
from ccnn_validation.sources.multibody.design import draw_design  # noqa: E402
from ccnn_validation.sources.multibody.equilibrium import settle  # noqa: E402
from ccnn_validation.sources.multibody.families import MACHINES, machines_of  # noqa: E402
from ccnn_validation.sources.multibody.plan import Plan, gap, poses  # noqa: E402
from ccnn_validation.sources.multibody.singles import named  # noqa: E402

from ccnn_torch.mechanisms import load_mechanism  # noqa: E402

# The library's names as docs/how_to/effects.md lists them.
NAMES = {"geometry", "joint_offset", "joint_gain", "transmission", "backlash", "friction", "compliance", "gravity"}
NAMES |= {"thermal", "drift", "frame", "tool", "coupling", "latency", "instrument"}


@pytest.mark.parametrize("name", MACHINES)
def test_the_rigid_model_is_the_nominal_mechanism(name):
    machine = MACHINES[name]()
    design = draw_design(machine, machine.nominal(), np.random.default_rng(1))
    measured = poses(machine, Plan(lambda strength: Build(), named("none")), 1.0, design)
    assert np.abs(gap(machine, measured, design.pose)).max() < 1e-7


_PACE = 0.003


def _simulated(model, commands, start, direction):
    """Joints after MuJoCo's own time steps, at the end of a slow and even way to the command from one side [rad/s]."""
    model.opt.timestep, model.opt.integrator = 1e-3, mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    # Loops and dry friction of MuJoCo's time steps are soft unless they are told not to be.
    model.eq_solref[:], model.eq_solimp[:, :2] = (2e-3, 1.0), 0.9999
    model.dof_solref[:], model.dof_solimp[:, :2] = (2e-3, 1.0), 0.99999
    data = mujoco.MjData(model)
    data.qpos[:] = start
    for step in range(2000):
        data.ctrl[:] = commands - _PACE * direction * (2000 - step) * model.opt.timestep
        mujoco.mj_step(model, data)
    return data.qpos.copy()


@pytest.mark.parametrize("lossy", [False, True])
def test_rest_is_where_time_steps_end(lossy):
    machine = MACHINES["puma"]()
    design = draw_design(machine, machine.nominal(), np.random.default_rng(2))
    one = slice(0, 1)
    loss = 1e-3 * machine.stiff if lossy else None
    build = Build(servo=machine.stiff, gravity=True, friction=loss, damping=0.02 * machine.stiff)
    commands, direction = design.joints[one], design.direction[one]
    start = machine.begin(machine.compiled(build), commands, design.pose[one])
    simulated = _simulated(machine.compiled(build), commands[0], start[0], direction[0])
    rest = settle(machine.compiled(build), commands, start, motion=direction, speed=_PACE * direction).joints[0]
    assert np.abs(rest - commands).max() > 1e-4
    np.testing.assert_allclose(simulated, rest, rtol=0, atol=1e-6)


@pytest.mark.parametrize("name", ["five_bar", "delta"])
def test_rest_of_closed_loops_is_where_time_steps_end(name):
    machine = MACHINES[name]()
    design = draw_design(machine, machine.nominal(), np.random.default_rng(3))
    one = slice(0, 1)
    build = Build(servo=0.1 * machine.stiff, gravity=True, damping=0.02 * machine.stiff)
    start = machine.begin(machine.compiled(build), design.joints[one], design.pose[one])
    model = machine.compiled(build)
    simulated = _simulated(model, design.joints[0], start[0], 0.0)
    rest = settle(machine.compiled(build), design.joints[one], start).joints[0]
    sag = np.abs(rest - start[0]).max()
    assert sag > 1e-4
    assert np.abs(simulated - rest).max() < 0.02 * sag


@pytest.mark.parametrize("family", FAMILIES)
def test_a_case_is_what_it_says(family, tmp_path: Path):
    case = make(family, 5)
    # Every family draws as the others do: some are drawn twice.
    again = make(family, 5) if family in FAMILIES[::4] else case
    for field in dataclasses.fields(case):
        one, other = getattr(case, field.name), getattr(again, field.name)
        if field.name in ("columns", "clean"):
            assert list(one) == list(other)
            assert all(np.array_equal(one[name], other[name]) for name in one)
        else:
            assert one == other

    path = tmp_path / "machine.yaml"
    path.write_text(case.mechanism)
    named_here = "\n" not in case.mechanism
    mechanism = load_mechanism(case.mechanism if named_here else str(path), **(case.mechanism_keys or {}))
    headers = [f"{c.name}[{c.unit}]" for c in mechanism.joints]
    assert [name for name in case.columns if name.startswith("q")] == headers
    poses_named = [f"{c.name}[{c.unit}]" for c in mechanism.pose]
    # A gantry's tool is measured without its orientation.
    assert list(case.clean) in (poses_named, poses_named[:3])
    rows = {len(values) for values in case.columns.values()}
    assert len(rows) == 1
    assert 150 <= rows.pop() <= 300
    assert all(np.isfinite(values).all() for values in case.columns.values())

    truth = case.truth
    assert truth.accepted
    assert all(names <= NAMES for names in truth.accepted)
    assert (truth.kind == "none") == (family == "none")
    assert (truth.kind == "pair") == ("+" in family)
    assert (truth.kind == "outside") == (truth.outside is True) == bool(truth.drivers)
    assert all(len(names) == 2 for names in truth.accepted[:1]) == (truth.kind == "pair")
    drivers = {d for d in truth.drivers if d != "position"}
    assert drivers <= {name.split("[")[0] for name in case.columns} | {f"load_{c.name}" for c in mechanism.pose}

    machine = next(m for m in (MACHINES[name]() for name in machines_of(family)) if m.mechanism == case.mechanism)
    joints = np.stack([v for name, v in case.columns.items() if name.startswith("q")], -1)
    clean = np.stack(list(case.clean.values()), -1)
    measured = np.stack([case.columns[name] for name in case.clean], -1)
    spread = (measured - clean).std(0)
    error = gap(machine, clean, machine.forward(mechanism, joints)[:, : clean.shape[1]])
    assert (spread > 4e-6).all()
    assert (spread < 2.5e-5).all()
    size = np.sqrt(np.mean((error / spread) ** 2))
    assert size < 1e-3 if family == "none" else 4 < size < 50
