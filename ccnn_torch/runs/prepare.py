"""From a config to the rows of a run: a case study simulated, or measured records with their frames fitted."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from ccnn_torch.coordinates import Coordinate
from ccnn_torch.errors import InputError
from ccnn_torch.identification import fit_links
from ccnn_torch.mechanisms import Mechanism, SerialArm, load_mechanism
from ccnn_torch.mechanisms.frames import fit_frames
from ccnn_torch.pseudoerror import Pseudoerror, joint_deviations
from ccnn_torch.records import check_rows, load_records
from ccnn_torch.runs.cases import CaseStudy, build_case
from ccnn_torch.runs.config import RunConfig
from ccnn_torch.runs.dataset import Dataset, pad_rows
from ccnn_torch.splits import Column, Split, split_rows

__all__ = ["Prepared", "prepare"]


@dataclass(frozen=True)
class Prepared:
    """Everything that is fixed before the first training step.

    Attributes:
        parameters: geometry with the fitted frames of each repeat, `r x 1 x k` (`r x s x k` where frames are per group
            of rows), or None for a nominal machine.
        joints: commanded joints, `s x n` [SI].
        pose: measured poses, `r x s x p` or `s x p` [SI].
        pseudoerror: what the poses say about the joints.
        identified: geometry with links and frames fitted to the training rows of each repeat, like `parameters`: what a
            geometric calibration would command by, to be compared with; None where it was not fitted.
        case: the case study behind simulated rows (its noise is `noise`, `r x s x n`), or None for measured records.
        notes: sentences for the person who reads the results.
    """

    mechanism: Mechanism
    parameters: Tensor | None
    joints: Tensor
    covariates: Tensor
    covariate_coordinates: tuple[Coordinate, ...]
    pose: Tensor
    pseudoerror: Pseudoerror
    dataset: Dataset
    data_hash: str
    identified: Tensor | None = None
    case: CaseStudy | None = None
    noise: Tensor | None = None
    notes: list[str] = field(default_factory=list)

    @property
    def simulated(self) -> bool:
        return self.case is not None

    def set_aside(self) -> dict[str, int]:
        """How many rows are not trained on in the first repeat, by reason."""
        return {
            reason: int(flags.expand(self.dataset.usable.shape)[0].sum())
            for reason, flags in self.pseudoerror.reasons.items()
        }

    def repeat_parameters(self, repeat: int) -> Tensor | None:
        """Geometry of one repeat, `k`; None where it is nominal, or differs from row to row."""
        if self.parameters is None or self.parameters.shape[1] > 1:
            return None
        return self.parameters[repeat, 0]


def prepare(config: RunConfig) -> Prepared:
    """Build the rows of a run.

    Raises:
        InputError: the config names no data, or the data cannot be used; the sentence says what to change.
    """
    seeds = [config.seed + k for k in range(config.repeats)]
    if config.case is not None:
        return _from_case(config, seeds)
    return _from_records(config, seeds)


def _from_case(config: RunConfig, seeds: list[int]) -> Prepared:
    assert config.case is not None
    case = build_case(config.case, config.variant or "printed", config.order or "raster")
    mechanism = case.mechanism
    columns = {"t": (case.time, Coordinate("t", "1"))}
    unknown = [name for name in config.covariates or [] if name not in columns]
    if unknown:
        raise InputError(f"covariates: {unknown[0]!r} is no column of the case {config.case}; it has only 't'")
    chosen = [columns[name] for name in config.covariates or []]
    covariates = (
        torch.stack([values for values, _ in chosen], -1) if chosen else case.joints.new_zeros(len(case.time), 0)
    )
    noise = case.noise(seeds)
    pose = case.measured(noise)
    deviations = joint_deviations(
        mechanism,
        case.joints,
        pose,
        **_pseudoerror_settings(config, mechanism),
    )
    splits = _splits(config, mechanism.frame(case.pose)[0], {"t": case.time}, seeds)
    notes = deviations.notes()
    if config.covariates is None:
        notes.append("The time t is not given to the learner; covariates=[t] adds it.")
    return Prepared(
        mechanism=mechanism,
        parameters=None,
        joints=case.joints,
        covariates=covariates,
        covariate_coordinates=tuple(coordinate for _, coordinate in chosen),
        pose=pose,
        pseudoerror=deviations,
        dataset=_dataset(mechanism, case.joints, covariates, deviations, splits, seeds),
        data_hash=_hash(case.joints, covariates, pose),
        case=case,
        noise=noise,
        notes=notes,
    )


def _from_records(config: RunConfig, seeds: list[int]) -> Prepared:
    if config.records is None or config.mechanism is None:
        missing = "records" if config.records is None else "mechanism"
        raise InputError(
            f"the config names no {missing}: write {missing}=… "
            "(records: a CSV file; mechanism: tripod, machine_tool, a DH file, a URDF, or file.py:Name)"
        )
    mechanism = load_mechanism(config.mechanism)
    records = load_records(config.records, mechanism, config.covariates)
    check_rows(records, mechanism)
    arm = mechanism if isinstance(mechanism, SerialArm) else None
    if arm is not None and records.orientation == "none":
        mechanism = arm = arm.with_orientation("none")
    splits = _splits(config, mechanism.frame(records.pose)[0], records.columns, seeds)
    parameters, identified = None, None
    notes = list(records.notes)
    if arm is not None and arm.unknown_frames:
        rows = pad_rows([Dataset.part(split, "fit") for split in splits])
        weights = torch.zeros(len(seeds), len(records.joints), dtype=torch.float64)
        weights.scatter_add_(1, rows.index, rows.weights)
        parameters = fit_frames(arm, records.joints, records.pose, weights, columns=records.columns)
        if not (arm.frame_per or arm.tool_per):
            identified = fit_links(arm, records.joints, records.pose, parameters, weights).unsqueeze(-2)
            parameters = parameters.unsqueeze(-2)
        frames = " and ".join(arm.unknown_frames)
        notes.append(f"Frames fitted first, on the training rows of each repeat: {frames}.")
    deviations = joint_deviations(
        mechanism,
        records.joints,
        records.pose,
        parameters=parameters,
        **_pseudoerror_settings(config, mechanism),
    )
    notes += deviations.notes()
    jacobian = mechanism.jacobian(records.joints, parameters, guess=records.pose)
    return Prepared(
        mechanism=mechanism,
        parameters=parameters,
        joints=records.joints,
        covariates=records.covariates,
        covariate_coordinates=records.covariate_coordinates,
        pose=records.pose,
        pseudoerror=deviations,
        dataset=_dataset(mechanism, records.joints, records.covariates, deviations, splits, seeds, jacobian),
        data_hash=records.data_hash,
        identified=identified,
        notes=notes,
    )


def _pseudoerror_settings(config: RunConfig, mechanism: Mechanism) -> dict[str, Any]:
    """Damping and bounds, by default those that suit the mechanism.

    Six-joint arms pass near singular poses all over their workspace: half of a UR10's rows have a condition number
    above 50. Damped, all of them can be learned from, and the deviation stays a smooth function of the joints.
    """
    damping = config.damping
    if damping is None:
        damping = 0.01 if isinstance(mechanism, SerialArm) else 0.0
    bound = config.max_condition
    if bound is None:
        bound = math.inf if damping > 0 else 50.0
    return {
        "rotation_weight": config.rotation_weight,
        "damping": damping,
        "max_condition": bound,
        "max_deviation": config.max_deviation,
    }


def _splits(config: RunConfig, positions: Tensor, columns: Mapping[str, Column], seeds: list[int]) -> list[Split]:
    split = config.split
    return [split_rows(positions, split.kind, split.by, columns, split.test, split.validation, seed) for seed in seeds]


def _dataset(
    mechanism: Mechanism,
    joints: Tensor,
    covariates: Tensor,
    deviations: Pseudoerror,
    splits: list[Split],
    seeds: list[int],
    jacobian: Tensor | None = None,
) -> Dataset:
    """Measured records are judged by the pose, so they bring the Jacobian; the paper's cases by the joints alone."""
    repeats, rows = len(seeds), len(joints)
    turning = [joint.unit == "rad" for joint in mechanism.joints] + [False] * covariates.shape[-1]
    return Dataset(
        inputs=torch.cat([joints, covariates], -1),
        deviation=deviations.deviation.expand(repeats, rows, -1),
        usable=deviations.usable.expand(repeats, rows),
        splits=splits,
        seeds=seeds,
        turning=torch.tensor(turning),
        # Singular rows are not trained on; their Jacobian must only not spoil sums with weight 0.
        jacobian=None if jacobian is None else torch.nan_to_num(jacobian).expand(repeats, rows, -1, -1),
    )


def _hash(*tensors: Tensor) -> str:
    digest = hashlib.sha256()
    for tensor in tensors:
        digest.update(tensor.contiguous().numpy().tobytes())
    return digest.hexdigest()
