"""Distances between two places that a machine itself reached, in every command, from rows that code of its own made."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from ccnn_validation import printer
from identify.instruments import Arm, Array, arm_file, joints

from ccnn_torch import diagnose
from ccnn_torch.calibration.calibrate import calibrate
from ccnn_torch.calibration.config import RunConfig
from ccnn_torch.compensation import load_compensation
from ccnn_torch.errors import InputError
from ccnn_torch.mechanisms import load_mechanism
from ccnn_torch.planning.config import PlanConfig
from ccnn_torch.planning.job import make_plan, write_plan
from ccnn_torch.records import load_records, read_table
from ccnn_torch.testing import check_effect
from ccnn_torch.verification.job import verify_model

NOISE = 2e-5
Move = Callable[[Array, Array], Array]
"""Where the joints of visits in turn `s x 6` really are, with the signs of the ways there."""


def gear(q: Array, way: Array) -> Array:
    """Four waves a turn of the third joint."""
    return q + 4e-4 * np.cos(4 * q[:, [2]]) * [0, 0, 1, 0, 0, 0]


def play(q: Array, way: Array) -> Array:
    """Of 0.4 and 0.6 mrad, in the second and third joint."""
    return q - way * [0, 2e-4, 3e-4, 0, 0, 0]


def pairs(path: Path, count: int, seed: int, move: Move) -> Path:
    """The distances of a true arm whose links are as drawn, and of the joints that it was sent to."""
    visits, rng = joints(2 * count, seed), np.random.default_rng(seed)
    moved = move(visits, np.sign(np.diff(visits, axis=0, prepend=visits[:1] - 1)))
    tips = np.array([Arm(None).tip(q) for q in moved]).reshape(count, 2, 3)
    far = np.linalg.norm(tips[:, 0] - tips[:, 1], axis=1) + rng.normal(0, NOISE, count)
    names = [f"q{i + 1}{end}[rad]" for end in ("", "_b") for i in range(6)]
    table = np.column_stack([visits.reshape(count, 12), far])
    np.savetxt(path, table, delimiter=",", header=",".join([*names, "distance[m]"]), comments="", fmt="%.10g")
    return path


def between(folder: Path, frames: bool = True) -> dict[str, Any]:
    return {"mechanism": str(arm_file(folder, frames=frames)), "kind": "between"}


def test_an_error_of_a_joint_acts_in_both_places(tmp_path: Path, cli: Callable[..., tuple[int, str, str]]) -> None:
    """Named, delivered as a machine of six joints, and right on distances of another day, by the commands."""
    records, later = pairs(tmp_path / "a.csv", 60, 9, gear), pairs(tmp_path / "b.csv", 40, 5, gear)
    config = tmp_path / "own.yaml"
    keys = "".join(f"  {name}: {value}\n" for name, value in between(tmp_path).items())
    config.write_text(f"records: {records}\nmechanism: instrument\nmechanism_keys:\n{keys}")
    effects = "effects=transmission"
    code, out, err = cli("diagnose", "--config", config, effects, "--out", tmp_path / "d", "--no-network")
    assert code == 0, out + err
    model = load_compensation(tmp_path / "d" / "diagnosis.json")
    assert [j.name for j in model.joints] == ["q1", "q2", "q3", "q4", "q5", "q6"]
    said = verify_model(model, str(later), "instrument", mechanism_keys=between(tmp_path))[0].position
    # Effects on both joints, at their own amplitude: half of it would leave half of the gap.
    assert said.after.rms < 1.2 * NOISE < 4 * NOISE < said.before.rms
    wanted = joints(40, 6)
    command = np.asarray(model(wanted)["command"])
    reached, ideal = (np.array([Arm(None).tip(q) for q in v]) for v in (gear(command, command), wanted))
    raw = np.array([Arm(None).tip(q) for q in gear(wanted, wanted)])
    after, before = (float(np.linalg.norm(v - ideal, axis=1).mean()) for v in (reached, raw))
    assert after < 0.2 * before


def test_the_way_to_each_place_follows_from_the_order_of_the_rows(tmp_path: Path) -> None:
    machine = load_mechanism("instrument", **between(tmp_path))
    rows = load_records(str(pairs(tmp_path / "a.csv", 100, 9, play)), machine)
    found = diagnose(rows, machine, effects=["joint_offset", "backlash"], network=True)
    assert found.verdict["effects"] == ["backlash"]
    size = next(e for e in found.effects if e["name"] == "backlash")["parameters"]
    assert size["q2"]["value"] == pytest.approx(4e-4, rel=0.1) and size["q3"]["value"] == pytest.approx(6e-4, rel=0.1)
    assert found.network["reason"] == "each row is of two places, and a network has the joints of one"
    assert set(found.next_measurements[0]["joints"]) == {f"q{i + 1}{end}" for end in ("", "_b") for i in range(6)}


def test_a_run_identifies_from_both_places_and_keeps_its_promise(tmp_path: Path) -> None:
    keys: dict[str, Any] = {"mechanism": "instrument", "mechanism_keys": between(tmp_path)}
    keys |= {"records": str(pairs(tmp_path / "a.csv", 90, 9, gear)), "effects": ["transmission"]}
    with pytest.raises(InputError, match=r"methods: each row of .*a.csv is of two places"):
        calibrate(RunConfig.from_keys(**keys, methods=["gp"]))
    found = calibrate(RunConfig.from_keys(**keys, geometry="identify", methods=["constant"]))
    position = found.results.pose.position
    assert position.explained is not None
    # The commands of both places are judged, and leave what the model does not explain.
    for error in (position.explained, position.after):
        assert error.rms.median is not None and error.rms.median < 1.3 * NOISE
    assert position.before.rms.median is not None and position.before.rms.median > 4 * NOISE
    found.save(tmp_path / "model", forms=["safetensors"])
    model = load_compensation(tmp_path / "model" / "model.safetensors")
    later = str(pairs(tmp_path / "b.csv", 40, 5, gear))
    said = verify_model(model, later, "instrument", mechanism_keys=keys["mechanism_keys"])[0]
    assert said.kept and said.position.after.rms < 1.2 * NOISE
    # Trusted where either place was: the same joints as the first place and as the second.
    table = read_table(Path(keys["records"]))
    second = np.column_stack([table.column(f"q{i + 1}_b", "rad") for i in range(6)])
    assert bool((second > model.region[:, 0]).all() and (second < model.region[:, 1]).all())


@pytest.mark.parametrize("noise", [None, 2e-5])
def test_marks_that_a_printer_made_show_its_geometry(tmp_path: Path, noise: float | None) -> None:
    """Of places that were commanded. Joints that are lengths are no readings: there is one a row, with its noise."""
    rng = np.random.default_rng(0)
    one, two = (np.c_[printer.bed(rng, 60)[:, :2], rng.uniform(0, 0.1, 60)] for _ in range(2))
    there = [printer.reached(printer.carriages(place, np.zeros(12)), place) for place in (one, two)]
    far = np.linalg.norm(there[0] - there[1], axis=1) + rng.normal(0, NOISE, 60)
    names = [f"goal_{axis}{end}[m]" for end in ("", "_b") for axis in "xyz"]
    header = ",".join([*names, "distance[m]"])
    np.savetxt(tmp_path / "m.csv", np.column_stack([one, two, far]), delimiter=",", header=header, comments="")
    (tmp_path / "own.yaml").write_text(printer.FILE)
    machine = load_mechanism("instrument", mechanism=str(tmp_path / "own.yaml"), kind="between")
    records = load_records(str(tmp_path / "m.csv"), machine, learns=False)
    found = diagnose(records, machine, noise=noise, effects=["geometry", "joint_offset", "joint_gain"])
    assert found.verdict["effects"] == ["geometry"] and not found.verdict["outside_library"]
    assert found.analysis.whitening.sigma.tolist() == pytest.approx([NOISE], rel=0.3 if noise is None else 1e-9)


@pytest.mark.parametrize("name", ["transmission", "gravity", "compliance", "thermal", "tool", "geometry"])
def test_effects_change_a_distance_by_what_they_do_at_both_ends(name: str, tmp_path: Path) -> None:
    """Their columns beside differences of what is reached; of joints, parameters and the pose."""
    check_effect(name, load_mechanism("instrument", **between(tmp_path, frames=False)))


def test_both_places_are_planned_within_the_limits(tmp_path: Path) -> None:
    machine = load_mechanism("instrument", **between(tmp_path, frames=False))
    config = PlanConfig.from_file(None, ["candidates=80", "limits={q1: [-1 rad, 1 rad]}", "program=krl"])
    _, plans = make_plan(machine, 24, config)
    write_plan(tmp_path / "plan.csv", machine, plans, 0.02, config)
    table = read_table(tmp_path / "plan.csv")
    ends = [table.column(f"q1{end}", "rad") for end in ("", "_b")]
    assert all(len(np.unique(q)) == 24 and np.abs(q).max() <= 1 for q in ends)
    own = [np.column_stack([table.column(f"q{i + 1}{end}", "rad") for i in range(6)]) for end in ("", "_b")]
    tips = [np.array([Arm(None).tip(q) for q in place]) for place in own]
    np.testing.assert_allclose(table.column("distance", "m"), np.linalg.norm(tips[0] - tips[1], axis=1), atol=1e-9)
    moves = [line for line in (tmp_path / "plan.src").read_text().splitlines() if "PTP {A1" in line]
    assert [float(line.split()[2].rstrip(",")) for line in moves] == pytest.approx(
        np.rad2deg(np.column_stack(ends).ravel()), abs=1e-3
    )


def test_what_two_places_cannot_be_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="a between has no key 'anchors'; it has none"):
        load_mechanism("instrument", **between(tmp_path), anchors=2)
    machine = load_mechanism("instrument", **between(tmp_path))
    assert "base" not in getattr(machine, "unknown_frames", ())
    q = torch.from_numpy(joints(1, 0)[0])
    assert float(machine.forward_kinematics(q, guess=torch.cat([q[:1], q]))[0]) < 1e-9
