"""Intervals of numbers beside a period or a time constant that had to be looked for."""

from __future__ import annotations

import torch
from diagnosis._machines import reached_with, rows_of

from ccnn_torch.diagnosis import diagnose_rows
from ccnn_torch.effects import Acting, make_effect

_Z95 = 1.96
# Frequencies of the screws of three slides, as shares of their grids.
_SCREWS = ((0.11, 0.27, 0.06), (0.24, 0.08, 0.19))


def _told(places: tuple[float, ...], seed: int) -> tuple[dict[str, dict[str, float]], dict[str, float]]:
    """Numbers told of a tripod with three screws, and the true ones."""
    situation, effect = rows_of("tripod", 120, seed), make_effect("transmission")
    g = torch.Generator().manual_seed(seed)
    shape, true = [], {}
    for one, place in zip(effect.shapes(situation), places, strict=True):
        shape.append(one.grid[0] + place * (one.grid[-1] - one.grid[0]))
        true[one.name] = shape[-1]
    every = effect.coefficients(situation)
    sizes = [2e-4 if c.name.endswith(("sin", "cos")) else 4e-5 if c.name.endswith(" 2") else 0.0 for c in every]
    values = torch.randn(len(every), generator=g, dtype=torch.float64) * torch.tensor(sizes, dtype=torch.float64)
    true |= {c.name: v for c, v in zip(every, values.tolist(), strict=True)}
    cause = Acting(effect, torch.tensor(shape, dtype=torch.float64), values)
    said = diagnose_rows(situation, reached_with(situation, [cause], seed + 1), effects=["transmission", "joint_gain"])
    assert said.verdict["effects"] == ["transmission"]
    return next(e["parameters"] for e in said.effects if e["name"] == "transmission"), true


def test_they_hold_the_true_numbers_as_often_as_they_say() -> None:
    """Periods too: without what is not known of these every second amplitude was outside, and one period in three
    was told as twice as long, since the harmonics of half a frequency make nearly the same wave."""
    inside, count, wider = 0, 0, 0.0
    for seed, places in enumerate(_SCREWS):
        told, true = _told(places, seed)
        for name, block in told.items():
            if true[name]:
                count += 1
                inside += abs(block["value"] - true[name]) < _Z95 * block["sd"]
        for joint in ("q1", "q2", "q3"):
            frequency = told[f"{joint} frequency"]
            assert abs(frequency["value"] / true[f"{joint} frequency"] - 1) < 0.01
            assert 0 < frequency["sd"] < 0.01 * frequency["value"] and frequency["searched"]
            wider = max(wider, told[f"{joint} sin"]["sd"] / told[f"{joint} sin 3"]["sd"])
    assert inside >= 0.8 * count > 20
    # Phase and period go together: what is known of a wave's phase is less than of a harmonic that is not there.
    assert wider > 2
