"""Which constants of the diagnosis its verdicts depend on: `python -m ccnn_validation.ablation --help`.

Each constant of the table in docs/explanation/diagnosis_constants.md is halved and doubled, one line of the table at a
time, and the same cases are diagnosed again. A constant that changes no verdict either way is not tuned: it could be
anything near, and a reader need not weigh it.
"""

from __future__ import annotations

import argparse
import importlib
import re
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from itertools import islice, product
from pathlib import Path
from typing import Any

from ccnn_torch.engine import Job, run_jobs
from ccnn_torch.errors import CcnnError, InputError
from ccnn_torch.files.write import write_whole
from ccnn_torch.report.json_files import read_json, write_json
from ccnn_torch.report.screen import note, stdout
from ccnn_torch.report.table import Table, markdown_table, print_table
from ccnn_validation.sources.judge import judged
from ccnn_validation.sources.run import diagnosed, source_of

__all__ = ["ablate", "scaled"]

_TABLE = Path(__file__).parents[2] / "docs" / "explanation" / "diagnosis_constants.md"
_LINE = re.compile(r"\| `(?P<module>[\w/]+)` \| `(?P<names>[\w, ]+)` \|.*\| (?P<source>[^|]+) \|$", re.MULTILINE)
_FACTORS = (0.5, 2.0)
# Module and names of the constants of one line of the table.
_Constants = tuple[str, tuple[str, ...]]


def ablate(
    sources: Sequence[str], cases: int, out: Path, seed: int = 2000, which: str = "tuned", engine: str = "processes"
) -> Table:
    """Right verdicts, and verdicts that change, for each constant halved and doubled; finished ones are kept.

    Args:
        sources: of `ccnn_validation.sources.run.SOURCES`, other than `motion`.
        cases: of each source; of one seed each family first.
        out: folder to write, with one file for each constant and factor.
        seed: of the first cases. Not one whose figures are reported.
        which: text that the constant's source in the table contains; "" = all.
        engine: where they are diagnosed: `local`, `processes`, `dask`, or a scheduler's address.

    Raises:
        InputError: an unknown source, or no constant of that kind.
    """
    wanted = [(s, f, n) for s in sources for f, n in islice(_cases(s, seed), cases)]
    lines = [
        (m["module"], tuple(m["names"].split(", ")))
        for m in _LINE.finditer(_TABLE.read_text(encoding="utf-8"))
        if which in m["source"]
    ]
    if not lines:
        raise InputError(f"--which: no constant of {_TABLE.name} has a source with '{which}'")
    out.mkdir(parents=True, exist_ok=True)
    runs: list[tuple[_Constants | None, float]] = [(None, 1.0), *product(lines, _FACTORS)]
    files = {run: out / f"{_name(run[0]).replace('/', '.')}-{run[1]:g}.json" for run in runs}
    jobs = [Job(f"{_name(c)} times {f:g}", files[c, f], partial(_one, (c, f), wanted, files[c, f])) for c, f in runs]
    failed = run_jobs(jobs, engine, note)
    if failed:
        raise InputError(f"{len(failed)} of {len(jobs)} runs failed: {next(iter(failed.values())).text}")
    found = {run: read_json(path)["cases"] for run, path in files.items()}
    usual = found[None, 1.0]
    rows = [(_name(line), *(text for f in _FACTORS for text in _against(usual, found[line, f]))) for line in lines]
    right = f"{sum(case['right'] for case in usual)} of {len(usual)} are right as it is."
    heads = ("constant", "halved: right", "verdicts that change", "doubled: right", "verdicts that change")
    return Table("Constants of the diagnosis, one line of their table at a time", heads, tuple(rows), right)


def scaled(value: Any, factor: float) -> Any:
    """A constant times a factor: of a probability between ½ and 1 the distance to 1, of numbers to count at least 1."""
    if isinstance(value, tuple):
        return tuple(scaled(v, factor) for v in value)
    if isinstance(value, int):
        return max(1, round(value * factor))
    return 1 - (1 - value) / factor if 0.5 < value < 1 else value * factor


@contextmanager
def _changed(constants: _Constants, factor: float) -> Iterator[None]:
    module, names = constants
    home = importlib.import_module("ccnn_torch." + module.replace("/", "."))
    before = {name: getattr(home, name) for name in names}
    # A module that took a public one from another has it under a name of its own.
    others = [module for key, module in sys.modules.items() if key.startswith("ccnn_torch.") and module is not home]
    taken = [(m, n) for m in others for n in names if not n.startswith("_") and getattr(m, n, None) == before[n]]
    places = [*((home, name) for name in names), *taken]
    try:
        for place, name in places:
            setattr(place, name, scaled(before[name], factor))
        yield
    finally:
        for place, name in places:
            setattr(place, name, before[name])


def _one(run: tuple[_Constants | None, float], wanted: Sequence[tuple[str, str, int]], path: Path) -> str:
    constants, factor = run
    if constants is None:
        found = [_verdict(*case) for case in wanted]
    else:
        with _changed(constants, factor):
            found = [_verdict(*case) for case in wanted]
    write_json(path, {"cases": found})
    return f"{sum(case['right'] for case in found)} of {len(found)} right"


def _verdict(source: str, family: str, seed: int) -> dict[str, Any]:
    case = source_of(source).make(family, seed)
    answer = diagnosed(case, case.columns)
    baseline = None if case.baseline is None else diagnosed(case, case.baseline)
    found = judged(case.truth, answer, baseline)
    return {"right": found["right"], "said": [found.get(key) for key in ("names", "drivers", "failed")]}


def _against(usual: Sequence[dict[str, Any]], other: Sequence[dict[str, Any]]) -> tuple[str, str]:
    changed = sum(a["said"] != b["said"] for a, b in zip(usual, other, strict=True))
    return str(sum(case["right"] for case in other)), str(changed)


def _cases(source: str, seed: int) -> Iterator[tuple[str, int]]:
    while True:
        yield from ((family, seed) for family in source_of(source).FAMILIES)
        seed += 1


def _name(constants: _Constants | None) -> str:
    return "none" if constants is None else f"{constants[0]} {', '.join(constants[1])}"


def _main() -> None:
    parser = argparse.ArgumentParser(prog="python -m ccnn_validation.ablation", description=__doc__)
    parser.add_argument("--source", nargs="+", default=["adversarial", "multibody"], help="sources of the cases")
    parser.add_argument("--cases", type=int, default=40, help="of each source (40)")
    parser.add_argument("--seed", type=int, default=2000, help="of the first cases (2000)")
    parser.add_argument("--which", default="tuned", help="text in the constant's source in the table ('tuned')")
    parser.add_argument("--engine", default="processes", help="local, processes, dask, or a scheduler's address")
    parser.add_argument("--out", type=Path, required=True, help="folder to write; finished runs in it are kept")
    given = parser.parse_args()
    try:
        table = ablate(given.source, given.cases, given.out, given.seed, given.which, given.engine)
    except CcnnError as problem:
        sys.exit(f"ablation: {problem}")
    print_table(table, stdout)
    write_whole(given.out / "ablation.md", markdown_table(table) + "\n")


if __name__ == "__main__":
    _main()
