"""Thin the logs of one servo to every second row, as they are shipped.

python experiments/data/choose_motion.py FOLDER_OF_LOGS experiments/data
"""

from __future__ import annotations

import sys
from pathlib import Path

LOGS = ("sin_sin_kp400", "up_and_down_kp400", "sin_time_square_kp400")
COLUMNS = ("time[s]", "command1[rad]", "q1[rad]", "pwm1[1]", "supply[V]", "torque_on[1]")


def main() -> None:
    """Write `servo_NAME.csv` for each log."""
    source, target = Path(sys.argv[1]), Path(sys.argv[2])
    for name in LOGS:
        header, *rows = (source / f"{name}.csv").read_text().splitlines()
        places = [header.split(",").index(column) for column in COLUMNS]
        lines = [",".join(COLUMNS)] + [",".join(row.split(",")[p] for p in places) for row in rows[::2]]
        short = name.removesuffix("_kp400")
        (target / f"servo_{short}.csv").write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
