"""Logs of a machine in motion: what is read of them, what is left out, and what is refused."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from motion.servo import write_log
from scipy.signal import lsim

from ccnn_torch.errors import InputError
from ccnn_torch.motion import diagnose_motion, load_logs, nominal_of
from ccnn_torch.motion.effects import motion_effects
from ccnn_torch.motion.setting import problem_of

Cli = Callable[..., tuple[int, str, str]]
DATA = Path(__file__).parents[2] / "experiments" / "data"


def test_a_file_that_cannot_be_is_refused_in_one_sentence(tmp_path: Path, cli: Cli) -> None:
    t = np.arange(0, 4, 0.01)
    u, w = np.sin(2 * t), 0.7 * np.sin(3.1 * t + 1)
    one = {"time[s]": t, "command1[rad]": u, "q1[rad]": 0.98 * u}
    both = {**one, "command2[rad]": w, "q2[rad]": w}
    swapped = both | {"q1[rad]": w, "q2[rad]": 0.98 * u}
    early = t[:260]
    bump = {lag: np.exp(-(((early - 1.0 - lag) / 0.3) ** 2)) for lag in (0.0, 0.5)}
    short = {"time[s]": early, "command1[rad]": bump[0.0], "q1[rad]": bump[0.5]}
    back = t.copy()
    back[50] = t[48]
    cases = {
        "time does not increase at line 52 (row 51)": one | {"time[s]": back},
        "its samples are 10 s apart, which shows no motion; if the times are in ms, write": one | {"time[s]": 1e3 * t},
        "q1 moves against command1; multiply one": one | {"q1[rad]": -0.98 * u},
        "one of them is in degrees and not in radians": one | {"q1[rad]": np.degrees(u)},
        "the columns of two joints are swapped": swapped,
        "the drive was off throughout": one | {"torque_on[1]": 0 * t},
        "too few; record at least 100 samples": {n: v[:80] for n, v in one.items()},
        "and the log lasts 2.59 s; record at least 3.9 s": short,
        "no command moves": one | {"command1[rad]": 0 * t},
        "q1 never moves while command1 does": one | {"q1[rad]": 0 * t},
        "there is no column 'q1'": {n: v for n, v in one.items() if n != "q1[rad]"},
        "rename its headers (pos), or say what each is: columns={'pos': 'q1[rad]'}": {
            n.replace("q1[rad]", "pos"): v for n, v in one.items()
        },
        "q1 has whole numbers up to 2048 rad, which are counts of an encoder; multiply it, and command1": {
            n: v if n == "time[s]" else np.round(2048 * v / np.abs(v).max()) for n, v in one.items()
        },
        "must be an angle or a length": {n.replace("q1[rad]", "q1[K]"): v for n, v in one.items()},
    }
    for sentence, columns in cases.items():
        path = tmp_path / "log.csv"
        rows = zip(*columns.values(), strict=True)
        path.write_text("\n".join([",".join(columns), *(",".join(f"{v:.12g}" for v in row) for row in rows)]) + "\n")
        code, _, error = cli("diagnose", "--motion", path, "--mechanism", "servo", "--out", tmp_path / "out")
        assert code == 2 and sentence in error and error.count("\n") == 1, (sentence, error)
        assert not (tmp_path / "out").exists()
    assert cli("diagnose", "--motion", path, "--out", tmp_path / "out")[0] == 2
    path = write_log(tmp_path / "log.csv", (0,))
    for model, sentence in {
        DATA / "ur10.yaml": "ur10.yaml: has 6 joints (rad, rad, rad, rad, rad, rad), and the logs 1 (rad)",
        "five_bar": "five_bar: has 2 joints (rad, rad), and the logs 1 (rad)",
        tmp_path / "none.xml": "none.xml",
        f"{tmp_path / 'none.py'}:SERVO": "there is no file",
    }.items():
        code, _, error = cli("diagnose", "--motion", path, "--mechanism", model, "--out", tmp_path / "out")
        assert code == 2 and sentence in error and error.count("\n") == 1, (sentence, error)
    with pytest.raises(InputError, match="'gian'; 'gain' is the nearest"):
        nominal_of("servo", {"gian": 2.0}, ["rad"])
    with pytest.raises(InputError, match="inertia is given without gain"):
        nominal_of("servo", {"inertia": 2.0}, ["rad"])
    with pytest.raises(InputError, match="no effect of motion 'delai'; 'delay' is the nearest"):
        diagnose_motion(
            load_logs([write_log(tmp_path / "fine.csv", (0,))]), nominal_of("servo", {}, ["rad"]), ["delai"]
        )


@pytest.mark.parametrize("both", [False, True])
def test_gaps_wrapped_counters_and_drives_that_are_off_are_left_out(tmp_path: Path, both: bool) -> None:
    t = np.arange(0, 6, 0.01)
    u = 2.5 * np.sin(2 * t) + 2
    q = u - 0.02
    pwm = 100 * (u - q) + np.sin(40 * t)
    q[200:260], pwm[200:260] = q[200] + 1.0, 0.0
    q = (q + np.pi) % (2 * np.pi) - np.pi
    keep = np.r_[0:480, 530:600]
    sent = (u + np.pi) % (2 * np.pi) - np.pi if both else u
    lines = ["time[s],command1[rad],q1[rad],pwm1[1]"]
    lines += [f"{t[k]},{sent[k]},{q[k]},{pwm[k]}" for k in keep]
    path = tmp_path / "log.csv"
    path.write_text("\n".join(lines) + "\n")
    log = load_logs([path])[0]
    said = " ".join(log.notes)
    assert "1 gap of 0.51 s in all, left out" in said and "the counter of q1 wrapped" in said
    assert "the drive was off for 0.6 s (pwm1" in said and int((~log.on).sum()) == 60
    assert np.allclose((log.position[:, 0] - u[keep])[log.on], -0.02)
    assert np.allclose(log.command[:, 0], u[keep]) and ("command1 wrapped" in said) == both
    # A command may jump by a turn, which the axis then follows.
    step = 2 * np.pi * (t > 3)
    rows = zip(t, step, step * (1 - np.exp(-5 * np.abs(t - 3))), strict=True)
    path.write_text("\n".join([lines[0].removesuffix(",pwm1[1]"), *(f"{a},{b},{c}" for a, b, c in rows)]) + "\n")
    assert np.allclose(load_logs([path])[0].command[:, 0], step)


def test_rows_of_a_run_need_not_be_adjacent(tmp_path: Path) -> None:
    path = write_log(tmp_path / "log.csv", (0, 1), 1.2)
    plain, (head, *rows) = load_logs([path]), path.read_text().splitlines()
    path.write_text("\n".join([head, *sorted(rows, key=lambda row: float(row.split(",")[0]))]) + "\n")
    mixed = load_logs([path])
    for one, other in zip(plain, sorted(mixed, key=lambda log: log.name), strict=True):
        assert one.name == other.name and np.array_equal(one.position, other.position)
        assert not one.notes and "they were gathered" in other.notes[0]


def test_a_log_that_is_thinned_keeps_the_commands_between_its_samples(tmp_path: Path) -> None:
    # A slide of 80 kg, sampled at 200 Hz, of which every other sample is evaluated: with straight lines between those
    # it would err by 14 um.
    time = np.arange(0, 3, 5e-4)
    asked = 0.1 * (1 - np.cos(2 * np.pi * time / 1.2))
    position = lsim(([1e6], [80.0, 7000.0, 1e6]), asked, time)[1]
    rows = np.stack([time, asked, position], -1)[::10]
    np.savetxt(tmp_path / "log.csv", rows, delimiter=",", header="time[s],command1[m],q1[m]", comments="")
    nominal = nominal_of("servo", {"gain": 1e6, "inertia": 80.0, "viscous": 7000.0}, ["m"])
    problem = problem_of(load_logs([tmp_path / "log.csv"]), nominal, motion_effects(["delay"]))
    left = problem.residual(torch.zeros(1, problem.library.size, dtype=torch.float64), problem.axes)
    assert float(left[:, problem.data.judged].square().mean().sqrt()) < 4e-6
