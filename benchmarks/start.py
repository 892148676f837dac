"""Time of whole commands in units of `python -c "import torch"`: `python benchmarks/start.py [REPEATS]`.

Each command is a process from its start to its end, its files included; the unit is measured beside each of them, in
the same run, so that a busy machine slows both. Time is that of the processor, all threads together, and by the clock.
"""

from __future__ import annotations

import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

DATA = Path(__file__).resolve().parent.parent / "experiments" / "data"
UNIT = ["-c", "import torch"]
SIMULATED = "simulate --mechanism five_bar --effect compliance --effect joint_gain --rows 400 --noise 5e-6 --out R.csv"
COMMANDS = {
    "ccnn --help": "--help",
    "ccnn check, five-bar": "check --records R.csv --mechanism five_bar --quiet",
    "ccnn diagnose, five-bar": "diagnose --records R.csv --mechanism five_bar --out D --quiet",
    "ccnn diagnose, UR10": f"diagnose --records {DATA}/ur10_b_500.csv --mechanism {DATA}/ur10.yaml --out U --quiet",
}


def seconds(arguments: list[str], folder: str) -> tuple[float, float]:
    """Of the processor and by the clock, of one process."""
    before, start = os.times(), time.perf_counter()
    subprocess.run([sys.executable, *arguments], cwd=folder, check=True, stdout=subprocess.DEVNULL)
    clock, after = time.perf_counter() - start, os.times()
    return after.children_user + after.children_system - before.children_user - before.children_system, clock


def main(repeats: int) -> None:
    """Measure and print medians."""
    print(f"{'':26}{'processor s':>12}{'clock s':>9}{'processor / unit':>18}{'clock / unit':>14}")
    with tempfile.TemporaryDirectory() as folder:
        seconds(["-m", "ccnn_torch", *SIMULATED.split()], folder)
        for name, command in COMMANDS.items():
            pairs = [
                (seconds(["-m", "ccnn_torch", *command.split()], folder), seconds(UNIT, folder)) for _ in range(repeats)
            ]
            own = [statistics.median(mine[i] for mine, _ in pairs) for i in (0, 1)]
            ratio = [statistics.median(mine[i] / unit[i] for mine, unit in pairs) for i in (0, 1)]
            print(f"{name:26}{own[0]:12.2f}{own[1]:9.2f}{ratio[0]:18.2f}{ratio[1]:14.2f}")


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 3)
