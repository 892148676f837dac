"""Identified geometry of a machine without closed forms: polynomials of the joints, and the compensator around one."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch
from machines import arm, overconstrained, small_network
from module_graph import to_onnx
from torch import Tensor, nn

from ccnn_torch.compensation import (
    expand,
    fit_compensator,
    geometric_deviation,
    load_model,
    save_model,
)
from ccnn_torch.compensation.expansions import ChebyshevExpansion
from ccnn_torch.compensation.model_files.metadata import check_graph, open_onnx
from ccnn_torch.coordinates import Coordinate
from ccnn_torch.errors import InputError, MethodFailedError
from ccnn_torch.mechanisms import Mechanism


@pytest.mark.parametrize("orientation", ["rotation_vector", "none"])
def test_nominal_arm_with_the_deviation_stands_where_the_identified_one_does(orientation: str) -> None:
    known = arm(orientation)
    machine, joints = known.mechanism, known.joints
    deviation = geometric_deviation(machine, machine.nominal, known.identified)(joints)
    wanted = machine.forward_kinematics(joints, known.identified)
    left = machine.pose_error(machine.forward_kinematics(joints + deviation), wanted).position
    assert float(left.max()) < 1e-9
    assert float(deviation.abs().max()) < 0.02


def test_repeats_side_by_side_are_those_one_by_one() -> None:
    known = arm()
    nominal, identified, joints = known.mechanism.nominal, known.identified, known.joints
    both = torch.stack([identified, 2 * identified - nominal]).unsqueeze(1)
    together = geometric_deviation(known.mechanism, nominal.expand_as(both), both)(joints.expand(2, -1, -1))
    for k in range(2):
        alone = geometric_deviation(known.mechanism, nominal, both[k, 0])(joints)
        torch.testing.assert_close(together[k], alone, rtol=0, atol=1e-12)


def fields_of(mechanism: Mechanism) -> dict[str, object]:
    return {"mechanism": mechanism.describe(), "metrics": {}, "data_sha256": "ab" * 32, "seed": 0}


def test_the_deviation_runs_in_onnx_in_double() -> None:
    joints = arm().joints
    module = expand(lambda q: 1e-3 * q * q.roll(1, -1), joints)
    model = to_onnx(module, {"joints": joints}, ["deviation"])
    check_graph(model)
    session = open_onnx(model.SerializeToString())
    (found,) = session.run(None, {session.get_inputs()[0].name: joints.numpy()})
    torch.testing.assert_close(torch.from_numpy(found), module(joints), rtol=0, atol=1e-14)


def test_a_machine_without_closed_forms_is_expanded(tmp_path: Path) -> None:
    known = overconstrained()
    machine, joints = known.mechanism, known.joints
    exact = geometric_deviation(machine, machine.nominal, known.identified)
    module = expand(exact, joints)
    assert isinstance(module, ChebyshevExpansion)
    fresh = joints.mean(0) + 0.9 * (joints - joints.mean(0)).roll(1, 0)
    wanted = exact(fresh)
    assert float((module(fresh) - wanted).abs().max()) < 1e-2 * float(wanted.abs().max())
    network, scaling, deviations = small_network(joints, 2e-5)
    made = fit_compensator(network, scaling, joints, deviations, machine.joints, geometry=module)
    expected = deviations + module(joints + deviations)
    torch.testing.assert_close(made.deviation(joints), expected, rtol=0, atol=1e-12)
    assert bool((made.limit >= expected.abs().amax(0)).all()) and torch.equal(made.most, made.limit)
    command, deviation, inside = made(joints)
    assert bool(inside.all())
    torch.testing.assert_close(command + deviation, joints, rtol=0, atol=1e-12)
    torch.testing.assert_close(made.back(command), joints, rtol=0, atol=1e-12)
    # It fades outside, where a polynomial says nothing, and says so.
    assert bool((made.deviation(joints[:3] + 30.0) == made.safe).all())
    assert made.solve(joints[:3] + 30.0).status.tolist() == [1, 1, 1]
    path = save_model(tmp_path, made, fields_of(machine), forms=())["safetensors"]
    assert "geometry" in json.loads((tmp_path / "card.json").read_text())
    found = load_model(path)(joints.numpy())
    torch.testing.assert_close(torch.from_numpy(found["command"]), made(joints)[0], rtol=0, atol=1e-15)


class Opposite(nn.Module):
    """An effect that takes back what the geometry does, as growth does of lengths that are off."""

    def forward(self, joints: Tensor, covariates: Tensor) -> Tensor:
        return torch.full_like(joints, -0.01)


def test_geometry_and_effects_may_each_be_larger_than_what_both_leave_and_hold_when_it_is_warmer() -> None:
    known = overconstrained()
    warmth = torch.linspace(293.0, 295.0, len(known.joints), dtype=torch.float64)[:, None]
    inputs = torch.cat([known.joints, warmth], -1)
    network, scaling, deviations = small_network(inputs, 2e-5, known.joints.shape[-1])
    geometry = expand(lambda joints: 0.01 + 1e-4 * joints, known.joints)
    about = network, scaling, inputs, deviations, known.mechanism.joints, [Coordinate("temperature", "K")]
    made = fit_compensator(*about, geometry=geometry, effects=Opposite())  # type: ignore[arg-type]
    assert float(made.limit.max()) < 1e-3
    both = 1e-4 * (known.joints + deviations - 0.01)
    torch.testing.assert_close(made.deviation(known.joints, warmth), deviations + both, rtol=0, atol=1e-10)
    warmer = made.deviation(known.joints, warmth + 20)
    torch.testing.assert_close(warmer, 1e-4 * (known.joints - 0.01), rtol=0, atol=1e-10)


def test_an_expansion_says_when_it_does_not_fit() -> None:
    joints = torch.rand(100, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    with pytest.raises(MethodFailedError, match="no polynomial"):
        expand(lambda q: 1e-3 * torch.sign(q - 0.5), joints)
    with pytest.raises(InputError, match="joints"):
        expand(lambda q: q, torch.rand(30, 12, dtype=torch.float64))
    nothing = expand(torch.zeros_like, joints)
    assert bool((nothing(joints) == 0).all())


def test_a_polynomial_is_expanded_exactly() -> None:
    joints = torch.rand(200, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)

    def cubic(q: Tensor) -> Tensor:
        return torch.stack([q[:, 0] ** 3, q[:, 0] * q[:, 1] * q[:, 2], 1 + q[:, 2] ** 2], -1)

    module = expand(cubic, joints)
    assert module.degree == 4
    torch.testing.assert_close(module(joints), cubic(joints), rtol=0, atol=1e-7)
