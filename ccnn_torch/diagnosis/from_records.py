"""From measured records to a diagnosis: covariates by name, unknown frames fitted first, the machine that was found."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from fnmatch import fnmatchcase
from typing import Any, cast

import numpy as np
import torch
from torch import Tensor

from ccnn_torch.coordinates import Condition
from ccnn_torch.diagnosis.checks.mistakes import plausible_rows, what_is_wrong
from ccnn_torch.diagnosis.discrepancy.network import with_network
from ccnn_torch.diagnosis.engine import diagnose_rows
from ccnn_torch.diagnosis.from_file import (
    TRAINING_ROWS,
    Verdict,
    in_time,
    usable_verdict,
    with_numbers,
)
from ccnn_torch.diagnosis.joint_fit import fit_jointly, loose_parameters, on_fitted_frames
from ccnn_torch.diagnosis.mount import SET_ANEW, frames_taken, mount_notes
from ccnn_torch.diagnosis.residual.distance import size_of
from ccnn_torch.diagnosis.residual.noise_evidence import Noise, column_names, noise_of_columns
from ccnn_torch.diagnosis.result import Diagnosis
from ccnn_torch.effects import Acting, Effect, Situation, default_gravity, make_effect, used_covariates
from ccnn_torch.effects.apply import ByGroup
from ccnn_torch.effects.columns import inside
from ccnn_torch.effects.covariates import covariate_units
from ccnn_torch.effects.found_machine import found_block
from ccnn_torch.effects.situation import has_upright_base
from ccnn_torch.effects.time import ROW, FrameDrift, Homing, elapsed
from ccnn_torch.errors import InputError, RowsError
from ccnn_torch.mechanisms import (
    BlackBox,
    Framed,
    Mechanism,
    Seen,
    SerialArm,
    as_measured,
    fit_unknown,
    judge_frames,
    sees_directions,
)
from ccnn_torch.mechanisms.frames.partial import completed
from ccnn_torch.numerics.rotations import rotation_vector_to_matrix
from ccnn_torch.records import Records, load_records
from ccnn_torch.records.covariates import DEFAULT_COVARIATES
from ccnn_torch.records.load import FILE, is_frame
from ccnn_torch.records.read_table import Frame
from ccnn_torch.records.table import PAYLOAD
from ccnn_torch.units import LARGEST, parse_header, si_unit_of


def simulator_inputs(
    records: Records, mechanism: Mechanism, covariates: Mapping[str, Tensor]
) -> tuple[Mechanism, dict[str, Tensor]]:
    """What the nominal machine takes from the records beyond the covariates that every diagnosis uses.

    Args:
        records: with all their columns.
        mechanism: the nominal one.
        covariates: by name, `s` each, those that are known already.

    Returns:
        The mechanism with what is constant in all rows (no driver of anything, but no less true), and further
        covariates that vary, `s` each [SI].

    Raises:
        InputError: a column that it takes has an empty cell or another unit.
    """
    constant: dict[str, Tensor] = {}
    varying: dict[str, Tensor] = {}
    for condition in mechanism.takes:
        if condition.name in covariates or condition.name not in records.columns:
            continue
        values = torch.from_numpy(_column(records, condition))
        if float(values.max() - values.min()) > 0:
            varying[condition.name] = values
        else:
            constant[condition.name] = values[0]
    return mechanism.under(constant), varying


def refuse_lost_rows(records: Records, situation: Situation) -> None:
    """A simulator answers for every row that was measured; other machines may have rows out of reach, set aside later.

    Raises:
        InputError: it returns NaN for some; names the first of them and how many there are.
    """
    machine = situation.machine.mechanism if isinstance(situation.machine, Framed) else situation.machine
    if not isinstance(machine, BlackBox):
        return
    lost = np.flatnonzero(~torch.isfinite(situation.pose).all(-1).numpy())
    if len(lost) == 0:
        return
    row = int(lost[0])
    rest = f" (and {len(lost) - 1} more)" if len(lost) > 1 else ""
    raise InputError(
        f"{records.path}: simulator '{machine.name}' returns NaN at {records.name_rows([row])}{rest}, with "
        f"{machine.words(situation.joints[row], row)}; let it return a pose there, check the units, or remove the row"
        f"{'s' if len(lost) > 1 else ''}"
    )


def _column(records: Records, condition: Condition) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    values, unit = records.columns[condition.name], records.units[condition.name]
    where = f"{records.path}: column '{condition.name}'"
    if not unit:
        parse_header(condition.name, records.path, condition.unit)
    if si_unit_of(unit, where) != si_unit_of(condition.unit):
        raise InputError(f"{where} is in '{unit}', and the simulator takes it in {condition.unit}")
    empty = np.flatnonzero(~np.isfinite(values))
    if len(empty):
        raise InputError(f"{where} is empty at {records.name_rows(empty[:1])}, and the simulator takes it; fill it in")
    far = np.flatnonzero(np.abs(values) > LARGEST)
    if len(far):
        raise InputError(f"{where} has {values[far[0]]:g} at {records.name_rows(far[:1])}, which is nothing measured")
    return np.array(values, dtype=np.float64).reshape(-1)


# Names that a note lists.
_FEW_NAMES = 6


def diagnose(
    records: Records | Frame,
    mechanism: Mechanism,
    *,
    noise: float | Mapping[str, float] | None = None,
    effects: Sequence[Effect | str] | None = None,
    gravity: Sequence[float] | None = None,
    seed: int = 0,
    network: bool = False,
) -> Diagnosis:
    """Find the effects that cause the error of a model on measured records, where they are, and how much they explain.

    Args:
        records: as `load_records` reads them, or a pandas DataFrame with headers ``name[unit]``.
        mechanism: the nominal machine.
        noise: standard deviation of the measured pose [SI]: one number for every channel, or by pose coordinate;
            estimated from the rows when None.
        effects: candidates, or their names, "all" for those of the library; the whole library when None.
        gravity: `3` [m/s²] in the base frame; down along -z (planar machines: -y) when None.
        seed: of folds and resampling.
        network: whether to train networks on what the verdict's effects leave, which takes seconds.

    Raises:
        InputError: too few rows, most of them out of reach, or noise of a coordinate that there is not.
    """
    if is_frame(records) and isinstance(mechanism, Mechanism):
        records = load_records(cast(Frame, records), mechanism, learns=False)
    if not isinstance(records, Records) or not isinstance(mechanism, Mechanism):
        raise InputError(
            "diagnose takes records as load_records gives them and a mechanism: mechanism = load_mechanism(name), then "
            "diagnose(load_records(path, mechanism), mechanism); write_simulated(path, made) puts simulated rows there"
        )
    situation = situation_of(records, mechanism, gravity)
    mounts = _mounts(records, situation)
    if effects is None and len(mounts) > 1:
        effects = ["all", *(ByGroup(make_effect(name), _word(situation), mounts) for name in SET_ANEW)]
    still, shown = constant_columns(records), _instrument(records, situation)
    with naming(records):
        said = diagnose_rows(situation, records.pose, noise_of(noise, situation), effects, seed, shown, still)
    mounted = mount_notes(said, mounts, _word(situation))
    notes = [*records.missing, *said.notes, *mounted, *_unread(records, situation, said)]
    doubts = [*said.cautions, *([records.doubt] if records.doubt else [])]
    entries = {"notes": notes, "cautions": doubts, "machine": named_machine(said), "frames": frames_taken(said)}
    entries["missing_covariates"] = [
        e | {"constant": still >= {c.partition("[")[0] for c in e["columns"]}}
        for e in said.content["missing_covariates"]
    ]
    said = replace(said, lines=tuple(records.lines.tolist())).with_entries(**entries)
    return with_network(said, seed) if network else said


def constant_columns(records: Records) -> set[str]:
    """Columns beside joints and pose that never change."""
    return {name for name, values in records.columns.items() if np.ptp(values) == 0}


def _mounts(records: Records, situation: Situation) -> dict[str, Tensor]:
    """Base frame of each group of rows that show directions, by the group's name, `6`; {} for other machines."""
    arm, values = situation.mechanism, situation.parameters
    if not sees_directions(arm) or values is None:
        return {}
    assert isinstance(arm, SerialArm)
    columns = [records.columns[name].tolist() for name in arm.frame_per]
    rows = [", ".join(f"{v:.10g}" for v in row) for row in zip(*columns, strict=True)] or [""]
    values = values.expand(len(rows), -1)
    return {name: values[rows.index(name), :6] for name in sorted(set(rows))}


def _word(situation: Situation) -> str:
    """What a group of rows is called."""
    return next(iter(situation.mechanism.frame_per), "")


def _instrument(records: Records, situation: Situation) -> Noise | None:
    names = [c.name for c in situation.mechanism.pose]
    return noise_of_columns(records, names, _numbers_of_channels(situation), situation.jacobian.shape[-2])


def _numbers_of_channels(situation: Situation) -> dict[str, int]:
    return {c.name: k for k, c in enumerate(situation.mechanism.channels)}


def _unread(records: Records, situation: Situation, said: Diagnosis) -> list[str]:
    """A note of columns that no effect uses: one of them may be misnamed."""
    mechanism = situation.mechanism
    known = [*DEFAULT_COVARIATES, *situation.covariates, *(condition.name for condition in mechanism.takes)]
    known += [*mechanism.frame_per, *mechanism.tool_per]
    known += ([FILE] if records.parts else []) + ([PAYLOAD] if "load_z" in situation.covariates else [])
    known += [name for c in mechanism.pose for name in column_names(c.name)] if said.noise == "columns" else []
    names = [name for name in records.columns if not any(fnmatchcase(name, pattern) for pattern in known)]
    if not names:
        return []
    more = f" and {len(names) - _FEW_NAMES} more" if len(names) > _FEW_NAMES else ""
    return [
        f"columns that were not evaluated: {', '.join(names[:_FEW_NAMES])}{more}; effects use time, temperature, "
        f"load_{mechanism.pose[0].name}, direction1, speed1 and the like"
    ]


@contextmanager
def naming(records: Records) -> Iterator[None]:
    """Within it a sentence about the rows names the file that they are from."""
    try:
        yield
    except RowsError as reason:
        raise RowsError(f"{records.path}: {reason}") from None


def refuse_far_rows(records: Records, mechanism: Mechanism) -> None:
    """Raise RowsError where the usual row is not of this machine: in another frame, with joints of other signs ..."""
    situation = situation_of(records, mechanism)
    with naming(records):
        plausible_rows(situation, records.pose)


def situation_of(records: Records, mechanism: Mechanism, gravity: Sequence[float] | None = None) -> Situation:
    """Rows of records on the nominal machine; unknown frames of an arm are fitted to them.

    Raises:
        InputError: records of another machine, gravity of another length, a direction that is no sign, or too many rows
            out of reach.
    """
    if records.joints.shape[-1] != len(mechanism.joints):
        raise InputError(
            f"records: they have {records.joints.shape[-1]} joints and {mechanism.name} has {len(mechanism.joints)}; "
            "load them with the mechanism that was measured"
        )
    mechanism = as_measured(mechanism, records.pose_coordinates, records.path, records.pose)
    mechanism = mechanism.with_leans() if isinstance(mechanism, SerialArm) else mechanism
    parameters = fit_unknown(mechanism, records.joints, records.pose, columns=records.columns)
    if isinstance(mechanism, SerialArm) and parameters is not None:
        try:
            judge_frames(mechanism, records.joints, records.pose, parameters, None, records.path, records.name_rows)
        except InputError as reason:
            raise named_mistake(reason, mechanism, records, parameters) from None
    down = default_gravity(mechanism) if gravity is None else torch.tensor(list(gravity), dtype=torch.float64)
    if down.shape != (3,):
        raise InputError(f"gravity: needs three numbers (x, y, z in m/s²), not {len(down)}")
    arm = inside(mechanism)
    fitted = isinstance(arm, SerialArm) and "base" in arm.unknown_frames
    if parameters is not None and fitted and not has_upright_base(mechanism):
        # Where the measuring device stands says nothing about gravity.
        down = rotation_vector_to_matrix(parameters.reshape(-1, parameters.shape[-1])[0, 3:6]) @ down
    covariates = {c.name: records.covariates[:, i] for i, c in enumerate(records.covariate_coordinates)}
    _refuse_no_sign(records, covariates)
    mechanism, more = simulator_inputs(records, mechanism, covariates)
    covariates |= more
    guess = None
    if records.pose.shape[-1] == len(mechanism.pose):
        guess = completed(mechanism, records.joints, records.pose, parameters)
    situation = Situation(mechanism, records.joints, covariates, down, parameters, guess)
    refuse_lost_rows(records, situation)
    return situation


def named_mistake(reason: InputError, arm: SerialArm, records: Records, parameters: Tensor) -> InputError:
    """The refusal of fitted frames, with the mistake that explains it in place of what to check, where there is one."""
    if "joint_map" in str(reason):
        return reason
    rows = Situation(arm, records.joints, {}, default_gravity(arm), parameters, records.pose)
    said = what_is_wrong(rows, records.pose, size_of(rows))
    until, then = ("; check", f": {said}") if said else ("; ccnn check", "")
    return InputError(str(reason).partition(until)[0] + then)


def _refuse_no_sign(records: Records, covariates: Mapping[str, Tensor]) -> None:
    """Raise InputError where a direction is none."""
    for name, values in covariates.items():
        if not name.startswith("direction"):
            continue
        wrong = torch.nonzero((values.abs() != 1) & (values != 0)).squeeze(-1)
        if len(wrong):
            raise InputError(
                f"{records.path}: column '{name}', line {int(records.lines[wrong[0]])}: {float(values[wrong[0]]):g} is "
                "no direction; write 1 or -1, the sign of the joint's last motion, or 0 where it is not known"
            )


def noise_of(noise: float | Mapping[str, float] | None, situation: Situation) -> Tensor | None:
    """Standard deviation of each channel of position and rotation vector, `c` [m, rad].

    Raises:
        InputError: a coordinate that the pose does not have, one that is missing, or a value that is not positive or
            more than the machine moves.
    """
    if noise is None:
        return None
    pose, measured = situation.mechanism.pose, situation.mechanism.pose[: situation.mechanism.compared]
    names = [c.name for c in measured]
    if isinstance(noise, str):
        raise InputError(
            f"noise: '{noise}' is a text; give a number in SI (1e-5), or one for each of {', '.join(names)}"
        )
    if not isinstance(noise, Mapping):
        noise = dict.fromkeys(names, float(noise))
    # What an instrument was pointed at needs none.
    wrong = [n for n in noise if all(n != c.name for c in pose)]
    missing = [n for n in names if n not in noise]
    if wrong or missing:
        said = f"there is no pose coordinate {wrong[0]}" if wrong else f"gives nothing for {', '.join(missing)}"
        raise InputError(f"noise: {said}; the pose is {', '.join(names)}")
    noise = {n: noise[n] for n in names}
    low = [n for n, v in noise.items() if not 0 < float(v) < float("inf")]
    if low:
        raise InputError(f"noise: must be above 0, not {noise[low[0]]!r} for {low[0]}")
    spread = float(size_of(situation).place)
    wide = [c.name for c in measured if c.unit == "m" and noise[c.name] > spread]
    if wide:
        value = noise[wide[0]]
        raise InputError(
            f"noise: {value:.4g} m for {wide[0]} is more than {situation.mechanism.name} moves (its poses are spread "
            f"over {spread:.3g} m); write the unit, e.g. {value:g}um"
        )
    lengths = [noise[c.name] for c in measured if c.unit == "m"]
    angles = [noise[c.name] for c in measured if c.unit != "m"]
    largest = {"m": max(lengths, default=1.0), "rad": max(angles, default=1.0)}
    values = [float(noise.get(c.name, largest[c.unit])) for c in situation.mechanism.channels]
    return torch.tensor(values, dtype=torch.float64)


def named_machine(said: Diagnosis) -> dict[str, Any] | None:
    """The entry `machine` of a diagnosis.json: effects and geometry that were named, fitted together to the rows.

    Where geometry or a parameter is among the names, all parameters are identified, six a link of an arm. None where a
    model can hold nothing of the verdict: no effect, one that needs the rows in order, several tools, or a simulator.
    A machine whose rows have a base frame for each group is that in its own base.
    """
    analysis, here = said.analysis, said.analysis.situation
    arm = here.mechanism
    rows = arm.resolve(here.parameters)
    rows = rows if rows.dim() > 1 else rows[None]
    grouped = len(rows) > 1
    if isinstance(arm, BlackBox) or bool((rows[:, -6:] != rows[0, -6:]).any()):
        return None
    recorded = replace(here, covariates={n: v for n, v in here.covariates.items() if n not in said.inferred})
    named = tuple((a.effect.name, _numbers(a, said)) for a in said.acting)
    try:
        whole, drift = Verdict(TRAINING_ROWS, here.gravity, named).of_machine()
        beside = [(a.effect, numbers) for a, (_, numbers) in zip(said.acting, named, strict=True) if _is_beside(a)]
        verdict = usable_verdict(whole, recorded)[0]
        identify = any(a.effect.kind == "parameters" for a in said.acting)
        if verdict is None and drift is None and not identify:
            return None
        situation = on_fitted_frames(recorded)
        if identify and isinstance(arm, SerialArm):
            situation = _in_link_frames(situation)
        known = [] if verdict is None else [k for k in verdict.on(recorded)[0] if k.effect.kind != "parameters"]
        if beside:
            # Fitted beside, and left out: it is none of the machine.
            times = (here.covariates[n] for n in ("time", ROW) if n in here.covariates)
            situation = in_time(situation, elapsed(next(times)))
            known += [with_numbers(effect, situation, numbers) for effect, numbers in beside]
        loose = loose_parameters(situation.mechanism, identify)
        fine = analysis.whitening.counted & ~analysis.near_singular
        acting, values = fit_jointly(situation, analysis.measured, known, fine, loose)
        acting = [a for a in acting if not _is_beside(a)]
        if grouped:
            situation, values = in_own_base(situation, values[0])
        used = used_covariates(situation, acting)
        situation = replace(situation, covariates={n: v for n, v in situation.covariates.items() if n in used})
        situation = of_commands(situation, acting)
        if isinstance(situation.mechanism, Seen):
            return None
        values = values[..., : len(situation.mechanism.geometry)]
        return found_block(situation, values, acting, covariate_units(situation.mechanism, used))
    except InputError:
        # A machine that no file describes, or an effect that needs what was before a row.
        return None


def of_commands(situation: Situation, acting: Sequence[Acting]) -> Situation:
    """The rows on the machine with its whole pose, whatever of it was measured: commands are for whole poses.

    Of an arm of which positions were measured another tool is at its place only where the orientation is right as well;
    three joints or fewer are all needed for the position. Rows stay as they are where an effect is of what was seen
    alone, as of a tool that was seen in part.
    """
    if all(len(a.effect.coefficients(situation.whole)) == len(a.coefficients) for a in acting):
        situation = situation.visits
    arm = situation.mechanism
    if not isinstance(arm, SerialArm) or arm.orientation != "none" or len(arm.joints) < 4:
        return situation
    return replace(situation, mechanism=arm.with_orientation("rotation_vector"), guess=None)


def _is_beside(acting: Acting) -> bool:
    """Whether an effect is of these rows alone, and not of the machine that others meet."""
    return acting.effect.name in (FrameDrift.name, Homing.name)


def _in_link_frames(situation: Situation) -> Situation:
    """An arm with six parameters a link; groups of rows keep their base frames."""
    arm, values = situation.mechanism, situation.parameters
    assert isinstance(arm, SerialArm)
    if values is None or values.dim() == 1:
        return replace(situation, mechanism=arm.with_link_frames())
    first = arm.with_nominal(values[0])
    assert isinstance(first, SerialArm)
    six = first.with_link_frames()
    parameters = torch.cat([values[:, :6], six.nominal[6:].expand(len(values), -1)], -1)
    return replace(situation, mechanism=six, parameters=parameters)


def in_own_base(situation: Situation, values: Tensor) -> tuple[Situation, Tensor]:
    """A machine of which groups of rows have frames, in its own base, and its parameters so.

    Where groups have tools, the tool is that of the first row, as it is: what it was taken for is no error.

    values: of one row, the first.
    """
    machine, parameters = situation.mechanism, situation.parameters
    assert parameters is not None
    none = torch.zeros(6, dtype=values.dtype)
    if isinstance(machine, SerialArm):
        plain: dict[str, Any] = {"frame_per": [], "tool_per": [], "unknown_frames": [], "tool_offset": None}
        one: Mechanism = SerialArm(**{**machine.recipe["keys"], **plain})
    else:
        assert isinstance(machine, Framed)
        one = Framed(machine.mechanism, True, machine.tool, machine.rotation_weight)
    base = 6 if isinstance(machine, SerialArm) or machine.base else 0
    nominal = torch.cat([parameters[0, base:-6], values[-6:]]) if machine.tool_per else parameters[0, base:]
    alone = one.with_nominal(torch.cat([none, nominal]))
    down = situation.gravity
    if base and not has_upright_base(machine):
        down = rotation_vector_to_matrix(parameters[0, 3:6]).mT @ down
    return replace(situation, mechanism=alone, parameters=None, gravity=down), torch.cat([none, values[base:]])


def _numbers(acting: Acting, said: Diagnosis) -> dict[str, float]:
    """Coefficients that were found and shapes, by name [SI]."""
    here = said.analysis.situation
    names = [c.name for c in acting.effect.coefficients(here)]
    found = {name: value for name, value in zip(names, acting.coefficients.tolist(), strict=True) if value}
    shapes = [s.name for s in acting.effect.shapes(here)]
    return found | dict(zip(shapes, acting.shape.tolist(), strict=True))
