"""Replay the repairs, and print and write the table."""

from __future__ import annotations

import argparse
import csv
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

from ccnn_validation.repairs.arms import REPAIRS
from ccnn_validation.repairs.replay import Replay, replayed

HEADER = ("model, repaired in", "people found", "the diagnosis says", "probability", "before → typed in", "outcome")


def line(found: Replay) -> tuple[str, ...]:
    """One row of the table of arms."""
    repair, verdict = found.repair, found.content.get("verdict", {})
    sure = f"{verdict['probability']:.2f}" if verdict else "refused"
    said = found.said.partition("these rows: ")[2] or found.said
    if found.outcome == "in the frames":
        said, moved = f"{said} {found.frames}", "–"
    else:
        moved = f"{found.before:.3g} → {found.typed:.2g} mm"
    return f"{repair.name}, {repair.source}", repair.found, said, sure, moved, found.outcome


def arms(word: str, seed: int) -> list[tuple[str, ...]]:
    """Replay the arms whose name holds a word, and print each."""
    rows: list[tuple[str, ...]] = []
    for repair in (r for r in REPAIRS if word in r.name.lower()):
        with TemporaryDirectory() as folder:
            found = replayed(repair, Path(folder), seed)
        rows.append(line(found))
        _print(rows[-1], found.seconds)
        for number, error, interval, *enter in found.shown:
            print(f"    {number}: {error} {interval}; enter {enter[0] if enter else '–'}")
        if found.shown:
            print(f"    leaves {found.kept:.2f} times what is promised", flush=True)
    return rows


def axes(word: str, seed: int) -> list[tuple[str, ...]]:
    """Replay the axes whose name holds a word, and print each."""
    from ccnn_validation.repairs.motion import MOTION_REPAIRS, replayed_motion

    rows: list[tuple[str, ...]] = []
    for repair in (r for r in MOTION_REPAIRS if word in r.name.lower()):
        with TemporaryDirectory() as folder:
            found = replayed_motion(repair, Path(folder), seed)
        verdict = found.content["verdict"]
        said = ", ".join(found.numbers) or "; ".join(["nothing is named", *found.content["cautions"]])
        typed = "–" if found.typed != found.typed else f"{found.typed:.2g} mrad"
        moved = f"{found.before:.3g} → {typed}"
        sure = f"{verdict['probability']:.2f}"
        rows.append((f"{repair.name}, {repair.source}", repair.found, said, sure, moved, found.outcome))
        _print(rows[-1], found.seconds)
    return rows


def _print(row: Sequence[str], seconds: float) -> None:
    cells = (f"{head}: {cell}" for head, cell in zip(HEADER[1:], row[1:], strict=True))
    print("\n  ".join([f"{row[0]} ({seconds:.1f} s)", *cells]), flush=True)


def main() -> None:
    """Replay all of them, or those whose name holds a word."""
    options = argparse.ArgumentParser(prog="python -m ccnn_validation.repairs", description=__doc__)
    options.add_argument("--motion", action="store_true", help="repairs of motion (needs mujoco) in the place of arms")
    options.add_argument("--only", default="", help="repairs whose name holds this")
    options.add_argument("--seed", type=int, default=0, help="of joints and noise")
    options.add_argument("--out", type=Path, help="a CSV of the table")
    given = options.parse_args()
    rows = (axes if given.motion else arms)(given.only.lower(), given.seed)
    if given.out:
        with open(given.out, "w", encoding="utf-8", newline="") as file:
            csv.writer(file, lineterminator="\n").writerows([HEADER, *rows])


if __name__ == "__main__":
    main()
