"""Print the README's tables from run folders: python experiments/readme_tables.py RUN_DIR …

A run on a case study gives a table of its own; runs on measured records are the rows of one table.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

from ccnn_torch.calibration.page.paper_tables import PAPER
from ccnn_torch.display import interval_text, number_text

Results = dict[str, Any]


def case_table(results: Results) -> str:
    """Mean squared error on held-out rows in 1e-10 m², beside the paper's figure for all joints."""
    joints = [joint["name"] for joint in results["joints"]]
    paper = PAPER[results["case"]].methods
    reach = results["reach"]["methods"]
    head = [
        "method",
        *joints,
        "all",
        "ratio to floor",
        "coverage of 95 %",
        "s",
        "s / evaluations to level",
        "paper, all",
    ]
    rows = []
    for name, block in results["methods"].items():
        effort = reach.get(name)
        rows.append(
            [
                name,
                *(interval_text(block["test"][joint]["mse"], 1e-10, 3) for joint in [*joints, "all"]),
                interval_text(block["ratio_to_floor"], 1, 3),
                interval_text(block["coverage"], 1, 3),
                number_text(block["seconds"]["median"], 2),
                "never" if effort is None else f"{effort['seconds']:.2g} / {effort['evaluations']:.0f}",
                number_text(paper[name][0][-1] / 1e-10, 3) if name in paper else "–",
            ]
        )
    floor = results["floor"]["realised"]
    rows.append(["floor", *(interval_text(floor[joint]["mse"], 1e-10, 3) for joint in [*joints, "all"]), *["–"] * 5])
    level = results["reach"]["level"] / 1e-10
    return f"{results['case']}, 1e-10 m², level {level:.3g}\n\n{table(head, rows)}"


def robot_row(results: Results, methods: list[str]) -> list[str]:
    """Held-out RMS of position [mm] and rotation [mrad], by method."""
    position, rotation = results["pose"]["position"], results["pose"]["rotation"]

    def both(first: Any, second: Any) -> str:
        return f"{1e3 * first['median']:.3f} / {1e3 * second['median']:.2f}"

    cells = [both(position[key]["rms"], rotation[key]["rms"]) for key in ("before", "geometry")]
    for name in methods:
        pose = results["methods"].get(name, {}).get("pose")
        cells.append("–" if not pose else both(pose["position"]["rms"], pose["rotation"]["rms"]))
    coverage = [results["methods"][name].get("coverage") for name in ("ccnn", "gp")]
    return [results["name"], *cells, " / ".join(number_text(c and c["median"], 3) for c in coverage)]


def table(head: list[str], rows: list[list[str]]) -> str:
    """A Markdown table."""
    return "\n".join("| " + " | ".join(line) + " |" for line in [head, ["---"] * len(head), *rows])


def main(folders: list[str]) -> None:
    runs = [json.loads((Path(folder) / "results.json").read_text()) for folder in folders]
    for results in runs:
        if results["records"] is None:
            print(case_table(results), end="\n\n")
    robots = [results for results in runs if results["records"] is not None]
    if robots:
        methods = list(robots[0]["methods"])
        head = ["mm / mrad", "frames", "geometry", *methods, "coverage ccnn / gp"]
        print(table(head, [robot_row(results, methods) for results in robots]))


if __name__ == "__main__":
    main(sys.argv[1:])
