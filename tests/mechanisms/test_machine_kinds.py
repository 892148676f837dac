"""Machine files: kinds, the numbers that people know, and the words and units in which they come back."""

from pathlib import Path

import numpy as np
import pytest
import torch

from ccnn_torch.effects import Situation, default_gravity, make_effect
from ccnn_torch.errors import InputError
from ccnn_torch.mechanisms import Mechanism, SerialArm, load_mechanism, mechanism_from_description
from ccnn_torch.mechanisms.kinds.machine_file import KINDS, template
from ccnn_torch.mechanisms.mechanism_file import urdf_text
from ccnn_torch.mechanisms.pose import frame_jacobian
from ccnn_torch.testing import check_mechanism


def machine(folder: Path, kind: str, **changed: str) -> Mechanism:
    """Of the kind's template, with lines in the place of its own."""
    lines = template(kind).splitlines()
    for key, value in changed.items():
        at = next(i for i, line in enumerate(lines) if line.strip().startswith(f"{key}:"))
        lines[at] = f"{lines[at].partition(':')[0]}: {value}"
    path = folder / f"{kind}.yaml"
    path.write_text("\n".join(lines))
    return load_mechanism(str(path))


@pytest.mark.parametrize("kind", KINDS)
def test_a_template_is_a_mechanism_that_its_description_makes_again(kind: str, tmp_path: Path) -> None:
    made = machine(tmp_path, kind)
    again = mechanism_from_description(made.describe())
    assert again.geometry == made.geometry and torch.equal(again.nominal, made.nominal)
    check_mechanism(made)


@pytest.mark.parametrize("kind", [k for k in KINDS if "mechanism:" not in template(k)])
def test_whole_poses_determine_every_number(kind: str, tmp_path: Path) -> None:
    """The numbers that are not held, and the unknown frames, are a minimal set."""
    made = machine(tmp_path, kind)
    free = [i for i, p in enumerate(made.geometry) if not p.held]
    sizes = torch.tensor([made.geometry[i].scale or 1e-3 for i in free], dtype=torch.float64)
    rows = made.parameter_jacobian(made.sample_joints(100, torch.Generator().manual_seed(1)))[..., free] * sizes
    values = torch.linalg.svdvals(rows.reshape(-1, len(free)))
    assert values[-1] > 1e-6 * values[0]


def test_a_gantry_moves_along_axes_of_its_numbers(tmp_path: Path) -> None:
    made = machine(
        tmp_path,
        "gantry",
        base_frame="identity",
        lead_x="120 um/m",
        squareness_xy="-0.4 mm/m +- 0.5 mrad",
        squareness_yz="300 urad",
    )
    place = made.forward_kinematics(torch.tensor([0.9, 0.7, 0.2], dtype=torch.float64))[:3]
    # Written out: each axis is a direction, y and z lean.
    wanted = 0.9 * (1 + 120e-6) * np.array([1, 0, 0]) + 0.7 * np.array([-4e-4, 1, 0]) + 0.2 * np.array([0, 3e-4, 1])
    np.testing.assert_allclose(place.numpy(), wanted, atol=1e-7)


TABLE = "{q1: {at: [0 mm, 300 mm, 1000 mm], error: [2 um, 14 um, -7 um]}}"


def tabled(joints: np.ndarray) -> np.ndarray:
    """Where a gantry is, written out: the table of x [m]."""
    along = np.interp(joints[:, 0], [0, 0.3, 1.0], [2e-6, 14e-6, -7e-6])
    return np.asarray(joints + along[:, None] * [1, 0, 0])


def test_a_gantry_has_the_pitch_errors_of_its_table(tmp_path: Path) -> None:
    made = machine(tmp_path, "gantry", base_frame="identity", limits="")
    text = (tmp_path / "gantry.yaml").read_text().replace("limits: ", f"pitch_errors: {TABLE}")
    (tmp_path / "gantry.yaml").write_text(text)
    made = load_mechanism(str(tmp_path / "gantry.yaml"))
    q = np.random.default_rng(0).uniform(0, [1, 0.8, 0.3], (40, 3))
    joints = torch.from_numpy(q)
    there = made.forward_kinematics(joints)
    np.testing.assert_allclose(there[:, :3].numpy(), tabled(q), atol=1e-12)
    back = made.solve_inverse(there, guess=joints + 1e-3)
    torch.testing.assert_close(back, joints, rtol=0, atol=1e-9)
    assert isinstance(made, SerialArm)
    torch.testing.assert_close(
        made.jacobian(joints),
        frame_jacobian(lambda v: made.frame(made.forward_kinematics(v)), joints),
        atol=1e-9,
        rtol=0,
    )
    again = mechanism_from_description(made.describe())
    assert torch.equal(again.forward_kinematics(joints), there)
    # The controller knows nothing of what was measured of its axis.
    assert not made.controlled().recipe["keys"].get("tables")
    for table, said in (
        ("{q9: {at: [0 mm], error: [0 um]}}", "pitch_errors: 'q9' is not known"),
        ("{q1: {at: [0 mm, 2 mm]}}", "q1: needs as many errors as places"),
        ("{q1: [1, 2]}", "pitch_errors: must be as"),
        ("{q1: {at: [2 mm, 1 mm], error: [0 um, 1 um]}}", "the places ascending"),
    ):
        (tmp_path / "gantry.yaml").write_text(f"machine: gantry\npitch_errors: {table}\n")
        with pytest.raises(InputError, match=said):
            load_mechanism(str(tmp_path / "gantry.yaml"))


def test_a_mount_points_by_the_terms_that_astronomers_know(tmp_path: Path) -> None:
    names = {"IA": 40, "IE": -25, "CA": 30, "NPAE": 50, "AN": -35, "AW": 20}
    made = machine(tmp_path, "alt_azimuth", **{name: f"{value} arcsec" for name, value in names.items()})
    ia, ie, ca, npae, an, aw = (np.deg2rad(v / 3600) for v in names.values())
    azimuth, elevation = np.deg2rad(np.array([[-100, 20], [10, 50], [130, 70]])).T
    found = made.forward_kinematics(torch.tensor(np.stack([azimuth, elevation], -1))).numpy()
    # To the first order (Wallace 2008): where it points, less what its encoders say.
    east = ia + (ca + npae * np.sin(elevation)) / np.cos(elevation)
    east = east - (an * np.sin(azimuth) + aw * np.cos(azimuth)) * np.tan(elevation)
    up = ie - an * np.cos(azimuth) + aw * np.sin(azimuth)
    a, e = np.arctan2(found[:, 1], found[:, 0]), np.arcsin(found[:, 2] / np.linalg.norm(found, axis=1))
    np.testing.assert_allclose(e - elevation, up, atol=1e-6)
    np.testing.assert_allclose(np.cos(elevation) * (a - azimuth), np.cos(elevation) * east, atol=1e-6)


def test_a_scara_lifts_its_quill_with_the_turn_of_joint_4(tmp_path: Path) -> None:
    made = machine(tmp_path, "scara", base_frame="identity", quill_coupling="20 mm/turn", upper_arm="325 mm +- 0")
    joints = torch.tensor([[0.3, -0.8, -0.1, 0.0], [0.3, -0.8, -0.1, np.pi]], dtype=torch.float64)
    place = made.forward_kinematics(joints)[:, :3]
    np.testing.assert_allclose((place[1] - place[0]).numpy(), [0, 0, 0.01], atol=1e-12)
    np.testing.assert_allclose(float(place[0, 0]), 0.325 * np.cos(0.3) + 0.25 * np.cos(-0.5), atol=1e-12)
    assert next(p for p in made.geometry if p.name == "upper_arm").held


def test_jacobians_of_drives_and_numbers_are_the_derivatives(tmp_path: Path) -> None:
    made = machine(tmp_path, "scara", quill_coupling="20 mm/turn")
    assert isinstance(made, SerialArm)
    draw = torch.Generator().manual_seed(3)
    values = made.nominal + 0.02 * torch.randn(len(made.nominal), generator=draw, dtype=torch.float64)
    joints = made.sample_joints(6, draw)
    by_joint = frame_jacobian(lambda q: made.frame(made.forward_kinematics(q, values)), joints)
    torch.testing.assert_close(made.jacobian(joints, values), by_joint, atol=1e-9, rtol=0)
    wide = values.expand(len(joints), -1)
    by_number = frame_jacobian(lambda p: made.frame(made.forward_kinematics(joints, p)), wide)
    torch.testing.assert_close(made.parameter_jacobian(joints, values), by_number, atol=1e-9, rtol=0)


def test_a_delta_printer_has_a_value_for_each_tower(tmp_path: Path) -> None:
    made = machine(tmp_path, "delta_printer", arm_length="[250.4 mm +- 0.05 mm, 250 mm, 249.8 mm]")
    by_name = {p.name: p for p in made.geometry}
    assert [by_name[f"rod{i}"].nominal for i in (1, 2, 3)] == pytest.approx([0.2504, 0.25, 0.2498])
    assert by_name["rod1"].word == "rod A" and by_name["rod1"].shown == "mm"
    assert by_name["rod1"].scale == pytest.approx(5e-5) and by_name["rod2"].scale == pytest.approx(5e-4)
    assert {by_name[f"base{i}"].tied for i in (1, 2, 3)} == {"delta_radius"} and by_name["angle3"].held
    assert by_name["lean2"].scale == pytest.approx(2e-4) and by_name["platform1"].held
    assert made.nominal[[p.name for p in made.geometry].index("rod1")] == pytest.approx(0.2504)


def test_joints_of_a_hexapod_are_known_as_well_as_the_file_says(tmp_path: Path) -> None:
    made = machine(tmp_path, "hexapod", base_x="+- 0.15 mm", platform_z="[+- 0.1 mm, ±0.2 mm, 1 mm, 2 mm, 3 mm, 4 mm]")
    by_name, drawn = ({p.name: p for p in m.geometry} for m in (made, machine(tmp_path, "hexapod")))
    assert by_name["B2x"].scale == pytest.approx(1.5e-4) and by_name["B2x"].nominal == drawn["B2x"].nominal
    assert [by_name[f"P{i}z"].scale for i in (1, 2, 3)] == pytest.approx([1e-4, 2e-4, 3e-4])
    assert by_name["P3z"].nominal == pytest.approx(1e-3) and by_name["B2y"].scale == pytest.approx(3e-4)


def test_drives_that_a_file_tells_are_the_machines_however_it_is_seen(tmp_path: Path) -> None:
    path = tmp_path / "gantry.yaml"
    path.write_text("machine: gantry\ngears: {q1: 20 mm, q3: 5 mm}\nbase_frame: identity\ntool_frame: identity\n")
    made = load_mechanism(str(path))
    assert made.gears == made.with_nominal(made.nominal + 1e-4).gears == pytest.approx((0.02, None, 0.005))
    assert load_mechanism("instrument", mechanism=str(path), kind="level").gears == made.gears
    situation = Situation(made, made.sample_joints(20, torch.Generator().manual_seed(0)), {}, default_gravity(made))
    told = [shape.told for shape in make_effect("transmission").shapes(situation)]
    assert (
        told[1] is None and told[0] == pytest.approx(2 * np.pi / 0.02) and told[2] == pytest.approx(2 * np.pi / 0.005)
    )


def test_any_machine_takes_gears_as_a_key_and_keeps_them(tmp_path: Path) -> None:
    arm = SerialArm("lift", "standard", [[0.0, 0.0, 0.1, 0.0], [0.3, 0.0, 0.0, 0.0]], ["prismatic", "revolute"])
    (tmp_path / "arm.urdf").write_text(urdf_text(arm))
    for spec, gears, si in (
        ("five_bar", [50, None], (50.0, None)),
        ("delta_linear", ["5 mm", None, 0.01], (0.005, None, 0.01)),
        (str(tmp_path / "arm.urdf"), ["5 mm", 100], (0.005, 100.0)),
    ):
        made = load_mechanism(spec, gears=gears)
        assert made.gears == mechanism_from_description(made.describe()).gears == pytest.approx(si)
    framed = load_mechanism("framed", mechanism="five_bar", keys={"gears": [50, None]})
    assert framed.gears == mechanism_from_description(framed.describe()).gears == (50.0, None)
    for wrong in ([1], [1, "1 mm"], [0, 1], 3):
        with pytest.raises(InputError, match=r"mechanism 'five_bar': gears"):
            load_mechanism("five_bar", gears=wrong)
    with pytest.raises(InputError, match="gears"):
        load_mechanism("framed", mechanism="five_bar", gears=[50, 50])


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ("machine: gantri", "did you mean 'gantry'"),
        ("machine: gantry\nnumbers: {lead_w: 1 um/m}", "numbers: 'lead_w' is not known; did you mean 'lead_"),
        ("machine: gantry\nnumbers: {lead_x: 1 mm}", "numbers.lead_x is in 'mm'"),
        ("machine: gantry\nnumbers: {lead_x: far}", "numbers.lead_x: 'far' is no number"),
        ("machine: gantry\nnumbers: {lead_x: 1 um/m +- -3 um/m}", "the tolerance"),
        ("machine: gantry\nnumbers: {lead_x: 1 um/m +- 2 um/m +- 3}", "two tolerances"),
        ("machine: gantry\nnumbers: {lead_x: .inf}", "must be a finite number"),
        ("machine: delta_printer\nnumbers: {arm_length: 250}", "'250' has no unit; write 250 mm"),
        ("machine: gantry\nnumbers: {lead_x: 0 um/m +- 3e2}", "'3e2' has no unit; write 3e2 um/m"),
        ("machine: hexapod\nnumbers: {L: +- 1 mm}", "numbers.L: '' is no number"),
        ("machine: gantry\nlimits: 3", "limits: must be as"),
        ("machine: gantry\ngears: {q9: 10 mm}", "gears: 'q9' is not known"),
        ("machine: gantry\ngears: {q1: 10}", "gears: '10' has no unit; write 10 mm"),
        ("machine: gantry\ngears: {q1: 0 mm}", "gears must be above 0"),
        ("machine: gantry\ngears: 100", "gears: must be as {q1: 80"),
        ("machine: gantry\nnumbers: 3", "must have lines such as"),
        ("machine: gantry\ntool_fram: identity", "the key 'tool_fram' is not known; did you mean 'tool_frame'"),
        ("machine: hexapod\nnumbers: {base_radius: 280 mm +- 1 mm}", "takes no tolerance, since it is not fitted"),
        ("machine: hexapod\nbase_frame: unknown", "base_frame of a parallel machine is no key of its file; to have"),
        ("machine: gantry\nbase_frame: [1, 2]", "base_frame: must be unknown, identity or"),
        ("machine: gantry\nlimits: {q1: [1 mm, 0 mm]}", "limits.q1: must be"),
        ("machine: gantry\nlimits: {q9: [0 mm, 1 mm]}", "limits: 'q9' is not known"),
        ("machine: delta_printer\nnumbers: {endstop: [1 mm, 2 mm]}", "needs one value, or a list of 3, not 2"),
    ],
)
def test_what_is_wrong_in_a_machine_file_is_one_sentence(line: str, said: str, tmp_path: Path) -> None:
    path = tmp_path / "wrong.yaml"
    path.write_text(line)
    with pytest.raises(InputError, match=r"wrong\.yaml") as error:
        load_mechanism(str(path))
    assert said in str(error.value) and "\n" not in str(error.value)
