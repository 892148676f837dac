"""The page of an identification, from `identified.json` alone: for the screen, Markdown and the HTML report."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from statistics import median
from typing import Any

from ccnn_torch.compensation.targets.machines import klipper_numbers
from ccnn_torch.display import count_text, display_unit, number_text, own_unit, to_enter, with_unit
from ccnn_torch.files.write import write_rows
from ccnn_torch.identification.judge import figure_text
from ccnn_torch.plugins import permission
from ccnn_torch.records.formats.klipper import STEPPERS
from ccnn_torch.report.arrays import ARRAYS_FILE, load_tensors
from ccnn_torch.report.json_files import read_json
from ccnn_torch.report.page import Answer, InlineFigure, Page, Section, sections_of
from ccnn_torch.report.table import Table, table_of


def printer_table(results: Mapping[str, Any]) -> Table | None:
    """Sections and keys with what was there and what to write; None for another machine.

    An endstop is told as what to add to it.
    """
    if results["mechanism"] != "delta_printer":
        return None
    was, now = (
        klipper_numbers({name: p[when] for name, p in results["parameters"].items()}) for when in ("nominal", "value")
    )
    rows = [("[printer]", "delta_radius", f"{1e3 * was[0]:.3f}", f"{1e3 * now[0]:.3f}")]
    for i, stepper in enumerate(STEPPERS):
        rows.append((f"[{stepper}]", "arm_length", f"{1e3 * was[1][i]:.3f}", f"{1e3 * now[1][i]:.3f}"))
        rows.append(("", "angle", f"{was[2][i]:.4f}", f"{now[2][i]:.4f}"))
        rows.append(("", "position_endstop", "x", f"x {1e3 * (now[3][i] - was[3][i]):+.3f}"))
    note = (
        "In mm and degrees; x is the position_endstop that was there. Lean and skew of the rails have no key in "
        "Klipper: identified.yaml holds them."
    )
    return Table("printer.cfg (Klipper)", ("section", "key", "was", "write"), tuple(rows), note)


_Z95 = 1.96
# Values on a screen.
_LINES = 6
BEFORE_SAYS = "Before: links nominal, what is unknown of frames, tool and instrument fitted."
_HOLDERS = {
    "sockets": "the other rows of its socket put",
    "distances": "the measured distance puts",
    "plane": "the plane puts",
    "pose": "the measured part of the pose puts",
}


def holder(results: Mapping[str, Any]) -> str:
    """Subject and verb that say what places the tool: `the plane puts` (the tool)."""
    return _HOLDERS[results["constraint"]["kind"]]


def _readings_table(results: Mapping[str, Any]) -> Table | None:
    """What was read, of several kinds: noise and RMS of each."""
    readings, rows = results.get("constraint", {}).get("readings"), []
    if not readings:
        return None
    for name, block in readings.items():
        scale, unit = display_unit(block["unit"], block["noise"])
        sizes = (number_text(block[key] / scale, 3) for key in ("before", "after", "noise"))
        rows.append((f"{name} [{unit}]", str(block["rows"]), *sizes, "given" if block["noise_known"] else "estimated"))
    note = "Off by, RMS over the rows that were fitted; readings of one instrument in one unit share a noise."
    return Table("Readings", ("reading", "rows", "before", "after", "noise", "which is"), tuple(rows), note)


def constraint_table(results: Mapping[str, Any]) -> Table | None:
    """Positions of plates, anchors or planes, with standard deviations."""
    about = results.get("constraint")
    if about is None:
        return None
    rows = []
    for name, block in about["unknowns"].items():
        sd = "not identifiable" if block["sd"] is None else with_unit(block["sd"], block["unit"])
        rows.append(
            (name, f"{number_text(block['value'], 6)} {block['unit']}".removesuffix(" 1"), sd.removesuffix(" 1"))
        )
    count = sum(place["rows"] for place in about["placements"])
    source = "as given" if about["noise_known"] else "from the residuals"
    note = (
        f"{count} rows in {len(about['placements'])} groups; standard deviation of one equation "
        f"{with_unit(about['noise'], about.get('unit', 'm'))}, {source}. "
        "Turns count from where the nominal machine sees them."
    )
    if not rows and about.get("readings"):
        return None
    if not rows:
        return Table("Rows", ("kind", "rows"), ((about["kind"], str(count)),), note)
    return Table(f"What held the tool ({about['kind']})", ("unknown", "value", "standard deviation"), tuple(rows), note)


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
        before, after, mean = (with_unit(block.get(key), block["unit"]) for key in ("before", "after", "mean_after"))
        mean = f" (mean {mean})" if "constraint" in results and "mean_after" in block else ""
        parts.append(f"{name} {before} → {after} RMS{mean}")
    rows = count_text(results["rows"]["test"], "held-out pose")
    machines = f" of {results['machines']} machines" if results["machines"] > 1 else ""
    nearer = "nearer to" if all(block["after"] < block["before"] for _, block in named) else "not nearer to"
    if "constraint" in results:
        rows = count_text(results["rows"]["test"], "held-out row")
        text = f"On {rows} the tool is {nearer} where {holder(results)} it: "
    else:
        text = f"On {rows}{machines} the predicted pose is {nearer} the measured one: "
    if results["methods"][method]["converged"] == 0:
        return f"{failed} Its error on {rows}{machines}: {', '.join(parts)}."
    return f"{failed} {text}".lstrip() + ", ".join(parts) + "."


def _known(results: Block) -> str:
    """How many values the rows determine one by one."""
    free = _free(results)
    lost = sum(not p["identifiable"] for p in free.values())
    if results["methods"][results["method"]]["converged"] == 0:
        return "none: the search did not converge."
    if not lost:
        return f"all {len(free)} values are determined."
    move = "moves" if lost == 1 else "move"
    return (
        f"{len(free) - lost} of {len(free)} values are determined one by one; {lost} {move} together with others, and "
        "predictions are not affected: the report lists them."
    )


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
        printer_table(results),
        _method_table(results),
        _deviation_table(results),
        _transfer_table(results),
        constraint_table(results),
        _readings_table(results),
        _compensation_table(results),
        _count_table(results),
    ]
    return [table for table in tables if table is not None]


def _answers(results: Block, folder: str | None) -> list[Answer]:
    """What is known, what to enter in a printer's firmware, and what to do next."""
    printer = printer_table(results)
    lines = () if printer or results["simulated"] else tuple(_clearest(results))
    said = [Answer("What is known", _known(results), lines)]
    if printer is not None:
        sections: dict[str, list[str]] = {}
        for section, key, _, write in printer.rows:
            sections.setdefault(section or [*sections][-1], []).append(f"{key} {write}")
        lines = tuple(f"{section} {', '.join(keys)}" for section, keys in sections.items())
        sure = any(block["identifiable"] for block in _free(results).values())
        doubt = "They fit the heights, and heights show no scale: DELTA_ANALYZE's distances of a printed object do. "
        said.append(Answer("Enter in printer.cfg", ("" if sure else doubt) + printer.note, lines))
    if folder is not None and not results["simulated"] and results["methods"][results["method"]]["converged"]:
        line = f"ccnn compensate {shlex.quote(f'{folder}/identified.yaml')} TARGETS.csv COMMANDS.csv --pose"
        line += permission(results.get("allow_code", False))
        said.append(Answer("Next", "correct targets by the identified machine.", (line,)))
    return said


def _clearest(results: Block) -> Iterator[str]:
    """The values that are determined best against how far they moved, a line each."""
    known = {name: block for name, block in _free(results).items() if block["identifiable"] and block["sd"]}
    # Frames are where instrument and target stood, nothing to enter.
    own = [name for name in known if not name.startswith(("base_", "tool_"))]
    own.sort(key=lambda name: -abs(known[name]["value"] - known[name]["nominal"]) / known[name]["sd"])
    for name in own[:_LINES]:
        block = known[name]
        half = _Z95 * block["sd"]
        scale, unit = own_unit(block) or display_unit(block["unit"], half)
        yield f"{name}: {to_enter(block, block['value'])} ± {number_text(half / scale, 2)} {unit}"


def identified_page(results: Block, figures: Sequence[InlineFigure] = (), folder: str | None = None) -> Page:
    """All that an identification shows; with its folder also the next command."""
    rows, machines = results["rows"], results["machines"]
    legs = "".join(f", {count} for leg {leg}" for leg, count in sorted(rows["per_leg"].items()))
    how = f"{count_text(machines, 'machine')} {'simulated' if results['simulated'] else 'measured'}"
    return Page(
        name=results["name"],
        kind="identification report",
        verdict=identified_verdict(results),
        sections=[*sections_of(identified_tables(results), figures, _answers(results, folder)), *_together(results)],
        facts=f"{results['mechanism']} · {rows['train']} poses to identify from{legs}, {rows['test']} held-out poses · "
        f"{how} · seed {results['seed']}",
        cautions=results.get("doubts", []),
        notes=results["notes"],
        versions=results["versions"],
    )


def _together(results: Block) -> list[Section]:
    """Which combinations of values the rows determine, where they do not determine each by itself."""
    found = results["combinations_not_identifiable"]
    return [Section("Values that move together", sentences=[f"{text}." for text in found])] if found else []


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


def _free(results: Block) -> dict[str, Block]:
    """What was identified, by the name that people use; parameters of one word are one number."""
    return {block.get("word") or name: block for name, block in results["parameters"].items() if block["free"]}


def _parameter_table(results: Block) -> Table:
    free = _free(results)
    lost = "not identifiable" if results["methods"][results["method"]]["converged"] else "–"
    plain = [block for block in free.values() if not own_unit(block)]
    units = _shown_units(plain)

    def unit(block: Block) -> tuple[float, str]:
        return own_unit(block) or units[block["unit"]]

    def column(cell: Callable[[Block, float], str]) -> list[str]:
        return [cell(block, unit(block)[0]) for block in free.values()]

    def nominal(block: Block, _: float) -> str:
        scale, shown = own_unit(block) or (1.0, block["unit"])
        return f"{number_text(block['nominal'] / scale, 6)} {shown}".removesuffix(" 1")

    columns = {
        "parameter": [f"{name} [{unit(block)[1]}]" for name, block in free.items()],
        "nominal": column(nominal),
    }
    if results["simulated"]:
        columns["|true - nominal|"] = column(lambda p, scale: figure_text(p, "error_before", scale))
        columns["|true - identified|"] = column(lambda p, scale: figure_text(p, "deviation", scale))
    else:
        columns["identified - nominal"] = column(lambda p, scale: number_text((p["value"] - p["nominal"]) / scale, 4))
    columns["standard deviation"] = column(lambda p, scale: figure_text(p, "sd", scale) if p["identifiable"] else lost)
    several = results["machines"] > 1
    note = f"Solver: {results['method']}." + " Medians over the machines, [5 %, 95 %]." * several
    return table_of("Parameters", columns, f"{note} {_interval_note(results)}", ["nominal"])


def _interval_note(results: Block) -> str:
    """What a standard deviation is worth here."""
    if results["methods"][results["method"]]["converged"] == 0:
        return "Without convergence there are no standard deviations."
    if results.get("doubts"):
        return "Standard deviations are for rows that fit the model and the noise, which these do not."
    return "The true value is within ±1.96 standard deviations with 95 %, if the geometry is all that is wrong."


_SHOWN = (("before", "before"), ("after", "after"), ("mean_after", "mean after"), ("max_after", "maximum after"))


def _method_table(results: Block) -> Table:
    methods = results["methods"]
    columns = {"method": [name + (" (leg by leg)" if block["per_leg"] else "") for name, block in methods.items()]}
    details = ["machines", "converged", "time [s]"]
    for name in ("position", "rotation"):
        if results["test"][name] is None:
            continue
        tests = [block["test"][name] for block in methods.values()]
        for key, words in _SHOWN:
            scale, unit = _shared_unit(tests, key)
            columns[f"{name} {words} [{unit}]"] = [figure_text(test, key, scale) for test in tests]
        details += [*columns][-2:]
    columns["machines"] = [str(block["machines"]) for block in methods.values()]
    columns["converged"] = [f"{100 * block['converged']:.0f} %" for block in methods.values()]
    columns["time [s]"] = [number_text(block["seconds"], 3) for block in methods.values()]
    noise = results["test"]["position"] or {}
    note = "RMS distance of held-out measured poses from the predicted ones."
    if "constraint" in results:
        note = f"RMS distance of held-out rows from where {holder(results)} the tool. {BEFORE_SAYS}"
    if noise.get("noise") is not None:
        note += f" The measurement noise alone is {with_unit(noise['noise'], 'm')} in position."
    return table_of("Held-out pose error", columns, note, details)


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
    methods = results["methods"]
    found, bounds = ([block[key] for block in methods.values()] for key in ("deviations", "bound"))
    columns, details = {"method": [*methods]}, ["range of σ / bound"]
    for unit, kind in (("m", "lengths"), ("rad", "angles"), ("1", "gains")):
        if unit in found[0]:
            scale, shown = _shared_unit([{"unit": unit, **block[unit]} for block in found], "largest")
            for key, words in (("largest", "maximum"), ("mean", "mean")):
                columns[f"{kind}: {words} [{shown}]"] = [figure_text(block[unit], key, scale) for block in found]
            details += [*columns][-1:]
    ends = [[number_text(bound[key], 3) for key in ("lowest", "highest")] if bound else None for bound in bounds]
    columns["σ / bound"] = [figure_text(bound, "median") for bound in bounds]
    columns["range of σ / bound"] = ["–" if end is None else " to ".join(end) for end in ends]
    shares = [block["coverage"] for block in methods.values()]
    columns["95 % intervals hold"] = ["–" if share is None else f"{100 * share:.1f} %" for share in shares]
    note = (
        "Deviation of identified from true parameters, median over machines. Bound: the Cramér-Rao bound of the same "
        "rows and noise; the standard deviation over the machines divided by it, median over the parameters."
    )
    return table_of("Deviation of the parameters", columns, note, details)


def _compensation_table(results: Block) -> Table | None:
    found = {
        f"{method}, {kind}": block["compensation"][kind]
        for method, block in results["methods"].items()
        for kind in ("exact", "linear")
        if (block["compensation"] or {}).get(kind)
    }
    if not found:
        return None
    columns = {"commands": [*found]}
    for name in ("position", "rotation"):
        blocks = [block[name] for block in found.values()]
        if any(blocks):
            scale, unit = _shared_unit(blocks, "after")
            columns[f"{name} after [{unit}]"] = [figure_text(block, "after", scale) for block in blocks]
            columns[f"{name} removed [%]"] = [figure_text(block, "removed", 0.01, 4) for block in blocks]
    note = (
        "RMS pose error of the simulated machines at held-out poses, commanded by the identified geometry: exact = "
        "real inverse kinematics; linear = nominal joints corrected by the identification Jacobian (Sun et al. 2018, "
        "eq. 15)."
    )
    return table_of("Compensation with the identified geometry", columns, note)


def _count_table(results: Block) -> Table | None:
    if not results["counts"]:
        return None
    counts = results["counts"]
    columns = {"poses": [str(entry["poses"]) for entry in counts]}
    for name in counts[0]["methods"]:
        columns[name] = [figure_text(entry["methods"][name], "position", 1e-3) for entry in counts]
    note = "RMS position error [mm] of the machines under exact commands, by the number of poses measured."
    return table_of("Measurements needed", columns, note)


_HEADER = ("subject", "name", "quantity", "unit", "value", "low", "high")
Row = tuple[str, str, str, str, float | None, float | None, float | None]


def _rows(results: Block) -> Iterator[Row]:
    def of(subject: str, name: str, block: Block, unit: str, keys: tuple[str, ...], prefix: str = "") -> Iterator[Row]:
        for key in keys:
            if key in block:
                low, high = block.get("spread", {}).get(key, (None, None))
                yield subject, name, prefix + key, unit, block[key], low, high

    keys: tuple[str, ...] = ("nominal", "value", "sd", "true", "error_before", "deviation")
    for name, block in results["parameters"].items():
        yield from of("parameter", name, block, block["unit"], keys)
    # Parameters of one word are one number; intervals over machines are above.
    for block in {block.get("word"): block for block in results["parameters"].values()}.values():
        if own := own_unit(block):
            told = {key: None if block[key] is None else block[key] / own[0] for key in keys if key in block}
            yield from of("number", block["word"], told, block["shown"], keys)
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


_LINKED = (
    "identified.json",
    "identified.csv",
    "identified.md",
    "identified.yaml",
    "identified_dh.yaml",
    "identified.urdf",
    "config.yaml",
)


def write_identified_report(folder: str | Path, results: Mapping[str, Any] | None = None) -> Path:
    """Write `plots/` and `report.html`; the same files give the same report, so it can be written again at any time.

    Args:
        folder: with arrays, and `identified.json`, which is read when `results` is None.
    """
    # Loads matplotlib, which only a report waits for.
    from ccnn_torch.identification.figures import identified_plots
    from ccnn_torch.report.figures import inline_figures

    folder = Path(folder)
    results = read_json(folder / "identified.json") if results is None else results
    arrays = load_tensors(folder / ARRAYS_FILE)[0]
    figures = inline_figures(identified_plots(results, arrays), folder / "plots")
    return identified_page(results, figures, folder.name).write_html(folder / "report.html", _LINKED)
