"""The search over sets of effects of a motion, and the speeds that it begins with."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from motion.servo import KEYS, write_log

from ccnn_torch.motion import load_logs, nominal_of
from ccnn_torch.motion.effects import motion_effects
from ccnn_torch.motion.search import _Pool, log_posterior, prior_of
from ccnn_torch.motion.setting import problem_of
from ccnn_torch.motion.spec import Fit, Spec
from ccnn_torch.motion.stretches import smooth_speed
from ccnn_torch.motion.whiten import white_noise


def test_no_screen_leaves_an_effect_out_beside_one_other(tmp_path: Path) -> None:
    log = write_log(tmp_path / "log.csv", (0,), 1.5, dry=0.1, delay=0.03)
    tried = ["delay", "coulomb", "offset", "inertia", "viscous", "gravity", "servo_gain", "speed_limit"]
    problem = problem_of(load_logs([log]), nominal_of("servo", KEYS, ["rad"]), motion_effects(tried))
    pool = _Pool(problem, white_noise(1))
    pool.forward()
    found = pool.found[0]
    alone = min((members for members in found if len(members) == 1), key=lambda members: found[members].left)
    pairs = {tuple(sorted({*alone, e})) for e in range(len(pool.library.names)) if pool.library.there[0, e]} - {alone}
    assert len(pairs) > 4 and pairs <= found.keys()
    # What has come to rest is not fitted anew.
    fit = next(f for f in found.values() if f.settled and f.members)
    pool.fit([[fit.spec]], 3)
    assert found[fit.members] is fit


def fit_of(count: int, evidence: float) -> Fit:
    """A set of so many effects whose model says so much."""
    spec, nothing = Spec(tuple(range(count)), torch.zeros(0), (), 0.0), torch.zeros(0)
    return Fit(spec, evidence, 1.0, nothing, 0.0, 0.0, 0.0, 0.0, None, True)  # type: ignore[arg-type]


def test_an_effect_must_be_ten_times_as_likely_and_something_outside_a_thousand_times() -> None:
    none = log_posterior(fit_of(0, 0.0))
    assert log_posterior(fit_of(1, 2.2)) < none < log_posterior(fit_of(1, 2.4))
    assert log_posterior(fit_of(3, 9.1)) < none < log_posterior(fit_of(3, 9.3))
    assert 6.8 + prior_of(fit_of(0, 0.0), drivers=1) < none < 7.0 + prior_of(fit_of(0, 0.0), drivers=1)


def test_speeds_are_slopes_of_parabolas_up_to_the_ends() -> None:
    time = np.arange(0, 1, 0.01)
    position = np.stack([time, np.square(time), 3 - 2 * np.square(time)], -1)
    assert smooth_speed(time, position) == pytest.approx(np.stack([1 + 0 * time, 2 * time, -4 * time], -1), abs=1e-9)
    assert smooth_speed(time[:3], position[:3]) == pytest.approx(np.gradient(position[:3], time[:3], axis=0))
