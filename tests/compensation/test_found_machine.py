"""The machine of a diagnosis.json wherever a machine is asked for; that of a model file: test_machine.py."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from fitted import LIMITS, six_axis_arm
from torch import Tensor

from ccnn_torch import diagnose, export_model, load_mechanism, load_records
from ccnn_torch.compensation import load_compensation
from ccnn_torch.compensation.job import compensate_table
from ccnn_torch.compensation.model_files.identified import model_of_machine
from ccnn_torch.compensation.wanted import WantedPoses
from ccnn_torch.effects import Acting, Situation, default_gravity, make_effect, measured_pose, reached
from ccnn_torch.effects.found_machine import FoundMachine
from ccnn_torch.errors import InputError
from ccnn_torch.mechanisms import FiveBar
from ccnn_torch.records import read_table, write_table
from ccnn_torch.simulation.job import simulate_records, write_simulated

Block = dict[str, Any]


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A diagnosis.json of a five-bar with wrong lengths and backlash; its records beside it."""
    folder = tmp_path_factory.mktemp("found")
    made = simulate_records("five_bar", ["geometry:A1x=0.0004", "backlash"], 120, 1e-5, seed=3)
    write_simulated(folder / "rows.csv", made)
    mechanism = load_mechanism("five_bar")
    effects = ["geometry", "joint_offset", "backlash", "compliance", "drift", "thermal"]
    said = diagnose(load_records(folder / "rows.csv", mechanism), mechanism, effects=effects)
    assert said.machine is not None and {e["name"] for e in said.machine["effects"]} == {"backlash"}
    (folder / "diagnosis.json").write_text(json.dumps({"machine": said.machine}), encoding="utf-8")
    return folder / "diagnosis.json"


def test_its_commands_bring_the_machine_to_the_nominal_pose(found: Path) -> None:
    model = load_compensation(found)
    assert model.machine is not None
    names = [c.name for c in model.covariates]
    assert {"direction1", "direction2"} <= set(names) and "temperature" not in names
    region = model.machine.rows(50)
    given = {n: v.sign() if n.startswith("direction") else v for n, v in region.covariates.items()}
    answer = model(region.joints.numpy(), torch.stack([given[n] for n in names], -1).numpy())
    exact = torch.from_numpy(answer["status"] < 2)
    assert float(exact.double().mean()) > 0.95
    there = Situation(model.machine.nominal, torch.from_numpy(answer["command"]), given, region.gravity)
    pose = measured_pose(there, reached(there, model.machine.acting, model.machine.values))
    wanted = model.machine.nominal.forward_kinematics(region.joints)
    torch.testing.assert_close(pose[exact], wanted[exact], rtol=0, atol=5e-7)
    with pytest.raises(InputError, match=r"needs the covariates .*direction1"):
        model(region.joints.numpy())


def test_linuxcnc_has_what_acts_beside_the_geometry(found: Path, tmp_path: Path) -> None:
    files = export_model(found, "linuxcnc", tmp_path)
    assert "in_direction1" in files["ccnnkins.comp"].read_text()


def test_it_says_that_rows_are_outside_what_was_measured(found: Path, tmp_path: Path) -> None:
    model = load_compensation(found)
    low, high = model.region.T
    # The middle of the region, and beyond its end.
    rows = torch.from_numpy((low + high) / 2 + torch.tensor([[0.0], [0.6]]).numpy() * (high - low))
    columns = {c.header: rows[:, i].numpy() for i, c in enumerate(model.joints)}
    write_table(tmp_path / "in.csv", columns | {c.header: [1.0, 1.0] for c in model.covariates})
    said, _ = compensate_table(model, tmp_path / "in.csv", tmp_path / "out.csv")
    joints, load = ", ".join(c.name for c in model.joints), model.covariates[0].header
    assert said[1].endswith(f" in {joints} (inside_domain = 0): geometry and effects hold there too.")
    # Inputs are named that are beyond in those rows, and no others.
    middle = {c.header: (low + high)[[i, i]] / 2 for i, c in enumerate(model.joints)}
    beside = {c.header: [1.0, 1.0] for c in model.covariates}
    write_table(tmp_path / "in.csv", middle | beside | {load: [1.0, 1e3]})
    said, _ = compensate_table(model, tmp_path / "in.csv", tmp_path / "out.csv")
    held = "load_x held at the ends of what was measured."
    then = "geometry and effects hold there too, with"
    assert said[1] == f"1 of them is outside what was measured in load_x (inside_domain = 0): {then} {held}"


def test_it_is_a_mechanism(found: Path) -> None:
    machine, known = load_mechanism(str(found)), load_compensation(found)
    assert isinstance(machine, FiveBar) and known.machine is not None
    torch.testing.assert_close(machine.nominal, known.machine.values, rtol=0, atol=0)
    assert not torch.equal(machine.nominal, known.machine.nominal.nominal)
    with pytest.raises(InputError, match=r"mechanism_keys: .* leave out l"):
        load_mechanism(str(found), l=0.3)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda b: b["effects"][0].update(name="nonsense"), "nonsense"),
        (lambda b: b["effects"][0].update(name="geometry"), "geometry"),
        (lambda b: b["effects"][0]["coefficients"].pop(), "backlash"),
        (lambda b: b["effects"][0].update(coefficients=[1e300]), "coefficients"),
        (lambda b: b["parameters"].popitem(), "machine: is not as ccnn diagnose writes it"),
        (lambda b: b.pop("gravity"), "gravity"),
        (lambda b: b["joints"].update(q1=[0.0]), "joints"),
        (lambda b: b["nominal"].update(spec="evil.py:Machine"), "not allowed|allow-code|code"),
        (lambda b: b.update(covariates=7), "covariates"),
    ],
)
def test_a_forged_one_is_refused_in_one_sentence(
    found: Path, tmp_path: Path, change: Callable[[Block], Any], said: str
) -> None:
    content = json.loads(found.read_text(encoding="utf-8"))
    change(content["machine"])
    (tmp_path / "diagnosis.json").write_text(json.dumps(content), encoding="utf-8")
    with pytest.raises(InputError, match=said) as refused:
        load_compensation(tmp_path / "diagnosis.json")
    assert "\n" not in str(refused.value) and "diagnosis.json" in str(refused.value)


def test_without_a_machine_it_says_what_to_do(tmp_path: Path) -> None:
    path = tmp_path / "diagnosis.json"
    path.write_text('{"machine": null}', encoding="utf-8")
    with pytest.raises(InputError, match="no effect was named that a model could hold; calibrate with ccnn run"):
        load_compensation(path)
    for text in ("{}", "[", "7", '"machine"'):
        path.write_text(text, encoding="utf-8")
        with pytest.raises(InputError, match=r"diagnosis\.json"):
            load_compensation(path)


def test_legs_that_were_moved_far_are_not_drawn_one_by_one() -> None:
    machine = load_mechanism("stewart")
    joints = machine.sample_joints(500, torch.Generator().manual_seed(1))
    middle = joints.mean(0)
    edges = torch.stack([middle + 1.5 * (joints.amin(0) - middle), middle + 1.5 * (joints.amax(0) - middle)], -1)
    none = torch.zeros(0, 2, dtype=torch.float64)
    found = FoundMachine(machine, machine.nominal, [], default_gravity(machine), edges, (), none, {}, {})
    drawn = found.rows(2000).joints
    torch.testing.assert_close(torch.stack([drawn.amin(0), drawn.amax(0)], -1), edges, rtol=0, atol=1e-12)
    # Legs that are drawn one by one turn the platform by up to 2.7 rad, and six in ten of them meet nowhere.
    turns = machine.forward_kinematics(drawn)[:, 3:].abs().amax(0)
    assert bool((turns < 2.2 * machine.sample_workspace(500, torch.Generator().manual_seed(1))[:, 3:].amax(0)).all())


@pytest.mark.parametrize("name", ["delta_linear", "five_bar", "stewart"])
def test_the_zero_of_one_joint_is_commanded_whole_where_all_others_are_right(name: str) -> None:
    """What the others move on the way to the command bounded the whole of it: by nanometres."""
    nominal = load_mechanism(name)
    joints, none = nominal.sample_joints(40, torch.Generator().manual_seed(0)), torch.zeros(0, dtype=torch.float64)
    zero = torch.zeros(len(nominal.joints), dtype=torch.float64)
    zero[1] = 2e-3
    ends = torch.stack([joints.amin(0), joints.amax(0)], -1)
    effect, gravity = Acting(make_effect("joint_offset"), none, zero), default_gravity(nominal)
    machine = FoundMachine(nominal, nominal.nominal.clone(), [effect], gravity, ends, (), none.reshape(0, 2), {}, {})
    answer = model_of_machine(Path("found"), machine)(joints.numpy())
    assert set(answer["status"].tolist()) <= {0, 1}
    torch.testing.assert_close(torch.from_numpy(answer["command"]), joints - zero, rtol=0, atol=1e-8)


def test_gravity_of_the_rows_is_that_of_the_machine(found: Path) -> None:
    machine = load_compensation(found).machine
    assert machine is not None
    torch.testing.assert_close(machine.gravity, default_gravity(load_mechanism("five_bar")), rtol=0, atol=0)


def test_the_first_pose_is_reached_on_the_branch_that_was_measured(tmp_path: Path) -> None:
    arm, none = six_axis_arm(), torch.zeros(0, 2, dtype=torch.float64)
    about = (default_gravity(arm), torch.tensor(LIMITS, dtype=torch.float64), (), none, {}, {})
    model = model_of_machine(tmp_path / "diagnosis.json", FoundMachine(arm, arm.nominal, [], *about))
    joints = arm.sample_joints(100, torch.Generator().manual_seed(4))
    # From the middle of the region the solver goes to another branch in these.
    for row in (15, 40, 78):
        pose = arm.forward_kinematics(joints[row])
        middle = arm.solve_inverse(pose, guess=torch.from_numpy(model.region.mean(-1)))
        assert float(arm.wrap(middle - joints[row]).abs().max()) > 0.1
        write_table(tmp_path / "pose.csv", {c.header: pose[i : i + 1].numpy() for i, c in enumerate(arm.pose)})
        found, _ = WantedPoses(model).joints(read_table(tmp_path / "pose.csv"))
        assert float(arm.wrap(torch.from_numpy(found[0]) - joints[row]).abs().max()) < 1e-6


def test_after_a_jump_the_branch_is_that_of_what_was_measured(tmp_path: Path) -> None:
    """Where the solver goes from a row far away is anywhere; a path that leaves what was measured is followed."""
    arm, none = six_axis_arm(), torch.zeros(0, 2, dtype=torch.float64)
    about = (default_gravity(arm), torch.tensor(LIMITS, dtype=torch.float64), (), none, {}, {})
    model = model_of_machine(tmp_path / "diagnosis.json", FoundMachine(arm, arm.nominal, [], *about))
    low, high = torch.from_numpy(model.region).unbind(-1)
    middle, room = (low + high) / 2, 0.55 * (high - low)

    def inside(wanted: Tensor) -> Tensor:
        pose = arm.forward_kinematics(wanted)
        write_table(tmp_path / "pose.csv", {c.header: pose[:, i].numpy() for i, c in enumerate(arm.pose)})
        found = torch.from_numpy(WantedPoses(model).joints(read_table(tmp_path / "pose.csv"))[0])
        torch.testing.assert_close(arm.forward_kinematics(found)[:, :3], pose[:, :3], rtol=0, atol=1e-7)
        return (arm.wrap(found - middle).abs() <= room).all(-1)

    jumping = arm.sample_joints(30, torch.Generator().manual_seed(4))
    assert bool(inside(jumping).all())
    path = middle + torch.linspace(0, 1, 25, dtype=torch.float64)[:, None] * (high - low) * torch.eye(6)[0].double()
    assert inside(path).tolist() == (arm.wrap(path - middle).abs() <= room).all(-1).tolist()
