"""The shipped conformance check passes on the whole catalogue, and catches what a user may get wrong."""

import pytest
import torch
from catalogue import FIVE_BAR, NAMES, make
from five_bar import FiveBar

from ccnn_torch.errors import InputError
from ccnn_torch.mechanisms import MachineTool, Mechanism, Stewart, Tripod
from ccnn_torch.testing import check_mechanism


# A framed hexapod, the longest, is identified in tests/identify/test_framed_set_ups.py; a framed five-bar is left.
@pytest.mark.parametrize("name", [name for name in NAMES if name != "framed_stewart"])
def test_conforms(name, tmp_path):
    check_mechanism(make(name, tmp_path))


class _WrongJacobian(Tripod):
    def jacobian(self, joints, parameters=None, guess=None):
        return 1.001 * super().jacobian(joints, parameters, guess)


class _WrongParameterJacobian(Stewart):
    def parameter_jacobian(self, joints, parameters=None, guess=None):
        slope = super().parameter_jacobian(joints, parameters, guess).clone()
        slope[..., 6] *= 1.001
        return slope


class _WrongForward(MachineTool):
    def forward_kinematics(self, joints, parameters=None, guess=None):
        return super().forward_kinematics(joints, parameters, guess) + 1e-6


class _NotBatched(MachineTool):
    def solve_inverse(self, pose, parameters=None, guess=None):
        joints = super().solve_inverse(pose, parameters, guess)
        return joints if pose.dim() < 3 else joints.flip(0)


class _IgnoresParameters(MachineTool):
    def solve_inverse(self, pose, parameters=None, guess=None):
        return super().solve_inverse(pose, None, guess)


class _CutsGradient(Tripod):
    def solve_inverse(self, pose, parameters=None, guess=None):
        return super().solve_inverse(pose, self.resolve(parameters).detach(), guess)


class _Hooked(Tripod):
    def solve_inverse(self, pose, parameters=None, guess=None):
        if not hasattr(self, "inverse_kinematics") or not self.inverse_kinematics._forward_hooks:
            return super().solve_inverse(pose, parameters, guess)
        return super().solve_inverse(pose, parameters, guess) + 1.0


class _LosesParameters(Tripod):
    def describe(self):
        return {**super().describe(), "parameters": {"L": 1.0, "r": 0.3}}


@pytest.mark.parametrize(
    ("wrong", "sentence"),
    [
        (_WrongJacobian, "jacobian is off by"),
        (_WrongParameterJacobian, "parameter_jacobian is off by .* for parameter offset1"),
        (_WrongForward, "has a pose error of"),
        (_NotBatched, "solve_inverse of batch shape"),
        (_IgnoresParameters, "of parameters"),
        (_CutsGradient, "not differentiable in its parameters"),
        (_Hooked, "does not return what its hook returns"),
        (_LosesParameters, "do not survive describe"),
    ],
)
def test_catches(wrong, sentence):
    with pytest.raises(AssertionError, match=sentence):
        check_mechanism(wrong())


def test_a_mechanism_needs_a_verb():
    class Empty(Mechanism):
        pass

    with pytest.raises(InputError, match="closure"):
        Empty("empty", [], [], [], [], [])


def test_a_users_mechanism_is_short_and_on_its_branch():
    assert len(FIVE_BAR.read_text().splitlines()) < 60
    bar = FiveBar()
    pose = bar.sample_workspace(50, torch.Generator().manual_seed(0))
    joints = bar.solve_inverse(pose)
    # Elbows outward: the left one left of its crank's foot, the right one right of its own.
    assert (torch.cos(joints[:, 0]) < 0).all() and (torch.cos(joints[:, 1]) > 0).all()
    assert bar.jacobian(joints).shape == (50, 3, 2)
    far = torch.tensor([[0.0, 2.0]], dtype=torch.float64)
    assert not bar.reachable(far).any()
    assert torch.isnan(bar.solve_inverse(far)).all()


def test_an_angle_without_a_meaning_is_refused():
    class Turning(FiveBar):
        def __init__(self):
            super().__init__()
            self.pose = (self.pose[0], type(self.pose[1])("phi", "rad"))

    with pytest.raises(InputError, match="phi"):
        Turning().frame(torch.zeros(2, dtype=torch.float64))
