"""The paper's two case studies: grids, errors, and the figures that follow from the formulas alone."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from ccnn_torch.errors import InputError
from ccnn_torch.pseudoerror import joint_deviations
from ccnn_torch.simulation.case_study import build_case


def test_case_one_has_the_means_that_eq_17_gives() -> None:
    case = build_case("tripod")
    assert case.joints.shape == (125, 3)
    assert torch.allclose(case.learnable.mean(0), torch.tensor([-0.950e-4, 0.919e-4, 1.489e-4]).double(), rtol=2e-3)
    assert torch.equal(case.sigma, torch.full((3,), 1e-5, dtype=torch.float64))
    assert not case.unlearnable.any()
    # Raster order, y slowest, phi fastest; well away from singular poses.
    assert case.pose[0].tolist() == [-0.2, 0.4, -0.3]
    assert case.pose[1].tolist() == pytest.approx([-0.2, 0.4, -0.15])
    assert case.pose[5].tolist() == pytest.approx([-0.2, 0.475, -0.3])
    assert case.mechanism.reachable(case.pose).all()


def test_case_two_has_152_poses_and_two_variants_of_noise() -> None:
    printed, tabulated = build_case("machine_tool"), build_case("machine_tool", "tabulated")
    assert printed.joints.shape == (152, 3)
    assert printed.sigma.tolist() == [2e-5, 5e-4, 2.5e-5]
    assert tabulated.sigma.tolist() == [4e-6, 2.1e-5, 3.6e-6]
    # Table III, column of the training sets: 6.01e-4, 3.00e-4, 4.90e-4.
    assert torch.allclose(printed.learnable.mean(0), torch.tensor([6.0e-4, 3.0e-4, 4.9e-4]).double(), rtol=1e-3)
    assert float(printed.unlearnable[:, 0].abs().max()) <= 1e-5
    assert not printed.unlearnable[:, 1:].any()
    assert np.rad2deg(float(printed.pose[125, 0])) == pytest.approx(-11.0)
    assert printed.mechanism.reachable(printed.pose).all()


@pytest.mark.parametrize("name", ["tripod", "machine_tool"])
def test_the_pseudoerror_of_the_simulated_poses_is_the_error_put_in(name: str) -> None:
    case = build_case(name)
    noise = case.noise([4, 5])
    found = joint_deviations(case.mechanism, case.joints, case.measured(noise))
    expected = case.learnable + case.unlearnable + noise
    # A thousandth of a thousandth of the noise: nothing of what is reported hangs on the solver.
    assert float((found.deviation - expected).abs().max()) < 1e-12
    assert found.usable.all()


def test_noise_belongs_to_the_seed_alone() -> None:
    case = build_case("tripod")
    assert torch.equal(case.noise([7, 8])[1], case.noise([8])[0])
    assert float(case.noise(list(range(50))).std()) == pytest.approx(1e-5, rel=0.02)


def test_shuffled_order_keeps_the_poses_and_breaks_the_path() -> None:
    raster, shuffled = build_case("tripod"), build_case("tripod", order="shuffled")
    assert torch.equal(raster.learnable, shuffled.learnable)
    assert not torch.equal(raster.pose, shuffled.pose)
    assert sorted(map(tuple, raster.pose.tolist())) == sorted(map(tuple, shuffled.pose.tolist()))


@pytest.mark.parametrize("key", [{"name": "tripd"}, {"variant": "print"}, {"order": "random"}])
def test_unknown_words_are_refused_with_those_that_are_known(key: dict[str, str]) -> None:
    with pytest.raises(InputError, match="write one of"):
        build_case(**({"name": "machine_tool"} | key))  # type: ignore[arg-type]
