"""The folder of a diagnosis: `diagnosis.json`, the arrays of its figures, the report; and `check.json`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

from ccnn_torch.compensation.model_files.identified import model_of_machine
from ccnn_torch.compensation.targets.lowered import Found, nearest_geometry
from ccnn_torch.coordinates import Coordinate, is_temperature
from ccnn_torch.diagnosis.checks.identifiable import Check
from ccnn_torch.diagnosis.mount import machine_as_told
from ccnn_torch.diagnosis.page.data import CORRECTED, NEXT, RESULT, about_of
from ccnn_torch.diagnosis.page.report import write_diagnosis_report
from ccnn_torch.diagnosis.page.tables import write_next_csv
from ccnn_torch.diagnosis.result import Diagnosis, Said
from ccnn_torch.diagnosis.search.analysis import Analysis
from ccnn_torch.diagnosis.shrink.held_out import held_out
from ccnn_torch.diagnosis.verdict.text import noise_text
from ccnn_torch.effects import Situation, pose_residual
from ccnn_torch.effects.covariates import covariate_units
from ccnn_torch.effects.found_machine import machine_of_block
from ccnn_torch.errors import InputError
from ccnn_torch.mechanisms import Instrument, Mechanism, PoseError, Seen, SerialArm
from ccnn_torch.mechanisms.drawn import drawn
from ccnn_torch.mechanisms.mechanism_file import write_machine
from ccnn_torch.mechanisms.pose import CHANNELS
from ccnn_torch.report.json_files import plain, write_json
from ccnn_torch.report.results.diagnosis import DiagnosisResults
from ccnn_torch.verification.promise import configurations, of_whole, promise_block


def write_result(folder: Path, diagnosis: Said) -> Path:
    """Write `diagnosis.json` alone.

    Raises:
        InputError: the folder cannot be written.
    """
    path = folder / RESULT
    write_json(path, DiagnosisResults.model_validate(diagnosis.to_json()))
    return path


def promise_of_verdict(diagnosis: Diagnosis, seed: int) -> dict[str, Any] | None:
    """The entry `promise`: what the rows under fits to others promise for new ones.

    None where the machine of the file lacks an effect of the verdict, or new rows would have another frame.

    Args:
        diagnosis: with its analysis.
        seed: of the folds, as in the diagnosis.
    """
    analysis, situation = diagnosis.analysis, diagnosis.analysis.situation
    mechanism = situation.mechanism
    held = {one["name"] for one in (diagnosis.machine or {}).get("effects", [])}
    lacking = any(a.effect.kind != "parameters" and a.effect.name not in held for a in diagnosis.acting)
    if diagnosis.machine is None or lacking or mechanism.grouped or isinstance(mechanism, Seen):
        return None
    keep, residual = analysis.whitening.keep(), pose_residual(situation, analysis.measured)
    left = _remainder(analysis, residual, diagnosis.judgement.found.members, seed)
    angles = torch.tensor([c.unit == "rad" for c in mechanism.channels])
    before, after = (
        of_whole(
            PoseError(e[:, ~angles].norm(dim=-1), e[:, angles].norm(dim=-1) if bool(angles.any()) else None),
            analysis.measured[keep],
            mechanism.pose,
        )
        for e in (residual[keep], left[keep])
    )
    return promise_block(before, after, configurations(situation.joints[keep], mechanism.joints))


def write_check(folder: Path, check: Check) -> Path:
    """Write `check.json`; raises as `write_result`."""
    path = folder / "check.json"
    write_json(path, asdict(check))
    return path


def write_diagnosis(
    folder: Path, diagnosis: Diagnosis, about: Mapping[str, Any] | None = None, seed: int = 0, source: str = ""
) -> Path:
    """Write `diagnosis.json`, the arrays of its figures, the report, and of a named geometry the corrected machine.

    Args:
        folder: made where it does not exist.
        diagnosis: what to write.
        about: for the head of the report: what `About` holds.
        seed: of the diagnosis.
        source: what the mechanism was read from.

    Raises:
        InputError: the folder cannot be written.
    """
    path = write_result(folder, diagnosis)
    for name in CORRECTED:
        (folder / name).unlink(missing_ok=True)
    # A machine that no file describes has no corrected one, and the report does not wait for it.
    with suppress(InputError):
        write_corrected(folder, diagnosis, source)
    arrays, labels = picture_arrays(diagnosis, seed)
    mechanism = diagnosis.analysis.situation.mechanism
    units = covariate_units(mechanism, diagnosis.analysis.situation.covariates) | {
        c.name: c.unit for c in (*mechanism.pose, *mechanism.joints)
    }
    lines = [diagnosis.lines[row] for row in diagnosis.rows_set_aside] if diagnosis.lines else []
    noise = noise_text(diagnosis.noise)
    labels = labels | {"about": {"noise": noise, **(about or {}), "units": units, "lines": lines}}
    results = plain(diagnosis.to_json())
    write_next_csv(folder / NEXT, results, about_of(labels))
    write_diagnosis_report(folder, results, arrays, labels)
    return path


def write_corrected(folder: Path, diagnosis: Diagnosis, source: str = "") -> None:
    """The machine with the geometry that was named, all of its numbers in it and its frames fitted again.

    Other causes act beside these numbers; a URDF and a DH table, which hold none, get the geometry nearest to all.
    """
    mechanism, frames = diagnosis.analysis.situation.mechanism, diagnosis.analysis.situation.parameters
    named = [e["parameters"] for e in diagnosis.effects if e["name"] in diagnosis.verdict["effects"]]
    changed = any(b.get("nominal") is not None for parameters in named for b in parameters.values())
    # Frames by group of rows are no machine's.
    machine = machine_as_told(diagnosis) if changed else None
    if machine is None:
        return
    before = mechanism.nominal if frames is None else frames
    names = [p.name for p in mechanism.geometry]
    nominal = dict(zip(names, before.tolist(), strict=True))
    columns, joint_map = ((diagnosis.machine or {}).get(key) for key in ("columns", "joint_map"))
    alone = _alone(diagnosis, machine)
    write_machine(machine, nominal, folder, Path(CORRECTED[0]).stem, columns, joint_map, None, alone, source)


def _alone(diagnosis: Diagnosis, machine: Mechanism) -> SerialArm | None:
    """The arm whose geometry alone comes nearest to the machine with all that was named; None where nothing is beside.

    An arm of which positions were measured is to turn its tool as that machine does.
    """
    if diagnosis.machine is None or not isinstance(machine, SerialArm) or machine.orientation == "direction":
        return None
    found = Found(model_of_machine(Path(RESULT), machine_of_block(diagnosis.machine, RESULT, allow_code=True)))
    if not found.beside:
        return None
    whole = len(found.nominal.pose) == 6 and machine.recipe["keys"]["tool_offset"] is None
    start = machine.with_orientation("rotation_vector") if whole else machine
    nearest = nearest_geometry(start, found.rows.joints, found.truth[:, : len(start.pose)])
    assert isinstance(nearest, SerialArm)
    return nearest


Column = tuple[str, str, Tensor]
"""Name, SI unit and values."""
# Quantile bins of a driver; the one whose bins hold most of an effect's variance is the signature of the effect.
_BINS = 12
_UNITS = {"time": "s"}


def picture_arrays(diagnosis: Diagnosis, seed: int = 0) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """What the report draws.

    Args:
        diagnosis: with its analysis.
        seed: of the folds, as in the diagnosis.

    Returns:
        Arrays by name (`s` rows, `c` pose channels, SI): `place` `s x 3`, `joints` `s x n`, `residual` and `remainder`
        `s x c`, all in the robot's frame; `drawn.*` as `report.machine` takes them; `noise` `c`, `held_out`
        and `set_aside` `s`, `covariate.NAME` `s`, and for each effect of the verdict and the driver outside the library
        `signature.NAME.x`, `.y` and `.fit` `s`. The remainder of each row is that of a fit to other rows. And
        the names and units of the signatures' axes, `{NAME: {"x": {"name", "unit"}, …}}`.
    """
    analysis = diagnosis.analysis
    situation = analysis.situation
    found = diagnosis.judgement.found
    keep = analysis.whitening.keep()
    held = torch.zeros(len(situation.joints), dtype=torch.float64)
    held[keep] = 1.0
    place = situation.mechanism.frame(analysis.measured)[0]
    # The analysis' own residual is about the machine with the effects.
    residual = pose_residual(situation, analysis.measured)
    remainder = _remainder(analysis, residual, found.members, seed)
    inside, turned, left = _in_robot_frame(situation, torch.nan_to_num(place), residual, remainder)
    arrays = {
        "place": inside,
        "joints": situation.joints,
        "residual": turned,
        "remainder": left,
        "noise": _noise(analysis),
        "held_out": held,
        "set_aside": 1 - held,
    }
    arrays |= _drawn(situation, place, residual, remainder, held > 0)
    arrays |= {f"covariate.{name}": value for name, value in situation.covariates.items()}
    labels: dict[str, Any] = {}
    parts = [analysis.atoms[i].columns @ mean for i, mean in zip(found.members, found.mean, strict=True)]
    columns = _drivers(analysis, place)
    shown = set(diagnosis.verdict["effects"]) | set(diagnosis.judgement.drivers)
    # What the whole set leaves, discrepancy term and all: the signature of one cause is drawn with all others taken
    # off.
    left = _remainder(analysis, residual, found.members, seed, with_discrepancies=True)
    for i, part in zip(found.members, parts, strict=True):
        name = analysis.atoms[i].name
        if name not in shown or not bool((part[keep] != 0).any()):
            continue
        # In the pose and in the joints; what follows one column best shows the cause best.
        views = [
            _along(part, left, keep, columns, situation.mechanism.channels),
            _in_joints(analysis, part, left, columns),
        ]
        scores = [_telling(view, keep, name) for view in views]
        view, (_, (x_name, x_unit, x)) = max(zip(views, scores, strict=True), key=lambda pair: pair[1][0])
        fit, rest, y_axis = view.fit, view.rest, {"name": view.axis.name, "unit": view.axis.unit}
        arrays |= {f"signature.{name}.x": x, f"signature.{name}.y": fit + rest, f"signature.{name}.fit": fit}
        labels[name] = {"x": {"name": x_name, "unit": x_unit}, "y": y_axis}
    return {name: value.to(torch.float64) for name, value in arrays.items()}, labels


def _drawn(situation: Situation, place: Tensor, residual: Tensor, remainder: Tensor, keep: Tensor) -> dict[str, Tensor]:
    """The picture of the machine, without the rows that were set aside; readings have a size, and no direction."""
    arm = situation.mechanism
    if isinstance(arm, Instrument):
        place = situation.whole.platform[0]
        before, after = (_sizes(arm, values)[:, 0] for values in (residual, remainder))
    else:
        before, after = residual[:, :3], remainder[:, :3]
    place = torch.where(keep[:, None], place, torch.nan)
    return drawn(arm, situation.joints, situation.pose, place, before, after, situation.parameters)


def _in_robot_frame(
    situation: Situation, place: Tensor, residual: Tensor, remainder: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Places `s x 3` and residuals `s x c0` in the robot's frame, wherever the measuring device stands."""
    arm = situation.mechanism
    if isinstance(arm, Instrument):
        # Readings have no direction in space: their size, in place of that of a position and of a rotation.
        return situation.whole.platform[0], _sizes(arm, residual), _sizes(arm, remainder)
    if not isinstance(arm, SerialArm):
        return place, residual, remainder
    vectors = torch.stack([residual, remainder], 1).reshape(len(place), -1, 3)
    place, vectors = arm.in_own_base(place, vectors, situation.parameters)
    residual, remainder = vectors.reshape(len(place), 2, -1).unbind(1)
    return place, residual, remainder


def _sizes(mechanism: Mechanism, values: Tensor) -> Tensor:
    """Size of lengths and of angles of each row `s x c0`, each the first of three columns, `s x 3` or `s x 6`."""
    angles = torch.tensor([c.unit == "rad" for c in mechanism.channels])
    parts = [values[:, ~angles], *([values[:, angles]] if bool(angles.any()) else [])]
    return torch.cat([torch.nn.functional.pad(part.norm(dim=-1, keepdim=True), (0, 2)) for part in parts], -1)


def _noise(analysis: Analysis) -> Tensor:
    """Standard deviation of each of all channels, `c0` [m, rad]: the root mean square over the rows."""
    white = analysis.whitening
    sizes = torch.diag(white.sigma * analysis.floor**0.5)
    squares = [white.unpicked(one.expand(len(white.weight), -1)).square().mean(0) for one in sizes]
    return sum(squares, torch.zeros_like(squares[0])).sqrt()


def _remainder(
    analysis: Analysis, residual: Tensor, members: tuple[int, ...], seed: int, *, with_discrepancies: bool = False
) -> Tensor:
    """What a set's effects leave of each row by a fit to others, `s x c0`; the residual where a row is set aside."""
    atoms = analysis.atoms
    chosen = [i for i in members if with_discrepancies or not atoms[i].is_discrepancy]
    out = residual.clone()
    keep = analysis.whitening.keep()
    out[keep] = analysis.whitening.unpicked(held_out(analysis, [chosen], seed)[0].left, keep)
    return out


class _View(NamedTuple):
    """One way to look at an effect: its fitted part and what is left, `s` each, on an axis; and what may drive it."""

    axis: Coordinate
    fit: Tensor
    rest: Tensor
    drivers: list[Column]


def _along(part: Tensor, left: Tensor, keep: Tensor, columns: list[Column], channels: Sequence[Coordinate]) -> _View:
    """Along the direction in which the effect moves the pose most."""
    direction, unit = _direction(part[keep], channels)
    return _View(Coordinate(_direction_words(direction, channels), unit), part @ direction, left @ direction, columns)


def _in_joints(analysis: Analysis, part: Tensor, left: Tensor, columns: list[Column]) -> _View:
    """In the joint that the effect moves most; 0 where a row was set aside for a singularity.

    A deviation of the joints looks the same everywhere in the workspace, what it does to the pose does not.
    """
    white = analysis.whitening
    jacobian = analysis.situation.jacobian
    keep = torch.nonzero(~analysis.near_singular & jacobian.isfinite().flatten(1).all(-1)).flatten()
    slope, both = (white.picked(v)[keep] / white.sigma[:, None] for v in (jacobian, torch.stack([part, left], -1)))
    # More joints than channels leave a choice, of which the smallest is taken.
    found = torch.linalg.pinv(slope, rtol=1e-9) @ both
    found = part.new_zeros(len(part), slope.shape[-1], 2).index_copy(0, keep, found)
    # Joints of several units are weighed by what a unit of each does to the pose.
    reach = slope.square().sum(1).mean(0).sqrt()
    joint = int((found[..., 0].square().mean(0).sqrt() * reach).argmax())
    axis = analysis.situation.mechanism.joints[joint]
    drivers = [*columns, *_torques(analysis, axis)]
    return _View(Coordinate(f"deviation of {axis.name}", axis.unit), found[:, joint, 0], found[:, joint, 1], drivers)


def _torques(analysis: Analysis, joint: Coordinate) -> list[Column]:
    """What load and weight ask of a joint, as further things that may give an effect on it away."""
    situation = analysis.situation
    i = [c.name for c in situation.mechanism.joints].index(joint.name)
    turns = joint.unit == "rad"
    found = [(f"pull of the weight on {joint.name}", "m" if turns else "1", situation.weight_torque[:, i])]
    if situation.loaded:
        name = f"{'torque' if turns else 'force'} of the load on {joint.name}"
        found.append((name, "N*m" if turns else "N", situation.load_torque[:, i]))
    return found


def _direction(part: Tensor, channels: Sequence[Coordinate]) -> tuple[Tensor, str]:
    """The direction in which an effect moves the pose most, `c0`: in position, or in rotation where only that moves."""
    lengths = torch.tensor([c.unit == "m" for c in channels])
    moving = bool(part[:, lengths].abs().sum() > 0)
    alike = lengths if moving else ~lengths
    main = torch.linalg.svd(part[:, alike], full_matrices=False)[2][0]
    main = main * torch.sign(main[main.abs().argmax()])
    direction = torch.zeros_like(part[0])
    direction[alike] = main
    return direction, "m" if moving else "rad"


def _direction_words(direction: Tensor, channels: Sequence[Coordinate]) -> str:
    near = int(direction.abs().argmax())
    unit, name = channels[near].unit, channels[near].name
    kind = "residual" if unit == "m" else "turn"
    if float(direction.abs()[near]) > 0.99:
        return f"{kind} along {name.removeprefix('r') if channels[near] in CHANNELS else name}"
    values = [float(v) for v, c in zip(direction, channels, strict=True) if c.unit == unit]
    return f"{kind} along ({', '.join(f'{v:.2f}' for v in values)})"


def _drivers(analysis: Analysis, place: Tensor) -> list[Column]:
    """What may give an effect away: covariates, joints, place; name, unit and values of each."""
    situation = analysis.situation
    found = [(name, _unit(name), value) for name, value in situation.covariates.items()]
    found += [(c.name, c.unit, situation.joints[:, i]) for i, c in enumerate(situation.mechanism.joints)]
    return [*found, *(("xyz"[i], "m", place[:, i]) for i in range(3))]


def _unit(name: str) -> str:
    if name.startswith("load_"):
        return "N*m" if name.startswith("load_r") else "N"
    return "K" if is_temperature(name) else _UNITS.get(name, "1")


def _telling(view: _View, keep: Tensor, cause: str) -> tuple[float, Column]:
    """The column that a cause follows, and how well: the one that its name says, else the one that it follows best."""
    kind, _, which = cause.partition(" ")
    columns = {"joint": which, "direction": f"direction{'' if which.isdigit() else '_'}{which}"}
    wanted = columns.get(kind, cause.replace(" ", "_"))
    named = [c for c in view.drivers if c[0] == wanted] or view.drivers
    shares = [_share(c[2][keep], view.fit[keep]) for c in named]
    best = max(range(len(named)), key=lambda i: shares[i])
    return shares[best], named[best]


def _share(x: Tensor, fit: Tensor) -> float:
    """Share of the variance of `fit` between quantile bins of `x`, both `s`."""
    known = torch.isfinite(x + fit)
    x, fit = x[known], fit[known]
    values = torch.unique(x)
    if len(values) < 2:
        return 0.0
    edges = (
        values[1:] if len(values) <= _BINS else torch.quantile(x, torch.linspace(0, 1, _BINS + 1, dtype=x.dtype))[1:-1]
    )
    bins = torch.bucketize(x.contiguous(), edges, right=True)
    count = torch.zeros(_BINS + 1, dtype=x.dtype).index_add(0, bins, torch.ones_like(x))
    total = torch.zeros(_BINS + 1, dtype=x.dtype).index_add(0, bins, fit - fit.mean())
    between = float((total.square() / count.clamp_min(1)).sum())
    # A bin takes up some of any variance by chance: each costs its share.
    whole = float((fit - fit.mean()).square().sum())
    return between / whole - len(edges) / len(x) if whole > 0 else 0.0
