"""The judge of delivered commands: its kinematics, its reference, its files, and one machine from start to end."""

import ast
import json
import math
from contextlib import chdir
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from xml.etree import ElementTree

import ccnn_validation.delivered as package
import numpy as np
import pytest
import torch
from ccnn_validation.delivered.__main__ import main
from ccnn_validation.delivered.arm_files import dh_chain
from ccnn_validation.delivered.chain import Chain, chain_pose
from ccnn_validation.delivered.judge import judged, jump, reached, reference_row
from ccnn_validation.delivered.kinds import KINDS, draw
from ccnn_validation.delivered.machine import Block
from ccnn_validation.delivered.parallel import leg_lengths
from ccnn_validation.delivered.plan import SETS, Rows, measured_pose, measured_rows, test_rows
from ccnn_validation.delivered.product import Contestant, calibrated, delivered, promised
from ccnn_validation.delivered.reference import apart, commands, fitted, fitted_frames, reachable, rms
from ccnn_validation.delivered.report import figures_of, line, summary
from ccnn_validation.delivered.rotation import difference, matrix
from ccnn_validation.delivered.tables import Commands, read_commands
from ruamel.yaml import YAML
from scipy.linalg import expm
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from ccnn_torch.cli.application import app
from ccnn_torch.mechanisms import load_mechanism
from ccnn_torch.records import load_records

test_rows.__test__ = False
PARALLEL = ("delta", "stewart", "five_bar")


def test_it_imports_nothing_of_the_package():
    for file in Path(package.__path__[0]).glob("*.py"):
        for node in ast.walk(ast.parse(file.read_text())):
            names = [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            names += [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            assert not [name for name in names if name.startswith(("ccnn_torch", "torch"))], file


def twist(axis, point, sliding):
    """4 x 4 of a joint's motion about (along) an axis through a point, for 1 rad (1 m)."""
    found = np.zeros((4, 4))
    if sliding:
        found[:3, 3] = axis
    else:
        found[:3, :3] = np.cross(np.eye(3), axis)
        found[:3, 3] = -np.cross(axis, point)
    return found


@pytest.mark.parametrize("kind", [kind for kind in KINDS if kind not in PARALLEL])
def test_a_chain_is_the_product_of_its_exponentials(kind):
    machine = draw(kind, 3, ())
    values = {block.name: block.true for block in machine.blocks}
    gears, count = values["gears"], len(machine.units)
    chain = _chain_of(machine)

    def at(joints, links):
        return chain_pose(chain, joints, values["base_frame"], values["tool_frame"], links)

    zero = np.zeros((1, count))
    # Axes and points of the machine as built at its zero pose, from poses with a tool on each joint alone.
    screws, rotation, position = [], matrix(values["base_frame"][3:]), values["base_frame"][:3]
    for i, (shift, turn) in enumerate(chain.origins):
        position = position + rotation @ (shift + values["links"][i, :3])
        rotation = rotation @ matrix(values["links"][i, 3:]) @ turn
        screws.append(twist(rotation @ chain.axes[i], position, machine.units[i] == "m"))
    home_position, home_rotation = at(zero, values["links"])
    home = np.eye(4)
    home[:3, :3], home[:3, 3] = home_rotation[0], home_position[0]
    rows = measured_rows(machine, 3)
    pose = machine.true_pose(rows.joints, rows.covariates)
    for row, q in enumerate(rows.joints):
        waves = sum(gears[:, 2 * k - 2] * np.sin(k * q) + gears[:, 2 * k - 1] * np.cos(k * q) for k in (1, 2))
        turning = np.array([unit == "rad" for unit in machine.units])
        moved = q + values["zeros"] + np.where(turning, waves, gears[:, 0] * q)
        product = np.linalg.multi_dot([*(expm(s * a) for s, a in zip(screws, moved, strict=True)), home])
        assert np.allclose(product[:3, 3], pose.position[row], atol=1e-12)
        assert np.allclose(product[:3, :3], pose.rotation[row], atol=1e-12)


def _chain_of(machine):
    """The chain that the machine's file tells, read by a few lines of our own."""
    if machine.files.mechanism.endswith(".yaml"):
        table = YAML(typ="safe").load(machine.files.text)
        return dh_chain([v / 1e3 for v in table["a"]], table["alpha"], [v / 1e3 for v in table["d"]])
    places, axes, units = [], [], []
    for joint in ElementTree.fromstring(machine.files.text).iter("joint"):
        origin = joint.find("origin")
        xyz, rpy = (np.array(origin.get(name).split(), float) for name in ("xyz", "rpy"))
        places.append((xyz, Rotation.from_euler("xyz", rpy).as_matrix()))
        if joint.get("type") != "fixed":
            axes.append(np.array(joint.find("axis").get("xyz").split(), float))
            units.append("rad" if joint.get("type") == "revolute" else "m")
    return Chain(tuple(places[:-1]), np.array(axes), tuple(units), places[-1])


def test_parallel_machines_close():
    for kind in PARALLEL:
        machine = draw(kind, 2)
        values = {block.name: block.true for block in machine.blocks}
        rows = measured_rows(machine, 40)
        pose = machine.true_pose(rows.joints, rows.covariates)
        moved = values["gain"] * rows.joints + values["offset"]
        if kind == "stewart":
            lengths = leg_lengths(values["base"], values["platform"], pose.position, pose.rotation)
            assert np.allclose(lengths, moved, atol=1e-9)
            assert np.allclose(pose.rotation @ pose.rotation.swapaxes(1, 2), np.eye(3), atol=1e-12)
        elif kind == "delta":
            for leg, angle in enumerate(values["angle"]):
                out, down = np.array([math.cos(angle), math.sin(angle), 0]), np.array([0, 0, -1])
                elbow = values["base"][leg] * out + values["crank"][leg] * (
                    np.cos(moved[:, leg, None]) * out + np.sin(moved[:, leg, None]) * down
                )
                rod = pose.position + values["platform"][leg] * out - elbow
                assert np.allclose(np.linalg.norm(rod, axis=-1), values["rod"][leg], atol=1e-12)
            assert (pose.position[:, 2] < 0).all()
        else:
            elbows = values["foot"] + values["crank"][:, None] * np.stack([np.cos(moved), np.sin(moved)], -1)
            rods = np.linalg.norm(pose.position[:, None] - elbows, axis=-1)
            assert np.allclose(rods, values["coupler"], atol=1e-12)


@pytest.mark.parametrize("kind", PARALLEL)
def test_a_nominal_parallel_machine_is_that_of_the_documentation(kind):
    machine = draw(kind, 1)
    rows = measured_rows(machine, 5)
    pose = machine.nominal_pose(np.zeros(0), rows.joints)
    mechanism = load_mechanism(kind, **machine.files.keys)
    theirs = mechanism.forward_kinematics(torch.from_numpy(rows.joints)).numpy()
    split = pose.position.shape[1]
    assert np.allclose(theirs[:, :split], pose.position, atol=1e-8)
    if pose.rotation is not None:
        assert np.allclose(Rotation.from_rotvec(theirs[:, split:]).as_matrix(), pose.rotation, atol=1e-8)


def test_difference_is_that_of_scipy():
    rng = np.random.default_rng(0)
    first, second = Rotation.random(50, rng), Rotation.random(50, rng)
    assert np.allclose(difference(first.as_matrix(), second.as_matrix()), (second * first.inv()).as_rotvec(), atol=1e-7)
    small = Rotation.from_rotvec(1e-6 * rng.normal(size=(50, 3)))
    assert np.allclose(difference(first.as_matrix(), (small * first).as_matrix()), small.as_rotvec(), atol=1e-14)


def test_weight_and_load_are_the_slopes_of_an_energy():
    machine = draw("seven", 5, ("sag",))
    loaded = draw("seven", 5, ("payload",))
    rows = measured_rows(machine, 4)
    masses = next(block.true for block in machine.blocks if block.name == "masses")

    def sagged(of, name, covariates):
        """Joint errors of a compliance of 1 rad/(N m) alone, from the slope of the tool's pose."""
        blocks = [
            replace(b, true=np.ones_like(b.true)) if b.name == name else b if b.name == "masses" else _nominal(b)
            for b in of.blocks
        ]
        small = replace(of, blocks=tuple(replace(b, true=1e-7 * b.true) if b.name == name else b for b in blocks))
        none = replace(of, blocks=tuple(replace(b, true=0 * b.true) if b.name == name else b for b in blocks))
        frames = none.vector("true")[:12]
        slope = _slopes(lambda q: none.nominal_pose(frames, q), rows.joints)
        moved = apart(none.true_pose(rows.joints, covariates), small.true_pose(rows.joints, covariates)) / 1e-7
        return np.stack([np.linalg.pinv(s) @ s for s in slope]), np.stack(
            [np.linalg.lstsq(s, m, rcond=None)[0] for s, m in zip(slope, moved, strict=True)]
        )

    def energy_slopes(height):
        return np.stack([(height(rows.joints + d) - height(rows.joints - d)) / 2e-6 for d in 1e-6 * np.eye(7)], -1)

    chain = _chain_of(machine)
    nothing = np.zeros(6)

    def weight(joints):
        total = np.zeros(len(joints))
        ends = []
        for i in range(1, 8):
            part = replace(chain, origins=chain.origins[:i], axes=chain.axes[:i], units=chain.units[:i])
            part = replace(part, flange=(np.zeros(3), np.eye(3)))
            ends.append(chain_pose(part, joints[:, :i], nothing, nothing)[0][:, 2])
        ends.append(chain_pose(chain, joints, nothing, nothing)[0][:, 2])
        for i in range(7):
            height = ends[i + 1] if i == 6 else (ends[i] + ends[i + 1]) / 2
            total += 9.81 * 6.0 * masses[i] * height
        return total

    span, found = sagged(machine, "sag", rows.covariates)
    wanted = -energy_slopes(weight)
    assert np.allclose((span @ wanted[..., None])[..., 0], found, atol=1e-3 * np.abs(wanted).max())
    covariates = {**rows.covariates, "load_z": np.full(4, -50.0)}
    span, found = sagged(loaded, "payload", covariates)
    wanted = -energy_slopes(lambda q: 50.0 * chain_pose(chain, q, nothing, nothing)[0][:, 2])
    assert np.allclose((span @ wanted[..., None])[..., 0], found, atol=1e-3 * np.abs(wanted).max())


def _nominal(block: Block) -> Block:
    return block if block.name.endswith("frame") else replace(block, true=block.nominal)


def _slopes(pose, joints):
    return np.stack([apart(pose(joints - d), pose(joints + d)) / 2e-6 for d in 1e-6 * np.eye(joints.shape[1])], -1)


@pytest.mark.parametrize(("kind", "extras"), [("spherical", ("backlash",)), ("delta", ())])
def test_the_reference_recovers_a_machine_with_tiny_noise(kind, extras):
    machine = replace(draw(kind, 4, extras), noise=(1e-8, 1e-8))
    at = measured_rows(machine, 40)
    sets = test_rows(machine, 8)
    frames = fitted_frames(machine, at.joints, machine.true_pose(at.joints, at.covariates))
    row = reference_row(machine, at, measured_pose(machine, at), sets, frames)
    assert row["reference_inside_mm"] < 1e-4 and row["reference_edge_mm"] < 1e-4
    assert row["reference_inside_mrad"] < 1e-3


def test_the_reference_keeps_its_bound():
    machine = draw("offset", 6, ())
    at = measured_rows(machine, 50)
    fit = fitted(machine, at, measured_pose(machine, at))
    error = fit.unknowns - machine.vector("true")
    scaled = error / machine.vector("prior")
    squares = ((fit.slopes @ scaled) ** 2).sum() + scaled @ scaled
    # A chi-square of as many degrees of freedom as unknowns, a little less under priors wider than the draw.
    assert 0.3 * len(error) < squares < 1.5 * len(error)


def test_commands_leave_what_a_machine_cannot_do_alone():
    machine = draw("scara", 1, ())
    rows = measured_rows(machine, 10)
    frames = machine.vector("true")[:12]
    wanted = machine.nominal_pose(frames, rows.joints)
    joints = commands(machine, machine.vector("true"), wanted, rows)
    there = machine.true_pose(joints, rows.covariates)
    span = reachable(machine, frames, rows.joints)
    assert np.allclose(np.linalg.matrix_rank(span), 4)
    assert rms(wanted, there, span)[0] < 2e-6 and rms(wanted, there)[1] > 1e-4


def test_test_rows_are_where_they_should_be():
    machine = draw("spherical", 1)
    sets = test_rows(machine, 60)
    middle, half = (machine.low + machine.high) / 2, (machine.high - machine.low) / 2
    share = {name: np.abs((rows.joints - middle) / half) for name, rows in sets.items()}
    assert share["inside"].max() <= 1
    assert np.allclose(share["edge"].max(-1), 1) and share["edge"].max() <= 1 + 1e-12
    assert (share["outside"].max(-1) > 1).all() and share["outside"].max() <= 1.3
    through = sets["wrist"].joints[:, 4]
    assert through.min() < 0 < through.max() or abs(through).min() == pytest.approx(abs(machine.low[4]))
    assert np.allclose(np.diff(sets["wrist"].joints, 2, axis=0), 0, atol=1e-12)
    assert jump(sets["wrist"].joints, sets["wrist"].joints) == pytest.approx(1)


def test_damped_rows_are_counted_apart():
    machine = draw("delta", 1)
    sets = test_rows(machine, 10)
    status = np.array([3.0, 1.0, *[0.0] * 8])
    found = {name: Commands(rows.joints, status) for name, rows in sets.items()}
    row = reached(machine, sets, found, np.zeros(0), "who")
    inside = sets["inside"]
    rest = Rows(inside.joints[1:], inside.covariates, inside.columns)
    wanted = machine.nominal_pose(np.zeros(0), rest.joints)
    expected = rms(wanted, machine.true_pose(rest.joints, rest.covariates))[0]
    assert row["who_inside_damped"] == 1 and row["who_inside_outside"] == 1
    assert row["who_inside_exact_mm"] == pytest.approx(1e3 * expected)


def test_commands_are_read_in_their_units(tmp_path):
    path = tmp_path / "out.csv"
    path.write_text("q1[deg],command_q1[deg],command_q2[mm],inside_domain[1],status[1]\n1,180,250,0,3\n1,90,1,1,0\n")
    read = read_commands(path, 2)
    assert np.allclose(read.joints, [[math.pi, 0.25], [math.pi / 2, 0.001]])
    assert read.status.tolist() == [3, 0]
    with pytest.raises(ValueError, match="command_q3"):
        read_commands(path, 3)


def test_ratios_of_a_row():
    row = {
        **dict(kind="delta", seed=1, extras="", whole="", reference_counts=1.0, noise_mm=3.0, noise_mrad=0.0, said=""),
        **dict(before_mm=9.0, reference_inside_mm=2.0, promised_mm=10.0, c_inside_mm=4.0, c_inside_mrad=0.0),
    }
    found = figures_of(row, "c")
    assert found == {"reached/reference mm": 2.0, "measured/promised mm": 0.5}
    assert "2 (0/1)" in summary([row], "c") and "0.5 (1/1)" in summary([row], "c")


@pytest.mark.parametrize("seed", [1, 2])
@pytest.mark.parametrize("kind", list(KINDS))
def test_the_files_are_read_by_the_package(kind, seed, tmp_path, monkeypatch):
    monkeypatch.setattr("ccnn_validation.delivered.product.Contestant.call", lambda *_: False)
    machine = draw(kind, seed)
    rows = measured_rows(machine, 40)
    measured = measured_pose(machine, rows)
    contestant = calibrated(machine, rows, measured, "run", (), tmp_path)
    assert promised(contestant)["position"] is None
    spec = machine.files.mechanism
    mechanism = load_mechanism(str(tmp_path / spec) if machine.files.text else spec, **machine.files.keys)
    records = load_records(tmp_path / "measured.csv", mechanism)
    assert np.allclose(records.joints.numpy(), rows.joints, atol=1e-9)
    assert sorted(c.name for c in records.covariate_coordinates) == sorted(rows.columns)


def test_a_compiled_function_gets_joints_and_covariates(tmp_path, monkeypatch):
    machine = draw("five_axis", 1, ("thermal", "backlash"))
    declared = "int ccnn_compensate(const double q[], const double c[], double command[], double deviation[])"
    body = "for (int i = 0; i < 5; i++) { command[i] = q[i] + c[i]; deviation[i] = 0; } return c[0] > 0 ? 3 : 1;"

    def exported(contestant, *arguments):
        folder = contestant.folder / "c"
        folder.mkdir()
        (folder / "compensator.h").write_text(f"{declared};\n")
        (folder / "compensator.c").write_text(f'#include "compensator.h"\n{declared} {{ {body} }}\n')
        return True

    monkeypatch.setattr("ccnn_validation.delivered.product.Contestant.call", exported)
    names = ["direction2", "temperature", "direction1", "direction3", "direction4"]
    (tmp_path / "card.json").write_text(json.dumps({"covariates": [{"name": name, "unit": "1"} for name in names]}))
    (tmp_path / "model.safetensors").touch()
    sets = test_rows(machine, 4)
    found = delivered(Contestant(tmp_path, "run", tmp_path / "model.safetensors"), "c", machine, sets)
    for name, rows in sets.items():
        given = np.stack([rows.covariates[n] + 273.15 * (n == "temperature") for n in names], -1)
        assert np.allclose(found[name].joints, rows.joints + given, atol=1e-12)
        assert np.array_equal(found[name].status, np.where(given[:, 0] > 0, 3, 1))


def test_one_machine_from_start_to_end(tmp_path, monkeypatch):
    # In this process: one of its own for every command takes seconds to start.
    def run(words, cwd, **_):
        with chdir(cwd):
            done = CliRunner().invoke(app, words[3:])
        return SimpleNamespace(returncode=done.exit_code, stdout=done.stdout, stderr=done.stderr)

    monkeypatch.setattr("ccnn_validation.delivered.product.subprocess.run", run)
    machine = draw("five_bar", 1)
    row = judged(
        machine,
        40,
        12,
        "run",
        ("safetensors",),
        ("methods=constant", "geometry=none", "effects=none", "save_report=false"),
        tmp_path,
    )
    assert row["said"] == ""
    for name in (*(f"safetensors_{name}_mm" for name in SETS), "promised_mm", "before_mm"):
        assert math.isfinite(row[name]), name
    assert row["safetensors_inside_mm"] < row["before_mm"]
    assert json.loads((tmp_path / "row.json").read_text())["kind"] == "five_bar"
    assert "five_bar" in line(row, ("safetensors",)) and "onnx: no commands" in line(row, ("onnx",))


def test_an_unknown_kind_is_one_sentence(monkeypatch, capsys):
    monkeypatch.setattr("sys.argv", ["delivered", "--seed", "1", "--machines", "crane", "--out", "x"])
    with pytest.raises(SystemExit, match="2"):
        main()
    assert "'crane' is not known; known: spherical" in capsys.readouterr().err
