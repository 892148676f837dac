"""`ccnn compensate`: a table of joints, poses or commands with what a model makes of it, part by part."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import compress
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ccnn_torch.compensation.model_files.load import TOGETHER, LoadedModel
from ccnn_torch.compensation.model_files.metadata import Array
from ccnn_torch.compensation.outputs import DAMPED
from ccnn_torch.coordinates import Coordinate
from ccnn_torch.errors import FallbackWarning, InputError
from ccnn_torch.files.read import parse_json, read_text
from ccnn_torch.records.commanded import is_commanded
from ccnn_torch.records.headers import JOINT_LIMIT, columns_there, stack_columns
from ccnn_torch.records.joint_map import JointMap, read_joint_map
from ccnn_torch.records.read_table import mapped, read_parts
from ccnn_torch.records.table import Table, writing_table
from ccnn_torch.units import from_si

if TYPE_CHECKING:
    from ccnn_torch.compensation.wanted import WantedPoses

_LARGEST = 500_000_000
ROWS = 4096
"""Rows that a model takes at once: its calls count for little then, and it takes a hundred MB."""


@dataclass
class Compensated:
    """What became of the rows.

    Attributes:
        rows: how many were written.
        outside: how many are outside the domain.
        beyond: names of the inputs by which they are, as of `LoadedModel.beyond`.
        damped: how many have a damped command.
        fallback: how many violate the limits of the model's card; `first` names the first.
        lost: which were left out, since the machine does not reach their pose, in words; empty without any.
        branch: how the branch of an arm was chosen, where that was left open.
    """

    rows: int = 0
    lost: str = ""
    outside: int = 0
    damped: int = 0
    fallback: int = 0
    first: str = ""
    branch: str = ""
    beyond: set[str] = field(default_factory=set)


def is_of_motion(path: Path) -> bool:
    """Whether a file is one that `ccnn diagnose --motion` writes for commands to be corrected by."""
    if path.suffix != ".json" or not path.is_file():
        return False
    content = parse_json(read_text(path, _LARGEST), str(path))
    return isinstance(content, dict) and {"axes", "mechanism", "left"} <= content.keys()


def compensate_table(
    loaded: LoadedModel,
    input: Path,
    output: Path,
    pose: bool = False,
    back: bool = False,
    sd: bool = False,
    allow_code: bool = False,
    tool: Sequence[float] | None = None,
    base: Sequence[float] | None = None,
) -> tuple[list[str], str]:
    """Write the input's columns with commands, deviations and flags; see `ccnn compensate --help` for the columns.

    Args:
        loaded: as `load_compensation` gives it.
        input, output: CSV files (`input` also .xlsx).
        pose, back, sd: as the options of `ccnn compensate`.
        allow_code, tool, base: as of `WantedPoses`.

    Returns:
        Sentences on what was written; and one on rows that were left out, or in which the model violates the limits in
        its card, else empty.

    Raises:
        InputError: a file cannot be read or is not in this form; nothing is written then.
    """
    poses = None
    if pose:
        from ccnn_torch.compensation.wanted import WantedPoses

        poses = WantedPoses(loaded, allow_code, tool, base)
    found = write_compensated(loaded, input, output, poses, back, sd, allow_code=allow_code)
    said = sentences(output, found, loaded)
    violates = (
        f"{output}: in {found.fallback} of {found.rows} rows, the first from {found.first} of {input}, {loaded.path} "
        "violates the limits in its card (finite numbers, |deviation| within the limit); they were written without any "
        "correction and with inside_domain = 0: do not use this model"
    )
    return said, "; ".join(filter(None, [found.lost, violates if found.fallback else ""]))


def write_compensated(
    loaded: LoadedModel,
    input: Path,
    output: Path,
    poses: WantedPoses | None = None,
    back: bool = False,
    sd: bool = False,
    rows: int = ROWS,
    allow_code: bool = False,
) -> Compensated:
    """The table of `compensate_table`, read, computed and written in parts of so many rows."""
    result = Compensated()
    counted = read_joint_map(loaded.joint_map, loaded.joints, loaded.columns)
    with writing_table(output) as write:
        for original in read_parts(input, rows):
            # Headers that the model's run mapped are mapped alike; OUT repeats them as they are.
            table = mapped(original, columns_there(original.units, loaded.columns))
            if poses is None and not back and is_commanded(table, loaded.joints):
                from ccnn_torch.compensation.wanted import WantedPoses

                poses = WantedPoses(loaded, allow_code, goals=True)
            # A file of poses or commands alone is of the controller as well; one with the mechanism's joints is not.
            own = poses is None and all(c.name in original for c in loaded.joints)
            shown = counted if counted is not None and (counted.is_in(original.names, table) or not own) else None
            joints, units = poses.joints(table, shown) if poses is not None else _joints(loaded, table, back, shown)
            covariates = stack_columns(table, loaded.covariates) if loaded.covariates else None
            columns = {original.header(n): original.cells(n) for n in original.names}
            there = np.asarray(np.isfinite(joints).all(-1))
            if not there.all():
                joints, covariates = joints[there], None if covariates is None else covariates[there]
                columns = {header: [*compress(cells, there)] for header, cells in columns.items()}
            with warnings.catch_warnings():
                # Reported at the end, with the line of the table.
                warnings.simplefilter("ignore", FallbackWarning)
                found = loaded(joints, covariates, ("back",) if back else ("command", "sd") if sd else ("command",))
            if sd and "deviation_sd" not in found:
                raise InputError(
                    f"--sd: {loaded.path} is identified geometry, which has no standard deviation of a command"
                )
            added = _added(loaded, found, units, back, sd, shown)
            if poses is not None:
                added |= poses.commanded(found["command"])
            names = {header.partition("[")[0] for header in added}
            write({header: cells for header, cells in columns.items() if header.partition("[")[0] not in names} | added)
            _count(result, table, np.flatnonzero(there), found, back)
            at = joints if back else found["command"]
            out = ~found["ideal_inside_domain" if back else "inside_domain"] & ~found["fallback"]
            result.beyond |= loaded.beyond(at[out], None if covariates is None else covariates[out])
        if poses is not None and poses.lost:
            hint = f", or give guess_{loaded.joints[0].header}… near the solution" if poses.chooses else ""
            others = f"{output} has the other {result.rows} rows" if result.rows else f"{output} is not written"
            result.lost = (
                f"{input}: no joints of {loaded.facts['mechanism']['name']} were found for the pose at {poses.lost}; "
                f"{others}: correct these poses{hint}"
            )
            if not result.rows:
                # Then nothing is written.
                raise InputError(result.lost)
    if poses is not None and poses.chooses:
        result.branch = poses.sentence
    return result


def _joints(loaded: LoadedModel, table: Table, back: bool, shown: JointMap | None) -> tuple[Array, dict[str, str]]:
    """Joints `rows x n` [SI], and the unit of each as written."""
    own = [c.name for c in loaded.joints] if shown is None else shown.columns
    names = {c.name: column for c, column in zip(loaded.joints, own, strict=True)}
    if back and all(f"command_{name}" in table for name in names):
        names = {name: f"command_{name}" for name in names}
    _check_joint_columns(loaded, table)
    columns = tuple(Coordinate(names[c.name], c.unit) for c in loaded.joints)
    values = stack_columns(table, columns, JOINT_LIMIT)
    units = {c.name: table.units[names[c.name]] for c in loaded.joints}
    return values if shown is None else shown.of_shown(values), units


def _check_joint_columns(loaded: LoadedModel, table: Table) -> None:
    """Raise `InputError` for a file with more joints than the model, or with poses alone."""
    known = {c.name for c in loaded.joints}
    if not known & {*table.names} and {"x", "y"} & {*table.names}:
        raise InputError(f"{table.path}: has no joints ({loaded.joints[0].header} …) but poses; add --pose")
    other = [name for name in table.names if name[:1] == "q" and name[1:].isdigit() and name not in known]
    if other:
        mechanism = loaded.facts["mechanism"]["name"]
        raise InputError(
            f"{table.path}: column '{other[0]}' is no joint of this model, which was made for {mechanism} "
            f"({', '.join(c.header for c in loaded.joints)}); take the model of the other machine, or rename the column"
        )


def _added(
    loaded: LoadedModel, found: dict[str, Array], units: dict[str, str], back: bool, sd: bool, shown: JointMap | None
) -> dict[str, ArrayLike]:
    """The columns that OUT gets, in the units and in the count that the joints were written in."""

    def named(what: str, values: Array) -> dict[str, ArrayLike]:
        return {
            f"{what}_{c.name}[{units[c.name]}]": from_si(values[:, k], c.unit, units[c.name])
            for k, c in enumerate(loaded.joints)
        }

    if shown is not None:
        kinds = {"command": shown.shown, "ideal": shown.shown, "deviation": shown.change_shown}
        kinds["deviation_sd"] = shown.spread_shown
        found = found | {name: show(found[name]) for name, show in kinds.items() if name in found}
    if back:
        flags = {"inside_domain[1]": found["ideal_inside_domain"], "status[1]": found["ideal_status"]}
        return named("ideal", found["ideal"]) | flags
    added = named("command", found["command"]) | named("deviation", found["deviation"])
    added["inside_domain[1]"] = found["inside_domain"]
    added["status[1]"] = found["status"]
    return added | (named("deviation_sd", found["deviation_sd"]) if sd else {})


def _count(result: Compensated, table: Table, rows: NDArray[np.int64], found: dict[str, Array], back: bool) -> None:
    bad = np.flatnonzero(found["fallback"])
    if len(bad) and not result.fallback:
        result.first = table.name_rows(rows[bad[:1]])
    result.rows += len(rows)
    result.fallback += len(bad)
    result.outside += int((~found["ideal_inside_domain" if back else "inside_domain"]).sum())
    result.damped += int((found["ideal_status" if back else "status"] == DAMPED).sum())


def sentences(output: Path, found: Compensated, model: LoadedModel) -> list[str]:
    """What was written, and how many rows are outside the domain or damped."""
    said = [f"{output}: {found.rows} rows written."]
    if found.outside:
        names = [c.name for c in (*model.joints, *model.covariates)]
        by = ", ".join(name for name in [*names, TOGETHER] if name in found.beyond)
        by = by and f" in {by}"
        what, then = "what was measured", "what was learned fades there, geometry and effects hold"
        if model.machine is not None:
            # Geometry alone holds all over the workspace, measured or not.
            measured = len(model.machine.joints) > 0
            what = what if measured else "the joints of the identified machine"
            then = "geometry and effects hold there too" if measured else "its geometry holds there too"
        ends = model.facts.get("machine", {}).get("ends", {})
        far = [c.name for c in model.covariates if c.name in found.beyond]
        held, told = ([name for name in far if (name in ends) == wide] for wide in (False, True))
        if held:
            then += f", with {', '.join(held)} held at the ends of what was measured"
        if told:
            then += f"{' and' if held else ', with'} {', '.join(told)} at wider ones (machine.ends of the card)"
        said.append(f"{found.outside} of them {_is(found.outside)} outside {what}{by} (inside_domain = 0): {then}.")
    if found.damped:
        said.append(
            f"{found.damped} of them {_is(found.damped)} near a singular pose or at a limit of the joints "
            f"(key limits of the machine's file; status = {DAMPED}), with the nearest safe command."
        )
    return [*said, found.branch] if found.branch else said


def _is(count: int) -> str:
    return "is" if count == 1 else "are"
