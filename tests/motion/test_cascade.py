"""A cascade by its data sheet against a loop of our own in small steps, and what a diagnosis finds of its errors."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from ccnn_torch.errors import InputError
from ccnn_torch.motion.axis import Drive, simulate_axes
from ccnn_torch.motion.engine import diagnose_motion
from ccnn_torch.motion.feed_forward import corrected_command
from ccnn_torch.motion.identified import load_identified, write_identified
from ccnn_torch.motion.known import shares_of
from ccnn_torch.motion.log import load_logs
from ccnn_torch.motion.nominal import Nominal
from ccnn_torch.motion.setting import nominal_of

Array = NDArray[np.float64]
KEYS = {"position_gain": 60.0, "speed_gain": 5e4, "integral_time": 8e-3, "forward": 0.9, "inertia": 180.0}
SHEET = KEYS | {"viscous": 500.0, "coulomb": 40.0}
LEAD, STEP = 0.01, 1e-3
TIME = np.arange(5001) * STEP


def table(asked: Array, forward: float, lag: float, dry: float, wave: float) -> Array:
    """Where the table of a cascade goes, in steps of 50 µs; `wave` [m] returns with each turn of the screw."""
    parts, at, speed, total, fed, found = 20, asked[0], 0.0, 0.0, 0.0, asked.copy()
    h = STEP / parts
    for i in range(1, len(asked)):
        rate = (asked[i] - asked[i - 1]) / STEP
        for k in range(1, parts + 1):
            wanted = asked[i - 1] + k * h * rate
            fed += h / (h + lag) * (rate - fed)
            gain = KEYS["speed_gain"] * (1 + h / 8e-3)
            push = KEYS["inertia"] / h * speed + gain * (60 * (wanted - at) + forward * fed) + total
            speed = (push - np.clip(push, -dry, dry)) / (KEYS["inertia"] / h + 500.0 + gain * (1 + 60 * h))
            total += KEYS["speed_gain"] / 8e-3 * h * (60 * (wanted - at - h * speed) + forward * fed - speed)
            at += h * speed
        found[i] = at + wave * np.sin(2 * np.pi / LEAD * at)
    return found


def course(seed: int) -> Array:
    """Sums of sines that begin at rest [m]."""
    rng = np.random.default_rng(seed)
    rates, sizes = np.array([0.4, 1.1, 2.6]) * rng.uniform(0.9, 1.1, 3), np.array([0.05, 0.012, 0.003])
    up = np.clip(TIME / 0.6, 0, 1)
    return np.asarray(up**3 * (10 - 15 * up + 6 * up**2) * (np.sin(np.outer(TIME, 2 * np.pi * rates)) @ sizes))


def log(path: str, asked: Array, went: Array) -> str:
    np.savetxt(path, np.c_[TIME, asked, went], delimiter=",", header="time[s],command1[m],q1[m]", comments="")
    return path


def servo() -> Nominal:
    return nominal_of("servo", SHEET, ["m"])


@pytest.mark.parametrize("every", [1, 8])
def test_a_cascade_is_what_its_data_sheet_says(every: int) -> None:
    asked = course(0)
    went = table(asked, 0.9, 0.0, 40.0, 3e-6)
    time, command = (torch.from_numpy(v[::every].copy())[None] for v in (TIME, asked))
    own = {**servo().axes[0], "lead_sin": 3e-6, "lead_order": 2 * np.pi / LEAD}
    given = {name: torch.tensor([[value]], dtype=torch.float64) for name, value in own.items()}
    bent = torch.tensor([1 - every**-2.0], dtype=torch.float64)
    drive = Drive(time, command, torch.zeros(1, 2, dtype=torch.float64), bent=bent)
    for fast in (True, False):
        error = simulate_axes(drive, given, fast)[0, 0].numpy() - went[::every]
        assert np.abs(asked - went).max() > 3e-4 and np.sqrt((error**2).mean()) < 1e-6
        # Without the integral of the speed's error, and without the wave, it goes elsewhere.
        for name, least in (("cascade", 2e-5), ("lead_sin", 1.5e-6), ("forward", 5e-5)):
            other = given | {name: torch.zeros(1, 1, dtype=torch.float64)}
            left = simulate_axes(drive, other, fast)[0, 0].numpy() - went[::every]
            assert np.sqrt((left**2).mean()) > least, name


def test_another_feedforward_and_a_screw_that_is_not_even_are_found_and_corrected(tmp_path) -> None:
    true = (0.85, 1.2e-3, 120.0, 5e-6)
    rng = np.random.default_rng(1)
    files = []
    for seed in (1, 2):
        asked = course(seed)
        went = table(asked, *true) + rng.normal(0, 1e-7, len(asked))
        files.append(log(str(tmp_path / f"{seed}.csv"), asked, went))
    known = shares_of(["gain", "derivative", "integral"])
    found = diagnose_motion(load_logs(files), replace(servo(), known=known))
    assert "feedforward" in found.content["verdict"]["effects"]
    write_identified(tmp_path, found, servo(), SHEET)
    model, wanted = load_identified(tmp_path / "identified_motion.json"), course(3)
    assert {"feedforward", "coulomb", "transmission"} <= {*model.effects}
    own = model.axes[0]
    assert own["lead_order"] == pytest.approx(2 * np.pi / LEAD, rel=0.01) and own["cascade"] == 1
    assert np.hypot(own["lead_sin"], own["lead_cos"]) == pytest.approx(true[3], rel=0.1)
    sent = corrected_command(model.nominal, model.axes, TIME, wanted[:, None], errors=model.errors).command
    before, after = (np.sqrt(((table(c, *true) - wanted) ** 2).mean()) for c in (wanted, sent[:, 0]))
    assert before > 2e-4 and after < 1e-6


@pytest.mark.parametrize(
    ("keys", "said"),
    [
        ({"position_gain": 60.0}, "needs speed_gain as well"),
        ({"position_gain": 60.0, "speed_gain": 1.0, "gain": 3.0}, "give speed_gain or gain, not both"),
        ({"integral_time": 0.01}, "needs position_gain as well"),
        ({"position_gain": 0.0, "speed_gain": 1.0}, "position_gain must be above 0"),
    ],
)
def test_half_a_cascade_is_refused(keys: dict[str, float], said: str) -> None:
    with pytest.raises(InputError, match=said):
        nominal_of("servo", keys, ["m"])
