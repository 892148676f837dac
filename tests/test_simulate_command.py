"""`ccnn simulate`: the records that it writes, and one sentence for everything that is wrong."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

from ccnn_torch.config.keys import list_keys
from ccnn_torch.effects import EFFECTS, Situation, default_gravity, make_effect, pose_residual, signature
from ccnn_torch.errors import InputError
from ccnn_torch.mechanisms import Mechanism, load_mechanism
from ccnn_torch.records import load_records, read_table
from ccnn_torch.simulation.config import SimulateConfig
from ccnn_torch.simulation.job import injected_table, simulate_records

Cli = Callable[..., tuple[int, str, str]]
ROOT = Path(__file__).parent.parent
ARM = Path(__file__).parent / "effects" / "arm.yaml"
GANTRY = ROOT / "tests" / "effects" / "gantry.yaml"


def words(mechanism: str | Path, *more: str | Path | int) -> tuple[str | Path, ...]:
    return ("simulate", "--mechanism", mechanism, "--rows", "60", *map(str, more))


def test_records_hold_what_was_injected_and_nothing_else(cli: Cli, tmp_path: Path) -> None:
    out = tmp_path / "new" / "r.csv"
    effect = "backlash:q1=2e-4,q2=0.3mrad"
    code, told, err = cli(*words("five_bar", "--effect", effect, "--noise", "0", "--out", out))
    assert code == 0 and err == "" and "backlash" in told and "0.0003" in told and str(out) in told
    mechanism = load_mechanism("five_bar")
    records = load_records(out, mechanism)
    names = [c.name for c in records.covariate_coordinates]
    assert names == ["time", "temperature", "load_x", "load_y", "direction1", "direction2"]
    covariates = dict(zip(names, records.covariates.unbind(-1), strict=True))
    situation = Situation(mechanism, records.joints, covariates, default_gravity(mechanism))
    columns = signature(situation, make_effect("backlash"), torch.tensor([100.0, 60.0, 0.3], dtype=torch.float64))
    play = [0, 3]  # of either joint; the rest is what a load does to it
    residual = pose_residual(situation, records.pose).flatten()
    fitted = torch.linalg.lstsq(columns[..., play].flatten(0, 1), residual).solution
    expected = torch.tensor([2e-4, 3e-4], dtype=torch.float64)
    assert torch.allclose(fitted, expected, atol=3e-6)  # the rest is of second order in them


def test_the_noise_is_what_was_asked_for_and_a_machine_as_its_model_has_nothing_else(cli: Cli, tmp_path: Path) -> None:
    out = tmp_path / "r.csv"
    noise = "y=10um,phi=40urad"
    code, told, _ = cli("simulate", "--mechanism", "tripod", "--rows", 400, "--noise", noise, "--out", out)
    assert code == 0 and "Nothing was injected" in told
    mechanism = load_mechanism("tripod")
    records = load_records(out, mechanism)
    error = records.pose - mechanism.forward_kinematics(records.joints)
    assert torch.allclose(error.std(0), torch.tensor([1e-5, 0.0, 4e-5], dtype=torch.float64), rtol=0.15, atol=1e-12)


def test_the_same_seed_gives_the_same_bytes_and_another_one_others(cli: Cli, tmp_path: Path) -> None:
    common = ("--noise", "1e-5", "--effect", "thermal", "--effect", "transmission", "--quiet")
    for name, seed in (("a", 1), ("b", 1), ("c", 2)):
        assert cli(*words("five_bar", *common, "--out", tmp_path / f"{name}.csv", "--seed", seed)) == (0, "", "")
    a, b, c = ((tmp_path / f"{name}.csv").read_bytes() for name in "abc")
    assert a == b != c


def test_latency_is_shown_by_moves_with_their_speeds(cli: Cli, tmp_path: Path) -> None:
    out = tmp_path / "r.csv"
    code, _, _ = cli(*words("stewart", "--effect", "latency:delay=5ms", "--noise", "1e-6", "--out", out))
    assert code == 0
    table = read_table(out)
    time, q1, speed = (np.asarray(table.raw(name)) for name in ("time", "q1", "speed1"))
    one = slice(0, 50)  # a move of a second in steps of 20 ms
    assert np.allclose(np.diff(time[one]), 0.02) and np.diff(time).max() > 1
    assert np.abs(np.gradient(q1[one], time[one]) - speed[one])[1:-1].max() < 0.02 * np.abs(speed[one]).max()


def test_bad_rows_are_few_and_far_out() -> None:
    made = simulate_records("five_bar", ["outlier:share=0.1,size=0.01"], 50, 1e-6, seed=4)
    error = (made.pose - made.mechanism.forward_kinematics(made.joints)).norm(dim=-1)
    far = torch.nonzero(error > 1e-4).flatten().tolist()
    assert far == list(made.outliers) and len(far) == 5 and made.gap == 0.0


@pytest.mark.parametrize("effect", list(EFFECTS))
def test_every_effect_can_be_drawn_in_a_plausible_size(effect: str) -> None:
    mechanism = _seen_by(effect)
    one, two = (simulate_records(mechanism, [f"{effect}:size={size}"], 60, seed=3) for size in (1, 2))
    assert 1e-6 < one.gap < 2e-2
    assert two.gap == pytest.approx(2 * one.gap, rel=0.05)
    secondary = {
        c.name
        for c in make_effect(effect).coefficients(_situation(mechanism, one.joints, one.covariates))
        if c.secondary
    }
    assert one.injected[0].parameters and not secondary & set(one.injected[0].parameters)


def _seen_by(effect: str) -> Mechanism:
    """The arm, a gantry for what is of guides, or a mount of two axes for what is of directions."""
    if effect != "flexure":
        return load_mechanism(str(GANTRY if effect == "error_motion" else ARM))
    links = [[0.0, math.pi / 2, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0]]
    return load_mechanism("serial", name="mount", convention="standard", links=links, orientation="direction")


def test_directions_are_unit_vectors_with_noise_too() -> None:
    made = simulate_records(_seen_by("flexure"), ["flexure"], 20, {"x": 1e-4, "y": 1e-4, "z": 1e-4}, seed=1)
    length = made.pose.norm(dim=-1)
    torch.testing.assert_close(length, length[:1].expand(20), rtol=1e-12, atol=0)


def _situation(mechanism: Mechanism, joints: torch.Tensor, covariates: dict[str, torch.Tensor]) -> Situation:
    return Situation(mechanism, joints, covariates, default_gravity(mechanism))


def test_an_own_effect_takes_part(cli: Cli, tmp_path: Path) -> None:
    own = f"{ROOT / 'experiments' / 'my_effect.py'}:HosePull"
    out = tmp_path / "r.csv"
    code, told, _ = cli(*words("five_bar", "--effect", f"{own}:q1=1e-4,height=1.5", "--noise", 0, "--out", out))
    assert code == 0 and "hose_pull" in told and "1.5" in told


@pytest.mark.parametrize(
    ("effect", "sentence"),
    [
        ("backlsh", "did you mean 'backlash'?"),
        ("outliers", "did you mean 'outlier'?"),
        ("backlash:q3=1e-4", "it has no parameter 'q3'; it has q1, q1_softer, q1_harder"),
        ("backlash:q1_softr=1", "did you mean 'q1_softer'?"),
        ("backlash:widht=1", "did you mean 'width'?"),
        ("backlash:q1", "write NAME or NAME:parameter=value"),
        ("backlash:q1=much", "q1=much is no number"),
        ("backlash:q1=0.1mm", "must be an angle"),
        ("tool", "it needs a platform that turns"),
        ("outlier:share=2", "share must be above 0 and at most 0.5"),
        ("outlier:sise=2", "it has no parameter 'sise'; it has share"),
        ("geometry:l1=3", "has no pose in"),
        ("thermal:growth=1.2e-5,lag=-30min", "--effect thermal: lag = -1800 s is below 0; on these rows a diagnosis"),
        ("transmission:q1_sin=1e-4,q1_frequency=-2", "q1 frequency = -2 is below 0"),
        ("backlash:q1=-0.1mrad", "q1 = -0.0001 rad is below 0, which physics does not allow; plausible is about"),
        (
            "joint_offset:q1=100",
            "q1 = 100 rad is more than 1000 times what a machine has; plausible is about 0.002",
        ),
        ("backlash:size=-1", "size = -1: give a factor from 0 to 1000"),
        ("nowhere.py:Mine", "there is no file nowhere.py"),
    ],
)
def test_a_wrong_effect_is_one_sentence(cli: Cli, tmp_path: Path, effect: str, sentence: str) -> None:
    code, _, err = cli(*words("five_bar", "--effect", effect, "--noise", "1e-5", "--out", tmp_path / "r.csv"))
    assert code == 2 and sentence in err, err
    assert len(err.strip().splitlines()) == 1 and "Traceback" not in err
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("effects", "sentence"),
    [
        (["parameter spring1:spring1=-6e4"], "spring1: spring1 would be -20000 N*m/rad, and the mechanism has it from"),
        (["parameter spring1:spring1=-6e4"], " from 1000 up; give a difference to its nominal 40000 from -39000 up"),
        (["parameter spring1:spring1=-2e4", "parameter spring1:spring1=-3e4"], "spring1 would be -10000 N*m/rad"),
    ],
)
def test_a_parameter_of_a_simulator_stays_within_its_bounds(
    cli: Cli, tmp_path: Path, effects: list[str], sentence: str
) -> None:
    press = f"{ROOT / 'experiments' / 'my_simulator.py'}:PRESS"
    more = [word for effect in effects for word in ("--effect", effect)]
    code, _, err = cli(*words(press, *more, "--noise", 0, "--out", tmp_path / "r.csv"))
    assert code == 2 and sentence in err and len(err.strip().splitlines()) == 1
    assert not list(tmp_path.iterdir())
    assert simulate_records(press, ["parameter spring1:spring1=-38999"], 20).gap > 0


def test_what_is_told_is_what_acts(cli: Cli, tmp_path: Path) -> None:
    out = ("--noise", 0, "--out", tmp_path / "r.csv")
    _, told, _ = cli(*words("five_bar", "--effect", "thermal:growth=1.2e-5,lag=30min", *out))
    assert "lag" in told and "late lag" not in told
    _, told, _ = cli(*words("five_bar", "--effect", "thermal:late=1.2e-5", *out))
    assert "late lag" in told
    _, told, _ = cli(*words("five_bar", "--effect", "outlier", *out))
    assert "by bad rows" in told and "without" not in told and " 0 µm" not in told
    _, told, _ = cli(*words("five_bar", "--effect", "outlier", "--effect", "backlash", *out))
    assert "without noise and bad rows (backlash alone" in " ".join(told.split())


@pytest.mark.parametrize(
    ("more", "sentence"),
    [
        (("--noise", "much"), "--noise much: 'much' is no number with a unit"),
        (("--noise", "z=1e-5"), "noise.z: there is no such name; there are x, y"),
        (("--noise", "-1"), "a standard deviation is a number from 0 up"),
        (("--noise", "nan"), "nan is no standard deviation; write a size from 0 up"),
        (("--noise", "0", "--rows", "0"), "--rows: simulate at least 1 row, not 0"),
        (("--noise", "0", "max_condition=1.0001"), "make max_condition larger"),
        (("--noise", "0", "laod=3"), "there is no key 'laod'; did you mean 'load'?"),
        (("--noise", "0", "covariates=[wind]"), "there is no column 'wind'; these rows have time"),
        (("--noise", "0", "covariates=[time]", "--effect", "backlash"), "--effect backlash: it needs the sign of each"),
    ],
)
def test_bad_input_is_one_sentence(cli: Cli, tmp_path: Path, more: tuple[str, ...], sentence: str) -> None:
    code, _, err = cli(*words("five_bar", "--out", tmp_path / "r.csv", *more))
    assert code == 2 and sentence in err, err
    assert len(err.strip().splitlines()) == 1 and not list(tmp_path.iterdir())


def test_a_file_that_is_no_csv_or_cannot_be_written_is_said(cli: Cli, tmp_path: Path) -> None:
    code, _, err = cli(*words("five_bar", "--noise", 0, "--out", tmp_path / "r.txt"))
    assert code == 2 and "must end in .csv" in err
    (tmp_path / "file").write_text("")
    code, _, err = cli(*words("five_bar", "--noise", 0, "--out", tmp_path / "file" / "r.csv"))
    assert code == 2 and "cannot be made" in err


def test_the_help_and_the_page_name_every_effect_and_key(cli: Cli, tmp_path: Path) -> None:
    _, told, _ = cli("simulate", "--help")
    page = (ROOT / "docs" / "how_to" / "effects.md").read_text()
    for name in EFFECTS:
        assert name in told and f"| `{name}` | " in page and make_effect(name).description in page
    for key, default, description in list_keys(SimulateConfig):
        assert key in told and f"| `{key}` | `{default}` | {description} |" in page
    example = (ROOT / "experiments" / "my_effect.py").read_text()
    assert f"```python\n{example}```" in page
    config = tmp_path / "s.yaml"
    config.write_text("covariates: [time, direction*]\nload: 10\n")
    assert SimulateConfig.from_file(config).load == 10.0 and SimulateConfig.from_file(None) == SimulateConfig()


def test_python_takes_a_mechanism_and_refuses_an_unknown_coordinate() -> None:
    made = simulate_records(load_mechanism("five_bar"), [], 5, {"x": 1e-5})
    assert len(made.joints) == 5
    with pytest.raises(InputError, match=r"noise\.phi: there is no such name; there are x, y"):
        simulate_records("five_bar", [], 5, {"phi": 1e-5})


def test_rows_that_the_changed_machine_does_not_reach_are_drawn_anew() -> None:
    made = simulate_records("five_bar", ["geometry"], 120, 0.0, seed=0)
    machine = load_mechanism("five_bar")
    # In order measured: the direction is the sign of the way from the row before, of those drawn anew as well.
    way = made.joints.diff(dim=0).sign()
    found = torch.stack([made.covariates[f"direction{i}"] for i in (1, 2)], -1)
    assert torch.equal(found[1:], way) and len(made.joints) == 120
    assert torch.isfinite(made.pose).all() and torch.isfinite(machine.forward_kinematics(made.joints)).all()


@pytest.mark.parametrize("rows", [1, 20])
def test_what_only_turns_the_tool_moves_no_position(rows: int) -> None:
    """An arm is told by its position, also where a cause only turns it, and from one row alone."""
    made = simulate_records("stewart", ["tool:rx=1mrad", "joint_offset:q1=1mm"], rows)
    turned, moved = made.injected
    assert turned.gap < 1e-12 and 1e-5 < moved.gap < 1e-2 and not made.turns
    assert "RMS error of the position" in injected_table(made).note
