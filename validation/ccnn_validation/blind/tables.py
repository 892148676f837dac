"""The tables of a blind check, from `blind.json` alone."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from rich.console import Console

from ccnn_torch.display import count_text, number_text
from ccnn_torch.report.table import Table, markdown_table, print_table, print_text

__all__ = ["blind_markdown", "blind_tables", "case_line", "print_blind"]

_KINDS = ("single", "pair", "none", "outside")
_GROUPS = {
    "by_strength": ("RMS gap in units of the noise", "Right answers by strength"),
    "by_machine": ("machine", "Right answers by machine"),
    "by_rows": ("rows", "Right answers by number of rows"),
    "by_disturbance": ("disturbance", "Right answers by what disturbs the rows"),
    "by_noise": ("noise", "Right answers by whether the noise is given"),
}
_MOST = 6
"""Verdicts named in a row of the confusion table; the rest are counted together."""


def blind_tables(found: Mapping[str, Any]) -> list[Table]:
    """All tables, in reading order."""
    tables = [_targets(found)]
    for key, (column, title) in _GROUPS.items():
        rows = tuple((of, *(_cell(kinds.get(kind)) for kind in _KINDS)) for of, kinds in found[key].items())
        tables.append(Table(title, (column, *_KINDS), rows))
    return [*tables, _causes(found), _confusion(found), _reliability(found), _withheld(found), _seconds(found)]


def blind_markdown(found: Mapping[str, Any]) -> str:
    """The tables as Markdown (`blind.md`)."""
    parts = [f"# Blind check over {count_text(found['cases'], 'case')}", *_sentences(found)]
    return "\n\n".join([*parts, *map(markdown_table, blind_tables(found))]) + "\n"


def print_blind(found: Mapping[str, Any], console: Console) -> None:
    """Show the tables on a terminal."""
    for table in blind_tables(found):
        if table.rows:
            print_table(table, console)
    for sentence in _sentences(found):
        print_text(sentence, console, "yellow")


def case_line(machine: str, answer: Mapping[str, Any], withheld: bool) -> str:
    """One line while a check runs; the truth is not known yet."""
    if "failed" in answer:
        return f"{machine}: {answer['failed']}"
    verdict = answer["verdict"]
    names = " + ".join(verdict["effects"]) or ("" if verdict["outside_library"] else "none")
    outside = f"{' ' if names else ''}outside ({verdict['driver']})" if verdict["outside_library"] else ""
    probability = number_text(verdict["probability"], 3)
    return f"{machine}{' (one effect withheld)' if withheld else ''}: {names}{outside}, {probability}"


def _cell(block: Mapping[str, Any] | None) -> str:
    if block is None or not block["of"]:
        return "–"
    return f"{block['share']:.3f} [{block['low']:.3f}, {block['high']:.3f}] of {block['of']}"


def _targets(found: Mapping[str, Any]) -> Table:
    rows = tuple((name, str(b["count"]), _cell(b)) for name, b in found["targets"].items() if b["of"])
    words = found["definitions"]
    defined = (f"{name.capitalize()}: {words[name]}." for name in ("right", "found", "hidden", "claims"))
    note = " ".join(["In brackets: 95 % intervals.", *defined])
    return Table("Blind check", ("figure", "counted", "share"), rows, note)


def _causes(found: Mapping[str, Any]) -> Table:
    rows = []
    for name, block in found["by_cause"].items():
        left = number_text(block["library_leaves"], 3)
        rows.append((name, *(_cell(block[key]) for key in ("right", "exact", "pair_right")), left))
    note = "Left: squares that the library leaves of the cause alone at best, in units of the noise's squares, median."
    columns = ("cause", "alone, right", "alone, exact", "in pairs, right", "left")
    return Table("Answers by cause", columns, tuple(rows), note)


def _confusion(found: Mapping[str, Any]) -> Table:
    rows = []
    for true, said in found["confusion"].items():
        entries = [f"{name} {count}" for name, count in said.items()]
        rest = sum(list(said.values())[_MOST:])
        rows.append((true, ", ".join(entries[:_MOST] + ([f"others {rest}"] if rest else []))))
    return Table("What was said of what", ("truth", "verdicts and how often"), tuple(rows))


def _reliability(found: Mapping[str, Any]) -> Table:
    rows = tuple(
        (f"{b['from']:g} to {b['to']:g}", number_text(b["claimed"], 3), _cell(b["right"])) for b in found["reliability"]
    )
    return Table("Reliability of the probabilities", ("claimed", "mean", "right"), rows)


def _withheld(found: Mapping[str, Any]) -> Table:
    rows = tuple((name, _cell(b["right"]), _cell(b["wrong_name"])) for name, b in found["withheld"].items())
    wrong = found["definitions"]["wrong_name"]
    note = f"Right: outside and by its driver, or names that explain as much. Wrong name: {wrong}."
    return Table("Library without the effect that was there", ("withheld", "right", "wrong name"), rows, note)


def _seconds(found: Mapping[str, Any]) -> Table:
    rows = tuple(
        (machine, *(number_text(took[k], 3) for k in ("median", "ninth_decile", "most")), _cell(took["below_1_s"]))
        for machine, took in found["seconds_by_machine"]["machines"].items()
    )
    title = f"Seconds of a diagnosis of {count_text(found['seconds_by_machine']['rows'], 'row')}"
    return Table(title, ("machine", "median", "nine in ten below", "most", "share below a second"), rows)


def _sentences(found: Mapping[str, Any]) -> list[str]:
    sentences = []
    if found["failed"]:
        first = found["failed"][0]
        sentences.append(
            f"{count_text(len(found['failed']), 'case')} had no answer, the first of them case {first['number']}: "
            f"{first['sentence']}"
        )
    seconds = found["seconds"]
    if seconds:
        sentences.append(
            f"A diagnosis took {number_text(seconds[len(seconds) // 2], 3)} s (median), "
            f"{number_text(seconds[-1], 3)} s at most."
        )
    return sentences
