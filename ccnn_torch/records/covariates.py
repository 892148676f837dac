"""Which columns of a table become inputs beside the joints, and in which unit each of them must be."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from ccnn_torch.coordinates import Coordinate, is_temperature
from ccnn_torch.errors import InputError
from ccnn_torch.records.table import FILE, PAYLOAD, Table
from ccnn_torch.spelling import hint, matching, nearest
from ccnn_torch.units import parse_header, si_unit_of, to_si

# A cell so many times farther from the column's median than every other one leaves nothing of the others to learn.
_EXTREME = 1e3
# A column that varies by less than this share is constant but for how its numbers were written.
_SAME = 1e-14

DEFAULT_COVARIATES = ("time", "temperature", "temperature_*", "load_*", "torque_*", "direction*", "speed*")


def choose_covariates(
    table: Table,
    joints: Sequence[Coordinate],
    pose: Mapping[str, str],
    wanted: Sequence[str] | None,
    groups: Sequence[str] = (),
) -> tuple[tuple[Coordinate, ...], list[str]]:
    """Choose the covariates of a table.

    Args:
        table: the records.
        joints: the columns that are joints; none of them may be a covariate.
        pose: SI unit of the columns that are pose, likewise.
        wanted: names or patterns (``load_*``) instead of the default ones; None = the default ones that are there.
        groups: columns that number groups of rows for the mechanism, which are not ignored.

    Returns:
        Covariates in the file's order, constant ones left out, and notes on what was left out and why.

    Raises:
        InputError: a wanted column is missing, is a joint or a pose column, or a column has the wrong dimension; one
            cell is an extreme outlier of its column.
    """
    taken = {coordinate.name for coordinate in joints} | set(pose)
    free = [name for name in table.names if name not in taken]
    if wanted is None:
        chosen = matching(free, DEFAULT_COVARIATES)
    else:
        for pattern in wanted:
            _check_wanted(pattern, free, table, joints, pose)
        chosen = matching(free, wanted)
    covariates, notes = [], []
    for name in chosen:
        coordinate = Coordinate(name, _si_unit(name, table, pose, {j.name: j.unit for j in joints}))
        values = table.column(name, coordinate.unit)
        _check_cell_sizes(values, name, table)
        if np.ptp(values) <= _SAME * max(np.abs(values).max(), 1.0):
            notes.append(f"covariate '{name}' is constant ({table.raw(name)[0]:g} {table.units[name]}) and was dropped")
        else:
            covariates.append(coordinate)
    # The column that numbers several files was added by this package, and what a payload weighs is another column.
    read = [*groups, *[FILE] * bool(table.parts), *[PAYLOAD] * ("load_z" in table)]
    ignored = [name for name in free if name not in chosen and name not in read]
    if ignored:
        notes.append(f"ignored columns: {', '.join(ignored)}; name them in covariates to use them as inputs")
    for name in ignored:
        meant = nearest(name, [default for default in DEFAULT_COVARIATES if "*" not in default], 0.8)
        if wanted is None and meant is not None and meant not in table:
            notes.append(f"the ignored column '{name}' looks like '{meant}'; rename it if that is meant")
    return tuple(covariates), notes


def _check_cell_sizes(values: NDArray[np.float64], name: str, table: Table) -> None:
    """Refuse a column with one extreme outlier: scaled to it, all other cells are nearly equal."""
    if len(values) < 3:
        return
    away = np.abs(values - np.median(values))
    order = np.argsort(away)
    first, second = away[order[-1]], away[order[-2]]
    if first > _EXTREME * second > 0:
        row = int(order[-1])
        raise InputError(
            f"{table.path}: column '{name}' has {table.cell(name, row)} at "
            f"{table.name_rows([row])}, {first / second:.0e} times as far from the rest as any other cell; "
            "correct the cell or remove the row"
        )


def asked_columns(names: Sequence[str], wanted: Sequence[str] | None, whose: str) -> list[str]:
    """Of the columns of a simulated machine those that names or patterns ask for, in their order; all where None."""
    for pattern in wanted or ():
        if not matching(names, [pattern]):
            there = ", ".join(names) or "no covariates"
            raise InputError(f"covariates: there is no column '{pattern}'; {whose} {there}")
    return [*names] if wanted is None else matching(names, wanted)


def _check_wanted(
    pattern: str, free: list[str], table: Table, joints: Sequence[Coordinate], pose: Mapping[str, str]
) -> None:
    if matching(free, [pattern]):
        return
    if pattern in {coordinate.name for coordinate in joints}:
        raise InputError(f"covariates: '{pattern}' is a joint and an input already; remove it from the list")
    if pattern in pose:
        raise InputError(f"covariates: '{pattern}' is the measured pose, which no command can know; remove it")
    near = hint(pattern, free, "the columns that could be are:")
    raise InputError(f"covariates: {table.path} has no column '{pattern}'; {near}")


def _si_unit(name: str, table: Table, pose: Mapping[str, str], joints: Mapping[str, str]) -> str:
    """SI unit of a covariate, whose dimension must fit a name that has a meaning."""
    where = f"{table.path}: column '{name}'"
    if not table.units[name]:
        parse_header(name, table.path)
    found = si_unit_of(table.units[name], where)
    allowed = _allowed(name, pose, joints)
    if allowed and found not in allowed:
        to_si([], table.units[name], allowed[0], where, name)
    return found


def _allowed(name: str, pose: Mapping[str, str], joints: Mapping[str, str]) -> tuple[str, ...]:
    if name == "time":
        return ("s",)
    if is_temperature(name):
        return ("K",)
    if name.startswith("load_"):
        # A force along a length, a moment about an angle; for another name either.
        unit = pose.get(name.removeprefix("load_"))
        return {"m": ("N",), "rad": ("N*m",)}.get(unit or "", ("N", "N*m"))
    if name.startswith("torque_"):
        return {"m": ("N",), "rad": ("N*m",)}.get(joints.get(name.removeprefix("torque_"), ""), ("N", "N*m"))
    if name.startswith("direction"):
        return ("1",)
    if name.startswith("speed"):
        return ("rad/s", "m/s", "1")
    return ()
