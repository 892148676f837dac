"""Thermal growth, against closed forms and the equation that a body follows."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from physical_rows import acting, columns, situation
from scipy.integrate import solve_ivp

from ccnn_torch.effects import make_effect, reached
from ccnn_torch.effects.situation import REFERENCE
from ccnn_torch.effects.time import lagged


def test_a_body_follows_its_surroundings_as_the_differential_equation_says() -> None:
    rng = np.random.default_rng(3)
    time = np.sort(rng.uniform(0, 5000, 40))
    value = rng.normal(size=40)
    for lag in (30.0, 700.0, 1e5):

        def rate(t: float, y: np.ndarray, lag: float = lag) -> np.ndarray:
            return (np.interp(t, time, value) - y) / lag

        found = solve_ivp(rate, time[[0, -1]], value[:1], t_eval=time, rtol=1e-9, atol=1e-12, max_step=5.0).y[0]
        shuffled = rng.permutation(40)
        got = lagged(torch.as_tensor(time[shuffled]), torch.as_tensor(value[shuffled]), torch.tensor(lag))
        assert np.abs(got.numpy() - found[shuffled]).max() < 1e-6
    now = lagged(torch.as_tensor(time), torch.as_tensor(value), torch.tensor(0.0, dtype=torch.float64))
    assert np.abs(now.numpy() - value).max() < 1e-8


@pytest.mark.parametrize("name", ["five_bar", "stewart"])
def test_a_machine_that_grows_evenly_is_the_same_machine_larger(name: str) -> None:
    warm = torch.linspace(-8, 9, 9, dtype=torch.float64)
    rows = situation(name, temperature=REFERENCE + warm)
    growth = 1.2e-5
    travels = {f"{j.name}_travel": growth for j in rows.mechanism.joints if j.unit == "m"}
    grown = reached(rows, [acting("thermal", rows, growth=growth, **travels)])
    position = rows.platform[0]
    assert torch.allclose(grown[:, :3], position * (1 + growth * warm[:, None]), atol=1e-12, rtol=0)
    turned = reached(rows, [])[:, 3:]
    assert torch.allclose(grown[:, 3:], turned, atol=1e-12, rtol=0)
    # The members together are the whole.
    effect = make_effect("thermal")
    parts = columns(effect, rows, torch.tensor([500.0, 4000.0], dtype=torch.float64))
    legs = [v for k, v in parts.items() if k.startswith("leg ") and not k.endswith(("warm-up", "late"))]
    assert torch.allclose(sum(legs[1:], legs[0]), parts["growth"])


def test_the_second_lag_is_of_what_is_late_and_of_no_plate() -> None:
    rows = situation("stewart", temperature=torch.full((9,), REFERENCE, dtype=torch.float64))
    rows = replace(rows, covariates=dict(rows.covariates) | {"temperature_plate": rows.covariates["temperature"]})
    effect = make_effect("thermal")
    names = [c.name for c in effect.coefficients(rows)]
    first, second = (shape.columns for shape in effect.shapes(rows))
    legs = [f"{joint.name} {what} late" for what in ("travel", "mount") for joint in rows.mechanism.joints]
    assert [names[k] for k in second] == ["late", *(f"leg {k} late" for k in range(1, 7)), *legs]
    assert sorted((*first, *second)) == [*range(len(names))] and names.index("growth plate") in first


def test_lengths_grow_with_each_further_thermometer_by_what_it_shows_beyond_the_first() -> None:
    rows = situation("tripod")
    hotter = replace(rows, covariates={**rows.covariates, "temperature_drives": rows.covariates["temperature"] + 5})
    by = columns(make_effect("thermal"), hotter, torch.zeros(2, dtype=torch.float64))
    assert torch.allclose(by["growth drives"], 5 * by["reference"])


@pytest.mark.parametrize(("name", "moved"), [("stewart", True), ("five_bar", False)])
def test_in_time_alone_lengths_grow_and_no_turning_joint_moves_by_itself(name: str, moved: bool) -> None:
    rows, effect = situation(name), make_effect("thermal")
    time = rows.covariates["time"]
    alone = replace(rows, covariates={"time": time})
    lags = torch.tensor([3000.0, 9000.0], dtype=torch.float64)
    grown = columns(effect, alone, lags)
    assert [*grown] == [c.name for c in effect.coefficients(alone)] and not effect.missing(rows.mechanism, ["time"])
    assert any(k.endswith("mount") for k in grown) is moved and not any(k.endswith(("bend", "warm-up")) for k in grown)
    # As if the surroundings had become 10 K warmer just after the first row.
    step = replace(rows, covariates={"time": time, "temperature": REFERENCE + 10.0 * (time > time[0])})
    told = columns(effect, step, lags)
    assert all(torch.allclose(grown[k], told[k]) for k in grown) and float(grown["growth"].abs().max()) > 0
