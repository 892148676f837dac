"""Rows of machines under drawn conditions, and effects of given size on them."""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor

from ccnn_torch.effects import Acting, Effect, Situation, default_gravity, make_effect, signature
from ccnn_torch.effects.covariates import draw_covariates
from ccnn_torch.mechanisms import load_mechanism

ARM = str(Path(__file__).parent / "arm.yaml")


def situation(name: str, rows: int = 9, seed: int = 0, **columns: Tensor) -> Situation:
    mechanism = load_mechanism(name)
    generator = torch.Generator().manual_seed(seed)
    joints = mechanism.sample_joints(20 * rows, generator)
    joints = joints[mechanism.condition_number(joints) < 30][:rows]
    drawn = draw_covariates(mechanism, joints, generator)
    return Situation(mechanism, joints, {**drawn, **columns}, default_gravity(mechanism))


def acting(effect: str, rows: Situation, **values: float) -> Acting:
    """An effect with these coefficients (blanks as underscores), all others 0; shapes by name too."""
    made = make_effect(effect)
    coefficients = [values.pop(c.name.replace(" ", "_"), 0.0) for c in made.coefficients(rows)]
    shapes = [values.pop(s.name.replace(" ", "_"), s.grid[0]) for s in made.shapes(rows)]
    assert not values
    return Acting(made, torch.tensor(shapes, dtype=torch.float64), torch.tensor(coefficients, dtype=torch.float64))


def columns(effect: Effect, rows: Situation, shape: Tensor) -> dict[str, Tensor]:
    names = [c.name for c in effect.coefficients(rows)]
    return dict(zip(names, signature(rows, effect, shape).unbind(-1), strict=True))
