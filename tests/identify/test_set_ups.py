"""One arm measured from two stations and with two tools; its kinematics here share nothing with the package."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from arm_text import ALPHA, A, D, arm_text
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

import ccnn_torch
from ccnn_torch.calibration.calibrate import calibrate
from ccnn_torch.calibration.config import RunConfig
from ccnn_torch.errors import InputError
from ccnn_torch.mechanisms import SerialArm, load_mechanism

Array = NDArray[np.float64]
Cli = Callable[..., tuple[int, str, str]]
ARM = arm_text()
STATIONS = [[1.5, -2, 0.4, 0.1, -0.05, 0.7], [-3.2, 3.8, 0.3, -0.1, 0.2, -2.0]]
TOOLS = [[0.02, 0.03, 0.12, 0.1, 0, 0.2], [-0.05, 0.01, 0.3, 0, 0.3, 0]]
NOISE, TURN_NOISE = 2e-5, 3e-5
SAID = {**dict.fromkeys("xyz", NOISE), **dict.fromkeys(("rx", "ry", "rz"), TURN_NOISE)}
NAMES = ("theta", "d", "a", "alpha")


def _frame(twist: list[float]) -> Array:
    at = np.eye(4)
    at[:3, :3], at[:3, 3] = Rotation.from_rotvec(twist[3:]).as_matrix(), twist[:3]
    return at


def _flange(q: Array, errors: Array) -> Array:
    """The flange in the arm's base, `4 x 4`."""
    at = np.eye(4)
    for angle, a, d, alpha, e in zip(q, A, D, ALPHA, errors.T, strict=True):
        c, s, ca, sa = np.cos(angle + e[0]), np.sin(angle + e[0]), np.cos(alpha + e[3]), np.sin(alpha + e[3])
        x, z = a + e[2], d + e[1]
        link = [[c, -s * ca, s * sa, x * c], [s, c * ca, -c * sa, x * s], [0, sa, ca, z], [0, 0, 0, 1]]
        at = at @ np.array(link)
    return np.asarray(at)


def _measured(folder: Path, seed: int, turned: bool = True, rows: int = 120) -> Array:
    """Writes records of an arm with errors, each row from one of the stations with one of the tools; the errors."""
    draw = np.random.default_rng(seed)
    errors = draw.normal(0, 1, (4, 6)) * np.array([[4e-4], [4e-4], [5e-4], [5e-4]])
    joints, station, tool = draw.uniform(-1.6, 1.6, (rows, 6)), draw.integers(0, 2, rows), draw.integers(0, 2, rows)
    lines = []
    for q, s, t in zip(joints, station, tool, strict=True):
        at = _frame(STATIONS[s]) @ _flange(q, errors) @ _frame(TOOLS[t])
        spun = Rotation.from_rotvec(draw.normal(0, TURN_NOISE, 3)) * Rotation.from_matrix(at[:3, :3])
        place = at[:3, 3] + draw.normal(0, NOISE, 3)
        lines.append([*q, *place, *(spun.as_rotvec() if turned else ()), s + 1, t + 1])
    pose = ["x[m]", "y[m]", "z[m]", *(["rx[rad]", "ry[rad]", "rz[rad]"] if turned else [])]
    header = ",".join([f"q{i + 1}[rad]" for i in range(6)] + pose + ["station[1]", "tool[1]"])
    np.savetxt(folder / "r.csv", np.array(lines), "%.17g", ",", header=header, comments="")
    (folder / "arm.yaml").write_text(ARM + "frame_per: [station]\ntool_per: [tool]\n")
    (folder / "alone.yaml").write_text(ARM)
    return np.asarray(errors)


def _links(parameters: dict[str, dict[str, float]], errors: Array) -> tuple[Array, Array]:
    """Of the links that are identified how far each is off, and what its standard deviation is said to be."""
    found = [(parameters[f"{n}{j + 1}"], errors[k, j]) for k, n in enumerate(NAMES) for j in range(6)]
    known = [(p["value"] - p["nominal"] - e, p["sd"]) for p, e in found if p["identifiable"]]
    return np.array([k[0] for k in known]), np.array([k[1] for k in known])


@pytest.mark.parametrize("turned", [True, False])
def test_links_are_found_from_two_stations_and_two_tools(turned: bool, tmp_path: Path) -> None:
    inside, ratios = [], []
    for seed in range(2 if turned else 1):
        errors = _measured(tmp_path, seed, turned)
        about: dict[str, Any] = {"records": str(tmp_path / "r.csv"), "refit": False, "save_report": False}
        about["noise"] = {n: v for n, v in SAID.items() if turned or n in "xyz"}
        found = ccnn_torch.identify(mechanism=str(tmp_path / "arm.yaml"), **about).results
        off, sd = _links(found["parameters"], errors)
        assert len(off) >= 15 and found["methods"]["lm"]["converged"] == 1
        assert found["test"]["position"]["after"] < 1.4 * np.sqrt(3) * NOISE and not found["doubts"]
        assert found["test"]["position"]["before"] > 5e-4
        inside += list(np.abs(off) < 1.96 * sd)
        ratios.append(float(np.sqrt(np.mean((off / sd) ** 2))))
        if seed == 0:
            place = [found["parameters"][f"base_{c} station 2"]["value"] for c in "xyz"]
            assert np.linalg.norm(np.array(place) - STATIONS[1][:3]) < 5e-3
            # What one station with one of the tools says alone is less.
            table = np.loadtxt(tmp_path / "r.csv", delimiter=",", skiprows=1)
            with (tmp_path / "r.csv").open() as lines:
                header = lines.readline().strip()
            for station in (1,):
                mine = table[(table[:, -2] == station) & (table[:, -1] == 1)]
                np.savetxt(tmp_path / "one.csv", mine, "%.17g", ",", header=header, comments="")
                keys = about | {"records": str(tmp_path / "one.csv"), "mechanism": str(tmp_path / "alone.yaml")}
                own_off, own_sd = _links(ccnn_torch.identify(**keys).results["parameters"], errors)
                assert len(own_off) == len(off) and np.all(own_sd > 1.2 * sd)
                assert np.mean((own_off / sd) ** 2) > 1.5 * np.mean((off / sd) ** 2)
    assert np.mean(inside) > 0.85 and np.sqrt(np.mean(np.square(ratios))) < 1.3, (np.mean(inside), ratios)


def test_the_command_names_the_groups_and_writes_an_arm_that_loads(cli: Cli, tmp_path: Path) -> None:
    _measured(tmp_path, 5)
    out, file = tmp_path / "out", tmp_path / "arm.yaml"
    keys = ("noise.x=0.02mm", "noise.y=0.02mm", "noise.z=0.02mm", *(f"noise.r{a}=0.03mrad" for a in "xyz"))
    words = (
        f"records={tmp_path / 'r.csv'}",
        f"mechanism={file}",
        "joint_noise=1e-6",
        f"out={out}",
        "save_report=false",
        *keys,
    )
    code, _, told = cli("identify", *words)
    assert code == 0, told
    found = json.loads((out / "identified.json").read_text())
    named = [f"{part}_{c} {group}" for part, group in (("base", "station 2"), ("tool", "tool 2")) for c in "xyz"]
    assert set(named) <= set(found["parameters"]) and "base_x" not in found["parameters"]
    arm = load_mechanism(str(out / "identified.yaml"))
    assert isinstance(arm, SerialArm) and arm.frame_per == ("station",)
    assert float(arm.nominal[[p.name for p in arm.geometry].index("a2")]) == found["parameters"]["a2"]["value"]
    # The arm that was found goes on being measured in set-ups of its own.
    code, _, told = cli(
        "identify", words[0], f"mechanism={out / 'identified.yaml'}", f"out={tmp_path / 'again'}", "save_report=false"
    )
    assert code == 0, told


def test_a_group_without_rows_to_identify_from_is_refused(tmp_path: Path) -> None:
    _measured(tmp_path, 6)
    keys = {"records": str(tmp_path / "r.csv"), "mechanism": str(tmp_path / "arm.yaml")}
    split = {"kind": "column", "by": "station", "test_values": [2]}
    with pytest.raises(InputError, match=r"station 2 has \d+ held-out rows but none to identify from"):
        ccnn_torch.identify(**keys, split=split)
    with pytest.raises(InputError, match="frame_per: poses beside a constraint are in the machine's own base"):
        ccnn_torch.identify(**keys, constraint={"kind": "pose"})
    with pytest.raises(InputError, match="transfer: takes an arm with one frame"):
        ccnn_torch.identify(**keys, transfer=keys["records"])


@pytest.mark.parametrize("tools", [1, 2])
def test_a_run_corrects_an_arm_that_was_measured_in_several_set_ups(tools: int, tmp_path: Path) -> None:
    """Its model is of the arm in its own base: on the true arm it leaves a rigid motion, whatever the station."""
    errors = _measured(tmp_path, 1)
    table = np.loadtxt(tmp_path / "r.csv", delimiter=",", skiprows=1)
    header = (tmp_path / "r.csv").read_text().partition("\n")[0]
    table = table[table[:, -1] <= tools]
    np.savetxt(tmp_path / "some.csv", table, "%.17g", ",", header=header, comments="")
    (tmp_path / "arm.yaml").write_text(ARM + "frame_per: [station]\n" + "tool_per: [tool]\n" * (tools > 1))
    keys = {"records": str(tmp_path / "some.csv"), "mechanism": str(tmp_path / "arm.yaml"), "methods": ["constant"]}
    found = calibrate(RunConfig.from_keys(**keys, geometry="identify", effects="none"))
    position = found.results.pose.position
    assert position.explained is not None and position.after.rms.median is not None
    before, explained = position.before.rms.median, position.explained.rms.median
    assert explained is not None and before is not None
    assert explained < 1.4 * np.sqrt(3) * NOISE and explained < 0.1 * before
    # Commands are damped near singular poses of the wrist, some of which are among the rows.
    assert position.after.rms.median < 0.4 * before
    q = np.random.default_rng(3).uniform(-1.5, 1.5, (60, 6))
    told = found.compensator()
    solved = told.solve(torch.from_numpy(q), torch.zeros(60, 0, dtype=torch.float64))
    exact = (solved.status == 0).numpy()
    assert exact.sum() > 30
    q, command = q[exact], solved.command.numpy()[exact]
    wanted = found.mechanism().forward_kinematics(torch.from_numpy(q))[:, :3].numpy()
    # The tool of the model is that of the first training row.
    left, before = (
        min(_apart(np.array([(_flange(v, errors) @ _frame(t))[:3, 3] for v in at]), wanted) for t in TOOLS[:tools])
        for at in (command, q)
    )
    assert left < 6e-5 and left < 0.1 * before


def test_positions_of_two_tools_correct_the_arm_with_either(tmp_path: Path) -> None:
    """What is judged is what the file commands, in its own base; and the orientation, or one tool alone is right."""
    errors = _measured(tmp_path, 5, turned=False)
    table = np.loadtxt(tmp_path / "r.csv", delimiter=",", skiprows=1)
    header = (tmp_path / "r.csv").read_text().partition("\n")[0]
    np.savetxt(tmp_path / "one.csv", table[table[:, -2] == 1], "%.17g", ",", header=header, comments="")
    (tmp_path / "arm.yaml").write_text(ARM + "tool_per: [tool]\n")
    keys = {"records": str(tmp_path / "one.csv"), "mechanism": str(tmp_path / "arm.yaml"), "methods": ["constant"]}
    found = calibrate(RunConfig.from_keys(**keys, geometry="identify", effects="none"))
    position = found.results.pose.position
    assert position.before.rms.median is not None and position.after.rms.median is not None
    assert position.after.rms.median < 0.3 * position.before.rms.median
    assert not any("tool" in note for note in found.results.notes if note.startswith("ignored columns"))
    q = np.random.default_rng(3).uniform(-1.5, 1.5, (60, 6))
    solved = found.compensator().solve(torch.from_numpy(q), torch.zeros(60, 0, dtype=torch.float64))
    exact = (solved.status == 0).numpy()
    assert exact.sum() > 30
    for tool in TOOLS:
        wanted, as_it_is, corrected = (
            np.array([(_flange(v, e) @ _frame(tool))[:3, 3] for v in at[exact]])
            for e, at in ((0 * errors, q), (errors, q), (errors, solved.command.numpy()))
        )
        # Which point of the flange a reflector marks is not known to a mm, so that it turns with the flange.
        turns = np.array([(_flange(v, 0 * errors))[:3, :3] for v in q[exact]])
        assert _apart_with_tool(corrected, wanted, turns) < 0.15 * _apart_with_tool(as_it_is, wanted, turns)


def _apart_with_tool(one: Array, other: Array, turns: Array) -> float:
    """As `_apart`, with the best shift in the frame of the flange, whose turns are given."""
    here = one
    for _ in range(20):
        there = other + np.einsum("sij,j->si", turns, _shift(here, other, turns))
        turn = Rotation.align_vectors(there - there.mean(0), here - here.mean(0))[0]
        here = turn.apply(here - here.mean(0)) + there.mean(0)
    return float(np.sqrt(((here - there) ** 2).sum(1).mean()))


def _shift(here: Array, there: Array, turns: Array) -> Array:
    """Of the tool, beside one of the base, by least squares, `3`."""
    columns = np.concatenate([turns, np.broadcast_to(np.eye(3), turns.shape)], -1).reshape(-1, 6)
    return np.asarray(np.linalg.lstsq(columns, (here - there).ravel(), rcond=None)[0][:3])


def _apart(one: Array, other: Array) -> float:
    """RMS of what a rigid motion leaves between points (Kabsch)."""
    here, there = one - one.mean(0), other - other.mean(0)
    turn = Rotation.align_vectors(there, here)[0]
    return float(np.sqrt(((turn.apply(here) - there) ** 2).sum(1).mean()))
