"""Judge a model on new rows against what it promised."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ccnn_torch.compensation import IdentifiedGeometry, LoadedModel
from ccnn_torch.display import count_text
from ccnn_torch.errors import InputError
from ccnn_torch.mechanisms import Mechanism, PoseError, SerialArm, load_mechanism, mechanism_from_description
from ccnn_torch.plugins import code_refused
from ccnn_torch.pseudoerror import joint_deviations
from ccnn_torch.records import Records, check_rows, load_records
from ccnn_torch.records.sources import read_source
from ccnn_torch.report.arrays import RunArrays
from ccnn_torch.report.json_files import read_json
from ccnn_torch.verification.moved_frame import Motion, fit_motion
from ccnn_torch.verification.promise import configurations, paired_gain, promised
from ccnn_torch.verification.tables import verify_text

__all__ = ["Verified", "verify_model"]

# As in a run: of orientation against position [m/rad], and damping of an arm's joint deviation, where no card says it.
_ROTATION_WEIGHT, _ARM_DAMPING = 0.04, 0.01
# A moved measuring frame is suspected where setting it right takes at least half of what is left.
_SUSPECT = 0.5


@dataclass(frozen=True)
class Verified:
    """`results`: the content of verify.json; `arrays`: what its pictures need, all rows held out."""

    results: dict[str, Any]
    arrays: RunArrays


@dataclass(frozen=True)
class _Rows:
    """Records beside what a model says of them: joints and deviations `s x n`, poses `s x p` [SI]; inside `s`, bool."""

    mechanism: Mechanism
    joints: Tensor
    pose: Tensor
    deviation: Tensor
    inside: Tensor
    nominal: Tensor
    predicted: Tensor


def verify_model(
    model: LoadedModel | IdentifiedGeometry,
    records: Any,
    mechanism: str | None = None,
    compensated: bool = False,
    refit_frames: bool = False,
    allow_code: bool = False,
) -> Verified:
    """Judge a model on new rows.

    Without `compensated` the joints are commands and the pose is what the uncompensated machine reached: before = its
    distance from the nominal machine's pose, after = from the pose that the model predicts, as `pose` of a run's
    results. With `compensated` the joints are the ideal ones that went through the compensator and the pose should be
    the nominal one: after = its distance from that, before = what the model says the machine would have missed by.

    Args:
        records: what `load_records` takes. Headers that the model's records had and its run mapped are mapped alike.
        mechanism: name or file; the one that the model describes when None.
        refit_frames: a rigid motion of the measuring frame is fitted before rows are judged, to "before" and "after"
            each its own: the tracker was moved since the model was made.
        allow_code: run the Python file that the model names for a user's own mechanism.

    Raises:
        InputError: the rows lack a column, are not of this machine, or frames cannot be fitted to them.
    """
    machine = _mechanism(model, mechanism, allow_code)
    names = [c.name for c in model.covariates]
    loaded = load_records(records, machine, names, learns=False, columns=_columns(model, records))
    if isinstance(machine, SerialArm) and loaded.orientation == "none":
        machine = machine.with_orientation("none")
    if not refit_frames:
        check_rows(loaded, machine)
    rows = _predict(model, machine, loaded, compensated)
    if refit_frames:
        motions = [fit_motion(rows.mechanism, at, rows.pose) for at in (rows.nominal, rows.predicted)]
    else:
        motions = [Motion.none(), Motion.none()]
    before, after, measured, left, usable = _judge(rows, compensated, motions, _settings(model, machine))
    groups = configurations(rows.joints, machine.joints)
    promise = _promise(model)
    count = int(groups.max()) + 1
    blocks = {
        kind: _block(unit, first, last, promise and promised(promise, kind, count))
        for kind, unit, first, last in (
            ("position", "m", before.position, after.position),
            ("rotation", "rad", before.rotation, after.rotation),
        )
    }
    results: dict[str, Any] = {
        "model": Path(model.path).name,
        "records": Path(loaded.path).name,
        "mechanism": machine.name,
        "rows": len(loaded),
        "configurations": count,
        "outside_domain": int((~rows.inside).sum()),
        "compensated": compensated,
        "frames": "fitted again" if refit_frames else "the model's",
        **blocks,
        "joints": {
            c.name: {"unit": c.unit, "before": _rms(measured[usable, k]), "after": _rms(left[usable, k])}
            for k, c in enumerate(machine.joints)
        },
        "kept": _kept(blocks, before, after, groups),
        "notes": [],
    }
    if results["outside_domain"]:
        results["notes"].append(
            f"{count_text(results['outside_domain'], 'row')} outside the model's domain, where its correction fades: "
            "the promise is not made for such rows."
        )
    if not refit_frames:
        results["notes"] += _moved(rows, results, compensated)
    results["text"] = verify_text(results)
    if loaded.data_hash == model.facts.get("data_sha256"):
        results["text"] = f"These are the rows that the model was made from, so this is no test. {results['text']}"
    return Verified(results, _arrays(rows, measured, left, before, after))


def _mechanism(model: LoadedModel | IdentifiedGeometry, spec: str | None, allow_code: bool) -> Mechanism:
    """The nominal machine that the model was made for, its frames as they were fitted then."""
    about = model.facts["mechanism"]
    if spec is None:
        if isinstance(model, IdentifiedGeometry):
            return model.nominal
        with code_refused(f"{model.path}: its mechanism", allow_code):
            return mechanism_from_description(about, allow_code=True)
    given = load_mechanism(spec)
    if isinstance(given, SerialArm) and len(about["pose"]) == 3:
        given = given.with_orientation("none")
    for key in ("name", "joints", "pose"):
        if about[key] != given.describe()[key]:
            raise InputError(
                f"--mechanism {spec}: {model.path} was made for {about['name']} ({', '.join(about['joints'])}; "
                f"{', '.join(about['pose'])}), not for {given.name}; take the model of that machine"
            )
    given.set_parameters(about["parameters"])
    return given


def _columns(model: LoadedModel | IdentifiedGeometry, records: Any) -> dict[str, str]:
    """The map of columns that the model's run had, as far as the new rows have these headers."""
    known = {} if isinstance(model, IdentifiedGeometry) else model.card.get("columns") or {}
    if not known or isinstance(records, Records):
        return {}
    table = read_source(records)
    there = {*table.names, *(table.header(name) for name in table.names)}
    return {header: meaning for header, meaning in known.items() if header in there}


def _predict(model: LoadedModel | IdentifiedGeometry, machine: Mechanism, records: Records, compensated: bool) -> _Rows:
    for key in ("frame_per", "tool_per"):
        if getattr(machine, key, ()):
            raise InputError(
                f"{model.path}: {machine.name} had frames per group of rows ({key}), which no model file holds; verify "
                "the rows of one group with a model that was made from that group"
            )
    names = [c.name for c in records.pose_coordinates]
    pose = records.pose[:, [names.index(c.name) for c in machine.pose]]
    found = model(records.joints.numpy(), _covariates(model, records))
    ideal = torch.from_numpy(np.asarray(found["ideal"]))
    nominal = machine.forward_kinematics(records.joints, guess=pose)
    if isinstance(model, IdentifiedGeometry):
        real = model.identified
        if isinstance(real, SerialArm) and len(machine.pose) == 3:
            real = real.with_orientation("none")
        predicted = real.forward_kinematics(records.joints, guess=pose)
    else:
        predicted = machine.forward_kinematics(ideal, guess=pose)
    lost = np.flatnonzero(~(torch.isfinite(nominal) & torch.isfinite(predicted)).all(-1).numpy())
    if len(lost):
        raise InputError(
            f"{records.path}: {machine.name} has no pose with the joints at {records.name_rows(lost)}; correct or "
            "remove them, or check the units"
        )
    inside = torch.from_numpy(np.asarray(found["inside_domain" if compensated else "ideal_inside_domain"]))
    return _Rows(machine, records.joints, pose, ideal - records.joints, inside, nominal, predicted)


def _covariates(model: LoadedModel | IdentifiedGeometry, records: Records) -> np.ndarray[Any, Any] | None:
    """The model's covariates, `s x m` [SI], a constant one as well, which a run would have dropped."""
    if not model.covariates:
        return None
    return np.stack([records.columns[c.name] for c in model.covariates], axis=-1)


def _settings(model: LoadedModel | IdentifiedGeometry, machine: Mechanism) -> dict[str, Any]:
    """How the joint deviations of a run were found: as the card has it."""
    card = {} if isinstance(model, IdentifiedGeometry) else model.card
    damping = float(card.get("damping", _ARM_DAMPING if isinstance(machine, SerialArm) else 0.0))
    return {
        "rotation_weight": float(card.get("rotation_weight", _ROTATION_WEIGHT)),
        "damping": damping,
        "max_condition": math.inf if damping > 0 else 50.0,
    }


def _judge(
    rows: _Rows, compensated: bool, motions: list[Motion], settings: Mapping[str, Any]
) -> tuple[PoseError, PoseError, Tensor, Tensor, Tensor]:
    """Pose error before and after, `s`; joint deviation before and after, `s x n` [SI]; rows with one, `s`."""
    machine = rows.mechanism
    if compensated:
        measured = motions[0].undone(machine, rows.pose)
        before = machine.pose_error(rows.predicted, rows.nominal)
        after = machine.pose_error(measured, rows.nominal)
        found = joint_deviations(machine, rows.joints, measured, **settings)
        return before, after, rows.deviation, found.deviation, found.usable
    first, last = (motion.undone(machine, rows.pose) for motion in motions)
    before = machine.pose_error(first, rows.nominal)
    after = machine.pose_error(last, rows.predicted)
    # Beside the frames that the model's deviation was found with, or those that suit the model best.
    found = joint_deviations(machine, rows.joints, last, **settings)
    return before, after, found.deviation, found.deviation - rows.deviation, found.usable


def _promise(model: LoadedModel | IdentifiedGeometry) -> dict[str, Any] | None:
    """The card's promise, or that of the identified.json beside an identified.yaml."""
    if isinstance(model, LoadedModel):
        metrics = model.card.get("metrics")
        found = metrics.get("promise") if isinstance(metrics, dict) else None
        return found if isinstance(found, dict) else None
    path = Path(model.path).with_name("identified.json")
    if not path.is_file():
        return None
    results = read_json(path)
    promise, parameters = results.get("promise"), results.get("parameters")
    if not isinstance(promise, dict) or not isinstance(parameters, dict):
        return None
    own = model.identified.describe()["parameters"]
    same = all(math.isclose(own.get(name, math.nan), block["value"]) for name, block in parameters.items())
    return promise if same else None


def _block(
    unit: str, before: Tensor | None, after: Tensor | None, promise: Mapping[str, float] | None
) -> dict[str, Any] | None:
    if before is None or after is None:
        return None
    figures = {
        when: {"rms": _rms(error), "max": float(error.max())} for when, error in (("before", before), ("after", after))
    }
    return {"unit": unit, **figures, "promised": promise}


def _rms(values: Tensor) -> float | None:
    return float(values.square().mean().sqrt()) if values.numel() else None


def _kept(blocks: Mapping[str, dict[str, Any] | None], before: PoseError, after: PoseError, groups: Tensor) -> bool:
    """Whether no RMS is above its upper limit; without a promise, whether the position error fell at 95 %."""
    judged = [block for block in blocks.values() if block is not None and block["promised"] is not None]
    if not judged:
        return paired_gain(before.position, after.position, groups)
    return all(block["after"]["rms"] <= block["promised"]["high"] for block in judged)


def _moved(rows: _Rows, results: Mapping[str, Any], compensated: bool) -> list[str]:
    """A sentence where a moved measuring frame explains most of what is left."""
    if results["kept"] or not Motion.fits(rows.mechanism) or results["configurations"] < 4:
        return []
    at = rows.nominal if compensated else rows.predicted
    motion = fit_motion(rows.mechanism, at, rows.pose)
    left = _rms(rows.mechanism.pose_error(motion.undone(rows.mechanism, rows.pose), at).position)
    if left is None or left > _SUSPECT * results["position"]["after"]["rms"]:
        return []
    return [
        f"The measuring device seems to have moved since the model was made: a rigid motion of its frame by "
        f"{motion.words} would leave {1e3 * left:.3g} mm RMS; if it was moved, judge with --refit-frames."
    ]


def _arrays(rows: _Rows, measured: Tensor, left: Tensor, before: PoseError, after: PoseError) -> RunArrays:
    return RunArrays(
        joints=rows.mechanism.joints,
        commanded=rows.joints.numpy(),
        measured=measured.detach().numpy(),
        predicted=(measured - left).detach().numpy(),
        test=np.ones(len(rows.joints), dtype=np.bool_),
        place=rows.mechanism.frame(rows.pose)[0].numpy(),
        position_before=before.position.detach().numpy(),
        position_after=after.position.detach().numpy(),
        rotation_before=None if before.rotation is None else before.rotation.detach().numpy(),
        rotation_after=None if after.rotation is None else after.rotation.detach().numpy(),
        labels={"mechanism": rows.mechanism.name},
    )
