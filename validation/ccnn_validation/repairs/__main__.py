"""Replay the repairs, and print and write the table."""

from __future__ import annotations

import argparse
import csv
from pathlib import Path
from tempfile import TemporaryDirectory

from ccnn_validation.repairs.arms import REPAIRS
from ccnn_validation.repairs.replay import Replay, replayed

HEADER = (
    "arm, repaired in",
    "people found",
    "the diagnosis says",
    "probability",
    "before → typed in [mm]",
    "of the promise",
    "outcome",
)


def line(found: Replay) -> tuple[str, ...]:
    """One row of the table."""
    repair, verdict = found.repair, found.content.get("verdict", {})
    sure = f"{verdict['probability']:.2f}" if verdict else "refused"
    moved = f"{found.before:.3g} → {found.typed:.2g}" if found.typed == found.typed else f"{found.before:.3g}"
    kept = f"{found.kept:.2f}" if found.kept == found.kept else "–"
    return f"{repair.name}, {repair.source}", repair.found, found.said, sure, moved, kept, found.outcome


def main() -> None:
    """Replay all of them, or those whose name holds a word."""
    options = argparse.ArgumentParser(prog="python -m ccnn_validation.repairs", description=__doc__)
    options.add_argument("--only", default="", help="repairs whose name holds this")
    options.add_argument("--seed", type=int, default=0, help="of joints and noise")
    options.add_argument("--out", type=Path, help="a CSV of the table")
    given = options.parse_args()
    rows = []
    for repair in (r for r in REPAIRS if given.only.lower() in r.name.lower()):
        with TemporaryDirectory() as folder:
            found = replayed(repair, Path(folder), given.seed)
        rows.append(line(found))
        print("\n  ".join([rows[-1][0], *(f"{h}: {c}" for h, c in zip(HEADER[1:], rows[-1][1:], strict=True))]))
        for number, error, interval, *enter in found.shown:
            print(f"    {number}: {error} {interval}; enter {enter[0] if enter else '–'}")
        print(f"  {found.seconds:.1f} s", flush=True)
    if given.out:
        with open(given.out, "w", encoding="utf-8", newline="") as file:
            csv.writer(file, lineterminator="\n").writerows([HEADER, *rows])


if __name__ == "__main__":
    main()
