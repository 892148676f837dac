"""What follows a joint as no law says is held beyond the travel of the rows that it was fitted to."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import Tensor

from ccnn_torch.compensation import PhysicalEffects, expand_effects
from ccnn_torch.effects import Acting, Situation, default_gravity, make_effect
from ccnn_torch.mechanisms import load_mechanism

ARM = load_mechanism(str(Path(__file__).with_name("arm.yaml")))
N = len(ARM.joints)


def rows(low: float, high: float) -> Situation:
    """Rows with each joint between two angles [rad]."""
    share = torch.rand(50, N, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    share[0], share[1] = 0.0, 1.0
    return Situation(ARM, low + (high - low) * share, {}, default_gravity(ARM))


def waves(frequency: float) -> Acting:
    effect = make_effect("transmission")
    sizes = torch.tensor([c.scale for c in effect.coefficients(rows(0, 1))], dtype=torch.float64)
    return Acting(effect, torch.full((N,), frequency, dtype=torch.float64), sizes)


def at(angle: float, situation: Situation) -> Situation:
    return replace(situation, joints=torch.full((1, N), angle, dtype=torch.float64))


@pytest.mark.parametrize(("frequency", "is_held"), [(1.0, True), (4.0, True), (6.0, False), (40.0, False)])
def test_a_wave_of_few_periods_stays_beyond_the_travel_of_the_rows(frequency: float, is_held: bool) -> None:
    seen = rows(-1.0, 1.0)
    fitted, one = seen.fitted_to(torch.ones(50, dtype=torch.bool)), waves(frequency)
    torch.testing.assert_close(one.change(fitted), one.change(seen), rtol=0, atol=0)
    for inside, beyond in ((1.0, 1.4), (-1.0, -2.0)):
        there = one.change(at(inside if is_held else beyond, seen))
        torch.testing.assert_close(one.change(at(beyond, fitted)), there, rtol=0, atol=0)
    # One and a half periods within 2 rad.
    assert is_held == (frequency * 2 < 1.5 * 2 * math.pi)


def test_only_rows_that_were_fitted_to_count() -> None:
    seen = rows(-1.0, 1.0)
    few = (seen.joints < 0.2).all(-1)
    travel = seen.fitted_to(few).travel
    assert travel is not None
    assert torch.equal(travel, torch.stack([seen.joints[few].amin(0), seen.joints[few].amax(0)]))


def test_motors_that_turn_with_other_joints_are_held_as_their_joints_are() -> None:
    table = torch.eye(N, dtype=torch.float64)
    table[-1, -2] = 0.5
    arm = load_mechanism(str(Path(__file__).with_name("arm.yaml")), motors={f"q{N}": {f"q{N - 1}": 0.5}})
    seen = replace(rows(-1.0, 1.0), mechanism=arm)
    held = seen.fitted_to(torch.ones(50, dtype=torch.bool))
    held = replace(held, joints=torch.full((1, N), 3.0, dtype=torch.float64))
    turns, far = held.held_turns() or (torch.zeros(0), torch.zeros(0))
    torch.testing.assert_close(turns[0], table.sum(-1))
    torch.testing.assert_close(far, 2 * table.sum(-1))


def test_a_model_file_holds_it_too() -> None:
    fitted = rows(-1.0, 1.0).fitted_to(torch.ones(50, dtype=torch.bool))
    module = expand_effects(fitted, [waves(1.0)], [], 0.1)
    again = PhysicalEffects.from_description(json.loads(json.dumps(module.describe())))
    again.load_state_dict(module.state_dict())

    def moved(effects: PhysicalEffects, angle: float) -> Tensor:
        found = effects.changes(torch.full((1, N), angle, dtype=torch.float64), torch.zeros(1, 0))[0]
        assert found is not None
        return found

    for effects in (module, again):
        torch.testing.assert_close(moved(effects, 2.5), moved(effects, 1.0), rtol=0, atol=0)
    # A file of before has no travel.
    old = module.describe()
    del old["travel"]
    free = PhysicalEffects.from_description(old)
    free.load_state_dict(module.state_dict())
    assert not torch.equal(moved(free, 2.5), moved(free, 1.0))
