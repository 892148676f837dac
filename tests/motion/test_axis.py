"""The simulated axis against scipy and against what each law means."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from motion.servo import GAIN, INERTIA, LENGTH, LOAD, MASS, VISCOUS, command, moved, moved_on_a_spring

from ccnn_torch.motion.axis import ABSENT, Drive, simulate_axes
from ccnn_torch.motion.effects import EFFECTS, Facts, motion_effects
from ccnn_torch.motion.library import library_of
from ccnn_torch.motion.search import with_gain
from ccnn_torch.motion.spec import Spec


def axis(time: np.ndarray, asked: np.ndarray, **parameters: float) -> np.ndarray:
    t, u = torch.from_numpy(time)[None], torch.from_numpy(asked)[None]
    start = torch.tensor([[asked[0], 0.0]], dtype=torch.float64)
    drive = Drive(t, u, start)
    given = {name: torch.tensor([[value]], dtype=torch.float64) for name, value in parameters.items()}
    return simulate_axes(drive, given)[0, 0].numpy()


TIME = np.sort(np.arange(0, 4, 0.01) + np.random.default_rng(0).uniform(0, 0.003, 400))
OWN = {"inertia": INERTIA / GAIN, "viscous": VISCOUS / GAIN}


@pytest.mark.parametrize(
    "real",
    [
        {},
        {"delay": 0.03},
        {"dry": 0.1},
        {"limit": 0.12, "drive": 0.05},
        {"integral": 3.0, "weight": 0.3},
        {"derivative": 0.03, "integral": 5.0, "dry": 0.02},
        {"band": 0.03, "integral": 3.0},
    ],
)
def test_it_moves_as_its_equation_says(real: dict[str, float]) -> None:
    asked = command(0, TIME)
    torques = {"weight": "gravity_sin", "dry": "coulomb", "drive": "drive_damping", "band": "dead_band"}
    mine = {torques.get(n, n): v / (GAIN if n in torques and n != "band" else 1) for n, v in real.items()}
    if "limit" in mine:
        mine["weakness"] = GAIN / mine.pop("limit")
    error = axis(TIME, asked, **OWN, **mine) - moved(TIME, asked, **real)
    assert np.abs(error).max() < 2e-3 * np.ptp(asked)


def test_an_axis_sticks_and_goes_on_in_time_between_samples() -> None:
    asked = command(1, TIME)
    times = np.unique(np.concatenate([TIME[:-1] + k / 16 * np.diff(TIME) for k in range(16)] + [TIME[-1:]]))
    short = axis(times, np.interp(times, TIME, asked), **OWN, coulomb=0.01)
    assert np.abs(axis(TIME, asked, **OWN, coulomb=0.01) - np.interp(TIME, times, short)).max() < 1e-4


@pytest.mark.parametrize("at_motor", [False, True])
def test_a_load_on_a_spring_pulls_at_the_motor(at_motor: bool) -> None:
    spring, damping, asked = 1.5, 0.01, command(0, TIME)
    flexibility = LOAD / spring
    mine = {"load": LOAD / GAIN, "gravity_sin": MASS * 9.80665 * LENGTH / GAIN, "encoder_at_motor": float(at_motor)}
    soft = {"flexibility": flexibility, "flexible_damping": 0.5 * damping / spring / np.sqrt(flexibility)}
    found = axis(TIME, asked, **OWN, **mine, **soft)
    assert np.abs(found - moved_on_a_spring(TIME, asked, spring, damping, at_motor)).max() < 2e-3 * np.ptp(asked)
    assert np.abs(found - axis(TIME, asked, **OWN, **mine)).max() > 0.005 * np.ptp(asked)


def test_without_parameters_the_position_is_the_command() -> None:
    asked = command(2, TIME)
    assert np.abs(axis(TIME, asked) - asked).max() < 1e-7


def test_each_law_does_what_its_name_says() -> None:
    ramp = np.maximum(TIME - 0.5, 0)
    # Dry friction keeps it until the command leads by so much, then the command leads by just that.
    stuck = axis(TIME, ramp, coulomb=0.1)
    assert np.abs(stuck - np.maximum(ramp - 0.1, 0)).max() < 1e-7
    # A share of the load is friction too: it holds a weight at rest, and more lead is needed.
    assert axis(TIME, ramp, coulomb=0.1, load_friction=0.5)[-1] < stuck[-1] - 0.09
    # Of an axis that carries nothing it is a share of nothing.
    assert np.abs(axis(TIME, ramp, load_friction=0.9) - ramp).max() < 1e-6
    # The driven side of a play comes half of it late, on either way.
    wave = np.sin(2 * TIME)
    late = wave - axis(TIME, wave, play=0.1)
    assert late.max() == pytest.approx(0.05) and late.min() == pytest.approx(-0.05)
    slow = axis(TIME, 3 * np.minimum(TIME, 1), slowness=1 / 1.5)
    assert slow[-1] == pytest.approx(3) and np.diff(slow).max() < 1.5 * 1.0001 * np.diff(TIME).max()
    # No torque beyond the limit: the acceleration is limit over inertia.
    step = np.where(TIME < 1, 0.0, 1.0)
    speed = np.gradient(axis(TIME, step, inertia=0.05, viscous=0.1, weakness=1 / 0.2), TIME)
    begin = int(np.searchsorted(TIME, 1.1))
    assert speed[begin] == pytest.approx((0.2 / 0.1) * (1 - np.exp(-2 * (TIME[begin] - 1))), rel=0.1)
    # Two teeth of a period of pi: the sag is the torque.
    teeth = axis(TIME, np.full(400, 0.3), cogging_sin=0.02, cogging_order=2.0, viscous=0.05)
    assert teeth[-1] == pytest.approx(0.3 - 0.02 * np.sin(2 * teeth[-1]), abs=1e-6)
    # Behind a spring of 5 Hz a step rings at 5 Hz.
    rings = axis(TIME, step, flexibility=1 / (10 * np.pi) ** 2, flexible_damping=0.02)[TIME > 1.02] - 1
    assert np.sum(np.diff(np.sign(rings)) != 0) in range(26, 32)


def test_limits_and_loads_go_on_where_a_stretch_begins() -> None:
    time = torch.from_numpy(TIME)[None]
    still, begin = torch.zeros_like(time), torch.zeros(1, 2, dtype=torch.float64)
    given = {"slowness": torch.tensor([[2.0]], dtype=torch.float64)}
    late = simulate_axes(Drive(time, still + 1, begin), given)[0, 0].numpy()
    # The command may be far ahead of a limited axis already.
    assert np.abs(late - np.minimum(0.5 * (TIME - TIME[0]), 1)).max() < 1e-3
    # What a simulator loads an axis with presses its play to one side.
    given = {n: torch.tensor([[v]], dtype=torch.float64) for n, v in {"play": 0.1, "play_loaded": 1.0, **OWN}.items()}
    hung = simulate_axes(Drive(time, still, begin, torque=still + 0.2), given)[0, 0]
    assert float(hung[-1]) == pytest.approx(-0.25, abs=1e-3)
    # Friction of its own brakes it: where it is strong it stays where the other end has taken it to.
    motor = simulate_axes(Drive(time, still, begin, torque=still + 0.2), given | {"play": 0 * given["play"]})[0, 0]
    pull, taken = 0.2 / OWN["inertia"], float(motor.min()) + 0.05
    for friction, end in ((50 * pull, taken), (0.9 * pull, -0.25)):
        given["play_friction"] = torch.tensor([[friction]], dtype=torch.float64)
        braked = simulate_axes(Drive(time, still, begin, torque=still + 0.2), given)[0, 0]
        assert float((braked - hung).max()) > 0.05 and float(braked[-1]) == pytest.approx(end, abs=1e-3)


def test_parameters_are_batched_and_never_run_away() -> None:
    asked = torch.from_numpy(command(0, TIME))[None]
    time = torch.from_numpy(TIME)[None]
    start = torch.zeros(1, 2, dtype=torch.float64)
    drive = Drive(time, asked, start)
    inertia = torch.tensor([[1e-3], [5e-3], [2e-2]], dtype=torch.float64)
    together = simulate_axes(drive, {"inertia": inertia})
    for k in range(3):
        assert torch.equal(together[k], simulate_axes(drive, {"inertia": inertia[k : k + 1]})[0])
    library = library_of(motion_effects(), [Facts("rad", {}, gain=2.0, length=0.1)])
    for j in range(len(library.numbers[0])):
        theta = torch.zeros(2, library.size, dtype=torch.float64)
        theta[0, j], theta[1, j] = 200.0, -200.0
        parameters = library.parameters(theta, torch.zeros(2, dtype=torch.int64))
        assert torch.isfinite(simulate_axes(drive, {name: v[:, None] for name, v in parameters.items()})).all()


def test_an_effect_of_ones_own_is_a_value_or_a_class(tmp_path: Path) -> None:
    own = "from ccnn_torch.motion.effects import MotionEffect\nONE = MotionEffect('one', lambda axis: ())\n"
    (tmp_path / "mine.py").write_text(f"{own}class Two:\n    name = 'two'\n")
    names = [f"{tmp_path}/mine.py:{name}" for name in ("ONE", "Two")]
    assert [effect.name for effect in motion_effects(names)] == ["one", "two"]


def test_every_effect_acts_on_parameters_that_the_axis_has() -> None:
    own = {"inertia": 0.01, "weakness": 1.0, "derivative": 0.1}
    facts = Facts("rad", own, gain=2.0, length=0.1, supply=0.2, temperature=10)
    for name, effect in EFFECTS.items():
        assert effect.name == name and not effect.missing(facts)
        for number in effect.numbers(facts):
            assert number.scale > 0 and all(act[0] in ABSENT for act in number.acts)
        assert len(effect.shapes(facts)) >= 1


def test_a_motor_near_its_limit_may_have_another_voltage_than_the_one_recorded() -> None:
    facts = Facts("rad", {"inertia": 0.01, "weakness": 1.0}, gain=2.0, supply=0.2, error=0.6)
    # An axis that is far from its limit has the same numbers, and the voltage does nothing that its gain does not.
    library = library_of(motion_effects(["supply"]), [facts, replace(facts, error=0.1)])
    names = [number.name for number in library.numbers[0]]
    # One number or the other, never both: a short log would share what it shows among them.
    assert [[names[j] for j in v.active] for v in library.variants[0]] == [names[:1], names[1:], names[1:]]
    found = library.parameters(torch.tensor([[0.0, 1.0]], dtype=torch.float64).expand(2, -1), torch.arange(2))
    assert found["gain"].tolist() == [pytest.approx(np.exp(0.3)), 1.0] and "supply" not in found
    assert library_of(motion_effects(["supply"]), [replace(facts, error=0.1, supply=0.0)]).lacking[0]


def test_what_one_model_has_changes_nothing_of_those_beside_it() -> None:
    asked, moving = command(0, TIME[100:]), [[0.2, 1.5]]
    drive = Drive(torch.from_numpy(TIME[None, 100:]), torch.from_numpy(asked)[None], torch.tensor(moving).double())
    shared = {name: torch.tensor([[value]]).double() for name, value in (OWN | {"integral": 3.0}).items()}
    alone = simulate_axes(drive, shared)[0]
    for other in ("slowness", "weakness", "flexibility", "play", "derivative", "stribeck"):
        beside = simulate_axes(drive, shared | {other: torch.tensor([[0.0], [0.05]]).double()})
        assert (beside[0] - alone).abs().max() < 1e-9, other


def lot(sets: list[dict[str, float]], asked: np.ndarray) -> np.ndarray:
    """Positions of axes with other parameters each, simulated side by side."""
    t, u = (torch.from_numpy(v).expand(len(sets), -1) for v in (TIME, asked))
    start = torch.tensor([[asked[0], 0.0]], dtype=torch.float64).expand(len(sets), -1)
    torque = 0.01 * torch.sin(3 * t)
    names = {name for one in sets for name in one}
    values = {n: torch.tensor([[one.get(n, ABSENT[n]) for one in sets]], dtype=torch.float64) for n in names}
    return simulate_axes(Drive(t, u, start, torque=torque), values)[0].numpy()


def test_an_axis_moves_the_same_beside_any_other() -> None:
    # The light one needs more steps than the others.
    sets = [OWN, {"inertia": 1e-6}, {}, OWN | {"delay": 0.013}, OWN | {"slowness": 0.4}, {"viscous": 0.05}]
    sets += [OWN | {"cogging_sin": 0.02, "cogging_order": 42.0}, OWN | {"stribeck": 0.05, "coulomb": 0.02}]
    sets += [OWN | {"flexibility": 1e-3, "load": 5e-4}, OWN | {"weakness": 8.0}, OWN | {"play": 0.01}]
    sets += [OWN | {"integral": 3.0}, OWN | {"derivative": 0.02}, OWN | {"load_friction": 0.2, "gravity_sin": 0.1}]
    beside = lot(sets, command(0, TIME))
    for one, row in zip(sets, beside, strict=True):
        assert np.array_equal(lot([one], command(0, TIME))[0], row), one


def test_threads_change_no_digit() -> None:
    sets, threads, ways = [OWN | {"coulomb": 0.01 * k} for k in range(40)], torch.get_num_threads(), []
    try:
        for count in (1, 3):
            torch.set_num_threads(count)
            ways.append(lot(sets, command(0, TIME)))
    finally:
        torch.set_num_threads(threads)
    assert np.array_equal(*ways)


def test_compiled_or_not_an_axis_moves_the_same() -> None:
    time = torch.from_numpy(TIME).expand(2, -1)
    asked = torch.stack([torch.from_numpy(command(k, TIME)) for k in (0, 1)])
    start = torch.stack([asked[:, 0], asked.new_tensor([0.0, 0.4])], -1)
    uneven = {"supply": 0.1 * torch.sin(time), "warm": 5 * time, "torque": 0.01 * torch.cos(time)}
    drive = Drive(time, asked, start, **uneven, bent=asked.new_tensor([0.0, 0.9]))
    generator = torch.Generator().manual_seed(0)
    names, sets = list(ABSENT), 40
    # Each of the sets has some of what an axis may have.
    has = torch.rand(len(names), sets, 1, generator=generator) < 0.4
    sizes = torch.rand(len(names), sets, 1, generator=generator, dtype=torch.float64)
    many = {"cogging_order": 20.0, "gain": 2.0, "stribeck_speed": 0.5, "weakness": 8.0, "integral": 4.0}
    values = {n: torch.where(h, many.get(n, 0.05) * v, ABSENT[n]) for n, h, v in zip(names, has, sizes, strict=True)}
    ways = [simulate_axes(drive, values, fast) for fast in (False, True)]
    assert ways[0].std() > 0.1
    # Where a limited acceleration begins to brake the last digit decides.
    ramped = has[names.index("ramp"), :, 0]
    for here, most in ((~ramped, 1e-10), (ramped, 1e-3)):
        torch.testing.assert_close(*(way[here] for way in ways), rtol=0, atol=most)


@pytest.mark.parametrize("fast", [True, False])
def test_a_late_command_that_was_thinned_goes_along_its_curve(fast: bool) -> None:
    """On straight lines between samples 8 ms apart it was elsewhere by what a spring or an inertia does."""
    whole = np.arange(0, 3, 1e-3)
    asked = 0.3 * np.sin(5 * whole + np.sin(3 * whole))
    late = np.interp(whole - 3.3e-3, whole, asked)[::8]
    time, command = (torch.from_numpy(v[::8].copy())[None] for v in (whole, asked))
    drive = Drive(time, command, torch.zeros(1, 2, dtype=torch.float64), bent=torch.tensor([1 - 8.0**-2]).double())
    given = {"delay": torch.tensor([[3.3e-3]], dtype=torch.float64)}
    errors = [simulate_axes(d, given, fast)[0, 0].numpy()[8:] - late[8:] for d in (drive, drive._replace(bent=None))]
    assert np.abs(errors[0]).max() < 5e-6 < 0.1 * np.abs(errors[1]).max()


def test_the_last_digit_of_a_command_decides_nothing() -> None:
    sets = [{"cogging_sin": 0.04, "cogging_order": 84.0}, {"stribeck": 0.05, "stribeck_speed": 0.02, "viscous": 0.01}]
    sets += [{"stribeck": 0.1, "coulomb": 0.05, "load_friction": 0.3}, OWN | {"stribeck": 0.1, "stribeck_speed": 0.01}]
    sets += [
        {"stribeck": 0.013, "stribeck_speed": 1.85},
        {"cogging_sin": 0.1, "cogging_cos": 0.1, "cogging_order": 60.0},
    ]
    sets += [{"inertia": 1e-6, "cogging_sin": 0.03, "cogging_order": 150.0, "coulomb": 0.01}]
    asked = command(1, TIME)
    rounded = asked * (1 + 2.3e-16 * np.random.default_rng(1).choice([-1, 0, 1], len(asked)))
    moved_by = np.abs(lot(sets, asked) - lot(sets, rounded)).max(-1)
    assert (moved_by < 1e-9).all(), moved_by


def test_another_gain_is_another_inertia_and_friction() -> None:
    # All torques are over the gain.
    tried = ["servo_gain", "inertia", "viscous", "coulomb"]
    facts = Facts("rad", {"inertia": 0.002, "viscous": 0.05, "coulomb": 0.01}, gain=2.0)
    library = library_of(motion_effects(tried), [facts])
    theta = torch.zeros(library.size, dtype=torch.float64)
    numbers = {number.name: j for j, number in enumerate(library.numbers[0])}
    for name, value in {"inertia": 0.006, "viscous": 0.02, "coulomb": 0.03}.items():
        theta[numbers[name]] = value / library.numbers[0][numbers[name]].scale
    own = [library.names.index(name) for name in ("inertia", "viscous", "coulomb")]
    spec = Spec(theta, tuple(library.variants[e][0] for e in sorted(own)))
    other = with_gain(library, 0, spec)
    assert other is not None and {library.names[m] for m in other.members} == {"servo_gain", "viscous", "coulomb"}
    sets = [library.parameters(one.theta[None], torch.tensor([0])) for one in (spec, other)]
    assert float(sets[1]["gain"]) == pytest.approx(0.25)
    a, b = (axis(TIME, command(0, TIME), **{n: float(v) for n, v in one.items()}) for one in sets)
    assert a == pytest.approx(b, abs=1e-9)
    for without in (["inertia", "viscous"], ["servo_gain", "viscous"]):
        few = library_of(motion_effects(without), [facts])
        assert with_gain(few, 0, Spec(torch.ones(few.size, dtype=torch.float64), few.variants[1][:1])) is None
