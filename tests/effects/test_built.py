"""Effects against machines as built that know nothing of them: own closures, statics, heat and play.

In `ccnn_validation.realistic` drives stiffen, backlash has a soft edge between friction and load, waves have two
harmonics, and heat moves through bodies of three time constants, one of them warmed by the drives' own work. The
share of the residual that an effect leaves at its best bounds what a diagnosis can conclude from it.
"""

from __future__ import annotations

from itertools import product

import pytest
import torch
from ccnn_validation.realistic.machine import RealisticMachine, build_machine
from torch import Tensor

from ccnn_torch.effects import Situation, default_gravity, make_effect, pose_residual, signature

# Share of the root mean square that is left over; with the textbook form alone it is the second figure or more.
LEFT = [
    ("tripod", "transmission", ["transmission"], 1e-3, 0.3),
    ("arm", "transmission", ["transmission"], 1e-3, 0.3),
    ("tripod", "backlash", ["backlash"], 0.3, 0.15),
    ("arm", "backlash", ["backlash"], 0.1, 0.3),
    ("tripod", "compliance", ["compliance", "gravity"], 0.045, 0.06),
    ("machine_tool", "compliance", ["compliance", "gravity"], 0.055, 0.15),
    ("arm", "compliance", ["compliance", "gravity"], 0.045, 0.055),
    ("tripod", "thermal", ["thermal"], 0.15, 0.25),
    ("machine_tool", "thermal", ["thermal"], 0.06, 0.4),
    ("arm", "geometry", ["geometry"], 0.25, 0.0),
]


@pytest.mark.parametrize(("machine", "cause", "effects", "most", "textbook"), LEFT)
def test_an_effect_describes_its_cause(
    machine: str, cause: str, effects: list[str], most: float, textbook: float
) -> None:
    built = build_machine(machine, cause, 1.0, 200, 0.0, [0, 1])
    for repeat in (0, 1):
        assert left(built, repeat, effects, secondary=True) <= most
        assert left(built, repeat, effects, secondary=False) >= textbook


def left(built: RealisticMachine, repeat: int, effects: list[str], secondary: bool) -> float:
    """Share of the gap that the least-squares fit leaves, angles over 0.3 m, at the best lag or the true frequency."""
    covariates = {c.name: values[repeat] for c, values in built.columns.items()}
    rows = Situation(built.mechanism, built.joints[repeat], covariates, default_gravity(built.mechanism))
    residual = pose_residual(rows, built.measured[repeat])
    weight = torch.ones(residual.shape[-1], dtype=torch.float64)
    weight[3:] = 0.3
    regular = built.mechanism.condition_number(rows.joints) < 50
    gap = (residual * weight)[regular].flatten()

    def columns(effect: str, shape: list[float]) -> Tensor:
        made = make_effect(effect)
        kept = [k for k, c in enumerate(made.coefficients(rows)) if secondary or not c.secondary]
        found = signature(rows, made, torch.tensor(shape, dtype=torch.float64)) * weight[:, None]
        return found[regular][..., kept].flatten(0, 1)

    shapes: list[list[float]] = [[]]
    if effects == ["transmission"]:
        shapes = [built.built.causes.frequency[repeat][:, 0].tolist()]
    elif len(effects) == 1:
        # The textbook has one value of most shapes, and no search.
        every = make_effect(effects[0]).shapes(rows)
        grids = [s.grid[::2] if secondary or s.usual is None else (s.usual,) for s in every]
        shapes = [list(values) for values in product(*grids)]
    shares = []
    for shape in shapes:
        matrix = torch.cat([columns(effect, shape) for effect in effects], -1)
        matrix = matrix / torch.linalg.vector_norm(matrix, dim=0).clamp_min(1e-30)
        fit = matrix @ torch.linalg.lstsq(matrix, gap, driver="gelsd").solution
        shares.append(float(torch.linalg.vector_norm(gap - fit) / torch.linalg.vector_norm(gap)))
    return min(shares)
