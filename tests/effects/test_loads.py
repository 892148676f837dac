"""A load and the weight that a machine's file tells, on one spring."""

from __future__ import annotations

import pytest
import torch

from ccnn_torch.effects import Situation, default_gravity, make_effect
from ccnn_torch.errors import InputError
from ccnn_torch.mechanisms import load_mechanism, mechanism_from_description
from ccnn_torch.units import STANDARD_GRAVITY


def columns(load: float, **keys: object) -> torch.Tensor:
    """Of the compliance of a delta under a load that hangs on it [kg]."""
    machine = load_mechanism("delta", **keys)
    joints = machine.sample_joints(20, torch.Generator().manual_seed(0))
    weight = torch.full((20,), -STANDARD_GRAVITY * load, dtype=torch.float64)
    situation = Situation(machine, joints, {"load_z": weight}, default_gravity(machine))
    return make_effect("compliance").basis(situation, torch.zeros(0))[..., : 3 * len(machine.joints)]


def test_a_platform_weighs_as_a_load_does() -> None:
    torch.testing.assert_close(columns(1.5, platform_mass="2.5 kg"), columns(4.0))
    assert not torch.allclose(columns(1.5), columns(4.0))
    framed = load_mechanism("framed", mechanism="delta", keys={"platform_mass": 2.5})
    assert mechanism_from_description(framed.describe()).platform_mass == 2.5


@pytest.mark.parametrize(
    ("spec", "told", "sentence"),
    [
        ("delta", "-1 kg", "platform_mass: -1 kg is no mass; write it as 2.8 kg"),
        ("delta", "2 mm", "must be in kg"),
        ("experiments/data/ur10.yaml", "2 kg", "is an arm; write the masses of its links"),
    ],
)
def test_what_is_no_mass_of_a_platform_is_refused(spec: str, told: str, sentence: str) -> None:
    with pytest.raises(InputError, match=sentence):
        load_mechanism(spec, platform_mass=told)
