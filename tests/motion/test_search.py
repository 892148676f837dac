"""The search over sets of effects of a motion, and the speeds that it begins with."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from motion.servo import KEYS, write_log

from ccnn_torch.motion import load_logs, nominal_of
from ccnn_torch.motion.effects import Facts, motion_effects
from ccnn_torch.motion.fit import form_errors, weighed
from ccnn_torch.motion.judge import least_unseen
from ccnn_torch.motion.library import library_of
from ccnn_torch.motion.search import _Pool, log_posterior, prior_of
from ccnn_torch.motion.setting import problem_of
from ccnn_torch.motion.spec import Fit, Spec, nothing, started, without
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


def test_a_set_counts_by_what_its_simulation_leaves_and_a_form_by_what_is_known(tmp_path: Path) -> None:
    # A push along the motion: friction below 0 would explain it, and there is none.
    log = load_logs([write_log(tmp_path / "log.csv", (0, 2), 1.5, dry=-0.02)])
    nominal, tried = nominal_of("servo", KEYS, ["rad"]), motion_effects(["coulomb"])
    problem = problem_of(log, nominal, tried)
    pool = _Pool(problem, white_noise(1))
    pool.forward()
    none, friction = pool.found[0][()], pool.found[0][0,]
    assert friction.spec.theta.abs().max() == 0 and friction.rss == none.rss
    linear = weighed(friction.grams, 0, [friction.spec.groups], None)
    assert float(linear.rss) == pytest.approx(none.rss) and friction.unseen >= none.rss
    # The better values are known the less the form of a model is wrong, without a jump.
    found = []
    for share in (0.0, 0.015, 0.0299, 0.03, 0.1):
        known = replace(problem, known=dict.fromkeys(problem.unsure, share))
        found += form_errors(known, pool.whitening, pool.nuisance, [[none]], [0.0])
    assert found[0] == 0 and found == sorted(found) and found[2] == pytest.approx(found[3], rel=0.01)
    assert found[3] == found[4] == form_errors(problem, pool.whitening, pool.nuisance, [[none]], [0.0])[0]


def fit_of(count: int, evidence: float) -> Fit:
    """A set of so many effects whose model says so much."""
    spec = SimpleNamespace(members=tuple(range(count)), log_prior=0.0)
    return Fit(*[None] * len(Fit._fields))._replace(spec=spec, log_evidence=evidence)  # type: ignore[arg-type]


def test_an_effect_must_be_ten_times_as_likely_and_something_outside_a_thousand_times() -> None:
    none = log_posterior(fit_of(0, 0.0))
    assert log_posterior(fit_of(1, 2.2)) < none < log_posterior(fit_of(1, 2.4))
    assert log_posterior(fit_of(3, 9.1)) < none < log_posterior(fit_of(3, 9.3))
    outside = prior_of(fit_of(0, 0.0).spec, drivers=1)
    assert 6.8 + outside < none < 7.0 + outside


def test_a_set_has_the_same_prior_by_any_path() -> None:
    facts = Facts("rad", {"inertia": 0.01}, gain=2.0)
    library = library_of(motion_effects(["delay", "servo_gain", "backlash"]), [facts])
    delay, gain, play = range(3)

    def after(*path: tuple[int, int] | int) -> Spec:
        """Effects that come as one of their variants, and go."""
        spec = nothing(library)
        for step in path:
            if isinstance(step, int):
                spec = without(spec, spec.members.index(step))
            else:
                spec = started(spec, library.variants[step[0]][step[1]], 0)
        return spec

    straight, around = after((delay, 0), (play, 1)), after((play, 0), (gain, 2), (delay, 0), gain, play, (play, 1))
    assert straight.members == around.members == (delay, play)
    assert straight.log_prior == around.log_prior == -math.log(2)
    assert straight.moved == around.moved and torch.equal(straight.theta, around.theta)
    assert after((gain, 1), gain).log_prior == 0


def test_alike_names_are_told_by_runs_that_were_not_fitted() -> None:
    def fit(members: tuple[int, ...], left: float, unseen: float) -> Fit:
        return Fit(*[None] * len(Fit._fields))._replace(  # type: ignore[arg-type]
            spec=SimpleNamespace(members=members), left=left, rss=left, unseen=unseen
        )

    fits = {
        own: fit(own, *rest) for own, rest in {(0,): (9, 9), (0, 1): (1, 5), (0, 2): (4, 2), (0, 3): (1, 5)}.items()
    }
    # The second leaves less of other runs; the third as little of these, whatever its prior.
    assert least_unseen(fits, (0, 1), {0: (), 1: (2,)}) == (fits[0, 2], {0: (), 2: (1, 3)})
    assert least_unseen(fits, (0, 1), {0: (), 1: ()}) == (fits[0, 1], {0: (), 1: (3,)})
    # Of a name that is not needed nothing is told by what stands in its place.
    idle = fits | {(0,): fit((0,), 1, 5)}
    assert least_unseen(idle, (0, 1), {0: (), 1: ()}) == (fits[0, 1], {0: (), 1: ()})


def test_speeds_are_slopes_of_parabolas_up_to_the_ends() -> None:
    time = np.arange(0, 1, 0.01)
    position = np.stack([time, np.square(time), 3 - 2 * np.square(time)], -1)
    assert smooth_speed(time, position) == pytest.approx(np.stack([1 + 0 * time, 2 * time, -4 * time], -1), abs=1e-9)
    assert smooth_speed(time[:3], position[:3]) == pytest.approx(np.gradient(position[:3], time[:3], axis=0))
