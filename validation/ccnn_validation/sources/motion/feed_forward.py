"""Commands corrected by what was named, tried on the machine that they are for: a run that no diagnosis saw.

python -m ccnn_validation.sources.motion.feed_forward SEED [FAMILY ...]
"""

from __future__ import annotations

import sys
import zlib
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from ccnn_torch.motion import diagnose_motion, load_identified, load_logs, nominal_of, write_identified
from ccnn_torch.motion.compensate import compensate_motion
from ccnn_torch.records import read_table, write_table
from ccnn_validation.sources.motion.families import CAUSES, PAIRS
from ccnn_validation.sources.motion.records import log_of, machine_of

__all__ = ["tried"]

_HELD = 3


def tried(family: str, seed: int, effects: Sequence[str] | None = None) -> dict[str, object]:
    """RMS tracking error of the last motion [rad]: of the machine as it is and corrected, and as predicted.

    Args:
        family: of the source, one axis.
        seed: of the case.
        effects: candidates; None = all.
    """
    generator = np.random.default_rng([seed, zlib.crc32(family.encode())])
    machine = machine_of(family, generator)
    with TemporaryDirectory() as name:
        folder = Path(name)
        write_table(folder / "log.csv", log_of(machine, range(_HELD), generator))
        logs = load_logs([folder / "log.csv"])
        nominal = nominal_of("servo", machine.keys, ["rad"])
        found = diagnose_motion(logs, nominal, effects)
        write_identified(folder, found, nominal, machine.keys)
        time = np.arange(0, 8, 0.005)
        wanted = machine.commands[_HELD](time)
        write_table(folder / "wanted.csv", {"time[s]": time, "command1[rad]": wanted})
        compensate_motion(folder / "identified_motion.json", folder / "wanted.csv", folder / "sent.csv")
        table = read_table(folder / "sent.csv")
        sent, predicted = (table.column(n, "rad") for n in ("corrected1", "predicted1"))
        left = load_identified(folder / "identified_motion.json").left[0]
    plain, corrected = (machine.measure(time, u, _HELD)[0] for u in (wanted, sent))

    def rms(values: np.ndarray) -> float:
        return float(np.sqrt(np.square(values).mean()))

    return {
        "effects": found.content["verdict"]["effects"],
        "before": rms(wanted - plain),
        "after": rms(wanted - corrected),
        "predicted": float(np.hypot(rms(wanted - predicted), left)),
    }


def main() -> None:
    """Print one line for each family."""
    families = sys.argv[2:] or [*CAUSES, *("+".join(pair) for pair in PAIRS)]
    print("family | named | before | after | predicted [mrad]")
    for family in families:
        own = tried(family, int(sys.argv[1]))
        said = " | ".join(f"{1e3 * float(str(own[name])):.2f}" for name in ("before", "after", "predicted"))
        print(f"{family} | {own['effects']} | {said}", flush=True)


if __name__ == "__main__":
    main()
