"""Seconds of a diagnosis of motion for logs of 1e4 and 1e6 samples, and of SciPy on the numbers that it names.

python benchmarks/motion.py
"""

from __future__ import annotations

import sys
import time
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import torch
from scipy.optimize import least_squares

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
    drive = Drive(time_, command, start, torch.zeros_like(time_), torch.zeros_like(time_))
    position = simulate_axes(drive, {n: torch.tensor([[v]], dtype=torch.float64) for n, v in REAL.items()})[0]
    noise = 1e-4 * torch.from_numpy(generator.standard_normal(position.shape))
    run = torch.arange(runs, dtype=torch.float64)[:, None].expand(-1, 2000)
    table = torch.stack([time_, run, command, position + noise], -1).reshape(-1, 4).numpy()
    np.savetxt(path, table, delimiter=",", header="time[s],run[1],command1[rad],q1[rad]", comments="")


def main() -> None:
    """Print one line for each size, and one for SciPy."""
    torch.set_num_threads(1)
    nominal = nominal_of("servo", KEYS, ["rad"])
    with TemporaryDirectory() as folder:
        for samples in [int(float(s)) for s in sys.argv[1:]] or [10_000, 1_000_000]:
            path = Path(folder) / "log.csv"
            write_log(path, samples)
            began = time.process_time()
            logs = load_logs([path])
            read = time.process_time() - began
            found = diagnose_motion(logs, nominal).content
            took = time.process_time() - began
            print(f"{samples} samples: {took:.1f} s of CPU, {read:.1f} of them reading; {found['verdict']['effects']}")
        logs = load_logs([path]) if samples <= 20_000 else logs[:5]
    problem = problem_of(logs, nominal, motion_effects(["delay", "coulomb"]))
    zero = torch.zeros(1, 1, problem.library.size, dtype=torch.float64)

    def residual(values: np.ndarray) -> np.ndarray:
        theta = zero.clone()
        theta[0, 0, :3] = torch.from_numpy(values)
        return problem.pooled(problem.residual(theta))[0, 0][problem.judged].numpy()

    began = time.process_time()
    bounds = ([0.0, 0.0, 0.0], [10.0, 10.0, 4.0])
    fit = least_squares(residual, np.full(3, 0.3), bounds=bounds, diff_step=1e-4)
    names = [n.name for n in problem.library.numbers[0]]
    sizes = [n.scale for n in problem.library.numbers[0]]
    values = ", ".join(f"{n} {v * s:.4g}" for n, v, s in zip(names, fit.x, sizes, strict=True))
    print(f"SciPy, these three numbers alone: {time.process_time() - began:.1f} s, {fit.nfev} steps; {values}")


if __name__ == "__main__":
    main()
