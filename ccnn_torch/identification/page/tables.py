"""The tables of an identification, from `identified.json` alone: for the screen, Markdown and the HTML report."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from statistics import median
from typing import Any

from rich.console import Console

from ccnn_torch.display import count_text, display_unit, number_text
from ccnn_torch.identification.page.constraint import BEFORE_SAYS, constraint_table, holder
from ccnn_torch.identification.page.paper import paper_tables
from ccnn_torch.identification.pose_errors import figure_text
from ccnn_torch.report.csv_file import write_rows
from ccnn_torch.report.table import Table, markdown_table, print_table, print_text

Block = Mapping[str, Any]


def identified_verdict(results: Block) -> str:
    """One sentence: what the identified geometry does to the pose error on held-out poses."""
    judged = ((name, results["test"][name]) for name in ("position", "rotation"))
    # A test pose that the nominal machine does not reach leaves no figure of before.
    named = [(name, block) for name, block in judged if block and block["before"] is not None]
    if not named:
        return "The pose error could not be judged."
    method = results["method"]
    failed = not_settled(results)
    parts = []
    for name, block in named:
        parts.append(f"{name} {_with_unit(block, 'before')} → {_with_unit(block, 'after')} RMS")
    rows = count_text(results["rows"]["test"], "held-out pose")
    machines = f" of {results['machines']} machines" if results["machines"] > 1 else ""
    if "constraint" in results:
        rows = count_text(results["rows"]["test"], "held-out row")
        text = f"On {rows} {method} brings the tool nearer to where {holder(results)} it: "
    else:
        text = f"On {rows}{machines} {method} brings the predicted pose nearer to the measured one: "
    if results["methods"][method]["converged"] == 0:
        return f"{failed} Its error on {rows}{machines}: {', '.join(parts)}."
    text = f"{failed} {text}".lstrip() + ", ".join(parts)
    free = [p for p in results["parameters"].values() if p["free"]]
    lost = sum(not p["identifiable"] for p in free)
    text += f"; {len(free) - lost} of {len(free)} parameters are identified"
    return text + (f", {lost} are not determined by these rows." if lost else ".")


def not_settled(results: Block) -> str:
    """The sentence that comes first where the first method did not converge; empty where it did."""
    method, machines = results["method"], results["methods"][results["method"]]["machines"]
    failed = round((1 - results["methods"][method]["converged"]) * machines)
    if failed == 0:
        return ""
    if failed < machines:
        return f"{method} did not converge on {failed} of {machines} machines, which the standard deviations leave out."
    return f"{method} did not converge, so nothing is identified: the values are those where it stopped."


def identified_tables(results: Block) -> list[Table]:
    """All tables, in reading order."""
    tables = [
        _parameter_table(results),
        _method_table(results),
        _deviation_table(results),
        _transfer_table(results),
        constraint_table(results),
        _compensation_table(results),
        _count_table(results),
        *paper_tables(results),
    ]
    return [table for table in tables if table is not None]


def identified_markdown(results: Block) -> str:
    """Verdict and tables as Markdown (`identified.md`)."""
    parts = [f"# {results['name']}", identified_verdict(results), *unknown_sentences(results)]
    return "\n\n".join([*parts, *map(markdown_table, identified_tables(results)), *results["notes"]]) + "\n"


def print_identified(results: Block, console: Console) -> None:
    """Show the tables and the verdict on a terminal."""
    for table in identified_tables(results):
        print_table(table, console)
    for sentence in (*unknown_sentences(results), *results["notes"]):
        print_text(sentence, console, "yellow")
    print_text(identified_verdict(results), console, "bold")


def unknown_sentences(results: Block) -> list[str]:
    """What speaks against the figures, and which combinations of parameters the rows do not determine, as sentences."""
    found = results["combinations_not_identifiable"]
    said = [f"Not identifiable from these rows: {'; '.join(found)}."] if found else []
    return [*results.get("doubts", []), *said]


def _with_unit(block: Block, key: str) -> str:
    if block[key] is None:
        return "unknown"
    scale, unit = display_unit(block["unit"], block[key])
    return f"{number_text(block[key] / scale, 3)} {unit}"


def _shown_units(blocks: Sequence[Block]) -> dict[str, tuple[float, str]]:
    """For each SI unit the one that all its parameters are shown in: that of the usual size, or a larger one where a
    number would have more than five digits before the point."""
    units = {}
    for si in dict.fromkeys(block["unit"] for block in blocks):
        mine = [block for block in blocks if block["unit"] == si]
        moved = [abs(block["value"] - block["nominal"]) for block in mine]
        usual = median([block["sd"] or move for block, move in zip(mine, moved, strict=True)])
        scale, unit = display_unit(si, max(usual, 1e-6))
        largest = max(moved)
        units[si] = display_unit(si, largest) if largest / scale >= 1e5 else (scale, unit)
    return units


def _parameter_table(results: Block) -> Table:
    simulated = results["simulated"]
    lost = "not identifiable" if results["methods"][results["method"]]["converged"] else "–"
    units = _shown_units([block for block in results["parameters"].values() if block["free"]])
    rows = []
    for name, block in results["parameters"].items():
        if not block["free"]:
            continue
        scale, unit = units[block["unit"]]
        sd = figure_text(block, "sd", scale) if block["identifiable"] else lost
        nominal = f"{number_text(block['nominal'], 6)} {block['unit']}".removesuffix(" 1")
        cells = [f"{name} [{unit}]", nominal]
        if simulated:
            cells += [figure_text(block, "error_before", scale), figure_text(block, "deviation", scale)]
        else:
            cells.append(number_text((block["value"] - block["nominal"]) / scale, 4))
        cells.append(sd)
        if "sd_bootstrap" in block:
            cells.append(number_text(block["sd_bootstrap"] / scale, 3))
        rows.append(tuple(cells))
    columns = ["parameter", "nominal"]
    columns += ["|true - nominal|", "|true - identified|"] if simulated else ["identified - nominal"]
    columns.append("standard deviation")
    bootstrapped = any("sd_bootstrap" in p for p in results["parameters"].values())
    columns += ["by bootstrap"] * bootstrapped
    several = results["machines"] > 1
    note = f"By {results['method']}." + " Medians over the machines, [5 %, 95 %]." * several
    note += f" {_interval_note(results)}"
    return Table("Parameters", tuple(columns), tuple(rows), note, details=("nominal",))


def _interval_note(results: Block) -> str:
    """What a standard deviation is worth here."""
    if results["methods"][results["method"]]["converged"] == 0:
        return "Without convergence there are no standard deviations."
    if results.get("doubts"):
        return "Standard deviations are for rows that fit the model and the noise, which these do not."
    return "95 % of intervals of ±1.96 standard deviations hold the true value, if the geometry is all that is wrong."


def _method_table(results: Block) -> Table:
    tests = [block["test"] for block in results["methods"].values()]
    scales = {
        name: {key: _shared_unit([test[name] for test in tests], key) for key in ("before", "after", "max_after")}
        for name in ("position", "rotation")
        if results["test"][name] is not None
    }
    rows = []
    for method, block in results["methods"].items():
        cells = [method + (" (leg by leg)" if block["per_leg"] else "")]
        for name, keyed in scales.items():
            cells += [figure_text(block["test"][name], key, scale) for key, (scale, _) in keyed.items()]
        cells += [str(block["machines"]), f"{100 * block['converged']:.0f} %", number_text(block["seconds"], 3)]
        rows.append(tuple(cells))
    columns = ["method"]
    details = ["machines", "converged", "time [s]"]
    for name, keyed in scales.items():
        words = {"before": "before", "after": "after", "max_after": "maximum after"}
        columns += [f"{name} {words[key]} [{unit}]" for key, (_, unit) in keyed.items()]
        details += columns[-1:]
    columns += ["machines", "converged", "time [s]"]
    noise = results["test"]["position"] or {}
    note = "RMS distance of held-out measured poses from the predicted ones."
    if "constraint" in results:
        note = f"RMS distance of held-out rows from where {holder(results)} the tool. {BEFORE_SAYS}"
    if noise.get("noise") is not None:
        scale, unit = display_unit("m", noise["noise"])
        note += f" The measurement noise alone is {number_text(noise['noise'] / scale, 3)} {unit} in position."
    return Table("Held-out pose error", tuple(columns), tuple(rows), note, details=tuple(details))


def _shared_unit(blocks: Sequence[Block | None], key: str) -> tuple[float, str]:
    """The unit that a column shows a figure of several methods in: that of the smallest."""
    known = [block for block in blocks if block is not None and block.get(key)]
    if not known:
        return 1.0, next((block["unit"] for block in blocks if block is not None), "1")
    return display_unit(known[0]["unit"], min(block[key] for block in known))


def _transfer_table(results: Block) -> Table | None:
    if "transfer" not in results:
        return None
    block = results["transfer"]
    rows = []
    for name in ("position", "rotation"):
        test = block["test"][name]
        if test is not None:
            scale, unit = display_unit(test["unit"], test["before"] or 1.0)
            keys = ("before", "after", "max_before", "max_after")
            rows.append((f"{name} [{unit}]", *(figure_text(test, key, scale) for key in keys)))
    columns = ("error", "nominal links", "identified links", "maximum, nominal", "maximum, identified")
    note = (
        f"RMS distance of {count_text(block['rows']['test'], 'held-out pose')} of {block['records']} from the "
        f"predicted ones; frames fitted to {count_text(block['rows']['train'], 'other row')} of it, links to none."
    )
    return Table("The same arm elsewhere", columns, tuple(rows), note)


def _deviation_table(results: Block) -> Table | None:
    if not results["simulated"]:
        return None
    found = [block["deviations"] for block in results["methods"].values()]
    scales = {
        unit: _shared_unit([{"unit": unit, **block[unit]} for block in found], "largest")
        for unit in ("m", "rad", "1")
        if unit in found[0]
    }
    rows = []
    for method, block in results["methods"].items():
        cells = [method]
        for unit, (scale, _) in scales.items():
            cells += [figure_text(block["deviations"][unit], key, scale) for key in ("largest", "mean")]
        bound = block["bound"]
        cells.append(number_text(bound["median"], 3) if bound else "–")
        cells.append(f"{number_text(bound['lowest'], 3)} to {number_text(bound['highest'], 3)}" if bound else "–")
        cells.append("–" if block["coverage"] is None else f"{100 * block['coverage']:.1f} %")
        rows.append(tuple(cells))
    columns = ["method"]
    details = ["range of σ / bound"]
    for unit, (_, shown) in scales.items():
        kind = {"m": "lengths", "rad": "angles"}.get(unit, "gains")
        columns += [f"{kind}: maximum [{shown}]", f"{kind}: mean [{shown}]"]
        details += columns[-1:]
    columns += ["σ / bound", "range of σ / bound", "95 % intervals hold"]
    note = (
        "Deviation of identified from true parameters, median over machines. Bound: the Cramér-Rao bound of the same "
        "rows and noise; the standard deviation over the machines divided by it, median over the parameters."
    )
    return Table("Deviation of the parameters", tuple(columns), tuple(rows), note, details=tuple(details))


def _compensation_table(results: Block) -> Table | None:
    found = {
        f"{method}, {kind}": block["compensation"][kind]
        for method, block in results["methods"].items()
        for kind in ("exact", "linear")
        if (block["compensation"] or {}).get(kind)
    }
    if not found:
        return None
    scales = {
        name: _shared_unit(blocks, "after")
        for name in ("position", "rotation")
        if any(blocks := [block[name] for block in found.values()])
    }
    columns = ["commands"]
    for name, (_, unit) in scales.items():
        columns += [f"{name} after [{unit}]", f"{name} removed [%]"]
    rows = [
        (
            label,
            *(
                cell
                for name, (scale, _) in scales.items()
                for cell in (figure_text(block[name], "after", scale), figure_text(block[name], "removed", 0.01, 4))
            ),
        )
        for label, block in found.items()
    ]
    note = (
        "RMS pose error of the simulated machines at held-out poses, commanded by the identified geometry: exact = "
        "real inverse kinematics; linear = nominal joints corrected by the identification Jacobian (Sun et al. 2018, "
        "eq. 15)."
    )
    return Table("Compensation with the identified geometry", tuple(columns), tuple(rows), note)


def _count_table(results: Block) -> Table | None:
    if not results["counts"]:
        return None
    methods = list(results["counts"][0]["methods"])
    rows = []
    for entry in results["counts"]:
        cells = [str(entry["poses"])]
        for method in methods:
            cells.append(figure_text(entry["methods"][method], "position", 1e-3))
        rows.append(tuple(cells))
    note = "RMS position error [mm] of the machines under exact commands, by the number of poses measured."
    return Table("Measurements needed", ("poses", *methods), tuple(rows), note)


_HEADER = ("subject", "name", "quantity", "unit", "value", "low", "high")
Row = tuple[str, str, str, str, float | None, float | None, float | None]


def _rows(results: Block) -> Iterator[Row]:
    def of(subject: str, name: str, block: Block, unit: str, keys: tuple[str, ...], prefix: str = "") -> Iterator[Row]:
        for key in keys:
            if key in block:
                low, high = block.get("spread", {}).get(key, (None, None))
                yield subject, name, prefix + key, unit, block[key], low, high

    for name, block in results["parameters"].items():
        yield from of(
            "parameter", name, block, block["unit"], ("nominal", "value", "sd", "true", "error_before", "deviation")
        )
    for method, block in results["methods"].items():
        for part in ("position", "rotation"):
            test = block["test"][part]
            if test is not None:
                keys = ("before", "after", "max_before", "max_after", "noise")
                yield from of("method", method, test, test["unit"], keys, f"{part}_")
        for unit, found in (block["deviations"] or {}).items():
            yield from of("method", method, found, "1" if unit == "share" else unit, ("largest", "mean"), f"{unit}_")
        for kind, found in (block["compensation"] or {}).items():
            for part in ("position", "rotation"):
                if found[part] is not None:
                    yield from of("method", method, found[part], found[part]["unit"], ("after",), f"{kind}_{part}_")
                    yield from of("method", method, found[part], "1", ("removed",), f"{kind}_{part}_")
        yield "method", method, "seconds", "s", block["seconds"], None, None
    for part in ("position", "rotation"):
        test = results.get("transfer", {}).get("test", {}).get(part)
        if test is not None:
            sizes = ("before", "after", "max_before", "max_after")
            yield from of("transfer", results["transfer"]["records"], test, test["unit"], sizes, f"{part}_")
    for name, block in results.get("constraint", {}).get("unknowns", {}).items():
        yield from of("constraint", name, block, block["unit"], ("value", "sd"))


def write_identified_csv(path: str | Path, results: Block) -> None:
    """Write `identified.csv`: every figure as one tidy row, in SI, 17 significant digits; an unknown one is empty."""
    write_rows(path, _HEADER, _rows(results))
