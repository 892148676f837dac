"""An arm whose base and tool frame are fitted to the records: what these can do is no cause and no noise."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from ccnn_torch.calibration.physics import frames_of_repeats
from ccnn_torch.diagnosis import Diagnosis, diagnose_rows
from ccnn_torch.diagnosis.from_records import named_machine, situation_of
from ccnn_torch.diagnosis.joint_fit import fit_jointly, loose_parameters, on_fitted_frames
from ccnn_torch.diagnosis.page.outputs import write_corrected
from ccnn_torch.diagnosis.residual.linearisation import remainder
from ccnn_torch.diagnosis.residual.rows import frame_columns
from ccnn_torch.diagnosis.verdict.localisation import own_pose
from ccnn_torch.effects import Acting, Situation, default_gravity, make_effect, pose_residual, reached
from ccnn_torch.effects.found_machine import found_block, machine_of_block
from ccnn_torch.errors import InputError
from ccnn_torch.identification.judge import scatter
from ccnn_torch.mechanisms import Framed, SerialArm, fit_frames, load_mechanism
from ccnn_torch.numerics.rotations import rotation_vector_to_matrix
from ccnn_torch.records import load_records
from ccnn_torch.records.splits import Split

DATA = Path(__file__).parents[2] / "experiments" / "data"
NOISE = 5e-5
Change = Callable[[Tensor], Tensor]


def _same(values: Tensor) -> Tensor:
    return values


@pytest.mark.parametrize("tilt", [4e-4, 0.4])
def test_a_tool_is_as_long_as_it_is_where_all_axes_are_all_but_parallel(tilt: float) -> None:
    links = [[0.4, tilt, 0.0, 0.0], [0.3, 0.0, 0.0, 0.0], [0.0, 0.0, 0.1, 0.0], [0.0, 0.0, 0.0, 0.0]]
    types = ["revolute", "revolute", "prismatic", "revolute"]
    arm = SerialArm(
        "scara", "standard", links, types, orientation="none", tool_offset="unknown", unknown_frames=["base"]
    )
    joints = arm.sample_joints(40, torch.Generator().manual_seed(1))
    columns = frame_columns(Situation(arm, joints, {}, default_gravity(arm)), torch.ones(40, dtype=torch.bool))
    # A longer tool on a lower base moves the rows by the tilt, or not at all.
    rank = torch.linalg.matrix_rank(columns.flatten(0, 1), rtol=1e-9)
    assert int(rank) == (9 if tilt > 0.1 else 8)


def test_a_large_error_beside_fitted_frames_leaves_the_noise_and_no_length_of_the_tool(tmp_path: Path) -> None:
    arm = load_mechanism(str(DATA / "ur10.yaml"))
    assert isinstance(arm, SerialArm)
    rows = (DATA / "ur10_b_500.csv").read_text(encoding="utf-8").splitlines(keepends=True)
    (tmp_path / "r.csv").write_text("".join(rows[:151]), encoding="utf-8")
    records = load_records(tmp_path / "r.csv", arm, learns=False)
    measured_about = situation_of(records, arm)
    # Down is along the arm's own base, wherever the measuring device stands.
    assert measured_about.parameters is not None
    base = rotation_vector_to_matrix(measured_about.parameters[3:6])
    torch.testing.assert_close(
        base.mT @ measured_about.gravity, torch.tensor([0.0, 0.0, -9.80665], dtype=torch.float64)
    )
    # And places are told there, too, three metres from the tracker.
    assert float(own_pose(measured_about).norm(dim=-1).max()) < 1.6 < float(records.pose[:, :3].norm(dim=-1).min())
    effect = make_effect("geometry")
    coefficients = effect.coefficients(measured_about)
    g = torch.Generator().manual_seed(3)
    sizes = torch.tensor([c.scale for c in coefficients], dtype=torch.float64)
    cause = Acting(effect, sizes.new_zeros(0), 6 * sizes * torch.randn(len(sizes), generator=g, dtype=torch.float64))
    pose = reached(measured_about, [cause])
    pose = pose + NOISE * torch.randn(pose.shape, generator=g, dtype=torch.float64)
    situation = situation_of(replace(records, pose=pose), arm)
    found = diagnose_rows(situation, pose)
    assert found.verdict["effects"] == ["geometry"] and not found.verdict["outside_library"]
    # Of one channel the median of 150 rows tells it to a tenth.
    sigma = found.analysis.whitening.sigma
    assert 0.8 * NOISE < float(sigma.square().mean().sqrt()) < 1.25 * NOISE, sigma
    told = found.effects[0]["parameters"]
    # The tool frame stands for the last link's length: nothing of it is left for the geometry.
    assert abs(told["d6"]["value"]) < 1e-4, told["d6"]
    # What is proposed lies where the arm has been: its joints do not turn many times, and hit nothing new.
    low, high = situation.joints.amin(0).tolist(), situation.joints.amax(0).tolist()
    proposed = [list(row["joints"].values()) for row in found.next_measurements]
    assert len(proposed) == 8
    assert all(a <= q <= b for row in proposed for a, q, b in zip(low, row, high, strict=True))
    # All of the numbers together correct the machine.
    write_corrected(tmp_path, found)
    for name in ("corrected.yaml", "corrected.urdf"):
        corrected = load_mechanism(str(tmp_path / name))
        far = corrected.pose_error(pose, corrected.forward_kinematics(situation.joints)).position
        assert float(far.square().mean().sqrt()) < 1.1 * NOISE * 3**0.5, name
    # Beside another cause a URDF, which holds none, gets the geometry that is nearest to both.
    plain = replace(situation, parameters=None, covariates={})
    sizes = torch.tensor([2e-3 if c.unit == "1" else 0.0 for c in make_effect("joint_gain").coefficients(plain)])
    gain = Acting(make_effect("joint_gain"), sizes.new_zeros(0).double(), sizes.double())
    real = load_mechanism(str(tmp_path / "corrected.yaml"))
    whole = replace(plain, mechanism=real, gravity=default_gravity(real))
    block = found_block(whole, real.nominal, [gain], {})
    write_corrected(tmp_path, replace(found, content={**found.content, "machine": block}))
    assert torch.equal(load_mechanism(str(tmp_path / "corrected.yaml")).nominal, real.nominal)
    both = reached(whole, [gain])
    yaml, urdf, table = (
        real.pose_error(both, load_mechanism(str(tmp_path / name)).forward_kinematics(situation.joints)).position
        for name in ("corrected.yaml", "corrected.urdf", "corrected_dh.yaml")
    )
    assert float(urdf.norm()) < 0.5 * float(yaml.norm()) and float(table.norm()) < 0.5 * float(yaml.norm())


def _in_sockets(size: float = 1e-3) -> tuple[Situation, Tensor]:
    """Rows of an arm with errors of its geometry whose tool is in one of two sockets of a plate, set up three times."""
    keys = load_mechanism(str(DATA / "ur10.yaml")).recipe["keys"]
    more = {"orientation": "none", "unknown_frames": ["base", "tool"], "frame_per": ["placement"]}
    arm = SerialArm(**{**keys, **more})
    g = torch.Generator().manual_seed(5)
    placement, socket = torch.arange(90) % 3, torch.arange(90) // 3 % 2
    pose = torch.zeros(90, 3, dtype=torch.float64)
    pose[:, 0] = 0.05 * socket
    places = torch.tensor([[0.6, 0.0, 0.2], [0.5, 0.4, 0.3], [0.1, -0.7, 0.25]], dtype=torch.float64)
    turns = rotation_vector_to_matrix(torch.randn(3, 3, generator=g, dtype=torch.float64))
    target = places[placement] + (turns[placement] @ pose[..., None])[..., 0]
    truth = arm.nominal.clone()
    truth[:6], truth[-6:-3] = 0.0, torch.tensor([0.0, 0.0, 0.1], dtype=torch.float64)
    truth[6:-6] += size * torch.randn(len(truth) - 12, generator=g, dtype=torch.float64)
    middle = torch.tensor([0.0, -1.2, 1.5, -1.0, 1.0, 0.0], dtype=torch.float64)
    joints = middle + 0.7 * torch.randn(90, 6, generator=g, dtype=torch.float64)
    for _ in range(60):
        there = arm.forward_kinematics(joints, truth)
        step = torch.linalg.pinv(arm.jacobian_at(there, joints, truth)) @ (target - there)[..., None]
        joints = joints + step[..., 0].clamp(-0.2, 0.2)
    assert float((arm.forward_kinematics(joints, truth) - target).abs().max()) < 1e-9
    joints = joints + 1e-4 * torch.randn(90, 6, generator=g, dtype=torch.float64)
    frames = fit_frames(arm, joints, pose, columns={"placement": placement.double().numpy()})
    return Situation(arm, joints, {}, default_gravity(arm), frames, pose), pose


@pytest.fixture(scope="module")
def sockets() -> tuple[Situation, Diagnosis]:
    """Rows in sockets and what is found in them."""
    situation, pose = _in_sockets()
    return situation, diagnose_rows(situation, pose, effects=["geometry", "joint_offset", "gravity", "instrument"])


def test_an_arm_far_from_its_table_is_found_though_two_points_hardly_show_its_base() -> None:
    """A whole Gauss-Newton step turns plates and links so far that no linear model holds."""
    situation, pose = _in_sockets(1e-2)
    situation = on_fitted_frames(situation)
    every = torch.ones(len(pose), dtype=torch.bool)
    fitted = fit_jointly(situation, pose, [], every, loose_parameters(situation.mechanism, True))
    left = remainder(situation, pose, [], fitted.parameters).square().sum(-1).mean().sqrt()
    assert float(left) < 2.5e-4


def test_where_the_plates_were_thought_to_stand_first_does_not_change_the_arm() -> None:
    """The frames of plates are as large as they have to be; a prior about a first fit would draw the links along."""
    situation, pose = _in_sockets(3e-4)
    assert situation.parameters is not None
    fine, loose = torch.ones(90, dtype=torch.bool), range(len(situation.mechanism.geometry))
    away = situation.parameters.clone()
    away[torch.arange(90) % 3 == 1, :3] += 0.02
    links = [
        fit_jointly(replace(situation, parameters=first), pose, [], fine, loose).parameters[0, 6:-6]
        for first in (situation.parameters, away)
    ]
    far = (links[0] - situation.mechanism.nominal[6:-6]).norm()
    assert float((links[1] - links[0]).norm()) < 0.01 * float(far)


def test_an_arm_stands_upright_however_its_plates_stand(sockets: tuple[Situation, Diagnosis]) -> None:
    situation = sockets[0]
    assert situation.parameters is not None
    base = rotation_vector_to_matrix(situation.parameters[:, 3:6])
    inside = (base.mT @ situation.down[..., None])[..., 0]
    assert torch.allclose(inside, torch.tensor([0.0, 0.0, -1.0], dtype=torch.float64).expand_as(inside))
    alone = replace(situation, mechanism=situation.mechanism.with_nominal(situation.parameters[0]), parameters=None)
    push = situation.own_weight_torque
    assert torch.allclose(push, alone.own_weight_torque, atol=1e-9), "the same joints bear the same weight"


def test_an_error_of_the_geometry_is_named_where_the_device_shows_two_points_alone(
    sockets: tuple[Situation, Diagnosis],
) -> None:
    """The nominal place varies there by the gap alone: no scale of the device, and no rest, may go by it."""
    found = sockets[1]
    assert found.verdict["effects"] == ["geometry"] and not found.verdict["outside_library"]
    assert found.gap["after"] < 0.1 * found.gap["before"]


def test_the_machine_that_was_found_in_sockets_is_delivered_in_its_own_base(
    sockets: tuple[Situation, Diagnosis],
) -> None:
    """Plates stand anywhere; links and tool are the arm's, and put the ball where each socket holds it."""
    situation, said = sockets
    block = named_machine(said)
    assert block is not None
    found = machine_of_block(block, "diagnosis.json")
    arm = found.identified
    assert isinstance(arm, SerialArm) and not arm.unknown_frames and not arm.frame_per
    assert arm.nominal[:6].tolist() == [0.0] * 6
    torch.testing.assert_close(found.gravity, torch.tensor([0.0, 0.0, -9.80665], dtype=torch.float64))
    socket = torch.arange(90) % 3 * 2 + torch.arange(90) // 3 % 2
    apart = [
        scatter(machine.forward_frame(situation.joints)[0], socket, torch.ones(90, dtype=torch.float64))
        for machine in (arm, found.nominal)
        if isinstance(machine, SerialArm)
    ]
    after, before = (float(far.square().mean().sqrt()) for far in apart)
    assert after < 3e-4 and before > 2e-3


def test_a_frame_of_a_group_of_rows_acts_in_these_alone() -> None:
    """Geometry and frames of the groups leave the noise; with one frame for all they do not."""
    situation, pose = _in_sockets()
    frames = frame_columns(situation, torch.ones(90, dtype=torch.bool))
    assert frames.shape == (90, 3, 3 * 6 + 6)
    columns = torch.cat([frames, situation.parameter_jacobian[..., 6:-6]], -1).flatten(0, 1)
    y = pose_residual(situation, pose).flatten()
    left = y - columns @ torch.linalg.lstsq(columns, y, driver="gelsd").solution
    assert float(left.square().mean().sqrt()) < 1e-4 < 0.1 * float(y.square().mean().sqrt())


def _reversed_second(joints: Tensor) -> Tensor:
    return joints * torch.tensor([1.0, -1, 1, 1, 1, 1], dtype=torch.float64)


@pytest.mark.parametrize(
    ("joints", "pose", "said"),
    [
        (_same, lambda pose: pose.roll(1, 0), "the poses seem to be one row late"),
        (_reversed_second, _same, "joint q2 seems to count in the other direction"),
    ],
)
def test_a_mistake_is_named_beside_frames_that_nobody_knows(joints: Change, pose: Change, said: str) -> None:
    """Measured in position: frames fitted to the mistaken rows hide how each is off, so that they are fitted anew."""
    arm = load_mechanism(str(DATA / "ur10.yaml"))
    records = load_records(DATA / "ur10_b_500.csv", arm, learns=False)
    here = replace(records, orientation="none", pose_coordinates=records.pose_coordinates[:3])
    wrong = replace(here, joints=joints(records.joints[:60]), pose=pose(records.pose[:60, :3]))
    with pytest.raises(InputError, match=said):
        situation_of(wrong, arm)


def test_the_wrong_tool_is_named_with_the_right_one() -> None:
    """The most usual mistake of all: what was measured is another point of the flange than the file says."""
    keys = load_mechanism(str(DATA / "ur10.yaml")).recipe["keys"]
    arm = SerialArm(**{**keys, "tool_offset": [0.0, 0.0, 0.11], "orientation": "none", "unknown_frames": ["base"]})
    joints = arm.sample_joints(60, torch.Generator().manual_seed(0))
    truth = arm.nominal.clone()
    truth[-6:-3] = torch.tensor([0.02, 0.0, 0.05], dtype=torch.float64)
    records = load_records(DATA / "ur10_b_500.csv", load_mechanism(str(DATA / "ur10.yaml")), learns=False)
    here = replace(records, orientation="none", pose_coordinates=records.pose_coordinates[:3])
    wrong = replace(here, joints=joints, pose=arm.forward_kinematics(joints, truth))
    split = Split(torch.arange(60), torch.arange(0), torch.arange(0))
    for told in (lambda: situation_of(wrong, arm), lambda: frames_of_repeats(arm, wrong, [split, split])):
        with pytest.raises(InputError, match=r"with base frame fitted.* at 20.0, -?0.0, 50.0 mm .* not at 0.0, 0.0"):
            told()


def _as_fixed_angles(pose: Tensor) -> Tensor:
    angles = Rotation.from_rotvec(pose[:, 3:].numpy()).as_euler("xyz")
    return torch.cat([pose[:, :3], torch.from_numpy(angles)], -1)


def _inverted(pose: Tensor) -> Tensor:
    back = rotation_vector_to_matrix(-pose[:, 3:])
    return torch.cat([-(back @ pose[:, :3, None])[..., 0], -pose[:, 3:]], -1)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (_as_fixed_angles, "Euler angles and no rotation vector: name them fanuc_w, fanuc_p, fanuc_r"),
        (_inverted, "the pose seems to be inverted"),
    ],
)
def test_a_pose_of_another_kind_is_named(change: Change, said: str) -> None:
    arm = load_mechanism(str(DATA / "ur10.yaml"))
    assert isinstance(arm, SerialArm)
    records = load_records(DATA / "ur10_b_500.csv", arm, learns=False)
    joints = arm.sample_joints(60, torch.Generator().manual_seed(0))
    pose = change(arm.forward_kinematics(joints))
    with pytest.raises(InputError, match=said):
        situation_of(replace(records, joints=joints, pose=pose), arm)


def test_the_base_of_a_framed_machine_is_fitted_first_without_outliers() -> None:
    """The machine inside has its own keys, and its parameters as they were; simulated with a frame of its own."""
    machine = load_mechanism("framed", mechanism="delta", keys={"base": 0.18, "crank": 0.26})
    assert machine.describe()["keys"]["mechanism"]["keys"] == {"base": 0.18, "crank": 0.26}
    assert isinstance(machine, Framed) and machine.unknown_frames == ("base",)
    base = torch.tensor([2.0, 1.0, -0.5, 0.1, -0.2, 1.3], dtype=torch.float64)
    truth = torch.cat([base, machine.nominal[6:]])
    at = machine.mechanism.sample_workspace(60, torch.Generator().manual_seed(0))
    joints = machine.mechanism.solve_inverse(at)
    pose = machine.forward_kinematics(joints, truth)
    pose[::9] += 0.2
    found = machine.inlying_frames(joints, pose, torch.ones(2, 60, dtype=torch.float64))
    torch.testing.assert_close(found, truth.expand(2, -1), rtol=0, atol=1e-8)
    assert machine.with_nominal(found[0]).unknown_frames == ()
    with pytest.raises(InputError, match="base is true or false"):
        load_mechanism("framed", mechanism="delta", base=0.18)


def test_a_gain_of_one_joint_is_asked_beside_what_frames_do() -> None:
    """The base's turn is what the first joint's zero does: beside unknown frames it is no part of a gain."""
    links = [[0.35, -1.5707963, 0.8, 0.0], [1.2, 0.0, 0.0, -1.5707963], [0.1, -1.5707963, 0.0, 0.0]]
    links += [[0.0, 1.0471976, 1.4, 0.0], [0.0, -1.0471976, 0.17, 0.0], [0.0, 0.0, 0.15, 0.0]]
    limits = [[-1.3, 1.3], [-0.6, 0.9], [-0.7, 0.5], [-2.5, 2.5], [-2.6, 2.6], [-2.8, 2.8]]
    arm = SerialArm("painter", "standard", links, limits=limits, unknown_frames=["base", "tool"])
    for seed in (1, 2):
        generator = torch.Generator().manual_seed(seed)
        joints = arm.sample_joints(200, generator)
        moved = joints.clone()
        moved[:, 1] += 3e-4 * joints[:, 1]
        sizes = torch.tensor([4e-5] * 3 + [6e-5] * 3, dtype=torch.float64)
        pose = arm.forward_kinematics(moved)
        pose = pose + sizes * torch.randn(pose.shape, generator=generator, dtype=torch.float64)
        here = Situation(arm, joints, {}, default_gravity(arm), fit_frames(arm, joints, pose))
        said = diagnose_rows(here, pose)
        assert said.verdict["effects"] == ["joint_gain"] and said.verdict["probability"] > 0.9
        named = next(e["parameters"] for e in said.effects if e["name"] == "joint_gain")
        assert set(named) == {"q2", "q2 zero"}
