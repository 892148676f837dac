"""Diagnosis of motion from logs, and SciPy on the numbers that it names."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch
from scipy.optimize import least_squares

from benchmarks.measure import Row, compare
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
    """Logs read and diagnosed; SciPy fits the three numbers of the two true effects, and nothing else."""
    nominal = nominal_of("servo", KEYS, ["rad"])
    with TemporaryDirectory() as folder:
        for samples in (2000,) if quick else (10_000, 100_000, 1_000_000):
            path = Path(folder) / f"{samples}.csv"
            write_log(path, samples)
            found = diagnose_motion(load_logs([path]), nominal).content
            yield from compare(
                "diagnose a servo in motion",
                samples,
                "samples",
                lambda p=path: diagnose_motion(load_logs([p]), nominal),
                {"SciPy, the true effects alone": scipy_fit(load_logs([path]), nominal)} if samples <= 10_000 else None,
                rounds=1,
                note=f"named: {', '.join(found['verdict']['effects']) or 'none'}",
            )


def scipy_fit(logs: Any, nominal: Any) -> Callable[[], object]:
    """`least_squares` on the same residual."""
    problem = problem_of(logs, nominal, motion_effects(["delay", "coulomb"]))
    zero = torch.zeros(1, problem.library.size, dtype=torch.float64)

    def residual(values: np.ndarray) -> np.ndarray:
        theta = zero.clone()
        theta[0, :3] = torch.from_numpy(values)
        return problem.pooled(problem.residual(theta, problem.axes))[0][problem.judged].numpy()

    bounds = ([0.0, 0.0, 0.0], [10.0, 10.0, 4.0])
    return lambda: least_squares(residual, np.full(3, 0.3), bounds=bounds, diff_step=1e-4)
