"""From the outcomes of all methods to the results of a run."""

from __future__ import annotations

from collections.abc import Mapping
from importlib.metadata import version
from typing import Literal

import torch
from torch import Tensor

from ccnn_torch.calibration.config import RunConfig
from ccnn_torch.calibration.dataset import Dataset, Rows, pad_rows
from ccnn_torch.calibration.early_stop import Plan
from ccnn_torch.calibration.evaluate import Outcome, pose_with_effects, pose_with_geometry
from ccnn_torch.calibration.fitting import Comparison
from ccnn_torch.calibration.physics import Physics
from ccnn_torch.calibration.prepare import Prepared
from ccnn_torch.calibration.statistics import (
    before_block,
    constant_errors,
    coverage,
    floor_block,
    inside_domain,
    joint_errors,
    pose_block,
    ratio_to_floor,
    spread,
)
from ccnn_torch.coordinates import Coordinate
from ccnn_torch.mechanisms import PoseError
from ccnn_torch.numerics.outliers import inlying
from ccnn_torch.report.results.base import Axis, Spread
from ccnn_torch.report.results.run import (
    Floor,
    Geometry,
    KnownEffects,
    Method,
    MethodPose,
    Pose,
    RecordRows,
    RowCounts,
    RunResults,
    WithoutOutliers,
)
from ccnn_torch.simulation.case_study import Simulation
from ccnn_torch.version import __version__

# Above so many times what the model explains a sentence says why.
_REACHED = 1.1
_NO_GEOMETRY = Geometry(chosen="none", why="A simulated case compares learners.")
_PACKAGES = ("torch", "numpy", "scipy", "onnx", "onnxruntime", "safetensors")


def versions() -> dict[str, str]:
    """Versions of this package and of those that decide its numbers."""
    # A checkout that is not installed has no metadata.
    return {"ccnn-torch": __version__, **{name: version(name) for name in _PACKAGES}}


def plan_of(config: RunConfig) -> Plan:
    """How the methods of a config are trained."""
    training = config.training
    return Plan(
        early_stop=training.early_stop,
        patience=training.patience,
        checkpoint_every=training.checkpoint_every,
        device=config.device,
        folds=config.auto.folds if config.methods == ["auto"] else training.folds,
        kind=config.split.kind,
    )


def best_method(outcomes: Mapping[str, Outcome]) -> str:
    """The method whose median score over the repeats is lowest, see `Outcome`."""
    return by_score(outcomes)[0]


def by_score(outcomes: Mapping[str, Outcome]) -> list[str]:
    """The methods, the best first."""
    return sorted(outcomes, key=lambda name: float(outcomes[name].score.median()))


def run_results(
    config: RunConfig,
    prepared: Prepared,
    before: PoseError,
    outcomes: dict[str, Outcome],
    failed: dict[str, str],
    comparison: Comparison | None = None,
) -> RunResults:
    """The results of a run.

    Args:
        before: pose error without compensation, `r x s`.
        outcomes: trained methods by name, at least one.
        failed: sentence of each method that could not be trained.
        comparison: how the method was chosen, where it was.
    """
    dataset, joints = prepared.dataset, prepared.mechanism.joints
    test, fit = dataset.usable_rows("test"), dataset.usable_rows("fit")
    measured, learned = test.take(dataset.deviation), fit.take(dataset.deviation)
    floor = None if prepared.simulation is None else _floor(prepared.simulation, test, joints)
    inside = inside_domain(dataset, config.compensation.margin)
    methods = {}
    for name, outcome in outcomes.items():
        errors = joint_errors(test.take(outcome.deviation), measured, test.weights, joints)
        each = outcome.fitted.seconds / len(dataset.seeds)
        certainty, sd = _certainty(outcome, dataset, test, inside, joints)
        methods[name] = Method(
            test=errors,
            ratio_to_floor=ratio_to_floor(errors, floor),
            score=spread(outcome.score),
            seconds=spread([each] * len(dataset.seeds)),
            coverage=certainty,
            sd=sd,
            converged=_spread_or_none(outcome.fitted.converged),
            evaluations=_spread_or_none(outcome.fitted.evaluations),
            pose=_pose_of(prepared, outcome),
        )
    constant = constant_errors(learned, measured, fit.weights, test.weights, joints)
    best = best_method(outcomes)
    pose = _pose(config, prepared, before, outcomes[best])
    results = RunResults(
        name=config.name,
        seed=config.seed,
        repeats=config.repeats,
        case=None if config.case is None else case_label(config),
        joints=[Axis(name=joint.name, unit=joint.unit) for joint in joints],
        best_method=best,
        chosen_by=chosen_by(config, prepared, outcomes[best]),
        rows=row_counts(config, dataset),
        before=before_block(test.take(prepared.total), test.weights, joints),
        before_train=before_block(fit.take(prepared.total), fit.weights, joints),
        methods=methods | {name: Method(test=None, failed=sentence) for name, sentence in failed.items()},
        constant=Method(test=constant, ratio_to_floor=ratio_to_floor(constant, floor)),
        floor=floor,
        auto=None if comparison is None else comparison.block(best),
        pose=pose,
        records=None if prepared.simulated else _records(prepared),
        data_sha256=prepared.data_hash,
        geometry=_NO_GEOMETRY if prepared.choice is None else prepared.choice.block,
        notes=[*prepared.notes, *_notes(plan_of(config)), *_not_reached(pose, outcomes[best].damped)],
        versions=versions(),
    )
    if prepared.physics is not None and prepared.physics.source:
        results.effects = _effects(prepared, prepared.physics, test)
    return results


def chosen_by(config: RunConfig, prepared: Prepared, outcome: Outcome) -> Literal["folds", "validation", "test"]:
    """What chose the model: `folds`, `validation` rows or `test` rows; never the rows that it was trained on."""
    folds = prepared.choice is not None and prepared.choice.by == "folds" and config.methods is None
    if folds or plan_of(config).folds > 1:
        return "folds"
    return "test" if outcome.fitted.choice is None else "validation"


def _notes(plan: Plan) -> list[str]:
    if not plan.holds_out:
        return [
            "No rows were held out to check the predictive standard deviation; training.folds=5 does so without "
            "changing the model."
        ]
    if plan.folds > 1:
        blocks = "neighbouring blocks" if plan.kind == "block" else "whole groups" * (plan.kind == "group") or "rows"
        return [f"What was chosen was chosen by cross-validation in {plan.folds} folds of {blocks}."]
    return []


def _not_reached(pose: Pose, damped: float) -> list[str]:
    """A sentence where the commands leave clearly more than what the model does not explain."""
    found = []
    for kind, unit, block in (("position", "mm", pose.position), ("rotation", "mrad", pose.rotation)):
        if block is None or block.explained is None:
            continue
        after, explained = (1e3 * (figures.rms.median or 0.0) for figures in (block.after, block.explained))
        if after > _REACHED * explained:
            found.append(f"{after:.3g} {unit} of {kind} where the model leaves {explained:.3g} unexplained")
    if not found:
        return []
    why = (
        f"at {damped:.1%} of the rows they are damped, near a singular pose or at a limit of the joints (status 3)"
        if damped
        else "no row is damped, so that what the file holds of the machine is coarser than what was identified"
    )
    return [f"The commands of the file leave {' and '.join(found)}: {why}."]


def _certainty(
    outcome: Outcome, dataset: Dataset, test: Rows, inside: Tensor, joints: tuple[Coordinate, ...]
) -> tuple[Spread, dict[str, Spread]]:
    """How often what was measured is within the 95 % interval, and how wide the predictive sd is."""
    sd = outcome.fitted.sd(test.take(dataset.inputs))
    residuals = test.take(dataset.deviation) - test.take(outcome.deviation)
    there = (test.weights > 0).unsqueeze(-1)
    typical = sd.masked_fill(~there, torch.nan).nanmedian(1).values
    covered = coverage(residuals, sd, test.weights * test.take(inside))
    return spread(covered), {joint.name: spread(typical[:, j]) for j, joint in enumerate(joints)}


def _spread_or_none(values: Tensor | None) -> Spread | None:
    return None if values is None else spread(values)


def _pose_of(prepared: Prepared, outcome: Outcome) -> dict[str, MethodPose | None]:
    """The pose error that a method leaves, over all test rows."""
    left, weights = _held_out(prepared, outcome.after)
    explained = None if prepared.simulated else _held_out(prepared, outcome.explained)[0]
    pose = pose_block(left, left, weights, explained=explained)
    found: dict[str, MethodPose | None] = {}
    for kind, block in (("position", pose.position), ("rotation", pose.rotation)):
        found[kind] = None
        if block is not None:
            kept = {} if explained is None else {"explained": block.explained}
            found[kind] = MethodPose(unit=block.unit, rms=block.after.rms, max=block.after.max, **kept)
    return found


def _held_out(prepared: Prepared, error: PoseError) -> tuple[PoseError, Tensor]:
    """Pose errors of all test rows, those that were not fit to be trained on as well, and the rows' weights."""
    rows = pad_rows([split.test for split in prepared.dataset.splits])
    position, rotation = (None if e is None else rows.take(e.expand(len(rows.index), -1)) for e in error)
    assert position is not None
    return PoseError(position, rotation), rows.weights


def case_label(config: RunConfig) -> str:
    """`tripod`, `machine_tool:VARIANT`, or `realistic:MACHINE:CAUSE`."""
    if config.case == "realistic":
        return f"realistic:{config.realistic.machine}:{config.realistic.cause}"
    return f"{config.case}:{config.variant}" if config.case == "machine_tool" else str(config.case)


def _floor(simulation: Simulation, test: Rows, joints: tuple[Coordinate, ...]) -> Floor:
    variance = test.take(simulation.noise_variance) * test.weights.unsqueeze(-1)
    unlearnable = simulation.unlearnable
    return floor_block(
        test.take(simulation.noise),
        test.weights,
        joints,
        variance.sum(1, keepdim=True) / test.weights.sum(1)[:, None, None],
        None if unlearnable is None else test.take(unlearnable),
    )


def row_counts(config: RunConfig, dataset: Dataset) -> RowCounts:
    """Rows of the first repeat's split; without early stopping, and with folds, the validation rows are trained on."""
    split = dataset.splits[0]
    plan = plan_of(config)
    held = len(split.validation) if plan.holds_out and plan.folds == 1 else 0
    return RowCounts(
        train=len(split.train) + len(split.validation) - held,
        validation=held,
        test=len(split.test),
        not_trained_on=int((~dataset.usable[0]).sum()),
    )


def _pose(config: RunConfig, prepared: Prepared, before: PoseError, outcome: Outcome) -> Pose:
    place, turn = prepared.pseudoerror.remainder_position, prepared.pseudoerror.remainder_rotation
    errors = {
        "before": before,
        "after": outcome.after,
        "explained": None if prepared.simulated else outcome.explained,
        "geometry": pose_with_geometry(prepared),
        "effects": pose_with_effects(prepared),
        # What no joint deviation can explain.
        "not_compensable": PoseError(place.nan_to_num(0.0), None if turn is None else turn.nan_to_num(0.0)),
    }
    found = {name: _held_out(prepared, error) for name, error in errors.items() if error is not None}
    weights = found["before"][1]
    pose = pose_block(
        weights=weights, rotation_weight=config.rotation_weight, **{name: error for name, (error, _) in found.items()}
    )
    models = torch.stack([error.position for name, (error, _) in found.items() if name != "not_compensable"])
    # Of some rows no position is known.
    least, known = models.amin(0), (weights > 0) & models.isfinite().all(0)
    far = known & ~inlying(least, known, 3, 0)
    if not bool(far.any()):
        return pose
    kept = {name: error for name, (error, _) in found.items() if name != "not_compensable"}
    others = pose_block(weights=weights * ~far, rotation_weight=None, **kept).position
    sizes = {name: others[name].rms for name in kept}
    told = WithoutOutliers(rows=int(far.sum(1).max()), **sizes)
    return pose.model_copy(update={"position": pose.position.model_copy(update={"without_outliers": told})})


def _effects(prepared: Prepared, physics: Physics, test: Rows) -> KnownEffects:
    """What known effects do by themselves, where they are a part of the compensator."""
    left = test.take(prepared.dataset.deviation)
    errors = joint_errors(torch.zeros_like(left), left, test.weights, prepared.mechanism.joints)
    return KnownEffects(source=physics.source, test=errors, coefficients=physics.block())


def _records(prepared: Prepared) -> RecordRows:
    """Which of the measured rows were set aside, and why."""
    usable = prepared.dataset.usable[0]
    aside = torch.nonzero(~usable).squeeze(-1).tolist()
    return RecordRows(rows=len(usable), rows_set_aside=aside, why_set_aside=prepared.set_aside())
