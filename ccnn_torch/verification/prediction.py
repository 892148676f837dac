"""New records and the predictions of a model for them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ccnn_torch.compensation import LoadedModel
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
    mechanism_from_description,
)
from ccnn_torch.mechanisms.frames.fit import rigid_body_frame
from ccnn_torch.mechanisms.frames.partial import completed
from ccnn_torch.numerics.rotations import rotation_vector_to_matrix
from ccnn_torch.plugins import code_refused
from ccnn_torch.pseudoerror import joint_deviations
from ccnn_torch.records import Records
from ccnn_torch.records.commanded import SECOND
from ccnn_torch.records.headers import columns_there
from ccnn_torch.records.joint_map import read_joint_map
from ccnn_torch.records.load import read_source
from ccnn_torch.records.read_table import mapped

# As in a run, if no card gives it: weight of orientation [m/rad], and damping of an arm's joint deviation.
_ROTATION_WEIGHT, _ARM_DAMPING = 0.04, 0.01


@dataclass(frozen=True)
class Rows:
    """Records and predictions of a model: joints and deviations `s x n`, poses `s x p` [SI]; inside `s`, bool."""

    mechanism: Mechanism
    joints: Tensor
    pose: Tensor
    deviation: Tensor
    inside: Tensor
    nominal: Tensor
    predicted: Tensor

    @property
    def whole(self) -> Tensor:
        """The poses, with the predicted ones in what was not measured, `s x p` [SI]."""
        return torch.where(self.pose.isnan(), self.predicted, self.pose)

    def undone(self, motion: Motion) -> Tensor:
        """The poses as they would have been measured in the model's frame, `s x p` [SI]; NaN where not measured."""
        return torch.where(self.pose.isnan(), torch.nan, motion.undone(self.mechanism, self.whole))


def nominal_mechanism(
    model: LoadedModel, spec: str | None, allow_code: bool, keys: Mapping[str, Any] | None = None
) -> Mechanism:
    """The nominal machine that the model was made for, its frames as they were fitted then."""
    about = model.facts["mechanism"]
    if spec is None:
        if model.machine is not None:
            return model.machine.nominal
        with code_refused(f"{model.path}: its mechanism", allow_code):
            return mechanism_from_description(about, allow_code=True)
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


def mapped_columns(model: LoadedModel, records: Any, machine: Mechanism) -> tuple[dict[str, str], dict[str, str]]:
    """The maps of columns and of joints that the model's run had, as far as the new rows have these headers."""
    if isinstance(records, Records) or not (model.columns or model.joint_map):
        return {}, {}
    table = read_source(records)
    columns = columns_there(table.units, model.columns)
    counted = read_joint_map(model.joint_map, machine.joints, model.columns)
    shown = counted is not None and counted.is_in(table.names, mapped(table, columns))
    return columns, model.joint_map if shown else {}


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
            here = replace(rows, mechanism=nominal_of, gravity=model.machine.gravity)
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
    return Rows(machine, records.joints, pose, ideal[0] - records.joints, inside, nominal, predicted)


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
        "rotation_weight": float(card.get("rotation_weight", _ROTATION_WEIGHT)),
        "damping": damping,
        "max_condition": math.inf if damping > 0 else 50.0,
    }


def judge(
    rows: Rows, compensated: bool, motions: list[Motion], settings: Mapping[str, Any]
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


def gaps(rows: Rows, compensated: bool, motions: list[Motion]) -> tuple[Tensor, Tensor, Tensor]:
    """Measured positions, and from where they should be to where they are before and after, `s x 3` each [m]."""
    machine = rows.mechanism
    nominal, predicted = (machine.frame(pose)[0] for pose in (rows.nominal, rows.predicted))
    first, last = (machine.frame(rows.undone(motion))[0] for motion in motions)
    before, after = (predicted - nominal, first - nominal) if compensated else (first - nominal, last - predicted)
    return first, before, after


# Weight of orientation against position [m/rad], as in fits of an arm's frames.
_ROTATION_WEIGHT = 0.3
_NEEDED = 4


@dataclass(frozen=True)
class Motion:
    """A rigid motion `6`: position [m] and rotation vector [rad], from the model's measuring frame into the new one."""

    frame: Tensor

    @classmethod
    def none(cls) -> Motion:
        return cls(torch.zeros(6, dtype=torch.float64))

    @staticmethod
    def fits(mechanism: Mechanism) -> bool:
        """Whether poses of this mechanism can be moved in space."""
        names = {c.name for c in mechanism.pose}
        return names in ({"x", "y", "z"}, {"x", "y", "z", "rx", "ry", "rz"})

    def undone(self, mechanism: Mechanism, pose: Tensor) -> Tensor:
        """Poses `s x p` as they would have been measured in the model's frame."""
        if not bool(self.frame.any()):
            return pose
        position, rotation = mechanism.frame(pose)
        turn = rotation_vector_to_matrix(self.frame[3:]).mT
        place = ((position - self.frame[:3])[..., None, :] @ turn.mT)[..., 0, :]
        return mechanism.pose_near(place, None if rotation is None else turn @ rotation)

    @property
    def words(self) -> str:
        shift, turn = self.frame[:3].norm(), self.frame[3:].norm()
        return f"{1e3 * float(shift):.3g} mm and {1e3 * float(turn):.3g} mrad"


def fit_motion(mechanism: Mechanism, expected: Tensor, measured: Tensor) -> Motion:
    """The motion that takes expected poses nearest to those measured, `s x p` [SI] each; whole ones (no NaN) count.

    Raises:
        InputError: the mechanism's poses cannot be moved in space, or the rows are too few.
    """
    if not Motion.fits(mechanism):
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
    return Motion(rigid_body_frame(mechanism.frame(expected), mechanism.frame(measured), weights, _ROTATION_WEIGHT))
