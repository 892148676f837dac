"""The tables of a run, from `results.json` alone: for the screen, for `results.md`, and for the HTML report.

They follow the paper: before calibration as Tables I and III, after it as Tables II and IV, and where the run is one of
the paper's cases its printed figures are listed beside ours. All numbers are medians over the repeats with [5 %, 95 %].
"""

from __future__ import annotations

import math
import shlex
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

from ccnn_torch.display import count_text, display_unit, number_text, typed_path, with_unit
from ccnn_torch.files.write import write_rows, write_whole
from ccnn_torch.files.yaml_file import read_yaml
from ccnn_torch.plugins import permission
from ccnn_torch.report.page import Answer, InlineFigure, Page, sections_of
from ccnn_torch.report.results.base import Spread, interval_text, removed_percent
from ccnn_torch.report.results.run import Before, Method, MethodPose, ModelFiles, Mse, PoseFigures, RmsMax, RunResults
from ccnn_torch.report.table import Table, table_of

# By less a learned part may be worse on other rows by chance: 100 rows tell an RMS error to 4 %, one to sqrt(1 / 600).
_WORSE = 1.05


@cache
def paper_case(case: str | None) -> dict[str, Any] | None:
    """What the paper prints of a case, as `paper.yaml` has it; None where `results.case` is none of its cases."""
    return None if case is None else read_yaml(Path(__file__).with_name("paper.yaml")).get(case.partition(":")[0])


def run_page(results: RunResults, figures: Sequence[InlineFigure] = (), folder: Path | None = None) -> Page:
    """All that a run shows; with its folder also the next commands."""
    rows = results.rows
    facts = f"{rows.train} training, {rows.validation} validation and {rows.test} held-out rows"
    facts += f", {rows.not_trained_on} not trained on" if rows.not_trained_on else ""
    facts += f" · {count_text(results.repeats, 'repeat')} · seed {results.seed}"
    worse = worse_text(results)
    return Page(
        name=results.name,
        kind="calibration report",
        verdict=verdict(results),
        sections=sections_of(result_tables(results), figures, _answers(results, folder)),
        facts=facts + f" · case {results.case} of the paper" if results.case else facts,
        cautions=[*([worse] if worse else []), *failures(results)],
        notes=results.notes,
        versions=results.versions,
        best=results.best_method,
        worse=bool(worse),
    )


def _answers(results: RunResults, folder: Path | None) -> list[Answer]:
    """What each part of the model leaves of the RMS position error, where it has parts, and what to do next."""
    (kind, error), best, told = results.pose.told, results.best_method, list[Answer]()
    if best is not None and results.pose.parts:
        steps = {"before": "as it is", **{part: f"with {part}" for part in results.pose.parts}, "after": f"with {best}"}
        parts = []
        for key, name in steps.items():
            size = with_unit(one.median if (one := error.led(key)) else None, error.unit)
            parts.append(f"{size} {name}" if key == "before" else f"{name} {size}")
        told.append(Answer("Step by step", f"{', '.join(parts)} (RMS {kind} error on held-out rows{_but(error)})."))
    if folder is not None and results.records is not None:
        path = typed_path(str(folder))
        if not pays(results):
            line = f"ccnn diagnose --config {shlex.quote(f'{path}/config.yaml')} --out {shlex.quote(f'{path}_cause')}"
            says = "leave this model unused, and find what is wrong with its rows or the machine's file:"
            return [*told, Answer("Next", says, (line,))]
        if results.model is not None and results.model.method is not None:
            line = f"ccnn compensate {shlex.quote(f'{path}/model.safetensors')} TARGETS.csv COMMANDS.csv --pose"
            line += permission(results.model.allow_code)
            told.append(Answer("Next", "correct targets by this model.", (line,)))
        line = f"ccnn identify {shlex.quote(f'{path}/config.yaml')} out={shlex.quote(f'{path}_numbers')}"
        told.append(Answer("To enter", "the model holds its numbers; those to type into a controller:", (line,)))
    return told


def verdict(results: RunResults) -> str:
    """One sentence: what the best method does to the error on held-out rows."""
    (kind, error), methods = results.pose.told, results.methods
    best = results.best_method or next(iter(methods), "the model")
    # What is left is left of both: the identified geometry, and what the method learned of the rest.
    whose = " + ".join([*results.pose.parts, best])
    rows = count_text(results.rows.test, "held-out row")
    before, after, but = error.led("before"), error.led("after"), _but(error)
    removed = removed_percent(before, after)
    if removed is None or before is None or after is None:
        return f"On {rows} the pose error of {whose} could not be measured."
    left, right, unit = _both(before.median, after.median, error.unit)
    did = f"removes {removed:.1f} %" if removed >= 0 else f"adds {-removed:.1f} %"
    text = f"On {rows}{but and f'{but},'} {whose} {did} of the RMS {kind} error ({left} → {right} {unit}"
    if error.without_outliers is not None:
        left, right, unit = _both(error.before.rms.median, error.after.rms.median, error.unit)
        text += f"; with {'it' if error.without_outliers.rows == 1 else 'them'} {left} → {right} {unit}"
    text += ")"
    ratio = methods[best].ratio_to_floor if best in methods else None
    if ratio is not None and ratio.median is not None:
        text += f"; its mean squared joint error is {number_text(ratio.median, 3)} times the noise floor"
        constant = results.constant.ratio_to_floor
        if constant is not None and constant.median is not None:
            text += f" (a constant correction: {number_text(constant.median, 3)})"
    return text + "."


def _but(error: PoseFigures) -> str:
    """Of which held-out rows the figures are not that a sentence leads with."""
    others = error.without_outliers
    return "" if others is None else f", without {count_text(others.rows, 'row')} far from every model"


def _both(before: float | None, after: float | None, of: str) -> tuple[str, str, str]:
    """Two errors [`of`] in the prefixed unit of the first, and this unit."""
    scale, unit = display_unit(of, before)
    left, right = (number_text(None if value is None else value / scale, 3) for value in (before, after))
    return left, right, unit


def errors_line(results: RunResults) -> str:
    """One line while many runs are at work: each method's median ratio to the floor, or its error."""
    texts = []
    for name, block in results.methods.items():
        spread = block.ratio_to_floor or block.mse
        text = number_text(None if spread is None else spread.median, 3)
        texts.append(f"{name} {'failed' if block.test is None else text}")
    return f"{'ratio to the floor' if results.floor else 'mean squared error'}: {', '.join(texts)}"


def result_tables(results: RunResults) -> list[Table]:
    """All tables of a run, in reading order."""
    paper = paper_case(results.case)
    tables = [
        _before_table(results, paper),
        comparison_table(results),
        *(_after_table(results, paper, measure) for measure in ("mse", "mae", "sse")),
        reach_table(results),
        _pose_table(results),
        pose_by_method_table(results),
    ]
    return [table for table in tables if table is not None]


def write_tables(folder: Path, results: RunResults) -> None:
    """Write `results.csv` and `results.md`."""
    write_rows(folder / "results.csv", HEADER, long_table(results))
    write_whole(folder / "results.md", replace(run_page(results), notes=()).markdown())


_HELD_BACK = (
    ": the model is right, but its file holds commands back near singular poses or at limits; what it explains is "
    "reached in the rows whose status is 0."
)


def pays(results: RunResults) -> bool:
    """Whether the model leaves less on held-out rows than no correction does, and than its own parts where all targets
    are reached."""
    _, error = results.pose.told
    removed, worse = removed_percent(error.led("before"), error.led("after")), worse_text(results)
    return (not worse or worse.endswith(_HELD_BACK)) and (removed is None or removed > 0)


def worse_text(results: RunResults) -> str:
    """One sentence where the best method's RMS pose error on held-out rows is larger than without it; else empty.

    Without it: the best of no correction, identified geometry, and known effects with it.
    """
    (kind, error), best, parts = results.pose.told, results.best_method, results.pose.parts
    size = {key: one.median for key in ("before", *parts, "explained", "after") if (one := error.led(key))}
    steps = {"no correction at all": size["before"]}
    for k, part in enumerate(parts):
        steps[f"{' + '.join(parts[: k + 1])} alone"] = size[part]
    # Of steps as good as each other the last one says more.
    instead, alone = min(reversed(steps.items()), key=lambda step: step[1] or math.inf)
    after = size["after"]
    if best is None or not alone or after is None or after <= _WORSE * alone:
        return ""
    left, right, unit = _both(alone, after, error.unit)
    what = " + ".join([*parts, best])
    if parts and instead.startswith(" + ".join(parts)):
        what = best
    text = f"On held-out rows {what} makes it worse than {instead} ({left} → {right} {unit} RMS {kind} error)"
    if parts and "explained" in size and (size["explained"] or after) <= _WORSE * alone:
        return text + _HELD_BACK
    if "effects" in parts and "effects" not in instead:
        return f"{text}: effects=none leaves the effects out."
    if best == "constant":
        return f"{text}: what it learned of the training rows does not hold on others."
    return f"{text}: methods=constant leaves the network out, methods=auto chooses by cross-validation."


def failures(results: RunResults) -> list[str]:
    """One sentence for each method that failed, and for each that has no model file; first whose `model.*` are."""
    said = []
    model, best = results.model or ModelFiles(method=None, without={}), results.best_method
    without = dict(model.without)
    if best in without and model.method is not None:
        why = without.pop(best)
        said.append(f"The model files model.* and card.json are of {model.method}, not of {best}: {why}.")
    said += [f"No model file of {name}: {why}." for name, why in without.items()]
    said += [
        f"The model files of {name} apply {share:.0%} of what it learned: all of it changes too fast for a command to "
        "be solved for; the promise in their card is of what they apply, the figures here of all that was learned."
        for name, share in model.damped.items()
    ]
    return said + [f"{name} failed: {m.failed}" for name, m in results.methods.items() if m.test is None]


def _units(results: RunResults) -> dict[str, str]:
    return {joint.name: joint.unit for joint in results.joints}


def _repeats(results: RunResults) -> str:
    count = results.repeats
    return f"Medians [5 %, 95 %] over {count} repeats." if count > 1 else ""


def _before_table(results: RunResults, paper: dict[str, Any] | None) -> Table:
    units, train = _units(results), results.before_train
    columns = ["joint"] + ["mean, training rows", "maximum, training rows"] * (train is not None)
    columns += ["mean, held-out rows", "maximum, held-out rows", "largest by absolute value"]
    if paper:
        columns += ["mean, paper", "maximum, paper"]
    rows = []
    for i, (name, unit) in enumerate(units.items()):
        scale, shown = display_unit(unit, results.before[name].max_abs or 0.0)
        row = [f"{name} [{shown}]"]
        if train is not None:
            row += [interval_text(train[name].spread[key], scale) for key in ("mean", "max")]
        row += [interval_text(results.before[name].spread[key], scale) for key in ("mean", "max", "max_abs")]
        if paper:
            row += [number_text(value / scale) for value in paper["before_test"][i]]
        rows.append(tuple(row))
    note = "Mean and maximum are of the signed error. " + _repeats(results)
    if paper:
        note += f" Paper: Table {paper['before']}, verification set. {paper['remark']}"
    return Table("Joint error before calibration", tuple(columns), rows, note.strip())


def _after_table(results: RunResults, paper: dict[str, Any] | None, measure: str) -> Table:
    titles = {"mse": "Mean squared error", "mae": "Mean absolute error", "sse": "Sum of squared errors"}
    floor = results.floor
    keys = list(_units(results)) + ["all"] * ("all" in (results.constant.test or {}))
    # Joints of one unit share a scale, so that columns can be compared at a glance.
    shared = "all" if "all" in keys else None
    scales = {key: _scale(results, shared or key, measure) for key in keys}
    beside = measure == "mse"
    columns = ["method", *(f"{'all joints' if key == 'all' else key} [{scales[key][1]}]" for key in keys)]
    blocks = [*results.methods.values(), results.constant]
    extras = [
        (key, column, digits)
        for key, column, digits in (
            ("ratio_to_floor", "ratio to floor [1]", 4),
            ("coverage", "coverage of 95 % [1]", 3),
            ("seconds", "time [s]", 3),
        )
        if beside and (key == "seconds" or any(block[key] for block in blocks))
    ]
    columns += [column for _, column, _ in extras]
    printed = dict(paper["methods"]) if paper and len(keys) == len(paper["symbols"]) + 1 else {}
    rows: list[tuple[str, ...]] = []

    def add(label: str, errors: Mapping[str, Mse] | None, method: Method | None = None) -> None:
        cells = [interval_text(errors[key][measure] if errors else None, scales[key][0]) for key in keys]
        beside = ((None if method is None else method[key], digits) for key, _, digits in extras)
        rows.append((label, *cells, *(interval_text(spread, digits=digits) for spread, digits in beside)))

    def add_printed(name: str) -> None:
        assert paper is not None
        values = zip(keys, printed.pop(name)[measure], strict=True)
        cells = [number_text(value / scales[key][0]) for key, value in values]
        rows.append((f"{name}, paper's Table {paper['after']}", *cells, *["–"] * len(extras)))

    for name, method in results.methods.items():
        add(method_label(results, name), method.test, method)
        if name in printed:
            add_printed(name)
    if "constant" not in results.methods or not results.methods["constant"].test:
        add("constant", results.constant.test, results.constant)
    if floor and beside:
        add("noise floor, realised", floor.realised)
        add("noise floor, expected", floor.expected)
        if floor.with_unlearnable:
            add("noise floor with what cannot be learned", floor.with_unlearnable)
    for name in list(printed):
        add_printed(name)
    note = _repeats(results)
    if any(key == "coverage" for key, _, _ in extras):
        note += (
            " Coverage: share of the held-out figures inside the domain that lie within 1.96 predictive standard "
            "deviations of the prediction."
        )
    details = tuple(columns[1 : len(keys)]) if shared else ()
    title = f"{titles[measure]} on held-out rows, after calibration"
    return Table(title, tuple(columns), rows, note.strip(), details=details, page_only=not beside)


def _scale(results: RunResults, key: str, measure: str) -> tuple[float, str]:
    """One unit for a column: a prefixed one for absolute errors, a power of ten of the SI unit for squares."""
    units = _units(results)
    unit = units[key] if key != "all" else next(iter(units.values()))
    block = [m.test for m in results.methods.values() if m.test] or [results.constant.test or {}]
    medians = [errors[key][measure].median for errors in block]
    typical = min((m for m in medians if m), default=1.0)
    if measure == "mae":
        return display_unit(unit, typical)
    square = "1" if unit == "1" else f"{unit}²"
    power = math.floor(math.log10(typical))
    return (1.0, square) if power == 0 else (10.0**power, f"1e{power} {square}")


def _pose_table(results: RunResults) -> Table:
    names = {"position": "position", "rotation": "rotation", "energy": "energy E (eq. 5)"}
    blocks = {name: results.pose[key] for key, name in names.items() if results.pose[key] is not None}
    # Beside before and after, where the run has them: block key, column, and the sentence that explains it.
    extras = [
        extra
        for extra in (
            ("geometry", "RMS geometry alone", "Geometry alone: link parameters and frames fitted to the same rows."),
            ("effects", "RMS effects alone", "Effects alone: with geometry, fitted to the training rows."),
            (
                "explained",
                "RMS not explained",
                "Not explained: what the model leaves of the poses at the joints as commanded; after: what is left "
                "under the commands of the file.",
            ),
            ("not_compensable", "RMS not compensable", "Not compensable: what no command of the joints can remove."),
        )
        if any(block[extra[0]] is not None for block in blocks.values())
    ]
    rows = []
    for name, block in blocks.items():
        scale, unit = display_unit(block.unit, block.before.rms.median or 0.0)
        cells = [f"{name} [{unit}]"]
        for measure in ("rms", "max"):
            removed = removed_percent(block.before[measure], block.after[measure])
            cells += [interval_text(block[when][measure], scale) for when in ("before", "after")]
            cells.append("–" if removed is None else f"{removed:.1f}")
        cells += [interval_text(None if block[key] is None else block[key].rms, scale) for key, _, _ in extras]
        rows.append(tuple(cells))
    columns = ["pose error"]
    for measure in ("RMS", "max"):
        columns += [f"{measure} before", f"{measure} after", f"{measure} removed [%]"]
    columns += [column for _, column, _ in extras]
    note = " ".join([*(sentence for _, _, sentence in extras), _repeats(results)]).strip()
    details = ("max before", "max after", "max removed [%]", "RMS not explained", "RMS not compensable")
    return Table("Pose error on held-out rows", tuple(columns), rows, note, details=details)


def method_label(results: RunResults, name: str) -> str:
    """A method's name, and in how many repeats it has not converged."""
    found = results.methods[name].converged if name in results.methods else None
    values = found.values if found else []
    missed = sum(value == 0 for value in values)
    if missed == 0:
        return name
    return f"{name} ({missed} of {count_text(len(values), 'repeat')} not converged)"


def comparison_table(results: RunResults) -> Table | None:
    """How `methods=auto` chose; None where it did not."""
    auto = results.auto
    if not auto:
        return None
    rows = []
    for name, found in auto.compared.items():
        steps = f"{found.steps}, stopped at the budget" if found.stopped else str(found.steps)
        error = number_text(found.standard_error, 2)
        rows.append((name, interval_text(found.cv), error, steps, number_text(found.seconds, 3)))
    columns = ("method", "error [1]", "standard error [1]", "steps", "time [s]")
    note = (
        f"Mean squared error on rows held out in {auto.folds} folds of the training rows, in units of the variance "
        f"of what was to be learned (a constant has about 1). {auto.why}"
    )
    note += "".join(f" Not compared: {name} ({sentence})." for name, sentence in auto.skipped.items())
    return Table("Methods compared by cross-validation", columns, rows, note)


def reach_table(results: RunResults) -> Table | None:
    """Seconds and evaluations to the same held-out error; None where the run has no curves."""
    reach = results.reach
    if not reach:
        return None
    rows = []
    for name, found in reach.methods.items():
        cells = ("never",) * 3
        if found is not None:
            counted = found.evaluations
            cells = (
                str(found.step),
                number_text(found.seconds, 3),
                "–" if counted is None else f"{counted:.0f}",
            )
        rows.append((method_label(results, name), *cells))
    unit = next(iter(results.joints)).unit
    note = (
        f"Until the median held-out mse is {number_text(reach.level)} {'1' if unit == '1' else unit + '²'} or less, "
        f"the lowest that {reach.set_by} reaches, which of the trained methods reaches least. Of the fit on all "
        "training rows; a search for the number of steps before it is not counted. An evaluation is one pass of the "
        "training rows through one model; seconds are one repeat's share."
    )
    columns = ("method", "steps", "time [s]", "evaluations")
    return Table("Effort to reach the same held-out error", columns, rows, note, page_only=True)


def pose_by_method_table(results: RunResults) -> Table | None:
    """RMS pose error on held-out rows before, and after each method; None for a single method."""
    found = {name: block.pose for name, block in results.methods.items() if block.pose}
    if len(found) < 2:
        return None
    kinds = [kind for kind in ("position", "rotation") if results.pose[kind] is not None]
    shown = {"before": {kind: results.pose[kind].before for kind in kinds}}
    if all(results.pose[kind].geometry for kind in kinds):
        shown["geometry alone"] = {kind: results.pose[kind].geometry for kind in kinds}
    shown |= {method_label(results, name): blocks for name, blocks in found.items()}
    columns = {"method": [*shown]}
    for kind in kinds:
        block = results.pose[kind]
        scale, unit = display_unit(block.unit, block.before.rms.median or 0.0)
        for key, words in (("rms", "RMS"), ("max", "max")):
            columns[f"{kind} {words} [{unit}]"] = [interval_text(rows[kind][key], scale) for rows in shown.values()]
    return table_of("Pose error on held-out rows, method by method", columns)


HEADER = ("method", "split", "quantity", "joint", "unit", "median", "low", "high")
Row = tuple[str, str, str, str, str, float | None, float | None, float | None]
_OF_A_METHOD = (
    ("ratio_to_floor", "test", "1"),
    ("coverage", "test", "1"),
    ("seconds", "", "s"),
    ("evaluations", "", "1"),
    ("converged", "", "1"),
)


def long_table(results: RunResults) -> Iterator[Row]:
    """Rows of (method, split, quantity, joint, unit, median, low, high); `joint` is empty where it means nothing."""
    units = {joint.name: joint.unit for joint in results.joints}
    units["all"] = results.joints[0].unit
    best = results.best_method or ""

    def row(method: str, split: str, quantity: str, joint: str, unit: str, spread: Spread) -> Row:
        return (method, split, quantity, joint, unit, spread.median, spread.low, spread.high)

    def pose(method: str, kind: str, unit: str, figures: RmsMax | MethodPose) -> Iterator[Row]:
        for measure in ("rms", "max"):
            yield row(method, "test", f"{kind}_{measure}", "", unit, figures[measure])

    def before(split: str, figures: dict[str, Before]) -> Iterator[Row]:
        for joint, block in figures.items():
            for quantity, spread in block.spread.items():
                yield row("before", split, quantity, joint, units[joint], spread)

    yield from before("train", results.before_train or {})
    yield from before("test", results.before)
    methods = results.methods
    tests = {name: method.test for name, method in methods.items()}
    tests["constant"] = tests.get("constant") or results.constant.test
    errors: dict[str, Mapping[str, Mse] | None] = dict(tests)
    if results.floor is not None:
        errors |= {f"floor_{kind}": results.floor[kind] for kind in ("realised", "expected", "with_unlearnable")}
    for method, joints in errors.items():
        for joint, measures in (joints or {}).items():
            for quantity, spread in measures:
                unit = units[joint] if quantity == "mae" or units[joint] == "1" else f"{units[joint]}^2"
                yield row(method, "test", quantity, joint, unit, spread)
    trained = {name: block for name, block in methods.items() if block.test is not None}
    for method, block in ({"constant": results.constant} | trained).items():
        for quantity, split, unit in _OF_A_METHOD:
            if block[quantity] is not None:
                yield row(method, split, quantity, "", unit, block[quantity])
        for joint, spread in block.sd.items():
            yield row(method, "test", "sd", joint, units[joint], spread)
        for kind, left in block.pose.items():
            # That of the best method is written below, with the error before compensation.
            if left is not None and method != best:
                yield from pose(method, kind, left.unit, left)
    for kind, figures in results.pose:
        for when in ("before", "after", "explained", "geometry", "effects", "not_compensable"):
            if figures is not None and figures[when] is not None:
                yield from pose(best if when == "after" else when, kind, figures.unit, figures[when])
