"""Names and patterns of free, fixed and tied parameters, and of priors."""

from __future__ import annotations

import math

import pytest
import torch

from ccnn_torch.coordinates import Parameter
from ccnn_torch.errors import InputError
from ccnn_torch.identification import ParameterChoice, select_parameters

GEOMETRY = [
    Parameter("l1", "m", 0.7, 1),
    Parameter("A1x", "m", -0.5, 1),
    Parameter("l2", "m", 0.7, 2),
    Parameter("A2x", "m", 0.5, 2),
    Parameter("gain", "1", 1.0),
]


def names(choice: ParameterChoice) -> list[str]:
    return [p.name for p in select_parameters(GEOMETRY, choice).parameters]


@pytest.mark.parametrize(
    ("choice", "expected"),
    [
        (ParameterChoice(), ["l1", "A1x", "l2", "A2x", "gain"]),
        (ParameterChoice(free=["A*"]), ["A1x", "A2x"]),
        (ParameterChoice(free=["leg1.*", "gain"]), ["l1", "A1x", "gain"]),
        (ParameterChoice(free=["leg2.l*"]), ["l2"]),
        (ParameterChoice(fixed=["l?"]), ["A1x", "A2x", "gain"]),
        (ParameterChoice(free=["l*"], fixed=["l1"]), ["l2"]),
        (ParameterChoice(tied=[["l1", "l2"]]), ["l1", "A1x", "A2x", "gain"]),
        (ParameterChoice(tied=["l*"]), ["l1", "A1x", "A2x", "gain"]),
    ],
)
def test_patterns_choose(choice: ParameterChoice, expected: list[str]) -> None:
    assert names(choice) == expected


def test_values_go_back_to_the_whole_geometry() -> None:
    choice = ParameterChoice(free=["l*", "A2x"], tied=["l*"], prior={"*": 0.5, "A*": 0.25})
    start = torch.tensor([[0.7, -0.5, 0.7, 0.5, 1.0], [0.8, -0.4, 0.8, 0.6, 1.1]], dtype=torch.float64)
    chosen = select_parameters(GEOMETRY, choice, start)
    assert chosen.groups == (("l1", "l2"), ("A2x",))
    assert [p.leg for p in chosen.parameters] == [None, 2]
    assert chosen.prior_sd.tolist() == [0.5, 0.25]
    torch.testing.assert_close(chosen.full(chosen.start), start, rtol=0, atol=0)
    moved = chosen.full(torch.tensor([[1.0, 2.0], [3.0, 4.0]], dtype=torch.float64))
    assert moved.tolist() == [[1.0, -0.5, 1.0, 2.0, 1.0], [3.0, -0.4, 3.0, 4.0, 1.1]]


def test_no_prior_is_an_infinite_one() -> None:
    assert set(select_parameters(GEOMETRY).prior_sd.tolist()) == {math.inf}


@pytest.mark.parametrize(
    ("choice", "said"),
    [
        (ParameterChoice(free=["A1y"]), "parameters.free: 'A1y' fits no parameter; did you mean 'A1x'"),
        (ParameterChoice(fixed=["leg3.*"]), "parameters.fixed: 'leg3.*' fits no parameter"),
        (ParameterChoice(free=["leg1.A2*"]), "did you mean"),
        (ParameterChoice(fixed=["*"]), "nothing is left free"),
        (ParameterChoice(tied=[["A1x", "A2x"]]), "A2x and A1x start at different values"),
        (ParameterChoice(tied=["l*", ["l1", "l2"]]), "'l1' is in two groups"),
        (ParameterChoice(fixed=["l2"], tied=["l*"]), "'l2' is fixed but tied to l1"),
        (ParameterChoice(prior={"gain": 0.0}), "parameters.prior: 'gain' has the standard deviation 0.0"),
        (ParameterChoice(prior={"gian": 1.0}), "did you mean 'gain'"),
    ],
)
def test_what_cannot_be_meant_is_refused(choice: ParameterChoice, said: str) -> None:
    with pytest.raises(InputError) as refusal:
        names(choice)
    assert said in str(refusal.value)
