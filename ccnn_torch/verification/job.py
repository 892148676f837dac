"""Verify a model on new rows against its promised error."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from pydantic import Field
from torch import Tensor

from ccnn_torch.compensation import LoadedModel
from ccnn_torch.compensation.outputs import DAMPED
from ccnn_torch.config.tree import Columns, Files, JobConfig, JointMap
from ccnn_torch.diagnosis.checks.mistakes import OF_FRAME, mistake
from ccnn_torch.diagnosis.residual.distance import USUAL, distance, size_of
from ccnn_torch.display import count_text
from ccnn_torch.effects import Situation, default_gravity, measured_pose, reached
from ccnn_torch.effects.columns import inside
from ccnn_torch.errors import InputError
from ccnn_torch.mechanisms import (
    Instrument,
    Mechanism,
    PoseError,
    Seen,
    SerialArm,
    as_measured,
    load_mechanism,
)
from ccnn_torch.mechanisms.frames.fit import ROTATION_WEIGHT, rigid_body_frame
from ccnn_torch.mechanisms.frames.partial import completed
from ccnn_torch.numerics.rotations import rotation_vector_to_matrix
from ccnn_torch.pseudoerror import joint_deviations
from ccnn_torch.records import Records, check_rows, load_records
from ccnn_torch.records.commanded import SECOND
from ccnn_torch.records.headers import columns_there
from ccnn_torch.records.joint_map import read_joint_map
from ccnn_torch.records.load import read_source
from ccnn_torch.records.read_table import mapped
from ccnn_torch.report.arrays import RunArrays
from ccnn_torch.report.results.base import Length
from ccnn_torch.report.results.verify import Error, JointError, Promised, Size, VerifyResults
from ccnn_torch.spelling import nearest
from ccnn_torch.units import split_header
from ccnn_torch.verification.page import verify_text
from ccnn_torch.verification.promise import configurations, paired_gain, promise_of, promised, repeated

# As in a run, if no card gives it: weight of orientation [m/rad], and damping of an arm's joint deviation.
_RUN_WEIGHT, _ARM_DAMPING = 0.04, 0.01


@dataclass(frozen=True)
class Rows:
    """Records and predictions of a model: joints and deviations `s x n`, poses `s x p` [SI]; inside `s`, bool; damped
    `s`, bool: what the model predicts is not where its machine would be, but what it holds back to."""

    mechanism: Mechanism
    joints: Tensor
    pose: Tensor
    deviation: Tensor
    inside: Tensor
    nominal: Tensor
    predicted: Tensor
    damped: Tensor

    @property
    def whole(self) -> Tensor:
        """The poses, with the predicted ones in what was not measured, `s x p` [SI]."""
        return torch.where(self.pose.isnan(), self.predicted, self.pose)

    def undone(self, motion: Tensor) -> Tensor:
        """The poses as they would have been measured in the model's frame, `s x p` [SI]; NaN where not measured.

        motion: `6`, position [m] and rotation vector [rad], from the model's measuring frame into the new one.
        """
        if not bool(motion.any()):
            return self.pose
        position, rotation = self.mechanism.frame(self.whole)
        turn = rotation_vector_to_matrix(motion[3:]).mT
        place = ((position - motion[:3])[..., None, :] @ turn.mT)[..., 0, :]
        before = self.mechanism.pose_near(place, None if rotation is None else turn @ rotation)
        return torch.where(self.pose.isnan(), torch.nan, before)


def nominal_mechanism(
    model: LoadedModel, spec: str | None, allow_code: bool, keys: Mapping[str, Any] | None = None
) -> Mechanism:
    """The nominal machine that the model was made for, its frames as they were fitted then."""
    about = model.facts["mechanism"]
    if spec is None:
        if model.machine is not None:
            return model.machine.nominal
        return model.mechanism(allow_code)
    shown = load_mechanism(spec, **(keys or {}))
    given = inside(shown)
    if isinstance(given, SerialArm) and len(about["pose"]) == 3:
        given = given.with_orientation("none")
    for key in ("name", "joints", "pose"):
        if about[key] != given.describe()[key]:
            raise InputError(
                f"--mechanism {spec}: {model.path} was made for {about['name']} ({', '.join(about['joints'])}; "
                f"{', '.join(about['pose'])}), not for {given.name}; take the model of that machine"
            )
    given.set_parameters(about["parameters"])
    return shown.around(given) if isinstance(shown, Seen) else given


def new_rows(
    model: LoadedModel,
    records: Any,
    mechanism: str | None,
    allow_code: bool = False,
    columns: Mapping[str, str] | None = None,
    joint_map: Mapping[str, str] | None = None,
    mechanism_keys: Mapping[str, Any] | None = None,
) -> tuple[Mechanism, Records]:
    """Rows measured after a model was made, and the nominal machine as they show it.

    Args:
        model: as `load_compensation` gives it.
        records: what `load_records` takes. Headers that the model's records had and its run mapped are mapped alike.
        mechanism: name or file of the nominal machine; the one that the model describes when None.
        allow_code: run the Python file that the model names for a user's own mechanism.
        columns: header in the records -> ``name[unit]`` or ``ignore``; those of the model's run when None or empty.
        joint_map: joint -> sum of columns; that of the model's run, where the records count so, when None or empty.
        mechanism_keys: keys of the mechanism's constructor.

    Raises:
        InputError: the rows lack a column, or are not of this machine.
    """
    machine = nominal_mechanism(model, mechanism, allow_code, mechanism_keys)
    names = [c.name for c in model.covariates]
    there, counted = mapped_columns(model, records, machine)
    maps = {"columns": columns or there, "joint_map": joint_map or counted}
    loaded = load_records(records, machine, names, learns=False, **maps)
    return as_measured(machine, loaded.pose_coordinates, loaded.path, loaded.pose), loaded


def mapped_columns(model: LoadedModel, records: Any, machine: Mechanism) -> tuple[dict[str, str], dict[str, str]]:
    """The maps of columns and of joints that the model's run had, as far as the new rows have these headers."""
    if isinstance(records, Records) or not (model.columns or model.joint_map):
        return {}, {}
    table = read_source(records)
    columns = columns_there(table.units, model.columns)
    counted = read_joint_map(model.joint_map, machine.joints, model.columns)
    shown = counted is not None and counted.is_in(table.names, mapped(table, columns))
    return columns, model.joint_map if shown else {}


def missing_of(model: LoadedModel, records: Records) -> list[str]:
    """Sentences on what was not measured: parts of rows, and coordinates of the model's pose that no column has."""
    units = {c.name: c.unit for c in records.pose_coordinates}
    headers = {split_header(target)[0]: split_header(key)[0] for key, target in model.columns.items()}
    notes = records.missing
    for c in model.pose:
        header = headers.get(c.name, "")
        # Where positions alone were measured, nobody misses the orientation.
        if c.name in units or not (header or c.unit in units.values()):
            continue
        near = nearest(header, [*records.columns])
        called = f" ('{header}' in the model's records)" if header else ""
        meant = f"; if column '{near}' is meant, rename it to '{header}'" if near else ""
        notes.append(f"{c.name}{called} is not among these rows, which are judged by {', '.join(units)} alone{meant}.")
    return notes


def predict(model: LoadedModel, machine: Mechanism, records: Records, compensated: bool) -> Rows:
    for key in ("frame_per", "tool_per"):
        if getattr(machine, key, ()):
            raise InputError(
                f"{model.path}: {machine.name} had frames per group of rows ({key}), which no model file holds; verify "
                "the rows of one group with a model that was made from that group"
            )
    names = [c.name for c in records.pose_coordinates]
    pose = records.pose[:, [names.index(c.name) for c in machine.pose]]
    if isinstance(machine, Instrument):
        machine = machine.placed(records.joints, pose)
    guess = completed(machine, records.joints, pose)
    rows = Situation(machine, records.joints, _covariates(model, records), default_gravity(machine), None, guess)
    found = [_found(model, place) for place in rows.places]
    ideal = [torch.from_numpy(np.asarray(one["ideal"])) for one in found]
    nominal = machine.forward_kinematics(records.joints, guess=guess)
    if model.machine is not None:
        nominal_of, real = (
            machine.around(m) if isinstance(machine, Seen) else as_measured(m, machine.pose, records.path, pose)
            for m in (model.machine.nominal, model.machine.identified)
        )
        real = real.placed(records.joints, pose) if isinstance(real, Instrument) else real
        predicted = real.forward_kinematics(records.joints, guess=guess)
        if model.machine.acting:
            here = replace(rows, mechanism=nominal_of, gravity=model.machine.gravity, travel=model.machine.travel)
            predicted = measured_pose(here, reached(here, model.machine.acting, real.nominal))
    else:
        there = rows.moved(ideal, None)
        real = machine.placed(there.joints, pose) if isinstance(machine, Instrument) else machine
        predicted = real.forward_kinematics(there.joints, guess=there.guess)
    lost = np.flatnonzero(~(torch.isfinite(nominal) & torch.isfinite(predicted)).all(-1).numpy())
    if len(lost):
        raise InputError(
            f"{records.path}: {machine.name} has no pose with the joints at {records.name_rows(lost)}; correct or "
            "remove them, or check the units"
        )
    key = "inside_domain" if compensated else "ideal_inside_domain"
    inside = torch.from_numpy(np.all([one[key] for one in found], axis=0))
    back = model.machine is None and not compensated
    damped = torch.from_numpy(np.any([back & (one["ideal_status"] == DAMPED) for one in found], axis=0))
    return Rows(machine, records.joints, pose, ideal[0] - records.joints, inside, nominal, predicted, damped)


def _covariates(model: LoadedModel, records: Records) -> dict[str, Tensor]:
    """The model's covariates, `s` each [SI], a constant one as well, which a run would have dropped."""
    names = [f"{c.name}{ending}" for c in model.covariates for ending in ("", SECOND)]
    return {n: torch.from_numpy(records.columns[n]) for n in names if n in records.columns}


def _found(model: LoadedModel, rows: Situation) -> dict[str, np.ndarray[Any, Any]]:
    """What the model says of rows."""
    covariates = [rows.covariates[c.name].numpy() for c in model.covariates]
    return model(rows.joints.numpy(), np.stack(covariates, axis=-1) if covariates else None)


def pseudoerror_settings(model: LoadedModel, machine: Mechanism) -> dict[str, Any]:
    """How the joint deviations of a run were found: as the card has it."""
    card = model.card
    damping = float(card.get("damping", _ARM_DAMPING if isinstance(machine, SerialArm) else 0.0))
    return {
        "rotation_weight": float(card.get("rotation_weight", _RUN_WEIGHT)),
        "damping": damping,
        "max_condition": math.inf if damping > 0 else 50.0,
    }


def judge(
    rows: Rows, compensated: bool, motions: list[Tensor], settings: Mapping[str, Any]
) -> tuple[PoseError, PoseError, Tensor, Tensor, Tensor]:
    """Pose error before and after, `s`; joint deviation before and after, `s x n` [SI]; rows with one, `s`."""
    machine = rows.mechanism
    if compensated:
        measured = rows.undone(motions[0])
        before = machine.pose_error(rows.predicted, rows.nominal)
        after = machine.pose_error(measured, rows.nominal)
        found = joint_deviations(machine, rows.joints, measured, **settings)
        return before, after, rows.deviation, found.deviation, found.usable
    first, last = (rows.undone(motion) for motion in motions)
    before = machine.pose_error(first, rows.nominal)
    after = machine.pose_error(last, rows.predicted)
    # Beside the frames that the model's deviation was found with, or those that suit the model best.
    found = joint_deviations(machine, rows.joints, last, **settings)
    return before, after, found.deviation, found.deviation - rows.deviation, found.usable


def gaps(rows: Rows, compensated: bool, motions: list[Tensor]) -> tuple[Tensor, Tensor, Tensor]:
    """Measured positions, and from where they should be to where they are before and after, `s x 3` each [m]."""
    machine = rows.mechanism
    nominal, predicted = (machine.frame(pose)[0] for pose in (rows.nominal, rows.predicted))
    first, last = (machine.frame(rows.undone(motion))[0] for motion in motions)
    before, after = (predicted - nominal, first - nominal) if compensated else (first - nominal, last - predicted)
    return first, before, after


def _of(error: PoseError, judged: Tensor) -> PoseError:
    """Errors `s`, NaN in rows that are not judged, `s` bool."""
    parts = (None if part is None else torch.where(judged, part, torch.nan) for part in error)
    position, rotation = parts
    assert position is not None
    return PoseError(position, rotation)


# Rows that show a frame.
_NEEDED = 4


def can_be_moved(mechanism: Mechanism) -> bool:
    """Whether poses of this mechanism can be moved in space."""
    names = {c.name for c in mechanism.pose}
    return names in ({"x", "y", "z"}, {"x", "y", "z", "rx", "ry", "rz"})


def motion_text(motion: Tensor) -> str:
    """How far a rigid motion goes, and how far it turns."""
    return f"{1e3 * float(motion[:3].norm()):.3g} mm and {1e3 * float(motion[3:].norm()):.3g} mrad"


def fit_motion(mechanism: Mechanism, expected: Tensor, measured: Tensor) -> Tensor:
    """The motion `6`, position [m] and rotation vector [rad], that takes expected poses nearest to those measured,
    `s x p` [SI] each; whole ones (no NaN) count.

    Raises:
        InputError: the mechanism's poses cannot be moved in space, or the rows are too few.
    """
    if not can_be_moved(mechanism):
        names = ", ".join(c.name for c in mechanism.pose)
        raise InputError(
            f"--refit-frames: the pose of {mechanism.name} is {names}, and a frame can be fitted to x, y, z only "
            "(with or without rx, ry, rz); leave the option out"
        )
    whole = ~measured.isnan().any(-1)
    if int(whole.sum()) < _NEEDED:
        raise InputError(f"--refit-frames: {int(whole.sum())} rows are too few to fit a frame; give {_NEEDED} or more")
    expected, measured = expected[whole], measured[whole]
    weights = torch.ones(len(measured), dtype=torch.float64)
    return rigid_body_frame(mechanism.frame(expected), mechanism.frame(measured), weights, ROTATION_WEIGHT)


# A moved measuring frame is suspected if correcting it halves the remaining RMS error at least, and leaves no more than
# was promised.
_SUSPECT = 0.5


def _refuse_mistakes(records: Records, machine: Mechanism) -> None:
    """Raise InputError where the usual row is far from the nominal machine, and units, signs or columns say why; that
    the measuring device was moved is told with the results."""
    if isinstance(machine, Seen) or machine.grouped or len(records.pose_coordinates) != len(machine.pose):
        return
    rows = Situation(
        machine, records.joints, {}, default_gravity(machine), None, completed(machine, records.joints, records.pose)
    )
    size = size_of(rows)
    if float(distance(rows, records.pose, size).nanmedian()) <= USUAL:
        return
    said = mistake(rows, records.pose, size)
    if said and not said.startswith(OF_FRAME):
        raise InputError(f"{records.path}: the usual pose is not where {machine.name} has it: {said}")


def verify_model(
    model: LoadedModel,
    records: Any,
    mechanism: str | None = None,
    compensated: bool = False,
    refit_frames: bool = False,
    **how: Any,
) -> tuple[VerifyResults, RunArrays]:
    """Judge a model on new rows; also gives the arrays that its pictures need, all rows held out.

    Without `compensated` the joints are commands and the pose is what the uncompensated machine reached: before = its
    distance from the nominal machine's pose, after = from the pose that the model predicts, as `pose` of a run's
    results. With `compensated` the joints are the ideal ones that went through the compensator and the pose should be
    the nominal one: after = its distance from that, before = the pose error without compensation, by the model.

    Args:
        model, records, mechanism, how: as of `new_rows`.
        refit_frames: a rigid motion of the measuring frame is fitted before rows are judged, to "before" and "after"
            each its own: the tracker was moved since the model was made.

    Raises:
        InputError: as `new_rows`, or frames cannot be fitted to the rows.
    """
    machine, loaded = new_rows(model, records, mechanism, **how)
    if not refit_frames:
        check_rows(loaded, machine)
        _refuse_mistakes(loaded, machine)
    rows = predict(model, machine, loaded, compensated)
    if refit_frames:
        motions = [fit_motion(rows.mechanism, at, rows.pose) for at in (rows.nominal, rows.predicted)]
    else:
        motions = [torch.zeros(6, dtype=torch.float64)] * 2
    before, after, measured, left, usable = judge(rows, compensated, motions, pseudoerror_settings(model, machine))
    judged = ~rows.damped if bool((~rows.damped).any()) else torch.ones_like(rows.damped)
    before, after, usable = _of(before, judged), _of(after, judged), usable & judged
    groups = configurations(rows.joints, machine.joints)
    promise = promise_of(model)
    count = len(torch.unique(groups[judged]))

    def error(kind: str, unit: Length, first: Tensor | None, last: Tensor | None) -> Error | None:
        return error_of(unit, first, last, promised(promise, kind, count) if promise else None)

    position = error("position", "m", before.position, after.position)
    rotation = error("rotation", "rad", before.rotation, after.rotation)
    assert position is not None
    limited = [block for block in (position, rotation) if block is not None and block.promised is not None]
    kept = [block.promised is None or block.after.rms <= block.promised.high for block in limited]
    results = VerifyResults(
        model=Path(model.path).name,
        records=Path(loaded.path).name,
        mechanism=machine.name,
        rows=len(loaded),
        configurations=count,
        outside_domain=int((~rows.inside).sum()),
        compensated=compensated,
        frames="fitted again" if refit_frames else "the model's",
        position=position,
        rotation=rotation,
        repeated=repeated(*gaps(rows, compensated, motions), groups),
        joints={
            c.name: JointError(unit=c.unit, before=rms_of(measured[usable, k]), after=rms_of(left[usable, k]))
            for k, c in enumerate(machine.joints)
        },
        kept=all(kept),
        notes=[],
        text="",
    )
    if not limited:
        # The first error has to fall at 95 %.
        first, last = (getattr(error, results.kinds[0]) for error in (before, after))
        results.kept = paired_gain(first, last, groups)
    results.notes += missing_of(model, loaded)
    if held := int((~judged).sum()):
        results.notes.append(
            f"{count_text(held, 'row')} next to a singular pose, where the model holds its way back to the nearest "
            "safe joints, so that it predicts no pose there: not judged."
        )
    if results.outside_domain:
        results.notes.append(
            f"{count_text(results.outside_domain, 'row')} outside the model's domain, where its correction fades: "
            "the promise is not made for such rows."
        )
    if not refit_frames:
        results.notes += _moved(rows, results)
    results.text = verify_text(results)
    if loaded.data_hash == model.facts.get("data_sha256"):
        results.text = f"These are the rows that the model was made from, so this is no test. {results.text}"
    return results, figure_arrays(rows, measured, left, before, after)


def _moved(rows: Rows, results: VerifyResults) -> list[str]:
    """A sentence if a moved measuring frame explains at least half of the remaining error."""
    whole = ~rows.pose.isnan().any(-1)
    few = min(results.configurations, int(whole.sum())) < 4
    if results.kept or few or "position" not in results.kinds or not can_be_moved(rows.mechanism):
        return []
    at = rows.nominal if results.compensated else rows.predicted
    motion = fit_motion(rows.mechanism, at, rows.pose)
    left = rms_of(rows.mechanism.pose_error(rows.undone(motion), at).position)
    promised = results.position.promised
    if left is None or left > _SUSPECT * results.position.after.rms or (promised and left > promised.high):
        return []
    return [
        f"The measuring device seems to have moved since the model was made: a rigid motion of its frame by "
        f"{motion_text(motion)} would leave {1e3 * left:.3g} mm RMS; if it was moved, judge with --refit-frames."
    ]


def error_of(unit: Length, before: Tensor | None, after: Tensor | None, promise: Promised | None) -> Error | None:
    """The errors of all rows before and after, `s` [unit]; NaN where not measured. None where there are none."""
    if before is None or after is None or bool(after.isnan().all()):
        return None
    first, last = (
        Size(rms=float(e.square().nanmean().sqrt()), max=float(e.nan_to_num().max())) for e in (before, after)
    )
    return Error(unit=unit, before=first, after=last, promised=promise)


def rms_of(values: Tensor) -> float | None:
    return float(values.square().nanmean().sqrt()) if values.numel() else None


def figure_arrays(rows: Rows, measured: Tensor, left: Tensor, before: PoseError, after: PoseError) -> RunArrays:
    mechanism = rows.mechanism
    place = mechanism.hand(rows.joints) if isinstance(mechanism, Instrument) else mechanism.frame(rows.whole)[0]
    return RunArrays(
        joints=rows.mechanism.joints,
        commanded=rows.joints.numpy(),
        measured=measured.detach().numpy(),
        predicted=(measured - left).detach().numpy(),
        test=np.ones(len(rows.joints), dtype=np.bool_),
        place=place.numpy(),
        position_before=before.position.detach().numpy(),
        position_after=after.position.detach().numpy(),
        rotation_before=None if before.rotation is None else before.rotation.detach().numpy(),
        rotation_after=None if after.rotation is None else after.rotation.detach().numpy(),
        labels={"mechanism": rows.mechanism.name},
    )


class VerifyConfig(JobConfig):
    """Keys of `ccnn verify`, which mean the same in a config for `ccnn run`."""

    of_a_run = ("records", "columns", "joint_map", "mechanism", "mechanism_keys")

    records: Files | None = Field(default=None, description="new rows; the same as RECORDS.csv and --records")
    columns: Columns
    joint_map: JointMap
    mechanism: str | None = Field(
        default=None, description="the nominal machine; the same as --mechanism; null = the model's"
    )
    mechanism_keys: dict[str, Any] = Field(default={}, description="keys of the mechanism's constructor")
