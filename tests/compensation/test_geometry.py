"""Identified geometry beside the network: the deviation it gives, the compensator around it, and every file form."""

from __future__ import annotations

import json
import math
from pathlib import Path

import pytest
import torch
from ccnn_torch.compensation.geometry.serial import SerialGeometry, _chain, _placed
from stand_ins import Sigmoids
from torch import Tensor

from ccnn_torch.compensation import (
    Compensator,
    fit_compensator,
    fit_geometry_module,
    geometric_deviation,
    load_model,
    save_model,
    settled_damping,
)
from ccnn_torch.compensation.export.to_onnx import to_onnx
from ccnn_torch.compensation.geometry import identified as _geometry
from ccnn_torch.compensation.geometry.expanded import ExpandedGeometry, expand_geometry
from ccnn_torch.compensation.model_files.onnx_session import check_graph, open_onnx
from ccnn_torch.coordinates import Coordinate
from ccnn_torch.errors import InputError, MethodFailedError
from ccnn_torch.mechanisms import Mechanism, SerialArm, load_mechanism
from ccnn_torch.training import Scaling

HALF = math.pi / 2
SIX = [[0.1, HALF, 0.4, 0], [-0.5, 0, 0, 0], [-0.4, 0, 0, 0], [0, HALF, 0.12, 0], [0, -HALF, 0.1, 0], [0, 0, 0.09, 0]]
TAMED = (0.3, 0.01)  # rotation weight and damping
AROUND = torch.tensor([0.3, -1.2, 1.4, 0.5, 1.2, 0.4], dtype=torch.float64)


def six_joint_arm(orientation: str = "rotation_vector") -> tuple[SerialArm, Tensor, Tensor]:
    """Arm, identified parameters (50 µm, 50 µrad off), joints in a region without singular poses."""
    generator = torch.Generator().manual_seed(4)
    arm = SerialArm("six", "standard", SIX, orientation=orientation)
    draw = torch.randn(arm.nominal.shape, generator=generator, dtype=torch.float64)
    joints = AROUND + 0.3 * (2 * torch.rand(120, 6, generator=generator, dtype=torch.float64) - 1)
    return arm, arm.nominal + 5e-5 * draw, joints


def small_network(joints: Tensor, size: float = 1e-4) -> tuple[Sigmoids, Scaling, Tensor]:
    """A network, its scaling, and the deviations `size` [SI] that it gives at the joints."""
    n = joints.shape[-1]
    network = Sigmoids([n, 4, n], seed=1, gain=0.5)
    blank, flat = torch.ones(1, len(joints), dtype=torch.float64), torch.zeros(n, dtype=torch.bool)
    scaling = Scaling.fit(joints[None], torch.zeros_like(joints)[None], blank, flat).repeat(0)
    scaling.deviation.fill_(size)
    with torch.no_grad():
        return network, scaling, scaling.restore(network(scaling.features(joints)))


def three_joint_arm() -> tuple[SerialArm, Tensor, Tensor]:
    """The same of an arm that turns, turns and slides, measured by its position: fewer operations to trace."""
    generator = torch.Generator().manual_seed(6)
    links = [[0.4, 0.0, 0.3, 0.0], [0.3, math.pi, 0.0, 0.0], [0.0, 0.0, 0.1, 0.0]]
    types = ["revolute", "revolute", "prismatic"]
    arm = SerialArm("scara", "standard", links, joint_types=types, joint_sign=[1, -1, 1], orientation="none")
    draw = torch.randn(arm.nominal.shape, generator=generator, dtype=torch.float64)
    spread = torch.rand(100, 3, generator=generator, dtype=torch.float64) - 0.5
    joints = torch.tensor([0.2, -1.3, 0.1], dtype=torch.float64) + spread * torch.tensor([1.0, 0.6, 0.1])
    return arm, arm.nominal + 1e-6 * draw, joints


def arm_compensator() -> tuple[Compensator, SerialArm, Tensor, Tensor, Tensor]:
    arm, identified, joints = three_joint_arm()
    network, scaling, deviations = small_network(joints, 1e-6)
    geometry = fit_geometry_module(arm, arm.nominal, identified, joints, 0.1, *TAMED)
    made = fit_compensator(network, scaling, joints, deviations, arm.joints, geometry=geometry)
    return made, arm, identified, joints, deviations


@pytest.mark.parametrize("orientation", ["rotation_vector", "none"])
def test_nominal_arm_with_the_deviation_stands_where_the_identified_one_does(orientation: str) -> None:
    arm, identified, joints = six_joint_arm(orientation)
    deviation = geometric_deviation(arm, arm.nominal, identified, 0.3, 1e-3)(joints)
    wanted = arm.forward_kinematics(joints, identified)
    start = arm.pose_error(arm.forward_kinematics(joints), wanted).position
    left = arm.pose_error(arm.forward_kinematics(joints + deviation), wanted).position
    assert float(left.max()) < 1e-3 * float(start.median())
    assert float(deviation.abs().max()) < 0.02


def test_repeats_side_by_side_are_those_one_by_one() -> None:
    arm, identified, joints = six_joint_arm()
    both = torch.stack([identified, 2 * identified - arm.nominal]).unsqueeze(1)
    together = geometric_deviation(arm, arm.nominal.expand_as(both), both)(joints.expand(2, -1, -1))
    for k in range(2):
        alone = geometric_deviation(arm, arm.nominal, both[k, 0])(joints)
        torch.testing.assert_close(together[k], alone, rtol=0, atol=1e-15)


def test_damping_grows_only_where_poses_are_singular(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(_geometry, "_ROWS", 20)
    arm, identified, joints = six_joint_arm()
    pair = arm.nominal[None, None], identified[None, None]
    limit = torch.full((6,), 5e-3, dtype=torch.float64)
    calm = settled_damping(arm, *pair, AROUND + 0.3 * (joints - AROUND), limit, 0.3, 0.1)
    near = joints.clone()
    near[:, 4] -= 1.2  # the wrist's axes come into line
    assert calm < settled_damping(arm, *pair, near, limit, 0.3, 0.1) < 1.0
    assert settled_damping(load_mechanism("tripod"), *pair, joints, limit, 0.3, 0.1) == 0.0


def test_compensator_adds_network_and_geometry() -> None:
    made, arm, identified, joints, deviations = arm_compensator()
    geometry = geometric_deviation(arm, arm.nominal, identified, *TAMED)
    expected = deviations + geometry(joints + deviations)
    torch.testing.assert_close(made.deviation(joints), expected, rtol=0, atol=1e-12)
    command, deviation, inside = made(joints)
    assert bool(inside.all())
    torch.testing.assert_close(command + deviation, joints, rtol=0, atol=1e-12)
    torch.testing.assert_close(made.back(command), joints, rtol=0, atol=1e-12)
    # The machine: the network's deviation is real, and so is the identified geometry.
    with torch.no_grad():
        moved = command + made.scaling.restore(made.network(made.scaling.features(command)))
    reached = arm.forward_kinematics(moved, identified)
    assert float(arm.pose_error(reached, arm.forward_kinematics(joints)).position.max()) < 1e-8
    assert bool((made.limit >= expected.abs().amax(0)).all())


def test_far_outside_the_geometry_of_an_arm_stays_and_everything_is_bounded() -> None:
    made, arm, identified, joints, _ = arm_compensator()
    far = joints[:5] + 40.0
    strange = torch.full((2, 3), float("nan"), dtype=torch.float64)
    strange[1] = float("inf")
    for given in (far, strange):
        command, deviation, inside = made(given)
        assert not bool(inside.any())
        assert bool(torch.isfinite(command).all()) and bool((deviation.abs() <= made.limit).all())
        assert bool(torch.isfinite(made.sd(given)).all())
    caged = made.domain.cage(far) + made.safe
    expected = made.safe + geometric_deviation(arm, arm.nominal, identified, *TAMED)(caged)
    torch.testing.assert_close(
        made.deviation(far), torch.minimum(torch.maximum(expected, -made.limit), made.limit), rtol=0, atol=1e-15
    )


def fields_of(mechanism: Mechanism) -> dict[str, object]:
    return {"mechanism": mechanism.describe(), "metrics": {}, "data_sha256": "ab" * 32, "seed": 0}


def test_every_file_form_of_an_arm_gives_the_same_commands(tmp_path: Path) -> None:
    made, arm, _, joints, _ = arm_compensator()
    paths = save_model(tmp_path, made, fields_of(arm), forms=("pt2",))
    assert json.loads(paths["card"].read_text())["format"] == "ccnn_torch compensator 3"
    expected = made.solve(joints)
    master = load_model(paths["safetensors"])(joints.numpy())
    program = torch.export.load(paths["pt2"]).module()
    assert not master["fallback"].any()
    for (name, value), exported in zip(expected._asdict().items(), program(joints), strict=True):
        torch.testing.assert_close(torch.from_numpy(master[name]), value, rtol=1e-9, atol=1e-12)
        torch.testing.assert_close(exported, value, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("kind", ["arm", "expansion"])
def test_the_deviation_runs_in_onnx_in_double(kind: str) -> None:
    arm, identified, joints = three_joint_arm()
    module: torch.nn.Module = SerialGeometry(arm, arm.nominal, identified, *TAMED)
    if kind == "expansion":
        module = expand_geometry(lambda q: 1e-3 * q * q.roll(1, -1), joints)
    model = to_onnx(module, {"joints": joints}, ["deviation"], 20)
    check_graph(model)
    session = open_onnx(model.SerializeToString())
    (found,) = session.run(None, {session.get_inputs()[0].name: joints.numpy()})
    torch.testing.assert_close(torch.from_numpy(found), module(joints), rtol=0, atol=1e-14)


def tripod_with_errors() -> tuple[Mechanism, Tensor, Tensor]:
    tripod = load_mechanism("tripod")
    draw = torch.randn(tripod.nominal.shape, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    joints = tripod.sample_joints(150, torch.Generator().manual_seed(3))
    return tripod, tripod.nominal + 5e-4 * draw, joints


def test_a_parallel_mechanism_is_expanded(tmp_path: Path) -> None:
    tripod, identified, joints = tripod_with_errors()
    exact = geometric_deviation(tripod, tripod.nominal, identified)
    module = fit_geometry_module(tripod, tripod.nominal, identified, joints)
    assert isinstance(module, ExpandedGeometry)
    fresh = tripod.sample_joints(200, torch.Generator().manual_seed(8))
    wanted = exact(fresh)
    inside = ((fresh - joints.mean(0)).abs() < 0.8 * (joints - joints.mean(0)).abs().amax(0)).all(-1)
    assert int(inside.sum()) > 50
    assert float((module(fresh) - wanted)[inside].abs().max()) < 1e-2 * float(wanted.abs().max())
    network, scaling, deviations = small_network(joints, 2e-5)
    made = fit_compensator(network, scaling, joints, deviations, tripod.joints, geometry=module)
    torch.testing.assert_close(made.deviation(joints), deviations + module(joints + deviations), rtol=0, atol=1e-12)
    assert bool((made.deviation(joints[:3] + 30.0) == made.safe).all())
    found = load_model(save_model(tmp_path, made, fields_of(tripod), forms=())["safetensors"])(joints.numpy())
    torch.testing.assert_close(torch.from_numpy(found["command"]), made(joints)[0], rtol=0, atol=1e-15)


def test_an_expansion_says_when_it_does_not_fit() -> None:
    joints = torch.rand(100, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    with pytest.raises(MethodFailedError, match="no polynomial"):
        expand_geometry(lambda q: 1e-3 * torch.sign(q - 0.5), joints)
    with pytest.raises(InputError, match="joints"):
        expand_geometry(lambda q: q, torch.rand(30, 12, dtype=torch.float64))
    nothing = expand_geometry(torch.zeros_like, joints)
    assert bool((nothing(joints) == 0).all())


def test_a_polynomial_is_expanded_exactly() -> None:
    joints = torch.rand(200, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)

    def cubic(q: Tensor) -> Tensor:
        return torch.stack([q[:, 0] ** 3, q[:, 0] * q[:, 1] * q[:, 2], 1 + q[:, 2] ** 2], -1)

    module = expand_geometry(cubic, joints)
    assert module.degree == 4
    torch.testing.assert_close(module(joints), cubic(joints), rtol=0, atol=1e-7)


def test_slopes_of_an_arm_are_those_of_its_own_jacobian() -> None:
    for arm, identified, joints in (six_joint_arm(), three_joint_arm()):
        module = SerialGeometry(arm, arm.nominal, identified, 0.3, 0.01)
        weight = torch.tensor([1.0] * 3 + [0.3] * 3, dtype=torch.float64)[: len(arm.pose), None]
        slope = module._slope(_chain(_placed(module._moved(joints), module._nominal_links)))
        torch.testing.assert_close(slope.mT, arm.jacobian(joints) * weight, rtol=0, atol=1e-13)


def test_without_geometry_the_form_of_the_file_is_that_of_before(tmp_path: Path) -> None:
    joints = torch.rand(50, 2, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    network, scaling, deviations = small_network(joints)
    names = [Coordinate("q1", "m"), Coordinate("q2", "m")]
    made = fit_compensator(network, scaling, joints, deviations, names)
    tripod = load_mechanism("tripod")
    paths = save_model(tmp_path, made, fields_of(tripod), forms=())
    card = json.loads(paths["card"].read_text())
    assert card["format"] == "ccnn_torch compensator 2" and "geometry" not in card
