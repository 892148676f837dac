"""Diagnosis of motion from logs; SciPy and mujoco.sysid on the two true effects, which they have to be told."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch
from scipy.optimize import least_squares

from benchmarks.measure import Row, compare
from benchmarks.motion_sysid import Fit, sysid_fit
from ccnn_torch.motion import diagnose_motion, load_logs, nominal_of
from ccnn_torch.motion.axis import Drive, simulate_axes
from ccnn_torch.motion.effects import motion_effects
from ccnn_torch.motion.setting import problem_of

KEYS = {"gain": 2.0, "inertia": 0.004, "viscous": 0.09}
REAL = {"inertia": 0.002, "viscous": 0.045, "coulomb": 0.05, "delay": 0.03}


def write_log(path: Path, samples: int) -> None:
    """Runs of 10 s at 200 Hz of an axis with a delay and dry friction that the model lacks."""
    generator = np.random.default_rng(0)
    runs = samples // 2000
    time_ = torch.arange(2000, dtype=torch.float64).expand(runs, -1) / 200
    rates, phases = (torch.from_numpy(generator.uniform(low, high, (runs, 3, 1))) for low, high in ((1, 9), (0, 6)))
    command = 0.3 * torch.sin(rates * time_[:, None] + phases).sum(1)
    start = torch.stack([command[:, 0], torch.zeros(runs, dtype=torch.float64)], -1)
    drive = Drive(time_, command, start)
    position = simulate_axes(drive, {n: torch.tensor([[v]], dtype=torch.float64) for n, v in REAL.items()})[0]
    noise = 1e-4 * torch.from_numpy(generator.standard_normal(position.shape))
    run = torch.arange(runs, dtype=torch.float64)[:, None].expand(-1, 2000)
    table = torch.stack([time_, run, command, position + noise], -1).reshape(-1, 4).numpy()
    np.savetxt(path, table, delimiter=",", header="time[s],run[1],command1[rad],q1[rad]", comments="")


def run(quick: bool, model: Path | None = None) -> Iterator[Row]:
    """Logs read and diagnosed; the peers fit the numbers of the two true effects, and nothing else."""
    nominal = nominal_of("servo", KEYS, ["rad"])
    with TemporaryDirectory() as folder:
        for samples in (2000,) if quick else (10_000, 100_000, 1_000_000):
            path = Path(folder) / f"{samples}.csv"
            write_log(path, samples)
            found = _diagnose(path, nominal).content
            peers = fits(load_logs([path]), nominal) if samples <= 10_000 else {}
            rows = compare(
                "diagnose a servo in motion",
                samples,
                "samples",
                partial(_diagnose, path, nominal),
                peers,
                rounds=1,
                note=f"named: {', '.join(found['verdict']['effects']) or 'none'}",
            )
            for row in rows:
                if row.peer:
                    delay, friction = peers[row.peer]()
                    row = replace(row, note=f"{row.note}; the peer's {1e3 * delay:.2f} ms, {1e3 * friction:.1f} mN m")
                yield row


def _diagnose(path: Path, nominal: Any) -> Any:
    return diagnose_motion(load_logs([path]), nominal)


def fits(logs: Any, nominal: Any) -> dict[str, Fit]:
    """The peers; mujoco.sysid where it is installed, at steps of the log's own and of a fifth."""
    return {"SciPy, the true effects alone": scipy_fit(logs, nominal)} | {
        f"mujoco.sysid, the true effects alone, steps of {1e3 * step:g} ms": fit
        for step in (0.005, 0.001)
        if (fit := sysid_fit(logs, KEYS, step)) is not None
    }


def scipy_fit(logs: Any, nominal: Any) -> Fit:
    """`least_squares` on the same residual."""
    problem = problem_of(logs, nominal, motion_effects(["delay", "coulomb"]))
    zero = torch.zeros(1, problem.library.size, dtype=torch.float64)

    def residual(values: np.ndarray) -> np.ndarray:
        theta = zero.clone()
        theta[0, :3] = torch.from_numpy(values)
        return problem.pooled(problem.residual(theta, problem.axes))[0][problem.judged].numpy()

    bounds = ([0.0, 0.0, 0.0], [10.0, 10.0, 4.0])
    late, rub, _ = (number.scale for number in problem.library.numbers[0])

    def fit() -> tuple[float, float]:
        found = least_squares(residual, np.full(3, 0.3), bounds=bounds, diff_step=1e-4).x
        # Torques are over the gain.
        return found[0] * late, found[1] * rub * KEYS["gain"]

    return fit
