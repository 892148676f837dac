"""Write docs/results.md and the README's table of results from the data files in docs/results/.

    python docs/make_results.py                            render docs/results.md and the README's table
    python docs/make_results.py --refresh NAME RUN_DIR …   first take the rows of the table NAME from these run folders

Each table is docs/results/NAME.csv: text cells as they are shown. `tables.json` has the title, the command, the repeats
and the origin of each, `page.md.in` the sentences between them.
"""

from __future__ import annotations

import csv
import datetime
import json
import re
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from ccnn_torch.calibration.page import paper_case
from ccnn_torch.display import number_text
from ccnn_torch.report.results.base import Spread, interval_text

Results = dict[str, Any]
Rows = list[list[str]]

ROOT = Path(__file__).parent.parent
DATA = ROOT / "docs" / "results"
PAGE = ROOT / "docs" / "results.md"
README = ROOT / "README.md"
_START, _END = "<!-- results: python docs/make_results.py -->\n", "<!-- end of results -->"


def read_rows(name: str) -> Rows:
    """The header and the rows of a table."""
    with open(DATA / f"{name}.csv", encoding="utf-8", newline="") as file:
        return list(csv.reader(file))


def write_rows(name: str, rows: Rows) -> None:
    """The header and the rows of a table, as a file."""
    with open(DATA / f"{name}.csv", "w", encoding="utf-8", newline="") as file:
        csv.writer(file, lineterminator="\n").writerows(rows)


def read_tables() -> dict[str, dict[str, str]]:
    """Title, command, repeats, date, commit and kind of each table, by its name."""
    return json.loads((DATA / "tables.json").read_text(encoding="utf-8"))  # type: ignore[no-any-return]


def markdown(rows: Rows) -> str:
    """A Markdown table; the first column holds words, the others are set flush right."""
    head, *body = ["| " + " | ".join(row) + " |" for row in rows]
    return "\n".join([head, "| --- |" + " ---: |" * (len(rows[0]) - 1), *body])


def render_table(name: str, about: dict[str, str]) -> str:
    """A table with its title above and its provenance below."""
    origin = [f"Command: {about['command']}", about["repeats"], f"Entered {about['date']}"]
    if about.get("commit"):
        origin[-1] += f" in commit {about['commit']}"
    return f"**{about['title']}**\n\n{markdown(read_rows(name))}\n\n*{'. '.join(origin)}.*"


def render_page() -> str:
    """docs/results.md: the sentences of page.md.in with the tables in their places."""
    tables = read_tables()
    page = (DATA / "page.md.in").read_text(encoding="utf-8")
    return re.sub(r"^\{\{ (\w+) \}\}$", lambda found: render_table(found[1], tables[found[1]]), page, flags=re.M)


def render_readme_table() -> str:
    """The README's table, six rows: the machine, the error before and after, what to compare it with."""

    def measured(name: str, rows: str, before: str, after: str, compare: str) -> list[str]:
        return [f"{name}, measured, {rows}: position RMS", f"{before} mm", f"{after} mm", compare]

    def tracker(name: str) -> list[str]:
        training, test = _cell("trackers", name, "training + test rows").split(" + ")
        before, after, geometry, published = (
            _cell("trackers", name, key) for key in ("before", "after", "geometry alone", "published")
        )
        compare = f"geometry alone {geometry} mm" + (f", published network {published} mm" if published != "–" else "")
        return measured(name, f"{training} rows, {test} test poses", before, after, compare)

    tripod = [
        _cell("tripod", *cell).split(" [")[0]
        for cell in (("constant", "all"), ("ccnn", "all"), ("floor", "all"), ("ccnn", "paper, all"))
    ]
    five_bar = next(row for row in read_rows("five_bar") if row[0].startswith("position error after compensation"))
    before = re.search(r"of ([\d.]+) mm", five_bar[0])
    assert before, five_bar[0]
    best = [_cell("suite_summary", method, "best or tied").split(" (")[0] for method in ("ccnn", "gp")]
    rows = [
        ["held-out error", "before", "after", "compare with"],
        tracker("UR10"),
        tracker("UR5"),
        tracker("WAM"),
        [
            "Tripod of the paper, simulated: joint MSE in 1e-10 m²",
            f"{tripod[0]} (constant)",
            tripod[1],
            f"noise floor {tripod[2]}, paper {tripod[3]}",
        ],
        [
            "Five-bar, simulated, geometry identified: position RMS",
            f"{before[1]} mm",
            f"{float(five_bar[1].split(' [')[0]) / 1e3:.3f} mm",
            f"standard deviation / Cramér-Rao bound {_cell('five_bar', 'σ / bound, 95 % intervals hold', 1)[:4]}",
        ],
        [
            f"{_cell('suite_summary', 'ccnn', 'cases')} cases of simulated machines with realistic errors",
            "–",
            f"CCNN best or tied in {best[0]}",
            f"Gaussian process in {best[1]}",
        ],
    ]
    return markdown(rows)


def _cell(table: str, row: str, column: str | int) -> str:
    """A cell by the first cell of its row and the header or number of its column."""
    head, *rows = read_rows(table)
    found = next((line for line in rows if line[0] == row), None)
    if found is None:
        sys.exit(f"docs/results/{table}.csv has no row {row!r}, which the README shows")
    return found[column if isinstance(column, int) else head.index(column)]


def _interval(block: Results | None, scale: float, digits: int) -> str:
    return interval_text(None if block is None else Spread.model_validate(block), scale, digits)


def case_rows(rows: Rows, runs: Sequence[Results]) -> Rows:
    """Mean squared error on held-out rows of a case study [1e-10 m²], beside the paper's for all joints."""
    (results,) = runs
    joints = [*(joint["name"] for joint in results["joints"]), "all"]
    paper, reach = (paper_case(results["case"]) or {})["methods"], (results["reach"] or {"methods": {}})["methods"]
    lines = []
    for name, block in results["methods"].items():
        effort = reach.get(name)
        lines.append(
            [
                name,
                *(_interval(block["test"][joint]["mse"], 1e-10, 3) for joint in joints),
                _interval(block["ratio_to_floor"], 1, 3),
                _interval(block["coverage"], 1, 3),
                number_text(block["seconds"]["median"], 2),
                ("–" if results["reach"] is None else "never")
                if effort is None
                else f"{effort['seconds']:.2g} / {effort['evaluations']:.0f}",
                number_text(paper[name]["mse"][-1] / 1e-10, 3) if name in paper else "–",
            ]
        )
    floor = results["floor"]["realised"]
    lines.append(["floor", *(_interval(floor[joint]["mse"], 1e-10, 3) for joint in joints), *["–"] * 5])
    return [rows[0], *lines]


def robot_rows(rows: Rows, runs: Sequence[Results]) -> Rows:
    """Held-out RMS of position [mm] and rotation [mrad], with frames alone, geometry, each method."""

    def both(pose: Results, key: str | None = None) -> str:
        first, second = (pose[part][key]["rms"] if key else pose[part]["rms"] for part in ("position", "rotation"))
        return f"{1e3 * first['median']:.3f} / {1e3 * second['median']:.2f}"

    for results in runs:
        cells = {"frames": both(results["pose"], "before")}
        if "geometry" in results["pose"]["position"]:
            cells["geometry"] = both(results["pose"], "geometry")
        identified = (results["geometry"] or {}).get("chosen") == "identify"
        for name, block in results["methods"].items():
            if block.get("pose"):
                cells[f"geometry + {name}" if identified else name] = both(block["pose"])
        rows = _with_cells(rows, results["name"], cells)
    return rows


def tracker_rows(rows: Rows, runs: Sequence[Results]) -> Rows:
    """Held-out RMS of the position [mm] of a run with defaults."""
    for results in runs:
        position = results["pose"]["position"]
        columns = {"before": "before", "geometry alone": "geometry", "after": "after"}
        cells = {column: number_text(1e3 * position[key]["rms"]["median"], 3) for column, key in columns.items()}
        rows = _with_cells(rows, results["name"], cells | {"chosen": results["best_method"]})
    return rows


def _with_cells(rows: Rows, name: str, cells: dict[str, str]) -> Rows:
    """The table with these cells in the row of this name, which is added where there is none."""
    head, *body = rows
    old = next((row for row in body if row[0] == name), [name, *["–"] * (len(head) - 1)])
    new = [cells.get(column, cell) for column, cell in zip(head, old, strict=True)]
    return [head, *(new if row is old else row for row in body), *([] if old in body else [new])]


REFRESH: dict[str, Callable[[Rows, Sequence[Results]], Rows]] = {
    "case": case_rows,
    "robots": robot_rows,
    "trackers": tracker_rows,
}


def refresh(name: str, folders: Sequence[str]) -> None:
    """Take a table's rows from run folders, and note the date and the commit."""
    tables = read_tables()
    kind = tables.get(name, {}).get("kind")
    if kind not in REFRESH:
        known = ", ".join(key for key, about in tables.items() if about.get("kind") in REFRESH)
        sys.exit(f"{name} is not taken from run folders; these tables are: {known}")
    runs = [json.loads((Path(folder) / "results.json").read_text(encoding="utf-8")) for folder in folders]
    write_rows(name, REFRESH[kind](read_rows(name), runs))
    commit = subprocess.run(["git", "rev-parse", "--short", "HEAD"], cwd=ROOT, capture_output=True, text=True)
    if reach := runs[0].get("reach"):
        tables[name]["title"] = re.sub(r"level \S+", f"level {reach['level'] / 1e-10:.3g}e-10", tables[name]["title"])
    tables[name] |= {"date": datetime.date.today().isoformat(), "commit": commit.stdout.strip()}
    (DATA / "tables.json").write_text(json.dumps(tables, indent=2, ensure_ascii=False) + "\n", encoding="utf-8")


def main(arguments: Sequence[str]) -> None:
    """Render; with --refresh NAME RUN_DIR … take new rows first."""
    if arguments and (arguments[0] != "--refresh" or len(arguments) < 3):
        sys.exit(__doc__)
    if arguments:
        refresh(arguments[1], arguments[2:])
    PAGE.write_text(render_page(), encoding="utf-8")
    before, _, rest = README.read_text(encoding="utf-8").partition(_START)
    README.write_text(f"{before}{_START}{render_readme_table()}\n{_END}{rest.partition(_END)[2]}", encoding="utf-8")


if __name__ == "__main__":
    main(sys.argv[1:])
