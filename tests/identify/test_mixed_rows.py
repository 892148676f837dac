"""Rows of several instruments on one arm, in one table: none of them determines the arm, all together do."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from identify.instruments import ALPHA, BOARD, A, Arm, Array, D, arm_file, images, joints, turn
from scipy.optimize import least_squares

from ccnn_torch import diagnose
from ccnn_torch.api import identify
from ccnn_torch.calibration.calibrate import calibrate
from ccnn_torch.calibration.config import RunConfig
from ccnn_torch.diagnosis.from_records import situation_of
from ccnn_torch.diagnosis.page.outputs import write_diagnosis
from ccnn_torch.effects import Acting, make_effect, reached, signature
from ccnn_torch.errors import InputError
from ccnn_torch.mechanisms import load_mechanism
from ccnn_torch.planning.config import PlanConfig
from ccnn_torch.planning.job import make_plan
from ccnn_torch.records import load_records

Cli = Callable[..., tuple[int, str, str]]
ANCHORS = np.array([[1.2, 0.3, 0.1], [-0.8, 1.1, 0.4]])
MOUNT = turn([0.01, -0.02, 0.015])
NOISE = {"level": 1e-5, "wire": 2e-5, "pose": 3e-5}
COUNTS = {"level": 60, "wire": 70, "pose": 8}
INSTRUMENTS: list[dict[str, Any]] = [
    {"kind": "level"},
    {"kind": "wire", "anchors": 2},
    {"kind": "pose", "pose": ["x", "y", "z"]},
]
READ = {"level": ["tilt_x", "tilt_y"], "wire": ["distance"], "pose": ["x", "y", "z"]}


def readings(arm: Arm, kind: str, q: Array, number: Array, anchors: Array = ANCHORS, mount: Array = MOUNT) -> Array:
    """What an instrument reads with joints `s x 6`, `s x c`; number: of the anchor, from 0."""
    if kind == "level":
        return np.asarray(np.arcsin((arm.flange(q)[0] @ mount)[:, 2, :2]))
    tips = arm.tip(q)
    return tips if kind == "pose" else np.linalg.norm(tips - anchors[number], axis=1)[:, None]


def table(folder: Path, arm: Arm, kinds: list[str], seed: int) -> tuple[Path, dict[str, tuple[Array, Array, Array]]]:
    """Records with a row for each reading, cells of the others empty; of each kind joints, number, what was read."""
    rng = np.random.default_rng(seed)
    read = [c for kind in kinds for c in READ[kind]]
    units = {"tilt_x": "urad", "tilt_y": "urad", "distance": "mm", "x": "mm", "y": "mm", "z": "mm"}
    header = [f"q{i + 1}[rad]" for i in range(6)] + [f"{c}[{units[c]}]" for c in read]
    header += ["anchor[1]"] if "wire" in kinds else []
    lines, rows = [], {}
    for kind in kinds:
        q = joints(COUNTS[kind], int(rng.integers(1 << 30)))
        number = np.arange(len(q)) % len(ANCHORS)
        seen = readings(arm, kind, q, number)
        seen = seen + rng.normal(0, NOISE[kind], seen.shape)
        rows[kind] = q, number, seen
        for v, n, r in zip(q, number, seen, strict=True):
            own = dict(zip(READ[kind], r, strict=True))
            cells = [f"{own[c] * (1e6 if units[c] == 'urad' else 1e3):.12g}" if c in own else "" for c in read]
            cells += [f"{n + 1}" if kind == "wire" else ""] if "wire" in kinds else []
            lines.append(",".join([*(f"{x:.15g}" for x in v), *cells]))
    order = rng.permutation(len(lines))
    path = folder / f"{'_'.join(kinds)}.csv"
    path.write_text("\n".join([",".join(header), *(lines[i] for i in order)]) + "\n")
    return path, rows


FREE = [f"{n}{i + 1}" for n in ("a", "alpha", "d", "theta") for i in range(6)]


def with_errors(change: Array) -> Arm:
    arm = Arm(None)
    a, alpha, d, theta = change.reshape(4, 6)
    arm.a, arm.alpha, arm.d, arm.theta = A + a, ALPHA + alpha, D + d, theta
    return arm


def by_scipy(rows: dict[str, tuple[Array, Array, Array]]) -> Arm:
    """The arm by plain least squares with the true weights and the priors of the package's defaults."""

    def gap(x: Array) -> Array:
        arm = with_errors(x[:24])
        anchors, mount = x[24:30].reshape(2, 3), turn(x[30:33] + 1e-12)
        parts = [x[:24] / PRIOR]
        for kind, (q, number, seen) in rows.items():
            parts.append(((readings(arm, kind, q, number, anchors, mount) - seen) / NOISE[kind]).ravel())
        return np.concatenate(parts)

    start = np.concatenate([np.zeros(24), ANCHORS.ravel(), np.zeros(3)])
    return with_errors(least_squares(gap, start, x_scale="jac", method="trf").x[:24])


PRIOR = np.array([1e-3] * 6 + [1e-2] * 6 + [1e-3] * 6 + [1e-2] * 6)


PLACES = joints(300, 77)


def elsewhere(tips: Array, arm: Arm) -> float:
    """RMS over places of the workspace, none of them measured, of how far tips are from the true arm's [m]."""
    gap = tips - arm.tip(PLACES)
    return float(np.sqrt((gap**2).sum(1).mean()))


def tips_of(seen: Any) -> Array:
    return np.asarray(seen.mechanism.forward_kinematics(torch.from_numpy(PLACES))[:, :3].numpy())


def test_a_level_alone_does_not_determine_the_arm_and_all_together_do(tmp_path: Path) -> None:
    """Beside SciPy's least squares with the true weights."""
    arm, nominal = Arm(4), str(arm_file(tmp_path, frames=False))
    left = {}
    for kinds in (["level"], ["level", "wire", "pose"]):
        records, rows = table(tmp_path, arm, kinds, 5)
        keys = {"mechanism": nominal, "instruments": [i for i in INSTRUMENTS if i["kind"] in kinds]}
        about: dict[str, Any] = {"records": str(records), "mechanism": "instrument", "mechanism_keys": keys}
        found = identify(**about, seed=0, refit=len(kinds) > 1)
        left["+".join(kinds)] = elsewhere(tips_of(found.mechanism()), arm)
    together = left.pop("level+wire+pose")
    assert min(left.values()) > 4 * together, left
    reference = by_scipy(rows)
    assert together < 1.1 * elsewhere(reference.tip(PLACES), arm)
    # The noise of each kind as it was, and the same number where it is given.
    said = found.results["constraint"]["readings"]
    for kind, names in READ.items():
        assert all(0.7 < said[n]["noise"] / NOISE[kind] < 1.2 and said[n]["rows"] == COUNTS[kind] for n in names)
    given = {"rad": "10 urad", "distance": "20 um", **dict.fromkeys("xyz", "30 um")}
    again = identify(
        records=str(records), mechanism="instrument", mechanism_keys=keys, noise=given, seed=0, refit=False
    )
    assert all(block["noise_known"] for block in again.results["constraint"]["readings"].values())
    assert elsewhere(tips_of(again.mechanism()), arm) < 1.3 * together


def test_every_command_takes_rows_of_several_instruments(tmp_path: Path, cli: Cli) -> None:
    arm, kinds = Arm(4), ["level", "wire", "pose"]
    records, _ = table(tmp_path, arm, kinds, 5)
    keys: dict[str, Any] = {"mechanism": str(arm_file(tmp_path, frames=False)), "instruments": INSTRUMENTS}
    machine = load_mechanism("instrument", **keys)
    effects = ["geometry", "joint_offset"]
    said = diagnose(load_records(str(records), machine), machine, network=False, effects=effects)
    assert set(said.verdict["effects"]) <= {"geometry", "joint_offset"} and said.verdict["effects"]
    assert said.by_block["after"] < 0.1 * said.by_block["before"]
    write_diagnosis(tmp_path / "why", said)
    assert (tmp_path / "why" / "report.html").is_file()
    config = {
        "records": str(records),
        "mechanism": "instrument",
        "mechanism_keys": keys,
        "effects": "none",
        "geometry": "identify",
    }
    (tmp_path / "arm_run.yaml").write_text(json.dumps(config))
    code, _, told = cli(
        "run", tmp_path / "arm_run.yaml", f"out={tmp_path / 'run'}", "methods=[constant]", "save_report=false"
    )
    assert code == 0, told
    pose = json.loads((tmp_path / "run" / "results.json").read_text())["pose"]
    for block in (pose["position"], pose["rotation"]):
        assert block["after"]["rms"]["median"] < 0.05 * block["before"]["rms"]["median"]
    # Another day, another table: of the wires alone, whose anchors are fitted to it.
    later, _ = table(tmp_path, arm, ["wire"], 9)
    words = (tmp_path / "run" / "model.safetensors", later, "--config", tmp_path / "arm_run.yaml")
    code, _, told = cli("verify", *words, "--out", tmp_path / "later")
    judged = json.loads((tmp_path / "later" / "verify.json").read_text())["position"]
    assert judged["after"]["rms"] < 0.1 * judged["before"]["rms"], told
    _, plans = make_plan(machine, 30, PlanConfig.from_file(None, ["candidates=60"]))
    assert bool(torch.isfinite(plans[0].pose).all()) and set(plans[0].pose[:, 6].tolist()) == {1.0, 2.0}


def test_a_camera_stands_beside_other_rows(tmp_path: Path) -> None:
    """It has a place of its own on the hand, and its board one in the frame of the tracker."""
    arm = Arm(4)
    q, columns = images(arm, 8, 3, 0.2)
    spots = joints(10, 8)
    tips = arm.tip(spots) + np.random.default_rng(2).normal(0, 3e-5, (10, 3))
    empty, pixels = np.full((10, 5), np.nan), np.column_stack([*columns.values()])
    every = np.block([[q, pixels, np.full((len(q), 3), np.nan)], [spots, empty, tips]])
    header = ",".join([*(f"q{i + 1}[rad]" for i in range(6)), *columns, "x[m]", "y[m]", "z[m]"])
    lines = [",".join("" if np.isnan(v) else f"{v:.15g}" for v in row) for row in every]
    (tmp_path / "both.csv").write_text("\n".join([header, *lines]) + "\n")
    camera = {"kind": "camera", "fx": 900.0, "cx": 640.0, "cy": 360.0}
    keys = {
        "mechanism": str(arm_file(tmp_path, frames=False)),
        "instruments": [camera, {"kind": "pose", "pose": ["x", "y", "z"]}],
    }
    found = identify(
        records=str(tmp_path / "both.csv"), mechanism="instrument", mechanism_keys=keys, seed=0, refit=False
    )
    said = found.results["constraint"]["readings"]
    assert 0.8 < said["u"]["noise"] / 0.2e-6 < 1.2 and said["x"]["noise"] < 6e-5
    values = dict(zip((p.name for p in found.mechanism().geometry), found.mechanism().nominal.tolist(), strict=True))
    assert abs(values["camera_fx"] * 1e6 - 905) < 4
    board = [values[f"stand_{c}"] for c in "xyz"]
    assert np.linalg.norm(np.array(board) - BOARD[1]) < 1e-3
    assert elsewhere(tips_of(found.mechanism()), arm) < 0.1 * elsewhere(Arm(None).tip(PLACES), arm)
    found.save(tmp_path / "found")
    again = load_mechanism(str(tmp_path / "found" / "identified.yaml"))
    torch.testing.assert_close(again.nominal, found.mechanism().nominal, rtol=0, atol=1e-12)


def test_instruments_that_cannot_stand_together_are_refused(tmp_path: Path) -> None:
    arm = str(arm_file(tmp_path, frames=False))
    for instruments, said in (
        ([{"kind": "level"}, {"kind": "level", "link": 3}], "two have 'tilt_x'; give one of them a name"),
        ([{"anchors": 2}], "has no kind; write one of camera, wire"),
        ({"kind": "level"}, "write a list"),
        ([{"kind": "pose", "pose": ["x", "rz"]}], "write some of x, y, z, and all of rx, ry, rz or none"),
    ):
        with pytest.raises(InputError, match=said):
            load_mechanism("instrument", mechanism=arm, instruments=instruments)
    two = [{"kind": "level"}, {"kind": "level", "link": 3, "name": "arm"}]
    machine = load_mechanism("instrument", mechanism=arm, instruments=two)
    assert [c.name for c in machine.pose] == ["tilt_x", "tilt_y", "arm.tilt_x", "arm.tilt_y"]
    records, _ = table(tmp_path, Arm(4), ["wire", "pose"], 5)
    text = records.read_text().replace(",1\n", ",\n", 1)
    records.write_text(text)
    machine = load_mechanism("instrument", mechanism=arm, instruments=INSTRUMENTS[1:])
    with pytest.raises(InputError, match=r"column 'anchor' is empty at line .* where distance was read"):
        load_records(str(records), machine)


def test_distances_between_two_places_stand_beside_heights(tmp_path: Path) -> None:
    """A cause at the joints acts at both places of a distance, and once on what is read at the first alone."""
    arm, rng = Arm(4), np.random.default_rng(3)
    pairs, spots = joints(120, 9).reshape(60, 2, 6), joints(60, 10)
    far = np.linalg.norm(arm.tip(pairs[:, 0]) - arm.tip(pairs[:, 1]), axis=-1) + rng.normal(0, 1e-5, 60)
    heights = arm.tip(spots)[:, 2] + rng.normal(0, 1e-5, 60)
    empty = np.full((60, 6), np.nan)
    none = empty[:, :1]
    every = np.block([[pairs[:, 0], pairs[:, 1], far[:, None], none], [spots, empty, none, heights[:, None]]])
    header = ",".join([*(f"q{i + 1}{end}[rad]" for end in ("", "_b") for i in range(6)), "distance[m]", "z[m]"])
    lines = [",".join("" if np.isnan(v) else f"{v:.15g}" for v in row) for row in every]
    (tmp_path / "rows.csv").write_text("\n".join([header, *lines]) + "\n")
    instruments = [{"kind": "between"}, {"kind": "pose", "pose": ["z"]}]
    keys = {"mechanism": str(arm_file(tmp_path, frames=False)), "instruments": instruments}
    machine = load_mechanism("instrument", **keys)  # type: ignore[arg-type]
    records = load_records(str(tmp_path / "rows.csv"), machine)
    here = situation_of(records, machine)
    effect = make_effect("joint_gain", machine)
    shape = torch.zeros(0, dtype=torch.float64)
    size = 1e-6 * torch.randn(len(effect.coefficients(here)), generator=torch.Generator().manual_seed(1)).double()
    moved = reached(here, [Acting(effect, shape, size)]) - reached(here, [])
    seen = ~records.pose[:, :2].isnan()
    linear = (signature(here, effect, shape) @ size)[:, :2]
    torch.testing.assert_close(linear[seen], moved[:, :2][seen], rtol=1e-3, atol=1e-11)
    assert float(linear[seen].abs().median()) > 1e-8
    about: dict[str, Any] = {"mechanism": "instrument", "mechanism_keys": keys, "records": str(tmp_path / "rows.csv")}
    found = identify(**about, seed=0, refit=False).results
    assert all(0.6 < found["constraint"]["readings"][n]["noise"] / 1e-5 < 1.4 for n in ("distance", "z"))
    position = calibrate(RunConfig.from_keys(**about, geometry="identify", effects="none")).results.pose.position
    before, after = position.before.rms.median, position.after.rms.median
    assert before is not None and after is not None and after < 0.1 * before
