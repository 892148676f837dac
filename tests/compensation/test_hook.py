"""Closed loop: a machine with an error, commanded with the hook and without."""

from __future__ import annotations

import warnings

import pytest
import torch
from stand_ins import Sigmoids, arm_compensator, tripod_compensator
from torch import Tensor, nn

from ccnn_torch.compensation import Compensator, fit_compensator
from ccnn_torch.errors import InputError, OutsideDomainWarning
from ccnn_torch.mechanisms import Mechanism, load_mechanism
from ccnn_torch.training import Scaling


class Machine:
    """The real machine: it moves its joints by δ_true more than commanded."""

    def __init__(self, nominal: Mechanism) -> None:
        self.nominal = nominal

    def deviation(self, command: Tensor) -> Tensor:
        return 2e-4 * torch.sin(3 * command.roll(1, -1)) + 1e-4 * command**2

    def reach(self, command: Tensor) -> Tensor:
        return self.nominal.forward_kinematics(command + self.deviation(command))


@pytest.fixture(scope="module")
def machine() -> Machine:
    return Machine(load_mechanism("tripod"))


@pytest.fixture(scope="module")
def learnt(machine: Machine) -> Compensator:
    """A least-squares fit of random sigmoid features to measured deviations: no stand-in for the truth itself."""
    generator = torch.Generator().manual_seed(2)
    pose = machine.nominal.sample_workspace(400, generator)
    command = machine.nominal.solve_inverse(pose)
    measured = machine.nominal.solve_inverse(machine.reach(command)) - command
    ones = torch.ones(1, 400, dtype=torch.float64)
    scaling = Scaling.fit(command[None], measured[None], ones, torch.zeros(3, dtype=torch.bool)).repeat(0)
    network = Sigmoids([3, 40, 3], seed=1)
    with torch.no_grad():
        hidden = torch.sigmoid(scaling.features(command) @ network.weights[0].mT)
        network.weights[1].copy_(torch.linalg.lstsq(hidden, scaling.standardise(measured)).solution.mT)
    return fit_compensator(network, scaling, command, measured, machine.nominal.joints)


def test_the_hook_shrinks_the_pose_error_and_without_it_nothing_changes(machine: Machine, learnt: Compensator) -> None:
    wanted = machine.nominal.sample_workspace(200, torch.Generator().manual_seed(8))
    ik = machine.nominal.inverse_kinematics
    plain = machine.nominal.solve_inverse(wanted)
    before = machine.nominal.pose_error(machine.reach(ik(wanted)), wanted)
    handle = ik.register_forward_hook(learnt.hook(warn=False), with_kwargs=True)
    try:
        command = ik(wanted)
        after = machine.nominal.pose_error(machine.reach(command), wanted)
        torch.testing.assert_close(machine.nominal.solve_inverse(wanted), plain, rtol=0, atol=0)
    finally:
        handle.remove()
    inside = learnt(plain)[2]
    assert float(inside.double().mean()) > 0.9
    assert before.rotation is not None and after.rotation is not None
    assert float(after.position[inside].square().mean().sqrt()) < 0.05 * float(before.position.square().mean().sqrt())
    assert float(after.rotation[inside].square().mean().sqrt()) < 0.05 * float(before.rotation.square().mean().sqrt())
    torch.testing.assert_close(ik(wanted), plain, rtol=0, atol=0)
    # What the controller reads back is the pose that the machine really has.
    seen = machine.nominal.forward_kinematics(learnt.back(command))
    assert float(machine.nominal.pose_error(seen, wanted).position[inside].max()) < 1e-12


def test_outside_the_domain_is_said_once_and_inside_never(machine: Machine, learnt: Compensator) -> None:
    mechanism = load_mechanism("tripod")
    mechanism.inverse_kinematics.register_forward_hook(learnt.hook(), with_kwargs=True)
    home = mechanism.home_pose.expand(2, 3)
    mechanism.inverse_kinematics(home)
    far = torch.tensor([[0.6, 0.3, 0.0]], dtype=torch.float64)
    with pytest.warns(OutsideDomainWarning, match="mean training deviation"):
        mechanism.inverse_kinematics(far)
    mechanism.inverse_kinematics(far)


def test_a_pose_that_cannot_be_reached_stays_without_joints(learnt: Compensator) -> None:
    mechanism = load_mechanism("tripod")
    mechanism.inverse_kinematics.register_forward_hook(learnt.hook(), with_kwargs=True)
    poses = torch.stack([mechanism.home_pose, mechanism.home_pose + 5.0])
    joints = mechanism.inverse_kinematics(poses)
    assert bool(torch.isfinite(joints[0]).all()) and bool(torch.isnan(joints[1]).any())


class _Arm(nn.Module):
    """Two revolute joints whose inverse kinematics is what it is given."""

    def forward(self, pose: Tensor, covariates: Tensor | None = None) -> Tensor:
        return pose


def test_covariates_travel_as_a_keyword() -> None:
    compensator, arm = arm_compensator(), _Arm()
    arm.register_forward_hook(compensator.hook(), with_kwargs=True)
    pose = torch.tensor([[[0.3, 1.0], [0.4, -1.0]]], dtype=torch.float64)
    covariates = torch.tensor([1000.0, 295.0], dtype=torch.float64)
    expected = compensator(pose, covariates.expand(1, 2, 2))[0]
    torch.testing.assert_close(arm(pose, covariates=covariates), expected, rtol=0, atol=0)
    with pytest.raises(InputError, match=r"time\[s\], temperature\[K\]"):
        arm(pose)


def test_the_hook_is_differentiable_and_works_inside_vmap() -> None:
    compensator = tripod_compensator()
    mechanism = load_mechanism("tripod")
    mechanism.inverse_kinematics.register_forward_hook(compensator.hook(warn=False), with_kwargs=True)
    poses = mechanism.sample_workspace(5, torch.Generator().manual_seed(3))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        slope = torch.func.vmap(torch.func.jacrev(mechanism.inverse_kinematics))(poses)
    step = 1e-6
    for k in range(3):
        moved = poses.clone()
        moved[:, k] += step
        numeric = (mechanism.inverse_kinematics(moved) - mechanism.inverse_kinematics(poses)) / step
        torch.testing.assert_close(slope[..., k], numeric, rtol=1e-4, atol=1e-5)
