"""Machines seen through an instrument, from rows that code of its own made: camera, wire, level, gauge, two arms."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from identify.instruments import (
    CORNERS,
    LENS,
    TOOL,
    Arm,
    Array,
    arm_file,
    camera_pose,
    images,
    joints,
    turn,
    write,
)

from ccnn_torch import diagnose
from ccnn_torch.api import identify
from ccnn_torch.calibration.calibrate import calibrate
from ccnn_torch.calibration.config import RunConfig
from ccnn_torch.compensation import load_compensation
from ccnn_torch.compensation.model_files.identified import load_machine
from ccnn_torch.errors import InputError
from ccnn_torch.identification.identify import Identification
from ccnn_torch.mechanisms import Instrument, load_mechanism, mechanism_from_description
from ccnn_torch.planning.config import PlanConfig
from ccnn_torch.planning.job import make_plan
from ccnn_torch.records import load_records
from ccnn_torch.verification.job import verify_model

CAMERA: dict[str, Any] = {"kind": "camera", "fx": 900.0, "cx": 640.0, "cy": 360.0}
ANCHORS = np.array([[1.2, 0.3, 0.1], [-0.8, 1.1, 0.4], [0.2, -1.3, 0.9]])
PIXEL = 1e-6


def _camera(folder: Path, count: int = 16) -> dict[str, Any]:
    q, columns = images(Arm(0), count, 0, 0.2)
    records = write(folder / "board.csv", q, columns)
    keys = {"mechanism": str(arm_file(folder, frames=True)), **CAMERA}
    return {"records": str(records), "mechanism": "instrument", "mechanism_keys": keys}


@pytest.fixture(scope="module")
def seen(tmp_path_factory: pytest.TempPathFactory) -> tuple[dict[str, Any], Identification]:
    """Keys of a camera over a board, and what was identified from its pixels; read only."""
    keys = _camera(tmp_path_factory.mktemp("board"))
    return keys, identify(**keys, noise="0.2 px", seed=0, refit=False)


def test_pixels_of_a_board_identify_the_arm_its_mounting_and_the_lens(
    seen: tuple[dict[str, Any], Identification], tmp_path: Path
) -> None:
    """The reference is the noise: of two coordinates of 0.2 pixels, on images that were held out whole."""
    found = seen[1]
    held_out = found.results["test"]["position"]
    assert 0.9 < held_out["after"] / (math.sqrt(2) * 0.2 * PIXEL) < 1.25
    assert held_out["before"] > 4 * held_out["after"]
    machine = found.mechanism()
    values = dict(zip((p.name for p in machine.geometry), machine.nominal.tolist(), strict=True))
    for name in ("fx", "fy", "cx", "cy"):
        assert abs(values[f"camera_{name}"] / PIXEL - LENS[name]) < 3, name
    assert abs(values["camera_k1"] - LENS["k1"]) < 0.03
    # New images of the same arm, at other places.
    q, columns = images(Arm(0), 6, 99, 0.0)
    rows = torch.from_numpy(np.column_stack([columns["u[px]"], columns["v[px]"]]) * PIXEL)
    given = torch.from_numpy(np.column_stack([columns[f"board_{a}[m]"] for a in "xyz"]))
    again = machine.forward_kinematics(torch.from_numpy(q), guess=torch.cat([rows, given], -1))[:, :2]
    assert float((again - rows).norm(dim=-1).square().mean().sqrt()) < 0.6 * PIXEL
    # Its file is the machine with the camera as found, and nothing of it is fitted anew.
    found.save(tmp_path / "found")
    read = load_mechanism(str(tmp_path / "found" / "identified.yaml"))
    assert isinstance(read, Instrument) and read.unknown_frames == ()
    torch.testing.assert_close(read.nominal, machine.nominal, rtol=0, atol=1e-12)


def test_corners_of_a_board_that_is_not_as_drawn_are_found_along(tmp_path: Path) -> None:
    """Half a millimetre of a printer's paper: without the corners as unknowns it would be the arm's."""
    off = np.random.default_rng(7).normal(0, 3e-4, CORNERS.shape) * [1, 1, 0]
    keys = _camera(tmp_path)
    q, columns = images(Arm(0), 16, 0, 0.2, off)
    number = np.arange(len(q)) % len(CORNERS) + 1.0
    write(tmp_path / "board.csv", q, {**columns, "corner[1]": number})
    plain = identify(**keys, seed=0, refit=False).results["test"]["position"]["after"]
    keys["mechanism_keys"] |= {"corners": len(CORNERS), "board_tolerance": 3e-4}
    found = identify(**keys, noise="0.2 px", seed=0, refit=False)
    after = found.results["test"]["position"]["after"]
    assert after < 1.4 * math.sqrt(2) * 0.2 * PIXEL < 0.6 * plain
    machine = found.mechanism()
    values = dict(zip((p.name for p in machine.geometry), machine.nominal.tolist(), strict=True))
    corners = np.array([[values[f"corner{i + 1}_{a}"] for a in "xy"] for i in range(len(CORNERS))])
    # But for what moves with the board, its turn and its size.
    assert _apart(list(CORNERS + off), list(CORNERS + np.pad(corners, ((0, 0), (0, 1))))) < 1.5e-4


def test_a_level_on_a_link_shows_what_is_before_it(tmp_path: Path) -> None:
    q = joints(60, 1)
    machine = load_mechanism("instrument", mechanism=str(arm_file(tmp_path, False)), kind="level", link=3)
    place = load_mechanism(str(arm_file(tmp_path, False)))
    rotation = place.link_frames(torch.from_numpy(q), place.nominal)[3][0]
    expected = np.arcsin(rotation[:, 2, :2].numpy())
    np.testing.assert_allclose(machine.forward_kinematics(torch.from_numpy(q)).numpy(), expected, atol=1e-12)
    later = machine.jacobian(torch.from_numpy(q))[..., 3:]
    assert float(later.abs().max()) < 1e-12


def test_a_camera_that_stands_sees_a_board_on_the_hand() -> None:
    """The same images: a camera on the hand that sees a board is a board that sees a camera, the other way round."""
    arm = load_mechanism("serial", name="one", convention="standard", links=[[0.1, 0.2, 0.3, 0.0]] * 3)
    lens = {"fx": 800.0, "cx": 500.0, "cy": 400.0, "refine": False}
    machine = load_mechanism("instrument", mechanism=arm.describe(), kind="camera", on_hand=False, **lens)
    q = torch.tensor([0.3, -0.2, 0.5], dtype=torch.float64)
    position, rotation = arm.frame(arm.forward_kinematics(q))
    corner = np.array([0.02, -0.03, 2.0])
    x, y, z = rotation.numpy() @ corner + position.numpy()
    guess = torch.tensor([0.0, 0.0, *corner], dtype=torch.float64)
    read = machine.forward_kinematics(q, guess=guess)
    expected = [1e-6 * (800 * x / z + 500), 1e-6 * (800 * y / z + 400)]
    np.testing.assert_allclose(read[:2].numpy(), expected, rtol=1e-12)
    np.testing.assert_allclose(read[2:].numpy(), corner)
    again = mechanism_from_description(machine.describe())
    torch.testing.assert_close(again.forward_kinematics(q, guess=guess), read, rtol=0, atol=0)


def test_commands_from_pixels_bring_the_true_arm_to_its_poses(tmp_path: Path) -> None:
    """By the model that a run writes, on the true arm: the way from pose to pose, which no frame changes."""
    keys = {**_camera(tmp_path, 25), "geometry": "identify", "effects": "none", "methods": ["constant"]}
    found = calibrate(RunConfig.from_keys(**keys))
    explained = found.results.pose.position.explained
    assert explained is not None and explained.rms.median is not None
    assert explained.rms.median < 1.3 * math.sqrt(2) * 0.2 * PIXEL
    found.save(tmp_path / "model", forms=["safetensors"])
    # Wanted: where the camera of the true arm is over the board; the command from near by.
    q = np.unique(images(Arm(0), 12, 5, 0.0)[0], axis=0)
    wanted = np.array([camera_pose(Arm(0), v) for v in q])
    near = torch.from_numpy(q + 0.02)
    machines = (found.mechanism(), load_machine(tmp_path / "model" / "model.safetensors"))
    commands = [m.solve_inverse(torch.from_numpy(wanted), guess=near).numpy() for m in machines]
    reached = [np.array([camera_pose(Arm(0), v) for v in command]) for command in commands]
    before, after = (float(np.sqrt(((r - wanted)[:, :3] ** 2).sum(1).mean())) for r in reached)
    assert after < 2.5e-4 and after < 0.15 * before


def _apart(wanted: list[Array], reached: list[Array]) -> float:
    """RMS of what a rigid motion and a size leave between points (Kabsch, Umeyama)."""
    one, other = np.array(wanted), np.array(reached)
    one, other = one - one.mean(0), other - other.mean(0)
    left, size, right = np.linalg.svd(other.T @ one)
    sign = np.array([1, 1, np.linalg.det(left @ right)])
    fitted = (size * sign).sum() / (other**2).sum() * other @ (left * sign) @ right
    return float(np.sqrt(((fitted - one) ** 2).sum(1).mean()))


def _wire(folder: Path, arm: Arm, q: Array, seed: int) -> Path:
    number = np.arange(len(q)) % 3
    tips = arm.tip(q)
    noise = np.random.default_rng(seed).normal(0, 2e-5, len(q))
    far = np.linalg.norm(tips - ANCHORS[number], axis=1) + noise
    return write(folder / "wire.csv", q, {"anchor[1]": number + 1.0, "distance[m]": far})


def _level(folder: Path, arm: Arm, q: Array, seed: int) -> Path:
    up = arm.flange(q)[0][:, 2, :2]
    tilt = np.arcsin(up) + np.random.default_rng(seed).normal(0, 2e-5, up.shape)
    return write(folder / "level.csv", q, {"tilt_x[rad]": tilt[:, 0], "tilt_y[rad]": tilt[:, 1]})


@pytest.mark.parametrize("kind", ["wire", "level"])
def test_geometry_that_an_instrument_shows_is_named(tmp_path: Path, kind: str) -> None:
    """Not every error of it: a level sees no length, and its verdict has none."""
    arm, q = Arm(3), joints(100, 1)
    records = {"wire": _wire, "level": _level}[kind](tmp_path, arm, q, 2)
    keys: dict[str, Any] = {"anchors": 3} if kind == "wire" else {}
    machine = load_mechanism("instrument", mechanism=str(arm_file(tmp_path, frames=False)), kind=kind, **keys)
    effects = ["geometry", "joint_offset"]
    found = diagnose(load_records(str(records), machine), machine, network=False, effects=effects)
    assert set(found.verdict["effects"]) <= {"geometry", "joint_offset"} and found.verdict["effects"]
    assert found.by_block["after"] < 0.05 * found.by_block["before"]
    geometry = next(e for e in found.effects if e["name"] == "geometry")["parameters"]
    if kind == "level":
        lengths = [abs(v["value"]) for n, v in geometry.items() if n[0] in "ad" and not n.startswith("alpha")]
        assert max(lengths, default=0.0) < 1e-12


def test_rows_of_a_gauge_a_level_and_wires_stand_in_one_fit(tmp_path: Path) -> None:
    """Held to the truth, of the numbers that are said to be identified: 95 % intervals."""
    arm = Arm(4)
    files = [_level(tmp_path, arm, joints(80, 5), 6), _wire(tmp_path, arm, joints(80, 7), 8)]
    pairs = joints(160, 9).reshape(80, 2, 6)
    far = np.linalg.norm(arm.tip(pairs[:, 0]) - arm.tip(pairs[:, 1]), axis=-1)
    names = {f"q{i + 1}_b[rad]": pairs[:, 1, i] for i in range(6)}
    rows = write(tmp_path / "pairs.csv", pairs[:, 0], {**names, "distance[m]": far})
    beside = [
        {"kind": "pose", "records": str(files[0]), "noise": "20 urad", "instrument": {"kind": "level"}},
        {"kind": "pose", "records": str(files[1]), "noise": "20 um", "instrument": {"kind": "wire", "anchors": 3}},
    ]
    found = identify(
        records=str(rows),
        mechanism=str(arm_file(tmp_path, frames=False)),
        constraint={"kind": "distances", "beside": beside},
        noise="5 um",
        seed=0,
        refit=False,
    )
    read = found.results["constraint"]["readings"]
    # The wire's distances stand beside those of the first file, and have a name in front.
    assert {n: (b["unit"], b["rows"]) for n, b in read.items()} == {
        "distance": ("m", 80),
        "tilt_x": ("rad", 80),
        "tilt_y": ("rad", 80),
        "beside2.distance": ("m", 80),
    }
    blocks = [read["tilt_x"], read["beside2.distance"]]
    assert all(0.5 < b["after"] / b["noise"] < 1.3 < b["before"] / b["noise"] for b in blocks)
    truth = {
        f"{n}{i + 1}": v
        for n, own in (("a", arm.a), ("alpha", arm.alpha), ("theta", arm.theta))
        for i, v in enumerate(own)
    }
    machine = found.mechanism()
    values = dict(zip((p.name for p in machine.geometry), machine.nominal.tolist(), strict=True))
    sds = {n: b["sd"] for n, b in found.results["parameters"].items() if b.get("sd") is not None}
    judged = [(values[n] - truth[n]) / sds[n] for n in truth if n in sds]
    assert len(judged) >= 10 and np.mean(np.abs(judged) < 2.5) > 0.85


def test_two_arms_that_hold_one_ball_are_one_machine(tmp_path: Path) -> None:
    """Self-contact: no device, only the joints at which the tools meet."""
    one, other = Arm(1), Arm(2)
    base = turn([0.003, -0.004, 3.1]), np.array([-1.0, 0.02, 0.01])
    rng = np.random.default_rng(0)
    q = np.concatenate([joints(160, 1), joints(160, 2)], -1)

    def gap(v: Array) -> Array:
        return np.asarray(base[1] + other.tip(v[..., 6:]) @ base[0].T - one.tip(v[..., :6]))

    for _ in range(25):
        slope = np.stack([(gap(q + 1e-6 * e) - gap(q - 1e-6 * e)) / 2e-6 for e in np.eye(12)], -1)
        step = (np.linalg.pinv(slope) @ gap(q)[..., None])[..., 0]
        q = q - step / np.maximum(1.0, 2 * np.abs(step).max(-1, keepdims=True))
    rows = q[np.linalg.norm(gap(q), axis=-1) < 1e-9][:100]
    rows = rows + rng.normal(0, 1e-5, rows.shape)
    names = [f"{arm}_q{i + 1}[rad]" for arm in ("first", "second") for i in range(6)]
    table = np.column_stack([rows, np.zeros((100, 3))])
    header = ",".join([*names, "x[m]", "y[m]", "z[m]"])
    np.savetxt(tmp_path / "two.csv", table, delimiter=",", header=header, comments="", fmt="%.10g")
    keys = {
        "first": str(arm_file(tmp_path, frames=False)),
        "second": str(arm_file(tmp_path, False, "second.yaml", "[-1, 0, 0, 0, 0, 3.1]")),
    }
    found = identify(records=str(tmp_path / "two.csv"), mechanism="pair", mechanism_keys=keys, seed=0, refit=False)
    held_out = found.results["test"]["position"]
    assert held_out["after"] < 8e-5 and held_out["after"] < 0.02 * held_out["before"]


def test_a_second_encoder_shows_the_gear_between(tmp_path: Path) -> None:
    q = joints(120, 4)
    wave = 3e-4 * np.cos(4 * q[:, 2]) + np.random.default_rng(1).normal(0, 1e-5, 120)
    records = write(tmp_path / "second.csv", q, {"q3_second[rad]": q[:, 2] + 0.01 + wave})
    machine = load_mechanism("instrument", mechanism=str(arm_file(tmp_path, False)), kind="encoder", joint="q3")
    effects = ["joint_offset", "transmission"]
    found = diagnose(load_records(str(records), machine), machine, network=False, effects=effects)
    assert found.verdict["effects"] == ["transmission"]


def test_what_no_instrument_can_be_is_refused(tmp_path: Path) -> None:
    arm = str(arm_file(tmp_path, frames=False))
    for keys, said in (
        ({"kind": "sextant"}, "no instrument 'sextant'; write one of camera, wire, dial, level, encoder"),
        ({"kind": "wire", "ropes": 2}, "a wire has no key 'ropes'; it has anchors, zero"),
        ({"kind": "wire", "anchors": 0}, "anchors: 0 is no number of them"),
        ({"kind": "encoder", "joint": "q9"}, "there is no joint 'q9'; write one of q1, q2"),
        ({"kind": "level", "link": 9}, "link: 9 is no link of own; write 0 to 6"),
        ({"kind": "wire", "link": 2}, "only a level may be on one"),
        ({"kind": "camera", "fx": 900.0}, "camera: .*missing.*cx"),
        ({"kind": "dial", "normals": [[0, 0, 0]]}, "normals: write a direction"),
    ):
        with pytest.raises(InputError, match=said):
            load_mechanism("instrument", mechanism=arm, **keys)
    with pytest.raises(InputError, match="has no orientation, which a level on it needs"):
        load_mechanism("instrument", mechanism="five_bar", kind="level")
    with pytest.raises(InputError, match="the frames of own are not known"):
        load_mechanism("pair", first=arm, second=str(arm_file(tmp_path, True, "free.yaml")))


def test_images_that_show_too_few_corners_are_refused(tmp_path: Path) -> None:
    q, columns = images(Arm(0), 10, 0, 0.2)
    few = np.arange(len(q)) % len(CORNERS) < 3
    records = write(tmp_path / "few.csv", q[few], {n: v[few] for n, v in columns.items()})
    keys = {"mechanism": str(arm_file(tmp_path, frames=True)), **CAMERA}
    with pytest.raises(InputError, match=r"0 of \d+ images show 4 corners or more"):
        identify(records=str(records), mechanism="instrument", mechanism_keys=keys)


def test_a_gauge_reads_heights_over_its_plane() -> None:
    arm = load_mechanism(
        "serial", name="one", convention="standard", links=[[0.1, 0.2, 0.3, 0.0]] * 3, tool=[*TOOL, 0, 0, 0]
    )
    machine = load_mechanism("instrument", mechanism=arm.describe(), kind="dial", normals=[[0, 0, 2], [1, 0, 0]])
    q = torch.tensor([[0.3, -0.2, 0.5], [0.1, 0.4, -0.3]], dtype=torch.float64)
    guess = torch.tensor([[0.0, 1.0], [0.0, 2.0]], dtype=torch.float64)
    values = machine.nominal.clone()
    values[-6:] = torch.tensor([0.1, 0.0, 0.0, 0.2, 0.0, 0.0])
    place = arm.forward_kinematics(q)
    expected = [float(place[0, 2]) - 0.1, float(place[1, 0]) - 0.2]
    np.testing.assert_allclose(machine.forward_kinematics(q, values, guess)[:, 0].numpy(), expected, atol=1e-15)


@pytest.mark.parametrize("keys", [{"kind": "level"}, {"kind": "wire", "anchors": 2}])
def test_poses_are_planned_for_an_instrument(tmp_path: Path, keys: dict[str, Any]) -> None:
    machine = load_mechanism("instrument", mechanism=str(arm_file(tmp_path, frames=False)), **keys)
    _, plans = make_plan(machine, 26, PlanConfig.from_file(None, ["candidates=60"]))
    assert plans[0].joints.shape == (26, 6) and len(torch.unique(plans[0].joints, dim=0)) == 26
    assert bool(torch.isfinite(plans[0].pose).all())
    if keys["kind"] == "wire":
        assert set(plans[0].pose[:, 1].tolist()) == {1.0, 2.0}


def test_a_model_is_verified_by_the_pixels_of_another_day(
    seen: tuple[dict[str, Any], Identification], tmp_path: Path
) -> None:
    """The lens that was found goes with the new rows: the model is of the arm."""
    keys, found = seen
    found.save(tmp_path / "found")
    later = write(tmp_path / "later.csv", *images(Arm(0), 6, 50, 0.2))
    machine = found.mechanism()
    assert isinstance(machine, Instrument)
    values = {p.name: v for p, v in zip(machine.geometry, machine.nominal.tolist(), strict=True)}
    lens = {name: values[f"camera_{name}"] / PIXEL for name in ("fx", "fy", "cx", "cy")}
    lens |= {name: values[f"camera_{name}"] for name in ("k1", "k2")}
    model = load_compensation(tmp_path / "found" / "identified.yaml")
    about = {"mechanism": keys["mechanism_keys"]["mechanism"], "kind": "camera", **lens}
    said = verify_model(model, str(later), "instrument", mechanism_keys=about)[0]
    assert said.position.after.rms < 2.5 * math.sqrt(2) * 0.2 * PIXEL < 0.2 * said.position.before.rms
