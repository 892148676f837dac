"""Numbers of a model that do the very same are told as one, and the others not as corrections."""

import pytest
import torch

from ccnn_torch.diagnosis.verdict.blocks import fewest, together


def test_an_error_is_in_one_of_the_numbers_that_do_the_same():
    generator = torch.Generator().manual_seed(0)
    own = torch.randn(200, 4, generator=generator, dtype=torch.float64)
    # Three numbers that do the same, one that does nothing, and one that two others do together.
    columns = torch.stack([own[:, 0]] * 3 + [own[:, 1], 1e-9 * own[:, 2], own[:, 0] + own[:, 3], own[:, 3]], -1)
    spread = torch.tensor([3.0, 3.0, 3.0, 0.0, 2.0, 0.0, 0.0], dtype=torch.float64)
    noise = 0.01
    gram, prior = columns.mT @ columns, 5.0**2 * torch.eye(7, dtype=torch.float64)
    values, deviation = fewest(gram, spread, torch.linalg.inv(gram / noise + torch.linalg.inv(prior)), noise)
    assert values.tolist() == pytest.approx([9, 0, 0, 0, 0, 0, 0])
    assert float(deviation[0]) == pytest.approx(float((noise / own[:, 0].square().sum()).sqrt()), rel=1e-3)
    assert float(deviation[1:3].min()) > 1


def test_independent_numbers_stay_as_they_are():
    generator = torch.Generator().manual_seed(1)
    columns = torch.randn(200, 5, generator=generator, dtype=torch.float64)
    mean = torch.tensor([1.0, -2.0, 0.5, 3.0, -0.1], dtype=torch.float64)
    values, _ = fewest(columns.mT @ columns, mean, torch.eye(5, dtype=torch.float64), 1e-6)
    assert values.tolist() == pytest.approx(mean.tolist())


def test_numbers_that_cannot_be_told_apart_are_left_as_fitted():
    columns = 1e-3 * torch.eye(3, dtype=torch.float64)
    mean = torch.full((3,), 900.0, dtype=torch.float64)
    values, errors = fewest(columns.mT @ columns, mean, torch.eye(3, dtype=torch.float64), 0.5)
    assert values.equal(mean) and errors.tolist() == [1.0] * 3


def test_two_that_differ_by_little_do_not_stand_for_a_third_one():
    """Ten metres of one less ten of the other would do what a millimetre of the third does."""
    generator = torch.Generator().manual_seed(2)
    own = torch.randn(200, 3, generator=generator, dtype=torch.float64)
    columns = torch.stack([own[:, 0], own[:, 0] + 1e-4 * own[:, 1], own[:, 1], own[:, 2]], -1)
    mean = torch.tensor([1.0, -1.0, 2.0, 1.0], dtype=torch.float64)
    for order in ([0, 1, 2, 3], [2, 0, 1, 3], [1, 3, 0, 2]):
        one = columns[:, order]
        values, _ = fewest(one.mT @ one, mean[order], torch.eye(4, dtype=torch.float64), 1e-9)
        assert float(values.abs().max()) <= 10 * 2.0
        assert float((one @ (values - mean[order])).square().sum()) < 1e-9


def test_numbers_have_to_be_entered_together_until_they_leave_what_is_promised():
    gram = torch.eye(4, dtype=torch.float64)
    mean = torch.tensor([1.0, -4.0, 3.0, 0.1], dtype=torch.float64)
    deviation = torch.full((4,), 0.05, dtype=torch.float64)
    # Entered one after the other the clearest leave squares of 10.01, 1.01, 0.01 and 0 beside those of all of them.
    for left, count in ((100.0, 0), (23.0, 1), (2.3, 2), (1.0, 3), (0.02, 4)):
        assert together(gram, mean, deviation, left) == count
