"""What a model of measured records is made of, by cross-validation: geometry, effects, a learner."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import torch
from torch import Tensor

from ccnn_torch.calibration.config import RunConfig, method_names
from ccnn_torch.calibration.dataset import dataset_of, rows_of
from ccnn_torch.calibration.early_stop import Plan
from ccnn_torch.calibration.fitting import fit_method
from ccnn_torch.calibration.physics import fit_physics, frames_of_repeats
from ccnn_torch.diagnosis.from_file import Verdict
from ccnn_torch.errors import InputError, MethodFailedError
from ccnn_torch.learners import make_learner
from ccnn_torch.learners.gp import GPSettings
from ccnn_torch.mechanisms import Mechanism
from ccnn_torch.mechanisms.frames.partial import completed
from ccnn_torch.mechanisms.pose import only_turns
from ccnn_torch.numerics.outliers import inlying
from ccnn_torch.pseudoerror import joint_deviations
from ccnn_torch.records import Records
from ccnn_torch.records.splits import Split, fold_splits
from ccnn_torch.report.results.run import Geometry

_FOLDS = 5
# Standard errors over the folds by which the logarithm of a larger model's error has to be better: one is exceeded by
# chance in every fifth comparison of five folds, two in every seventeenth (Student's t).
_ERRORS = 2.0
# Usual errors of the best candidate, at which errors are bounded.
_BOUND = 3.0
# Rows that the comparison uses: enough to see what helps, few enough to take seconds.
_MOST_ROWS = 600
# The learner that is compared, and its settings: hyperparameters from few rows and steps, since there is a GP a fold.
_LEARNER = "gp"
# What is trained where nothing was compared.
_ELSE = "ccnn"
_QUICK = GPSettings(steps=30, hyperparameter_rows=200, variance_rows=16)
# Steps to the command of a learned deviation of the joints, which is steep near the singular poses of an arm.
_COMMANDS = 8


class Candidate(NamedTuple):
    """What a model may hold: identified geometry, effects, a learner on what these leave."""

    identify: bool
    effects: bool
    learner: bool

    @property
    def words(self) -> str:
        """For people."""
        parts = ["identified geometry" if self.identify else "nominal geometry"]
        parts += ["effects"] * self.effects + ["learner"] * self.learner
        return " + ".join(parts)


@dataclass(frozen=True)
class ModelChoice:
    """What `geometry` and `effects` end as.

    Attributes:
        identify: whether identified geometry is a part of the compensator.
        effects: whether the effects are.
        method: the learner where the config names none: the one that was compared, or the constant where it found
            nothing to learn.
        why: one sentence.
        by: `folds` where candidates were compared by cross-validation, else `config`.
    """

    identify: bool
    effects: bool
    method: str
    why: str
    by: str = "config"

    @property
    def block(self) -> Geometry:
        """For `results.json`."""
        return Geometry(chosen="identify" if self.identify else "none", why=self.why)


def choose_model(
    config: RunConfig,
    mechanism: Mechanism,
    records: Records,
    split: Split,
    settings: dict[str, Any],
    verdict: Verdict | None,
    asked_effects: bool,
    unlearnable: str = "",
) -> ModelChoice:
    """Compare what the config leaves open by the held-out pose errors under the candidates' own commands.

    By cross-validation in the training rows of one repeat, at most 600 of them; frames, parameters, coefficients and
    learner are fitted anew in each fold. The learner is a Gaussian process, for every method that is trained later. A
    simpler candidate is kept unless another is better by more than two standard errors of the folds' differences.

    Args:
        split: of the repeat.
        settings: of `joint_deviations`.
        verdict: effects that were found in the training rows, or that a file names; None without any.
        asked_effects: whether the effects are a part of every candidate.
        unlearnable: why there is nothing that a learner could have; empty where there is.
    """
    learns, geometry = not unlearnable, config.geometry
    name, other = mechanism.name, _ELSE if learns else "constant"
    geometry_why = ""
    if geometry != "none" and not mechanism.geometry:
        geometry_why = f"{name} has no geometric parameters to identify."
    if geometry_why and geometry == "identify":
        # It is refused where it is fitted, with what to do.
        return ModelChoice(True, False, other, "geometry=identify was asked for.")
    if geometry_why:
        geometry = "none"
    identify = {"auto": (True, False), "identify": (True,), "none": (False,)}[geometry]
    effects = (False,) if verdict is None else (True,) if asked_effects else (False, True)
    # Effects that a diagnosis found stand beside identified geometry wherever that may be a part.
    physical = [Candidate(i, e, False) for e in effects for i in (identify if not e else identify[:1]) if i or e]
    asked = "" if geometry == "auto" else geometry_why or f"geometry={geometry} was asked for."
    nominal_too = False in identify and not asked_effects and learns
    if not physical or (len(physical) == 1 and not nominal_too and not (learns and method_names(config, "") == [""])):
        why = f"No learner is trained: {unlearnable}." if unlearnable else ""
        return ModelChoice(identify[0], effects[0], other, f"{asked} {why}".strip())
    rows = torch.cat([split.train, split.validation])
    if len(rows) > _MOST_ROWS:
        rows = rows[torch.randperm(len(rows), generator=torch.Generator().manual_seed(config.seed))[:_MOST_ROWS]]
    rows = rows.sort().values
    few = rows_of(records, rows)
    none = torch.zeros(0, dtype=torch.int64)
    whole = Split(torch.arange(len(rows)), none, none, None if split.groups is None else split.groups[rows])
    try:
        folds = fold_splits(whole, config.split.kind, _FOLDS, config.seed)
        folds = [replace(f, validation=none, test=f.validation) for f in folds]
        errors = _errors(mechanism, few, folds, config.seed, settings, physical, nominal_too, verdict, learns)
    except (InputError, MethodFailedError) as problem:
        why = f"Candidates could not be cross-validated: {problem}"
        return ModelChoice(geometry == "identify", effects[0], other, why)
    # A machine that only turns errs by angles, which count as the lengths that they are at the weight's arm.
    shown = ("mrad", settings["rotation_weight"]) if only_turns(mechanism.frame(few.pose)) else ("mm", 1.0)
    return simplest_of_best(errors, asked, *shown)


def _errors(
    mechanism: Mechanism,
    records: Records,
    folds: list[Split],
    seed: int,
    settings: dict[str, Any],
    physical: list[Candidate],
    nominal_too: bool,
    verdict: Verdict | None,
    learns: bool,
) -> dict[Candidate, Tensor]:
    """Mean squared, bounded pose error of the held-out rows of each fold, `k` [m²], by candidate, the simplest first.

    Args:
        physical: candidates without a learner; one is put on what each of them leaves.
        nominal_too: whether it may learn everything, on the nominal machine.
        learns: whether there is a learner at all.
    """
    joints, pose, weight = records.joints, records.pose, settings["rotation_weight"]
    gaps = pose.isnan().any(-1)
    frames, _ = frames_of_repeats(mechanism, records, folds)
    held = torch.zeros(len(folds), len(joints), dtype=torch.float64)
    for k, fold in enumerate(folds):
        held[k, fold.test] = 1.0

    def square(reached: Tensor, wanted: Tensor) -> Tensor:
        # Of a row with gaps what was measured counts.
        parts = [torch.where(gaps, e.nan_to_num(), e) for e in mechanism.pose_error(wanted, reached) if e is not None]
        turned = weight**2 * parts[1].square() if len(parts) == 2 else 0.0
        return (parts[0].square() + turned).expand(len(folds), -1)

    nominal = joint_deviations(mechanism, joints, pose, parameters=frames, **settings)
    about = (mechanism, records, folds, frames, nominal.known)
    machines = {c[:2]: fit_physics(verdict if c.effects else None, *about, c.identify)[0] for c in physical}

    def error(c: Candidate) -> Tensor:
        physics = machines.get(c[:2])
        if physics is None:
            learned = _learned(mechanism, records, nominal, folds, seed, frames)
            # The same joints are wanted, so that what a command misses is added to what the model misses.
            command = joints.expand(len(folds), -1, -1)
            for _ in range(_COMMANDS):
                command = joints - learned(command)
            moved = joints + learned(joints) + (command + learned(command) - joints)
            guess = completed(mechanism, joints, pose, frames)
            return square(mechanism.forward_kinematics(moved, frames, guess=guess), pose)
        moved = joints.expand(len(folds), -1, -1)
        if c.learner:
            targets = physics.targets(joints, pose, settings)
            moved = joints + _learned(mechanism, records, targets, folds, seed, physics.values)(joints)
        return square(torch.stack([physics.poses(k, at) for k, at in enumerate(moved)]), pose)

    # Physics first: what it knows holds beside the measured region as well. What effects that stand for others
    # leave may be rougher than what is there without them: a learner on that says nothing of one on geometry alone.
    learned = [c._replace(learner=True) for c in physical]
    learned += [Candidate(False, False, True)] if nominal_too or not physical else []
    return by_fold({c: error(c) for c in (*physical, *(learned if learns else []))}, held)


def by_fold(rows: dict[Candidate, Tensor], held: Tensor) -> dict[Candidate, Tensor]:
    """Mean over the held-out rows of each fold, `k` [m²], of squared errors that are bounded.

    Args:
        rows: squared errors of each candidate, `k x s` [m²]; NaN where none is known.
        held: 1 for rows that a fold holds out, `k x s`.
    """
    # A gross outlier is no evidence for any of them, and would decide alone; so would rows at the edges of what was
    # measured, which err by many times as much under all of them (a bounded loss: Geman and McClure 1985).
    length = torch.stack([r.nan_to_num(math.inf) for r in rows.values()]).amin(0).sqrt()
    held = held * inlying(length, held > 0, 3, 0)
    most = (_BOUND * length[held > 0].median()).square()
    bounded = {c: most * (values := r.nan_to_num(1e6)) / (most + values) for c, r in rows.items()}
    return {c: (values * held).sum(-1) / held.sum(-1) for c, values in bounded.items()}


def _learned(
    mechanism: Mechanism,
    records: Records,
    targets: Any,
    folds: list[Split],
    seed: int,
    parameters: Tensor | None,
) -> Any:
    """The learner of every fold, trained: commanded joints `[k x] s x n` -> deviations `k x s x n` [SI]."""
    joints = records.joints
    jacobian = mechanism.jacobian(joints, parameters, guess=completed(mechanism, joints, records.pose, parameters))
    data = dataset_of(mechanism, joints, records.covariates, targets, folds, [seed] * len(folds), jacobian)
    plan = Plan(early_stop=False, patience=None, checkpoint_every=1000)
    one = fit_method(_LEARNER, lambda: make_learner(_LEARNER, _QUICK), data, plan, None, lambda *_: [])

    def predict(at: Tensor) -> Tensor:
        each = at.expand(len(folds), *at.shape[-2:])
        return one.predict(torch.cat([each, records.covariates.expand(len(folds), -1, -1)], -1))

    return predict


def simplest_of_best(errors: dict[Candidate, Tensor], asked: str, unit: str = "mm", length: float = 1.0) -> ModelChoice:
    """The simplest that none of the others beats by more than two standard errors over the folds.

    Args:
        errors: mean squared pose error by fold, `k` [m²], by candidate, the simplest first.
        asked: what was asked for, a sentence or nothing.
        unit: of the errors that are told.
        length: that makes a told error one [m], in thousandths: 1, or of an angle its weight [m/rad].
    """
    # By ratio: a fold with a row near a singular pose errs many times as much as the others in all.
    logs = torch.stack([e.log() for e in errors.values()])
    worse = logs[:, None] - logs
    is_beaten = (worse.mean(-1) > _ERRORS * worse.std(-1) / math.sqrt(logs.shape[-1])).any(-1).tolist()
    # The one with the least mean is beaten by none.
    chosen = next(c for c, beaten in zip(errors, is_beaten, strict=True) if not beaten)
    said = ", ".join(f"{c.words} {1e3 * math.sqrt(float(e.mean())) / length:.3g} {unit}" for c, e in errors.items())
    best = f"{chosen.words.capitalize()}: the simplest of the best in cross-validation"
    why = f"{best} (held-out RMS, large errors bounded: {said})."
    method = _LEARNER if chosen.learner else "constant"
    return ModelChoice(chosen.identify, chosen.effects, method, f"{asked} {why}".strip(), "folds")
