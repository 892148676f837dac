"""Whole commands beside `python -c "import torch"`, which each of them needs at least."""

from __future__ import annotations

import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

from benchmarks.measure import Row, compare

DATA = Path(__file__).resolve().parent.parent / "experiments" / "data"
UNIT = ["-c", "import torch"]
SIMULATED = "simulate --mechanism five_bar --effect compliance --effect joint_gain --rows 400 --noise 5e-6 --out R.csv"
COMMANDS = {
    "ccnn --help": "--help",
    "ccnn check, five-bar": "check --records R.csv --mechanism five_bar --quiet",
    "ccnn diagnose, five-bar": "diagnose --records R.csv --mechanism five_bar --out D --quiet",
    "ccnn diagnose, UR10": f"diagnose --records {DATA}/ur10_b_500.csv --mechanism {DATA}/ur10.yaml --out U --quiet",
}


def run(quick: bool, model: Path | None = None) -> Iterator[Row]:
    """Whole commands, each a process from its start to its end, its files included."""
    with tempfile.TemporaryDirectory() as folder:

        def process(*words: str) -> Callable[[], object]:
            return lambda: subprocess.run([sys.executable, *words], cwd=folder, check=True, stdout=subprocess.DEVNULL)

        process("-m", "ccnn_torch", *SIMULATED.split())()
        for name, command in list(COMMANDS.items())[: 1 if quick else None]:
            ours = process("-m", "ccnn_torch", *command.split())
            yield from compare(name, 1, "command", ours, {"import torch": process(*UNIT)}, rounds=1 if quick else 3)
