"""Draw machines, calibrate them by the program, and print what the true machines reach."""

from __future__ import annotations

import argparse
from pathlib import Path

from ccnn_validation.delivered.judge import Figures, judged
from ccnn_validation.delivered.kinds import KINDS, draw
from ccnn_validation.delivered.product import COMMANDS, FORMS
from ccnn_validation.delivered.report import line, summary, write_csv


def main() -> None:
    """Judge machines of each kind, the seeds counted from `--seed`."""
    options = argparse.ArgumentParser(prog="python -m ccnn_validation.delivered", description=__doc__)
    options.add_argument("--seed", type=int, required=True, help="of the first machine of each kind")
    options.add_argument("--machines", default=",".join(KINDS), help="kinds; all by default: %(default)s")
    options.add_argument("--each", type=int, default=1, help="machines of each kind")
    options.add_argument("--rows", type=int, default=200, help="measured rows of a machine")
    options.add_argument("--tests", type=int, default=150, help="rows of each test set")
    options.add_argument("--command", choices=COMMANDS, default="run")
    options.add_argument("--forms", default="safetensors", help=f"of {','.join(FORMS)}; the first one is summed up")
    options.add_argument("--set", dest="keys", action="append", default=[], metavar="KEY=VALUE", help="for the program")
    options.add_argument("--plain", action="store_true", help="geometry, zeros and gears only")
    options.add_argument("--out", type=Path, required=True)
    given = options.parse_args()
    kinds, forms = given.machines.split(","), given.forms.split(",")
    for name, known in ((kinds, KINDS), (forms, FORMS)):
        if unknown := [one for one in name if one not in known]:
            options.error(f"'{unknown[0]}' is not known; known: {', '.join(known)}")
    rows: list[Figures] = []
    given.out.mkdir(parents=True, exist_ok=True)
    for kind in kinds:
        for seed in range(given.seed, given.seed + given.each):
            machine = draw(kind, seed, () if given.plain else None)
            folder = given.out / f"{kind}_{seed}"
            rows.append(judged(machine, given.rows, given.tests, given.command, forms, given.keys, folder))
            print(line(rows[-1], forms), flush=True)
            write_csv(given.out / "machines.csv", rows)
    text = summary(rows, forms[0])
    (given.out / "summary.txt").write_text(text + "\n")
    print(text)


if __name__ == "__main__":
    main()
