"""The command against an independent solver, and what holds wherever the joints stand."""

from __future__ import annotations

import copy
import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings, strategies as st
from scipy.optimize import root
from stand_ins import Sigmoids, arm_compensator, tripod_compensator, tripod_joints
from torch import Tensor

from ccnn_torch.compensation import Compensator, fit_compensator
from ccnn_torch.compensation.fit import Steepness, iterations_needed
from ccnn_torch.coordinates import Coordinate
from ccnn_torch.errors import InputError, MethodFailedError
from ccnn_torch.learners.constant import ConstantNetwork
from ccnn_torch.training import Scaling

NAN, INF = math.nan, math.inf
# hypothesis takes no fixtures.
ARM = arm_compensator()
JOINTS = [Coordinate(f"q{i}", "m") for i in (1, 2, 3)]


def around(compensator: Compensator, count: int, reach: float, seed: int = 0) -> Tensor:
    """Inputs up to `reach` half ranges from the domain's centre."""
    domain = compensator.domain
    draw = torch.rand(count, len(domain.centre), generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return domain.centre + domain.half_range * reach * (2 * draw - 1)


@pytest.mark.parametrize("reach", [0.5, 1.5, 30.0])
def test_round_trip_is_exact_inside_in_the_transition_and_far_outside(tripod: Compensator, reach: float) -> None:
    joints = around(tripod, 2000, reach)
    command, deviation, inside = tripod(joints)
    tolerance = 1e-12 * tripod.limit + 2 * torch.from_numpy(np.spacing(joints.abs().numpy()))
    assert bool(((tripod.back(command) - joints).abs() <= tolerance).all())
    assert bool(((tripod.deviation(command) - deviation).abs() <= tolerance).all())
    assert torch.equal(joints - deviation, command)
    assert bool(inside.any()) == (reach < 30)


def test_round_trip_of_the_arm_with_covariates(arm: Compensator) -> None:
    inputs = around(arm, 2000, 1.6)
    joints, covariates = inputs[:, :2], inputs[:, 2:]
    command, _, _ = arm(joints, covariates)
    error = (arm.back(command, covariates) - joints).abs()
    assert bool((error <= 1e-12 * arm.limit + 2 * torch.from_numpy(np.spacing(joints.abs().numpy()))).all())


def test_command_is_the_root_that_scipy_finds(tripod: Compensator) -> None:
    for joints in around(tripod, 20, 1.4, seed=1):
        command, _, _ = tripod(joints)

        def residual(q: np.ndarray, joints: Tensor = joints) -> np.ndarray:
            return ((torch.from_numpy(q) + tripod.deviation(torch.from_numpy(q)) - joints) / tripod.limit).numpy()

        found = root(residual, joints.numpy(), tol=1e-14)
        # scipy starts at the ideal joints and differentiates numerically: 1e-9 of the limit is what it can do.
        np.testing.assert_allclose((command.numpy() - found.x) / tripod.limit.numpy(), 0, atol=1e-9)


def test_deviation_inside_is_the_network_alone(tripod: Compensator) -> None:
    joints = tripod_joints()
    command, _, inside = tripod(joints + tripod.deviation(joints))
    assert bool(inside.all())
    expected = tripod.scaling.restore(tripod.network(tripod.scaling.features(command)))
    torch.testing.assert_close(tripod.deviation(command), expected, rtol=0, atol=0)


def test_far_outside_the_correction_is_the_mean_training_deviation(tripod: Compensator) -> None:
    joints = tripod_joints()
    mean = tripod.scaling.restore(tripod.network(tripod.scaling.features(joints))).mean(0)
    torch.testing.assert_close(tripod.deviation(joints + 10.0), mean.expand(len(joints), 3), rtol=1e-14, atol=0)
    assert not bool(tripod(joints + 10.0)[2].any())


wild = st.floats(allow_nan=True, allow_infinity=True, width=64)


@given(st.lists(wild, min_size=4, max_size=4))
@settings(max_examples=100, deadline=None)
def test_no_input_gives_nan_or_more_than_the_limit(values: list[float]) -> None:
    inputs = torch.tensor(values, dtype=torch.float64)
    solution = ARM.solve(inputs[:2], inputs[2:])
    assert bool((solution.deviation.abs() <= ARM.limit).all())
    assert all(bool(torch.isfinite(value).all()) for value in solution)
    assert bool((solution.deviation_sd > 0).all())
    moved = solution.command + solution.deviation
    finite = inputs.abs() < ARM.domain.huge
    clean = torch.where(finite[:2], inputs[:2], moved)
    torch.testing.assert_close(moved, clean, rtol=1e-15, atol=1e-15)
    if bool(finite.all()):
        sd = ARM.sd(solution.command, inputs[2:])
        torch.testing.assert_close(sd, solution.deviation_sd, rtol=1e-9, atol=0)
    else:
        assert int(solution.status) == int(solution.ideal_status) == 2
        assert bool((solution.deviation == 0).all()) and torch.equal(solution.deviation_sd, ARM.fallback_sd)
        assert not bool(solution.inside_domain) and not bool(solution.ideal_inside_domain)


def test_the_standard_deviation_inside_outside_and_between(tripod: Compensator) -> None:
    joints = around(tripod, 500, 2.0)
    features = tripod.scaling.features(tripod.domain.cage(joints))
    network = tripod.network
    assert isinstance(network, Sigmoids)
    inside = 2e-4 * torch.tensor([1.0, 0.5, 2.0], dtype=torch.float64) * network.variance(features).sqrt()
    weight = tripod.run(joints)["back_guard"]
    expected = (weight**2 * inside**2 + (1 - weight) ** 2 * tripod.safe_sd**2).sqrt()
    found = tripod.sd(joints)
    torch.testing.assert_close(found, expected, rtol=1e-12, atol=0)
    assert bool((weight == 1).any() and (weight == 0).any() and ((weight > 0) & (weight < 1)).any())
    far = torch.tensor([[50.0, 1, 1], [NAN, 1, 1], [1, INF, 1], [1e300, -1e308, 0]], dtype=torch.float64)
    # What is not finite is commanded as it is: the mean deviation is then an error, too.
    beyond = torch.cat([tripod.safe_sd[None], torch.hypot(tripod.safe, tripod.safe_sd).expand(3, 3)])
    assert torch.equal(tripod.sd(far), beyond)
    assert torch.equal(tripod.solve(far).deviation_sd, beyond)
    deviations = tripod.deviation(tripod_joints())
    torch.testing.assert_close(tripod.safe_sd, (deviations - tripod.safe).square().mean(0).sqrt())


def test_a_network_without_a_variance_has_that_of_its_training_deviations() -> None:
    class Plain(torch.nn.Module):
        def forward(self, features: Tensor) -> Tensor:
            return 0.1 * features

    joints = tripod_joints()
    scaling = _scaling(joints)
    scaling.deviation.copy_(torch.tensor([1e-4, 2e-4, 3e-4]))
    deviations = scaling.restore(0.1 * scaling.features(joints))
    scale = torch.tensor([1.0, 2.0, 0.5], dtype=torch.float64)
    compensator = fit_compensator(Plain(), scaling, joints, deviations, JOINTS, sd_scale=scale)
    torch.testing.assert_close(compensator.sd(joints), (scaling.deviation * scale).expand_as(joints))
    for wrong in (scale[:2], -scale, scale * NAN):
        with pytest.raises(InputError, match="sd_scale must be one finite number above 0 for each of the 3 joints"):
            fit_compensator(Plain(), scaling, joints, deviations, JOINTS, sd_scale=wrong)


def test_strange_joints_go_to_the_domain_without_a_correction(tripod: Compensator) -> None:
    domain = tripod.domain
    joints = torch.tensor([[NAN, 1.0, 1.0], [INF, 1.0, 1.0], [1.0, -INF, 1.0]], dtype=torch.float64)
    found = tripod.solve(joints)
    assert not bool(found.inside_domain.any()) and found.status.tolist() == found.ideal_status.tolist() == [2, 2, 2]
    assert bool((found.deviation == 0).all()) and torch.equal(found.ideal, found.command)
    expected = torch.stack([domain.centre[0], domain.high[0], domain.low[1]])
    torch.testing.assert_close(found.command[[0, 1, 2], [0, 0, 1]], expected)


def test_the_transition_has_no_kink(tripod: Compensator) -> None:
    """Along lines through the edge: the first differences of δ change by O(step), as those of a C¹ function do."""
    domain = tripod.domain
    biggest = []
    for count in (2000, 4000):
        share = torch.linspace(0.5, 2.5, count, dtype=torch.float64).unsqueeze(-1)
        line = domain.centre + share * domain.half_range * torch.tensor([1.0, -0.4, 0.7], dtype=torch.float64)
        slope = tripod.deviation(line).diff(dim=0) / (share[1] - share[0])
        assert bool((slope.abs().amax(0) > 0).all())
        biggest.append(float(slope.diff(dim=0).abs().max()))
    assert biggest[1] < 0.6 * biggest[0]


def test_lipschitz_bounds_every_slope(tripod: Compensator, arm: Compensator) -> None:
    for compensator in (tripod, arm):
        n = len(compensator.joints)
        inputs = around(compensator, 20000, 2.0, seed=9)
        for j in range(n):
            moved = inputs.clone()
            moved[:, j] += compensator.domain.half_range[j] * 1e-5
            args = (inputs[:, n:],) if compensator.covariates else ()
            change = compensator.deviation(moved[:, :n], *args) - compensator.deviation(inputs[:, :n], *args)
            slope = change.abs() / (compensator.domain.half_range[j] * 1e-5) * compensator.limit[j] / compensator.limit
            assert float(slope.max()) <= compensator.lipschitz


@pytest.mark.parametrize(("lipschitz", "expected"), [(1e-4, 3), (0.01, 6), (0.2, 18), (1e-13, 1), (0.0, 1)])
def test_iterations_are_the_smallest_power_below_the_tolerance(lipschitz: float, expected: int) -> None:
    assert iterations_needed(Steepness(lipschitz, 1.0)) == expected


def test_iterations_count_the_largest_deviation() -> None:
    assert iterations_needed(Steepness(0.01, 0.99e-2)) == 5
    assert iterations_needed(Steepness(0.01, 0.0)) == 1


def test_a_steep_deviation_is_solved_for_in_few_steps() -> None:
    """By Broyden's method, where the fixed point takes 40; both come to the same."""
    steep = tripod_compensator(gain=2.0, size=2e-2)
    assert steep.share == 1 and 0.2 < steep.lipschitz <= 0.5 and steep.secant and steep.iterations < 12
    joints = tripod_joints()
    command, deviation, _ = steep(joints)
    slow = copy.copy(steep)
    slow.secant, slow.iterations = False, iterations_needed(Steepness(steep.lipschitz, 1.0))
    assert slow.iterations > 30
    torch.testing.assert_close(command, slow(joints)[0], rtol=0, atol=1e-12 * float(steep.limit.min()))
    torch.testing.assert_close(command + steep.deviation(command), joints, rtol=0, atol=1e-12)
    assert float(deviation.abs().max()) > 1e-3


def test_a_steeper_one_is_damped_about_its_mean() -> None:
    """Until a command can be solved for; the standard deviation of what is measured stays."""
    gentle, damped = tripod_compensator(gain=2.0, size=2e-2), tripod_compensator(gain=4.0, size=3e-2)
    assert gentle.share == 1 and 0.1 < damped.share < 1 and damped.lipschitz <= 0.5
    joints = tripod_joints()
    command, _, _ = damped(joints)
    torch.testing.assert_close(command + damped.deviation(command), joints, rtol=0, atol=1e-12)


def test_where_little_would_be_left_it_is_refused_with_a_sentence() -> None:
    with pytest.raises(MethodFailedError, match=r"above 0\.5 the command cannot be solved"):
        tripod_compensator(gain=40.0, size=5e-1)


def test_a_network_that_gives_no_numbers_is_refused() -> None:
    joints = tripod_joints()
    broken = ConstantNetwork(torch.full((3,), NAN, dtype=torch.float64))
    with pytest.raises(MethodFailedError, match="not finite"):
        fit_compensator(broken, _scaling(joints), joints, torch.ones_like(joints), JOINTS)


def test_a_constant_deviation_takes_one_step() -> None:
    joints = tripod_joints()
    value = torch.tensor([1e-4, -2e-4, 0.0], dtype=torch.float64)
    scaling = _scaling(joints)
    compensator = fit_compensator(ConstantNetwork(value), scaling, joints, value.expand_as(joints), JOINTS)
    assert compensator.iterations == 1
    command, deviation, _ = compensator(joints)
    torch.testing.assert_close(deviation, value.expand_as(joints), rtol=1e-15, atol=0)
    torch.testing.assert_close(command, joints - value, rtol=1e-15, atol=0)


def test_a_joint_that_never_moved_is_trusted_at_its_place_only() -> None:
    joints = tripod_joints()
    joints[:, 1] = 0.8
    network = Sigmoids([3, 4, 3], seed=1)
    deviations = 1e-4 * network(_scaling(joints).features(joints)).detach()
    scaling = _scaling(joints)
    scaling.deviation.fill_(1e-4)
    compensator = fit_compensator(network, scaling, joints, deviations, JOINTS)
    assert bool(compensator(joints)[2].all())
    moved = joints.clone()
    moved[:, 1] = 1.0
    assert not bool(compensator(moved)[2].any())


def test_the_limit_given_holds_and_the_safe_correction_obeys_it() -> None:
    limit = torch.tensor([2e-5, 1e-3, 3e-5], dtype=torch.float64)
    compensator = tripod_compensator(limit=limit)
    deviation = compensator.deviation(around(compensator, 3000, 3.0))
    assert bool((deviation.abs() <= limit).all())
    assert float(deviation[:, 0].abs().max()) == 2e-5


def test_the_learner_may_train_on_without_changing_the_compensator() -> None:
    joints, network, scaling = tripod_joints(), Sigmoids([3, 4, 3], seed=1), _scaling(tripod_joints())
    scaling.deviation.fill_(1e-4)
    compensator = fit_compensator(network, scaling, joints, torch.full_like(joints, 1e-4), JOINTS)
    before = compensator.deviation(joints)
    with torch.no_grad():
        network.weights[0].add_(1.0)
    torch.testing.assert_close(compensator.deviation(joints), before, rtol=0, atol=0)


@pytest.mark.parametrize("shape", [(), (2,), (2, 3)])
def test_leading_dimensions(arm: Compensator, shape: tuple[int, ...]) -> None:
    inputs = around(arm, math.prod(shape), 1.0)
    joints, covariates = inputs[:, :2].reshape(*shape, 2), inputs[:, 2:].reshape(*shape, 2)
    command, deviation, inside = arm(joints, covariates)
    assert command.shape == deviation.shape == (*shape, 2) and inside.shape == shape
    flat = arm(inputs[:, :2], inputs[:, 2:])[0]
    torch.testing.assert_close(command.reshape(-1, 2), flat, rtol=1e-14, atol=1e-14)
    assert command.dtype == torch.float64


def test_missing_or_wrong_inputs_are_named(arm: Compensator, tripod: Compensator) -> None:
    joints = torch.zeros(4, 2, dtype=torch.float64)
    with pytest.raises(InputError, match=r"time\[s\], temperature\[K\]"):
        arm(joints)
    with pytest.raises(InputError, match="got 1 columns"):
        arm.back(joints, joints[:, :1])
    with pytest.raises(InputError, match=r"3 joints q1\[m\], q2\[m\], q3\[m\]; got 2"):
        tripod.deviation(joints)


@pytest.mark.parametrize(
    ("keys", "sentence"),
    [
        ({"margin": -0.1}, "margin"),
        ({"transition": 0.0}, "transition"),
        ({"limit": torch.tensor([1.0, -1.0, 1.0])}, "limit must be"),
    ],
)
def test_settings_out_of_range_are_refused(keys: dict[str, object], sentence: str) -> None:
    with pytest.raises(InputError, match=sentence):
        tripod_compensator(**keys)


def test_shapes_that_do_not_fit_are_refused() -> None:
    joints = tripod_joints()
    with pytest.raises(InputError, match="do not fit 3 joints"):
        fit_compensator(Sigmoids([3, 4, 3]), _scaling(joints), joints, joints[:, :2], JOINTS)
    joints[3, 1] = NAN
    with pytest.raises(InputError, match="must be finite"):
        fit_compensator(Sigmoids([3, 4, 3]), _scaling(joints), joints, torch.ones_like(joints), JOINTS)


def _scaling(joints: Tensor) -> Scaling:
    blank = torch.ones(1, len(joints), dtype=torch.float64)
    return Scaling.fit(
        joints[None], torch.zeros_like(joints)[None], blank, torch.zeros(joints.shape[-1], dtype=torch.bool)
    ).repeat(0)
