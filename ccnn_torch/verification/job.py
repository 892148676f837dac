"""Verify a model on new rows against its promised error."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import Field
from torch import Tensor

from ccnn_torch.compensation import LoadedModel
from ccnn_torch.config.tree import Columns, Files, JobConfig, JointMap
from ccnn_torch.display import count_text
from ccnn_torch.mechanisms import Instrument, PoseError, as_measured
from ccnn_torch.records import check_rows, load_records
from ccnn_torch.report.arrays import RunArrays
from ccnn_torch.report.results.base import Length
from ccnn_torch.report.results.verify import Error, JointError, Promised, Size, VerifyResults
from ccnn_torch.verification.page import verify_text
from ccnn_torch.verification.prediction import (
    Motion,
    Rows,
    fit_motion,
    gaps,
    judge,
    mapped_columns,
    nominal_mechanism,
    predict,
    pseudoerror_settings,
)
from ccnn_torch.verification.promise import configurations, paired_gain, promise_of, promised, repeated

# A moved measuring frame is suspected if correcting it halves the remaining RMS error at least.
_SUSPECT = 0.5


def verify_model(
    model: LoadedModel,
    records: Any,
    mechanism: str | None = None,
    compensated: bool = False,
    refit_frames: bool = False,
    allow_code: bool = False,
    columns: Mapping[str, str] | None = None,
    joint_map: Mapping[str, str] | None = None,
    mechanism_keys: Mapping[str, Any] | None = None,
) -> Verified:
    """Judge a model on new rows.

    Without `compensated` the joints are commands and the pose is what the uncompensated machine reached: before = its
    distance from the nominal machine's pose, after = from the pose that the model predicts, as `pose` of a run's
    results. With `compensated` the joints are the ideal ones that went through the compensator and the pose should be
    the nominal one: after = its distance from that, before = the pose error without compensation, by the model.

    Args:
        records: what `load_records` takes. Headers that the model's records had and its run mapped are mapped alike.
        mechanism: name or file; the one that the model describes when None.
        refit_frames: a rigid motion of the measuring frame is fitted before rows are judged, to "before" and "after"
            each its own: the tracker was moved since the model was made.
        allow_code: run the Python file that the model names for a user's own mechanism.
        columns: header in the records -> ``name[unit]`` or ``ignore``; those of the model's run when None or empty.
        joint_map: joint -> sum of columns; that of the model's run, where the records count so, when None or empty.
        mechanism_keys: keys of the mechanism's constructor.

    Raises:
        InputError: the rows lack a column, are not of this machine, or frames cannot be fitted to them.
    """
    machine = nominal_mechanism(model, mechanism, allow_code, mechanism_keys)
    names = [c.name for c in model.covariates]
    there, counted = mapped_columns(model, records, machine)
    loaded = load_records(
        records, machine, names, learns=False, columns=columns or there, joint_map=joint_map or counted
    )
    machine = as_measured(machine, loaded.pose_coordinates, loaded.path, loaded.pose)
    if not refit_frames:
        check_rows(loaded, machine)
    rows = predict(model, machine, loaded, compensated)
    if refit_frames:
        motions = [fit_motion(rows.mechanism, at, rows.pose) for at in (rows.nominal, rows.predicted)]
    else:
        motions = [Motion.none(), Motion.none()]
    before, after, measured, left, usable = judge(rows, compensated, motions, pseudoerror_settings(model, machine))
    groups = configurations(rows.joints, machine.joints)
    promise = promise_of(model)
    count = int(groups.max()) + 1

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
        # Without a promise the position error has to fall at 95 %.
        kept=all(kept) if limited else paired_gain(before.position, after.position, groups),
        notes=[],
        text="",
    )
    results.notes += loaded.missing
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
    return Verified(results, figure_arrays(rows, measured, left, before, after))


def _moved(rows: Rows, results: VerifyResults) -> list[str]:
    """A sentence if a moved measuring frame explains at least half of the remaining error."""
    whole = ~rows.pose.isnan().any(-1)
    if results.kept or not Motion.fits(rows.mechanism) or min(results.configurations, int(whole.sum())) < 4:
        return []
    at = rows.nominal if results.compensated else rows.predicted
    motion = fit_motion(rows.mechanism, at, rows.pose)
    left = rms_of(rows.mechanism.pose_error(rows.undone(motion), at).position)
    if left is None or left > _SUSPECT * results.position.after.rms:
        return []
    return [
        f"The measuring device seems to have moved since the model was made: a rigid motion of its frame by "
        f"{motion.words} would leave {1e3 * left:.3g} mm RMS; if it was moved, judge with --refit-frames."
    ]


@dataclass(frozen=True)
class Verified:
    """What was found, and the arrays that its pictures need, all rows held out."""

    results: VerifyResults
    arrays: RunArrays


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
