"""Tables that compare methods: cross-validation, effort, remaining pose error."""

from __future__ import annotations

from ccnn_torch.display import count_text, display_unit, number_text
from ccnn_torch.report.results.base import interval_text
from ccnn_torch.report.results.run import RunResults
from ccnn_torch.report.table import Table, table_of


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
