"""`ccnn compensate` with a model of a motion: how far commands go, what surrounds a motion, and where it begins."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
import pytest
from motion.servo import KEYS, command
from numpy.typing import NDArray

from ccnn_torch.motion import corrected_command, nominal_of
from ccnn_torch.records import read_table

Cli = Callable[..., tuple[int, str, str]]
Array = NDArray[np.float64]
TIME = np.arange(0, 1.5, 0.01)


def compensated(
    folder: Path, cli: Cli, keys: Mapping[str, float], error: float = 0.3, **columns: Array
) -> tuple[int, str, Mapping[str, Array]]:
    """Exit status, what was said, and the columns, of a servo with these keys."""
    content = {"mechanism": "servo", "mechanism_keys": keys, "units": ["rad"], "effects": [], "axes": [{}]}
    content |= {"left": [0.001], "errors": [error], "temperature": 300.0}
    (folder / "identified_motion.json").write_text(json.dumps(content))
    given = {"time[s]": TIME, "command1[rad]": command(2, TIME)} | columns
    rows = [",".join(f"{v:.12g}" for v in row) for row in zip(*given.values(), strict=True)]
    (folder / "in.csv").write_text("\n".join([",".join(given), *rows]) + "\n")
    code, said, refused = cli("compensate", *(folder / n for n in ("identified_motion.json", "in.csv", "out.csv")))
    table = read_table(folder / "out.csv") if code == 0 else None
    found = {} if table is None else {n: table.column(f"{n}1", "rad") for n in ("command", "corrected", "predicted")}
    return code, " ".join((said + refused).split()), found


def test_a_command_stays_near_the_motion_and_an_absurd_model_is_refused(tmp_path: Path, cli: Cli) -> None:
    # Without the other bound the command would run away from what the motor cannot hold.
    weak = nominal_of("servo", KEYS | {"gravity_cos": 0.9, "torque_limit": 0.8}, ["rad"])
    wanted = command(0, TIME)[:, None]
    far = corrected_command(weak, weak.axes, TIME, wanted, errors=[0.1]).command
    beyond = 0.5 * float(np.ptp(wanted)) + 1e-9
    assert wanted.min() - beyond <= far.min() and far.max() <= wanted.max() + beyond
    code, said, found = compensated(tmp_path, cli, KEYS | {"torque_limit": 0.002})
    assert code == 0 and "less than a tenth: the wanted motion is sent as it is" in said
    assert np.array_equal(found["corrected"], found["command"])
    code, said, _ = compensated(tmp_path, cli, KEYS | {"gravity_cos": 40.0})
    assert code == 2 and "its q1 errs by" in said and "by at most 0.30 rad): it is not that machine" in said


def test_every_run_of_a_file_is_corrected_for_itself_and_told_where_most_of_its_error_stays(
    tmp_path: Path, cli: Cli
) -> None:
    # The motor is too weak for the second run, alone in a file and after another one.
    keys, slow = KEYS | {"gravity_sin": 0.4, "torque_limit": 0.02}, {"command1[rad]": 0.1 * command(2, TIME)}
    _, said, first = compensated(tmp_path, cli, keys, **slow)
    assert "RMS" in said and "most of the error" not in said
    _, alone, second = compensated(tmp_path, cli, keys)
    assert "the wanted motion is sent as it is" in alone and "most of the error" not in alone
    both = {name: np.r_[first[name], second[name]] for name in ("command", "corrected", "predicted")}
    columns = {"time[s]": np.r_[TIME, TIME], "run[1]": np.repeat([1.0, 2.0], len(TIME))}
    code, said, found = compensated(tmp_path, cli, keys, **columns, **{"command1[rad]": both["command"]})
    assert code == 0 and all(np.allclose(found[name], both[name], atol=1e-9) for name in both)
    assert "q1: predicted " in said and " -> " in said.split("most of")[0]
    assert "in.csv run 2: most of the error stays at q1 (" in said and "run 1: most" not in said
    assert "rad RMS; the wanted motion is sent as it is)." in said


def test_an_axis_that_comes_late_by_more_than_a_delay_is_led_to_the_wanted_motion() -> None:
    # A delay and a lag, which no shift in time makes up for: a joint of frequencies up to 2 Hz.
    late = nominal_of("servo", {"gain": 1.0, "viscous": 0.05, "delay": 0.1}, ["rad"])
    time = np.arange(0, 4, 0.01)
    wanted = sum(0.2 * np.cos(2 * np.pi * f * time + f) for f in (0.4, 1.1, 2.0)) * (1 - np.exp(-((time / 0.5) ** 4)))
    found = corrected_command(late, late.axes, time, wanted[:, None])
    inside = (time > 0.5) & (time < 3.5)
    before, after = (float(np.abs(wanted - q[:, 0])[inside].max()) for q in (found.plain, found.position))
    assert after < 0.02 * before


@pytest.mark.parametrize(
    ("column", "value", "keys", "same", "usual"),
    [
        ("supply[V]", 9.0, {"supply": 12.0}, {"gain": 0.75 * KEYS["gain"]}, "12.0 V"),
        ("temperature[degC]", 36.85, {"coulomb": 0.1, "thermal": 0.05}, {"coulomb": 0.15}, "26.9 degC"),
    ],
)
def test_what_surrounds_a_motion_is_what_the_model_follows(
    tmp_path: Path, cli: Cli, column: str, value: float, keys: dict[str, float], same: dict[str, float], usual: str
) -> None:
    _, said, own = compensated(tmp_path, cli, KEYS | keys, **{column: np.full_like(TIME, value)})
    assert "assumed" not in said
    _, said, other = compensated(tmp_path, cli, KEYS | same, **{column: np.full_like(TIME, value)})
    assert f"{column} changes nothing" in said
    assert np.allclose(own["corrected"], other["corrected"], atol=1e-6)
    _, said, without = compensated(tmp_path, cli, KEYS | keys)
    assert f"has no column {column}, which the model follows: {usual} is assumed" in said
    assert np.abs(without["corrected"] - own["corrected"]).max() > 0.01


def test_a_motion_that_begins_with_a_speed_begins_at_rest(tmp_path: Path, cli: Cli) -> None:
    wanted = 0.3 + 0.5 * np.sin(3 * TIME)
    _, said, found = compensated(tmp_path, cli, KEYS | {"gravity_sin": 0.4}, **{"command1[rad]": wanted})
    assert "q1 begins with a speed, and the machine at rest" in said
    # It stands there although its weight takes a larger command.
    assert found["predicted"][0] == pytest.approx(0.3, abs=1e-4) and found["corrected"][0] > 0.35
    assert np.abs(found["predicted"] - wanted)[:5].max() > 10 * np.abs(found["predicted"] - wanted)[60:].max()
    assert "begins with" not in compensated(tmp_path, cli, KEYS)[1]
