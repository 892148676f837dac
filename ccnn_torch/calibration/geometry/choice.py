"""`geometry: auto`: nominal or identified geometry, with or without a learner, by cross-validation."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from ccnn_torch.calibration.geometry.identified import fit_machine
from ccnn_torch.calibration.learning.early_stop import Plan
from ccnn_torch.calibration.learning.fitting import fit_method
from ccnn_torch.calibration.rows.dataset import dataset_of
from ccnn_torch.errors import InputError, MethodFailedError
from ccnn_torch.learners import make_learner
from ccnn_torch.mechanisms import Mechanism, SerialArm
from ccnn_torch.numerics.outliers import inlying
from ccnn_torch.pseudoerror import joint_deviations
from ccnn_torch.records import Records
from ccnn_torch.records.splits import Split, fold_splits

_FOLDS = 5
# Rows that the comparison uses: enough to see what helps, few enough to take seconds.
_MOST_ROWS = 600
# The learner that is compared, and its settings: hyperparameters from few rows and steps, since there is a GP a fold.
_LEARNER = "gp"
# What is trained where nothing was compared.
_ELSE = "ccnn"
_QUICK = {"steps": 30, "hyperparameter_rows": 200, "variance_rows": 16}


@dataclass(frozen=True)
class GeometryChoice:
    """What `geometry` ends as.

    Attributes:
        identify: whether identified geometry is a part of the compensator.
        method: the learner where the config names none: the one that was compared, or the constant where it found
            nothing to learn.
        why: one sentence.
    """

    identify: bool
    method: str
    why: str

    @property
    def block(self) -> dict[str, str]:
        """For `results.json`."""
        return {"chosen": "identify" if self.identify else "none", "why": self.why}


def choose_geometry(
    mechanism: Mechanism, records: Records, split: Split, kind: str, seed: int, settings: dict[str, Any]
) -> GeometryChoice:
    """Compare identified geometry alone, nominal geometry with a learner, and identified geometry with a learner.

    By the held-out pose errors of cross-validation in the training rows of one repeat, at most 600 of them; frames,
    parameters and learner are fitted anew in each fold. The learner is a Gaussian process, for every method that is
    trained later. A simpler one of the three, in this order, is kept unless a later one is better by more than a
    standard error of the folds' differences.

    Args:
        split, kind: of the repeat; `kind` says how folds are made.
    """
    name = mechanism.name
    if not mechanism.geometry:
        return GeometryChoice(False, _ELSE, f"{name} has no geometric parameters to identify.")
    if isinstance(mechanism, SerialArm) and (mechanism.frame_per or mechanism.tool_per):
        return GeometryChoice(False, _ELSE, f"{name} has frames per group of rows, and identified geometry has one.")
    rows = torch.cat([split.train, split.validation])
    if len(rows) > _MOST_ROWS:
        rows = rows[torch.randperm(len(rows), generator=torch.Generator().manual_seed(seed))[:_MOST_ROWS]]
    rows = rows.sort().values
    few = _rows_of(records, rows)
    none = torch.zeros(0, dtype=torch.int64)
    whole = Split(torch.arange(len(rows)), none, none, None if split.groups is None else split.groups[rows])
    try:
        folds = [replace(f, validation=none, test=f.validation) for f in fold_splits(whole, kind, _FOLDS, seed)]
        errors = _errors(mechanism, few, folds, seed, settings)
    except (InputError, MethodFailedError) as problem:
        return GeometryChoice(False, _ELSE, f"Identified geometry could not be cross-validated: {problem}")
    return _chosen(errors)


def _rows_of(records: Records, rows: Tensor) -> Records:
    columns = {name: values[rows.numpy()] for name, values in records.columns.items()}
    parts = {key: getattr(records, key)[rows] for key in ("joints", "pose", "covariates")}
    return replace(records, **parts, columns=columns, lines=records.lines[rows.numpy()], parts=())


def _errors(
    mechanism: Mechanism, records: Records, folds: list[Split], seed: int, settings: dict[str, Any]
) -> dict[str, Tensor]:
    """Mean squared pose error of the held-out rows of each fold, `k` [m²], by candidate, the simplest first."""
    fitted = fit_machine(mechanism, records, folds, identify=True)
    joints, pose, weight = records.joints, records.pose, settings["rotation_weight"]
    held = torch.zeros(len(folds), len(joints), dtype=torch.float64)
    for k, fold in enumerate(folds):
        held[k, fold.test] = 1.0

    def square(reached: Tensor) -> Tensor:
        error = mechanism.pose_error(pose, reached)
        turned = 0.0 if error.rotation is None else weight**2 * error.rotation.square()
        return (error.position.square() + turned).expand(len(folds), -1)

    def learned(parameters: Tensor | None) -> Tensor:
        found = joint_deviations(mechanism, joints, pose, parameters=parameters, **settings)
        jacobian = mechanism.jacobian(joints, parameters, guess=pose)
        seeds = [seed] * len(folds)
        data = dataset_of(mechanism, joints, records.covariates, found, folds, seeds, jacobian)
        plan = Plan(early_stop=False, patience=None, checkpoint_every=1000)
        one = fit_method(_LEARNER, lambda: make_learner(_LEARNER, _QUICK), data, plan, None, lambda *_: [])
        return square(mechanism.forward_kinematics(joints + one.predict(data.inputs), parameters, guess=pose))

    assert fitted.geometry is not None
    rows = {
        "identified": square(mechanism.forward_kinematics(joints, fitted.geometry, guess=pose)),
        "nominal + learner": learned(fitted.parameters),
        "identified + learner": learned(fitted.geometry),
    }
    # A gross outlier is no evidence for any of them, and would decide alone.
    length = rows["identified"].sqrt().nan_to_num(math.inf)
    held = held * inlying(length, held > 0, 3, 0)
    return {name: (values.nan_to_num(0.0) * held).sum(-1) / held.sum(-1) for name, values in rows.items()}


def _chosen(errors: dict[str, Tensor]) -> GeometryChoice:
    """The simplest that none of the later ones beats by more than a standard error of the folds' differences."""
    chosen, *others = errors
    for other in others:
        gain = errors[chosen] - errors[other]
        if float(gain.mean()) > float(gain.std()) / math.sqrt(len(gain)):
            chosen = other
    said = ", ".join(f"{name} {1e3 * math.sqrt(float(e.mean())):.3g} mm" for name, e in errors.items())
    best = {
        "identified": "Identified geometry alone is taken: no learner is better by more than a standard error",
        "nominal + learner": "Nominal geometry with a learner is taken, the best in cross-validation",
        "identified + learner": "Identified geometry with a learner on what it leaves is taken, the best in "
        "cross-validation",
    }[chosen]
    method = "constant" if chosen == "identified" else _LEARNER
    return GeometryChoice(chosen != "nominal + learner", method, f"{best} (held-out RMS: {said}).")
