"""Identification of simulated machines and of records: figures against what is known of the simulation."""

from functools import cache
from pathlib import Path
from typing import Any

import pytest
import torch
from mechanisms.catalogue import make
from scipy.optimize import approx_fprime, least_squares

import ccnn_torch
from ccnn_torch.errors import InputError
from ccnn_torch.identification.config import IdentifyConfig
from ccnn_torch.identification.identify import IDENTIFY, Identification
from ccnn_torch.identification.measured import make_kinematics, notes_of
from ccnn_torch.identification.simulated import Places, PointsView
from ccnn_torch.mechanisms import Framed, SerialArm, load_mechanism
from ccnn_torch.records import load_records, write_table
from ccnn_torch.report.page import Page

FIVE_BAR: dict[str, Any] = {
    "machines": 60,
    "poses": 24,
    "design": "planned_per_leg",
    "candidates": 600,
    "noise": 1e-4,
    "circle": True,
    "test_poses": 60,
    "box": {"y": [0.8, 1.5]},
}


@cache
def five_bar() -> Identification:
    return ccnn_torch.identify(mechanism="five_bar", methods=["lm", "lm_per_leg"], simulate=FIVE_BAR)


def test_standard_deviations_are_those_of_the_bound() -> None:
    for method in ("lm", "lm_per_leg"):
        block = five_bar().results["methods"][method]
        assert block["bound"]["median"] == pytest.approx(1, abs=0.12)
        assert 0.92 <= block["coverage"] <= 0.98


def test_held_out_error_is_the_measurement_noise_and_almost_all_is_removed() -> None:
    results = five_bar().results
    position = results["test"]["position"]
    assert position["noise"] == pytest.approx(2**0.5 * 1e-4, rel=0.1)
    left = results["compensation"]["exact"]["position"]["after"]
    assert position["after"] == pytest.approx((position["noise"] ** 2 + left**2) ** 0.5, rel=0.1)
    assert position["before"] > 20 * position["after"]
    assert results["test"]["rotation"] is None
    assert results["compensation"]["exact"]["position"]["removed"] >= 0.99
    # Linear commands leave what is of second order in the errors.
    assert 0.9 < results["compensation"]["linear"]["position"]["removed"] < 0.995


def test_every_machine_has_its_own_errors_and_more_machines_do_not_change_them() -> None:
    fewer = ccnn_torch.identify(mechanism="five_bar", simulate={**FIVE_BAR, "machines": 2, "design": "even"})
    truth = five_bar().measured.truth
    assert truth is not None and fewer.measured.truth is not None
    assert torch.equal(fewer.measured.truth, truth[:2])
    assert not torch.equal(truth[0], truth[1])


def test_each_leg_is_identified_from_its_own_poses_alone() -> None:
    """Another solver, on plain loop equations of leg 1 and the rows of leg 1."""
    found = five_bar()
    rows = found.measured.leg_rows[1]
    joints, pose = rows.joints[0, :, 0].numpy(), rows.observed[0].numpy()
    assert len(joints) == 12

    def angle(p: Any, x: Any) -> Any:
        import numpy as np

        l, L, ax, ay, k, gamma = p
        across, up = x[..., 0] - ax, x[..., 1] - ay
        d = np.hypot(across, up)
        return (np.arctan2(up, across) + np.arccos((l**2 + d**2 - L**2) / (2 * l * d)) - gamma) / k

    values = found.outcomes["lm_per_leg"].values[0, :6].numpy()

    def noise(i: int) -> float:
        return float((approx_fprime(pose[i], lambda x: angle(values, x), 1e-7) ** 2).sum() ** 0.5) * 1e-4

    import numpy as np

    sd = np.array([noise(i) for i in range(len(pose))])
    start = found.measured.start[0, :6].numpy()
    other = least_squares(lambda p: (angle(p, pose) - joints) / sd, start, xtol=1e-15, ftol=1e-15, gtol=1e-15)
    error = found.outcomes["lm_per_leg"].values[0, :6].numpy() - other.x
    # The noise was carried over one round earlier here: a small part of a standard deviation.
    bound = np.array([found.results["parameters"][n]["sd"] for n in ("l1", "L1", "A1x", "A1y", "k1", "gamma1")])
    assert np.abs(error / bound).max() < 0.05


def test_the_same_seed_gives_the_same_figures() -> None:
    keys: dict[str, Any] = {"mechanism": "five_bar", "simulate": {"poses": 12, "design": "random", "test_poses": 5}}
    first, second = (ccnn_torch.identify(seed=3, **keys) for _ in range(2))
    for name in first.arrays:
        assert torch.equal(first.arrays[name], second.arrays[name])
    other = ccnn_torch.identify(seed=4, **keys)
    assert not torch.equal(first.arrays["values_lm"], other.arrays["values_lm"])


def test_what_cannot_be_known_is_named_and_has_no_interval() -> None:
    # All lengths of a five-bar can grow together: gains and joints do not see it.
    found = ccnn_torch.identify(
        mechanism="five_bar",
        simulate={"poses": 30, "test_poses": 10, "noise": 1e-5, "points": None},
        parameters={"fixed": ["k*", "gamma*"]},
    )
    assert all(p["identifiable"] == p["free"] for p in found.results["parameters"].values())
    tied = ccnn_torch.identify(
        mechanism=f"{Path(__file__).parent / 'two_lengths.py'}:TwoLengths", simulate={"poses": 12, "test_poses": 10}
    ).results
    assert [tied["parameters"][n]["sd"] for n in ("first", "second")] == [None, None]
    assert tied["parameters"]["offset"]["identifiable"]
    assert len(tied["combinations_not_identifiable"]) == 1
    assert "first" in tied["combinations_not_identifiable"][0]


def test_parameters_that_are_fixed_or_have_a_prior() -> None:
    keys: dict[str, Any] = {
        "mechanism": "tripod",
        "simulate": {"poses": 20, "test_poses": 10, "errors": {"L": 0, "r": 0}},
    }
    without, held = (
        ccnn_torch.identify(parameters={"fixed": ["r"], "prior": prior}, **keys).results["parameters"]
        for prior in ({}, {"L": "3 um"})
    )
    assert not held["r"]["free"] and held["r"]["value"] == 0.3 and held["r"]["sd"] is None
    assert held["L"]["sd"] ** -2 == pytest.approx(without["L"]["sd"] ** -2 + 3e-6**-2, rel=1e-4)
    assert abs(held["L"]["value"] - 1) < abs(without["L"]["value"] - 1)


def test_points_give_the_frame_that_they_were_seen_in() -> None:
    mechanism = load_mechanism("overconstrained_2dof")
    points = torch.tensor([[0.15, 0.02, 0.0], [-0.1, 0.0, 0.01], [0.0, 0.13, 0.0]], dtype=torch.float64)
    view = PointsView(mechanism, points)
    pose = mechanism.sample_workspace(10, torch.Generator().manual_seed(0))
    frame = mechanism.frame(pose)
    again = view.frame(view.seen(*frame))
    for ours, theirs in zip(frame, again, strict=True):
        torch.testing.assert_close(theirs, ours, rtol=0, atol=1e-14)
    torch.testing.assert_close(view.solve_inverse(view.seen(*frame)), mechanism.solve_inverse(pose))


def test_a_machine_off_its_nominal_motion_is_commanded_exactly() -> None:
    mechanism = load_mechanism("overconstrained_2dof")
    errors = torch.tensor([p.scale or 0.0 for p in mechanism.geometry], dtype=torch.float64)
    truth = mechanism.nominal + errors * torch.randn(26, generator=torch.Generator().manual_seed(0), dtype=errors.dtype)
    wanted = torch.tensor([[0.3, 0.4], [2.5, 0.7], [5.0, 0.1]], dtype=torch.float64)
    built = make_kinematics(mechanism, built=True)
    near = mechanism.solve_inverse(wanted)
    reached = built.reached(built.command(wanted, truth, near), truth, wanted)
    assert float(mechanism.pose_error(reached, wanted).rotation.max()) < 1e-8
    # The inverse kinematics of the pose alone, which is on the nominal motion, are not enough.
    plain = built.reached(mechanism.solve_inverse(wanted, truth, near), truth, wanted)
    assert float(mechanism.pose_error(plain, wanted).rotation.min()) > 1e-5
    with pytest.raises(InputError, match=r"simulate\.as_built: tripod never leaves its nominal motion"):
        make_kinematics(load_mechanism("tripod"), built=True)


def test_frames_that_nobody_knows_are_fitted_before_anything_is_judged() -> None:
    found = ccnn_torch.identify(
        mechanism="stewart",
        frame={"base": True},
        parameters={"free": ["base_*", "*gain*"]} if _has("stewart", "gain") else {"free": ["base_*"]},
        simulate={"poses": 16, "test_poses": 10, "errors": {"base_*": 0.01}, "noise": 1e-6},
    )
    assert isinstance(found.measured.mechanism, Framed)
    assert found.results["test"]["position"]["before"] < 5e-3  # not the 10 mm by which the base is off
    assert found.results["parameters"]["base_x"]["identifiable"]


def _has(mechanism: str, word: str) -> bool:
    return any(word in p.name for p in load_mechanism(mechanism).geometry)


@cache
def arm_rows(folder: Path) -> tuple[Path, Path, SerialArm]:
    """Records of a UR10 with wrong links and frames; its DH file; the true arm."""
    arm = make("ur10", folder)
    assert isinstance(arm, SerialArm)
    generator = torch.Generator().manual_seed(5)
    noise = torch.randn(len(arm.nominal), generator=generator, dtype=torch.float64)
    truth = arm.nominal + 5e-4 * noise
    truth[:6] += torch.tensor([1.0, -2.0, 0.5, 0.1, 0.2, 1.5])
    truth[-6:] += torch.tensor([0.02, 0.01, 0.1, 0.0, 0.3, 0.2])
    real = arm.with_nominal(truth)
    joints = real.sample_joints(40, generator)
    pose = real.forward_kinematics(joints)
    pose = pose + torch.tensor([1e-5] * 3 + [3e-5] * 3) * torch.randn(pose.shape, generator=generator, dtype=pose.dtype)
    columns = {c.header: joints[:, i].numpy() for i, c in enumerate(arm.joints)}
    columns |= {c.header: pose[:, i].numpy() for i, c in enumerate(arm.pose)}
    write_table(folder / "rows.csv", columns)
    return folder / "rows.csv", folder / "ur10.yaml", real


def test_an_arm_from_records_out_again_as_dh_file_and_urdf(tmp_path: Path) -> None:
    rows, file, real = arm_rows(tmp_path)
    found = ccnn_torch.identify(mechanism=str(file), records=str(rows), noise=1e-5, save_report=False)
    results = found.results
    assert results["data_sha256"]
    assert results["compensation"] is None and not results["simulated"]
    position, rotation = results["test"]["position"], results["test"]["rotation"]
    assert position["after"] < 4e-5 < 5e-4 < position["before"] < 5e-2
    assert rotation["after"] < 1e-4
    # Joints 2, 3 and 4 are nearly parallel, so that their offsets along the axis are as good as one number.
    assert results["combinations_not_identifiable"]
    assert (results["parameters"]["d2"]["sd"] or torch.inf) > 0.1
    found.save(tmp_path / "out")
    joints = real.sample_joints(30, torch.Generator().manual_seed(9))
    expected = real.forward_frame(joints)
    for name in ("identified.yaml", "identified_dh.yaml", "identified.urdf"):
        again = load_mechanism(str(tmp_path / "out" / name))
        assert isinstance(again, SerialArm)
        assert float((again.forward_frame(joints)[0] - expected[0]).norm(dim=-1).max()) < 2e-4


def test_the_machine_is_written_before_a_screen_that_nobody_reads(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """`ccnn identify … | head -1` closes the pipe."""

    def closed(*_: object) -> None:
        raise BrokenPipeError

    monkeypatch.setattr(Page, "show", closed)
    keys = {"mechanism": "five_bar", "simulate": {"machines": 1, "poses": 12}, "save_report": False}
    with pytest.raises(BrokenPipeError):
        IDENTIFY.start(IdentifyConfig.from_keys(**keys, out=str(tmp_path / "found")))
    assert (tmp_path / "found" / "identified.yaml").is_file()


def test_links_are_fitted_without_gross_outliers_and_the_note_names_their_lines(tmp_path: Path) -> None:
    """A note said so, and the links were fitted with them."""
    rows, file, real = arm_rows(tmp_path)
    lines = rows.read_text().splitlines()
    for k in range(1, 41, 8):
        cells = lines[k].split(",")
        lines[k] = ",".join([*cells[:6], str(float(cells[6]) + 0.1), *cells[7:]])
    rows.write_text("\n".join(lines))
    found = ccnn_torch.identify(mechanism=str(file), records=str(rows), noise=1e-5, save_report=False)
    (note,) = (note for note in found.measured.notes if "gross outlier" in note)
    assert "fitted without: line" in note
    joints = real.sample_joints(30, torch.Generator().manual_seed(9))
    error = found.mechanism().forward_kinematics(joints) - real.forward_kinematics(joints)
    assert float(error[:, :3].norm(dim=-1).max()) < 2e-4


def test_rows_that_are_far_off_among_the_others_are_left_out_and_named(tmp_path: Path) -> None:
    """One reading of 119 that was off by 9 mm widened the numbers of a printer a hundredfold, and none was named."""
    machine, generator = make("delta", tmp_path), torch.Generator().manual_seed(2)
    truth = machine.nominal + 3e-4 * torch.randn(len(machine.nominal), generator=generator, dtype=torch.float64)
    joints = machine.solve_inverse(machine.sample_workspace(90, generator))
    pose = machine.forward_kinematics(joints, truth)
    pose = pose + 1e-5 * torch.randn(pose.shape, generator=generator, dtype=pose.dtype)
    names = [c.header for c in (*machine.joints, *machine.pose)]

    def found(path: Path, **keys: Any) -> Identification:
        write_table(path, dict(zip(names, torch.cat([joints, pose], -1).mT.numpy(), strict=True)))
        return ccnn_torch.identify(mechanism="delta", records=str(path), save_report=False, **keys)

    clean = found(tmp_path / "clean.csv").results
    assert clean["rows"] == {"train": 63, "per_leg": {}, "test": 27} and not clean["doubts"]
    pose[[4, 40, 41], 2] += torch.tensor([9e-3, 3e-2, 9e-3])
    results = found(tmp_path / "rows.csv").results
    assert results["rows"]["train"] + results["rows"]["test"] == 87
    (note,) = results["doubts"]
    assert note.startswith("3 rows are far off among the others") and "lines 6, 42, 43 (rows 5, 41, 42)" in note
    assert results["test"]["position"]["after"] < 1.2 * clean["test"]["position"]["after"]
    assert results["parameters"].keys() == clean["parameters"].keys()
    for name, block in results["parameters"].items():
        assert (block["sd"] or 0) <= 1.3 * (clean["parameters"][name]["sd"] or 0)
    robust = found(tmp_path / "rows.csv", robust="huber").results
    assert robust["rows"] == clean["rows"] and not any("far off" in doubt for doubt in robust["doubts"])


def test_a_payload_is_said_not_to_be_used(tmp_path: Path) -> None:
    rows, file, _ = arm_rows(tmp_path)
    lines = rows.read_text().splitlines()
    rows.write_text("\n".join([f"{lines[0]},payload[kg]", *(f"{line},{k % 3}" for k, line in enumerate(lines[1:]))]))
    found = load_records(str(rows), load_mechanism(str(file)), [], learns=False)
    (note,) = (note for note in notes_of(found) if "load" in note)
    assert note.startswith("load_z acts on no parameter of the geometry and was not used")


def test_links_hold_where_the_arm_stands_elsewhere(tmp_path: Path) -> None:
    rows, file, real = arm_rows(tmp_path)
    moved = real.nominal.clone()
    moved[:6] = torch.tensor([-0.7, 0.4, 0.2, 0.3, -0.1, 0.8])
    moved[-6:-3] = torch.tensor([0.0, 0.05, 0.12])
    again = real.with_nominal(moved)
    joints = real.sample_joints(40, torch.Generator().manual_seed(11))
    pose = again.forward_kinematics(joints)
    columns = {c.header: joints[:, i].numpy() for i, c in enumerate(real.joints)}
    columns |= {c.header: pose[:, i].numpy() for i, c in enumerate(real.pose)}
    write_table(tmp_path / "elsewhere.csv", columns)
    keys = {"mechanism": str(file), "records": str(rows), "noise": 1e-5, "save_report": False}
    for links in ("given", "lean"):
        found = ccnn_torch.identify(**keys, links=links, transfer=str(tmp_path / "elsewhere.csv"))
        block = found.results["transfer"]
        assert block["rows"] == {"train": 28, "test": 12} and block["records"].endswith("/elsewhere.csv")
        position = block["test"]["position"]
        assert position["after"] < 1e-4 < 5e-4 < position["before"]
        found.save(tmp_path / links)
        assert "elsewhere.csv" in (tmp_path / links / "identified.md").read_text(encoding="utf-8")
    with pytest.raises(InputError, match="transfer: five_bar has no frame to be fitted anew"):
        mechanism = load_mechanism("five_bar")
        bar = mechanism.sample_workspace(20, torch.Generator().manual_seed(0))
        table = {c.header: mechanism.solve_inverse(bar)[:, i].numpy() for i, c in enumerate(mechanism.joints)}
        table |= {c.header: bar[:, i].numpy() for i, c in enumerate(mechanism.pose)}
        write_table(tmp_path / "bar.csv", table)
        path = str(tmp_path / "bar.csv")
        ccnn_torch.identify(mechanism="five_bar", records=path, transfer=path)


def test_rows_that_cannot_be_are_named(tmp_path: Path) -> None:
    mechanism = load_mechanism("five_bar")
    pose = mechanism.sample_workspace(20, torch.Generator().manual_seed(0))
    joints = mechanism.solve_inverse(pose)
    pose[7] = torch.tensor([3.0, 0.5])
    path = tmp_path / "rows.csv"
    table = {"q1[rad]": joints[:, 0], "q2[rad]": joints[:, 1], "x[m]": pose[:, 0], "y[m]": pose[:, 1]}
    write_table(path, {k: v.numpy() for k, v in table.items()})
    with pytest.raises(InputError, match=r"rows\.csv: the pose at line 9 \(row 8\) is outside the .* check the units$"):
        ccnn_torch.identify(mechanism="five_bar", records=str(path))
    write_table(path, {k: v.numpy() + 5 * (k == "x[m]") for k, v in table.items()})
    with pytest.raises(InputError, match=r"another frame .*, write mechanism: framed, and .*: {mechanism: "):
        ccnn_torch.identify(mechanism="five_bar", records=str(path))


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({"simulate": {"poses": 3}}, "3 rows of 2 equations cannot determine 12 free parameters"),
        ({"simulate": {}, "parameters": {"free": ["B*"]}}, r"parameters.free: 'B\*' fits no parameter"),
        ({"simulate": {"errors": {"a1x": 1}}}, "simulate.errors.a1x: there is no such name; did you mean 'A1x'"),
        ({"simulate": {"box": {"z": [0, 1]}}}, "simulate.box.z: there is no such coordinate"),
        ({"simulate": {"box": {"x": [1, 0]}}}, "must be \\[low, high\\]"),
        ({"simulate": {"points": [[0, 0, 0], [1, 0, 0], [2, 0, 0]]}}, "lie on one line"),
        ({"simulate": {"points": [[0, 0, 0], [1, 0, 0], [2, 1, 0]]}}, "five_bar takes no measured rotation"),
        ({"simulate": {"poses": 25, "design": "planned_per_leg"}}, "25 poses cannot be dealt to 2 legs"),
        ({"simulate": {"errors": {"l*": "100 m"}}}, "hardly any pose"),
        ({"simulate": {}, "settings": {"lm": {"start": 3}}}, "has no setting 'start'; did you mean 'starts'"),
        ({"simulate": {}, "residual": "forward", "methods": ["lm_per_leg"]}, "a pose depends on all legs"),
        ({"simulate": {}, "transfer": "rows.csv"}, "transfer: needs measured records"),
    ],
)
def test_what_cannot_be_identified_is_one_sentence(keys: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message) as caught:
        ccnn_torch.identify(mechanism="five_bar", **keys)
    assert "\n" not in str(caught.value)


def test_places_of_an_arm_are_joints(tmp_path: Path) -> None:
    arm = make("panda", tmp_path)
    places = Places(arm, arm.nominal[None], {"q1": (-1.0, "30 deg")}, circle=False)
    joints, pose = places.taken(places.even(9))
    assert joints.shape == (1, 9, 7)
    assert float(joints[..., 0].max()) < torch.pi / 6 < float(joints[..., 1].abs().max())
    torch.testing.assert_close(pose, arm.forward_kinematics(joints))
