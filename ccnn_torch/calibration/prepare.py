"""The rows of a run: a simulated case study, or measured records with their frames fitted."""

from __future__ import annotations

import hashlib
import math
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, NamedTuple

import torch
from torch import Tensor

from ccnn_torch.calibration.choice import ModelChoice, choose_model
from ccnn_torch.calibration.config import RunConfig, method_names
from ccnn_torch.calibration.dataset import Dataset, by_repeat, dataset_of
from ccnn_torch.calibration.physics import (
    MOST_ROWS,
    Physics,
    fit_physics,
    frames_of_repeats,
    search_effects,
    verdict_of,
    without_frame_drift,
)
from ccnn_torch.config.sizes import size
from ccnn_torch.config.split import Given, held_out_notes, rows_of_test_file, split_by, with_test_file
from ccnn_torch.coordinates import Coordinate
from ccnn_torch.diagnosis.from_file import Verdict
from ccnn_torch.diagnosis.from_records import refuse_far_rows
from ccnn_torch.errors import InputError
from ccnn_torch.mechanisms import Mechanism, SerialArm, as_measured, load_mechanism
from ccnn_torch.mechanisms.frames.partial import completed
from ccnn_torch.pseudoerror import Pseudoerror, joint_deviations
from ccnn_torch.records import Records, check_rows, load_records
from ccnn_torch.records.covariates import asked_columns
from ccnn_torch.records.load import fewest_rows
from ccnn_torch.records.splits import Column, Split
from ccnn_torch.simulation.case_study import Simulation, build_case
from ccnn_torch.spelling import hint

# Of the realistic machines.
_MOST_JOINTS = 6


class Source(NamedTuple):
    """Measured records and what was chosen for them, with which a model is fitted to any of their rows.

    Attributes:
        search: looks for effects in some rows, where those of the verdict were found so and more rows may show more.
    """

    mechanism: Mechanism
    records: Records
    settings: dict[str, Any]
    choice: ModelChoice
    verdict: Verdict | None
    search: Callable[[Tensor], tuple[Verdict | None, list[str]]] | None = None


@dataclass(frozen=True)
class Prepared:
    """Everything that is fixed before the first training step.

    Attributes:
        parameters: geometry with the fitted frames of each repeat, `r x 1 x k` (`r x s x k` where frames are per group
            of rows), or None for a nominal machine.
        joints: commanded joints, `r x s x n` [SI]; the repeats of measured records share their rows.
        covariates: `r x s x m` [SI].
        pose: measured poses, `r x s x p` [SI]; NaN where not measured.
        pseudoerror: what the poses say about the joints, and what is learned: with `physics` what that leaves.
        total: deviation of the joints of the nominal machine, `r x s x n` [SI]; without these two that is learned.
        identified: geometry with all parameters fitted to the training rows of each repeat, like `parameters`: what a
            geometric calibration would command by, to be compared with; None where it was not fitted.
        physics: the identified machine that is a part of the compensator, so that the network learns what it leaves.
        choice: what `geometry` ended as; None for a case.
        source: the measured records; None for a case.
        simulation: the machine behind simulated rows, or None for measured records.
        notes: sentences for the person who reads the results.
    """

    mechanism: Mechanism
    parameters: Tensor | None
    joints: Tensor
    covariates: Tensor
    covariate_coordinates: tuple[Coordinate, ...]
    pose: Tensor
    pseudoerror: Pseudoerror
    total: Tensor
    dataset: Dataset
    data_hash: str
    identified: Tensor | None = None
    physics: Physics | None = None
    choice: ModelChoice | None = None
    source: Source | None = None
    simulation: Simulation | None = None
    notes: list[str] = field(default_factory=list)

    @property
    def simulated(self) -> bool:
        return self.simulation is not None

    @property
    def default_method(self) -> str:
        """The learner where the config names none."""
        return "ccnn" if self.choice is None else self.choice.method

    @property
    def noise(self) -> Tensor | None:
        """What noise adds to the joint deviations, `r x s x n` [SI]; None where that is not known."""
        return None if self.simulation is None else self.simulation.noise

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


def prepare(config: RunConfig, given: Given | None = None) -> Prepared:
    """Build the rows of a run.

    Args:
        given: records that Python has, in place of the config's file.
    """
    seeds = [config.seed + k for k in range(config.repeats)]
    if config.case == "realistic":
        return _from_realistic(config, seeds)
    if config.case is not None:
        return _from_case(config, seeds)
    return _from_records(config, seeds, given)


def _from_case(config: RunConfig, seeds: list[int]) -> Prepared:
    assert config.case is not None
    case = build_case(config.case, config.variant or "printed", config.order or "raster")
    doubts = check_memory(config, len(case.time), len(case.mechanism.joints))
    time, noise = {Coordinate("t", "1"): case.time}, case.noise(seeds)
    chosen = asked_columns(["t"], config.covariates or [], f"the case {config.case} has")
    prepared = _simulated(config, case.mechanism, case.joints, case.pose, case.measured(noise), time, chosen, seeds)
    notes = [*doubts, *prepared.notes]
    if config.covariates is None:
        notes.append("The time t is not given to the learner; covariates=[t] adds it.")
    return replace(prepared, simulation=case.simulated(noise), notes=notes)


def _from_realistic(config: RunConfig, seeds: list[int]) -> Prepared:
    from ccnn_validation.realistic.machine import build_machine, simulate_realistic

    about = config.realistic
    doubts = check_memory(config, about.rows, _MOST_JOINTS)
    machine = build_machine(about.machine, about.cause, about.strength, about.rows, about.noise, seeds)
    mechanism, joints = machine.mechanism, machine.joints
    whose = f"the {about.machine} with the cause {about.cause} has"
    chosen = asked_columns([c.name for c in machine.columns], config.covariates, whose)
    jacobian = mechanism.jacobian(joints, guess=machine.measured)
    rows = (mechanism, joints, machine.pose, machine.measured, machine.columns, chosen, seeds)
    prepared = _simulated(config, *rows, jacobian, machine.turns_far)

    def deviation(pose: Tensor) -> Tensor:
        return joint_deviations(mechanism, joints, pose, **_pseudoerror_settings(config, mechanism)).deviation

    simulation = simulate_realistic(machine, deviation, prepared.total)
    return replace(prepared, simulation=simulation, notes=[*doubts, *prepared.notes])


def _simulated(
    config: RunConfig,
    mechanism: Mechanism,
    joints: Tensor,
    pose: Tensor,
    measured: Tensor,
    columns: Mapping[Coordinate, Tensor],
    names: list[str],
    seeds: list[int],
    jacobian: Tensor | None = None,
    turns_far: Tensor | None = None,
) -> Prepared:
    """The rows of a simulated machine.

    Args:
        joints: commanded, `[r x] s x n` [SI].
        pose: without errors, `[r x] s x p` [SI]: by their place rows are held out.
        measured: `r x s x p` [SI].
        columns: what else is recorded, `[r x] s` each [SI].
        names: those that are inputs.
        jacobian, turns_far: as of `dataset_of`.
    """
    chosen = tuple(c for c in columns if c.name in names)
    covariates = torch.stack([columns[c] for c in chosen], -1) if chosen else joints[..., :0]
    deviations = joint_deviations(mechanism, joints, measured, **_pseudoerror_settings(config, mechanism))
    known = {c.name: values.expand(measured.shape[:-1]) for c, values in columns.items()}
    splits = [
        _splits(config, positions, {name: values[k] for name, values in known.items()}, [seed])[0]
        for k, (seed, positions) in enumerate(zip(seeds, by_repeat(mechanism.frame(pose)[0], seeds), strict=True))
    ]
    return Prepared(
        mechanism=mechanism,
        parameters=None,
        joints=by_repeat(joints, seeds),
        covariates=by_repeat(covariates, seeds),
        covariate_coordinates=chosen,
        pose=measured,
        pseudoerror=deviations,
        total=by_repeat(deviations.deviation, seeds),
        dataset=dataset_of(mechanism, joints, covariates, deviations, splits, seeds, jacobian, turns_far),
        data_hash=_hash(joints, covariates, measured),
        notes=deviations.notes(),
    )


def _from_records(config: RunConfig, seeds: list[int], given: Given | None) -> Prepared:
    if config.records is None or config.mechanism is None:
        missing = "records" if config.records is None else "mechanism"
        raise InputError(
            f"the config names no {missing}: write {missing}=… "
            "(records: a CSV file; mechanism: tripod, machine_tool, a DH file, a URDF, or file.py:Name)"
        )
    mechanism = load_mechanism(config.mechanism, **config.mechanism_keys)
    effects = config.effects
    verdict = verdict_of(effects, mechanism) if isinstance(effects, str) and effects.startswith("from:") else None
    source = with_test_file(config.records if given is None else given, config.split)
    records = load_records(source, mechanism, config.covariates, columns=config.columns, joint_map=config.joint_map)
    ends_of(config, records.covariate_coordinates)
    doubts = check_memory(config, len(records), len(mechanism.joints))
    check_rows(records, mechanism)
    mechanism = as_measured(mechanism, records.pose_coordinates, records.path, records.pose)
    if not getattr(mechanism, "unknown_frames", ()):
        refuse_far_rows(records, mechanism)
    unlearnable = _unlearnable(mechanism, records)
    if unlearnable and method_names(config, "constant") != ["constant"]:
        raise InputError(
            f"methods: {unlearnable}; leave methods out, and geometry and effects alone are identified and corrected"
        )
    if isinstance(mechanism, SerialArm) and config.geometry != "none":
        mechanism = mechanism.with_link_frames()
    held = rows_of_test_file(config.split, records.parts)
    pose = completed(mechanism, records.joints, records.pose)
    splits = _splits(config, mechanism.frame(pose)[0], records.columns, seeds, held, records.joints)
    settings = _pseudoerror_settings(config, mechanism)
    chosen, said = _source(config, mechanism, records, splits[0], settings, verdict)
    notes = [*doubts, *records.notes, *said, chosen.choice.why]
    prepared = _fitted_to(chosen, splits, seeds)
    notes = [*held_out_notes(config.split, len(splits[0].test), splits[0]), *notes, *prepared.notes]
    return replace(prepared, notes=notes)


def _unlearnable(mechanism: Mechanism, records: Records) -> str:
    """Why there is no deviation of joints that a learner could have; empty where there is one."""
    if len(mechanism.places(records.joints, records.pose)) > 1:
        return f"each row of {records.path} is of two places, and what a learner learns has the joints of one"
    whole, needed = int(records.whole.sum()), fewest_rows(len(mechanism.joints))
    if whole >= needed:
        return ""
    return f"{whole} rows of {records.path} have all that is measured, and a learner needs the joints of {needed}"


def over_all_rows(prepared: Prepared) -> Prepared:
    """The rows of the only repeat with none held out: what was chosen stays, what was found or fitted is so again."""
    source = prepared.source
    assert source is not None
    rows, none = torch.arange(len(source.records)), torch.zeros(0, dtype=torch.int64)
    if source.search is not None:
        verdict, _ = source.search(rows)
        # A drift of the frame has been taken out of the records.
        verdict = None if verdict is None else verdict.of_machine()[0]
        source = source._replace(verdict=verdict if verdict and verdict.effects else source.verdict)
    return _fitted_to(source, [Split(rows, none, none)], prepared.dataset.seeds)


def _fitted_to(source: Source, splits: list[Split], seeds: list[int]) -> Prepared:
    """Frames, geometry and effects fitted to the rows that are not held out, and what is left to be learned."""
    mechanism, records, settings, choice, verdict, _ = source
    frames, notes = frames_of_repeats(mechanism, records, splits)
    total = deviations = joint_deviations(mechanism, records.joints, records.pose, parameters=frames, **settings)
    about = (mechanism, records, splits, frames, total.known)
    learned, physics, geometry = frames, None, None
    # For comparison, where it costs nothing.
    one_frame = frames is not None and frames.shape[1] == 1 and isinstance(mechanism, SerialArm)
    if choice.identify or one_frame:
        geometry, said = fit_physics(None, *about, True)
        notes += said if choice.identify and verdict is None else []
    if verdict is not None:
        physics, said = fit_physics(verdict, *about, choice.identify)
        notes += said
    elif choice.identify:
        physics = geometry
    if physics is not None:
        learned = physics.values
        deviations = physics.targets(records.joints, records.pose, settings)
    if _unlearnable(mechanism, records):
        deviations = replace(
            deviations, deviation=torch.zeros_like(deviations.deviation), usable=deviations.known.clone()
        )
    guess = completed(mechanism, records.joints, records.pose, frames)
    jacobian = mechanism.jacobian(records.joints, learned, guess=guess)
    return Prepared(
        mechanism=mechanism,
        parameters=frames,
        joints=by_repeat(records.joints, seeds),
        covariates=by_repeat(records.covariates, seeds),
        covariate_coordinates=records.covariate_coordinates,
        pose=by_repeat(records.pose, seeds),
        pseudoerror=deviations,
        total=by_repeat(total.deviation, seeds),
        dataset=dataset_of(mechanism, records.joints, records.covariates, deviations, splits, seeds, jacobian),
        data_hash=records.data_hash,
        identified=None if geometry is None else geometry.values,
        physics=physics,
        choice=choice,
        source=source,
        notes=[*notes, *deviations.notes()],
    )


def _source(
    config: RunConfig,
    mechanism: Mechanism,
    records: Records,
    split: Split,
    settings: dict[str, Any],
    verdict: Verdict | None,
) -> tuple[Source, list[str]]:
    """The records less what is none of the machine, with what `geometry` and `effects` come to for them; and notes."""
    notes: list[str] = []
    rows, identify = torch.cat([split.train, split.validation]), config.geometry != "none" and bool(mechanism.geometry)
    asked, search = verdict is not None, None
    if config.effects != "none" and not asked:
        names = None if isinstance(config.effects, str) else config.effects
        search = partial(search_effects, mechanism, names=names, seed=config.seed, identify=identify)
        verdict, notes = search(records, rows)
        if config.repeats > 1 and verdict is not None:
            notes.append("They were searched in the training rows of the first repeat, for all repeats.")
    if verdict is not None:
        records, verdict, said = without_frame_drift(mechanism, records, rows, verdict, identify)
        asked, notes = asked and verdict is not None, [*notes, *said]
    about = (settings, verdict, asked, _unlearnable(mechanism, records))
    choice = choose_model(config, mechanism, records, split, *about)
    verdict = verdict if choice.effects else None
    again = None
    if search is not None and verdict is not None and len(rows) < MOST_ROWS:
        again = partial(search, records)
    return Source(mechanism, records, settings, choice, verdict, again), notes


def ends_of(config: RunConfig, covariates: Sequence[Coordinate]) -> dict[str, tuple[float, float]]:
    """Lowest and highest value [SI] of each covariate of `compensation.ends`, by its name.

    Raises:
        InputError: a run has no such covariate, or its ends do not ascend.
    """
    units, found = {c.name: c.unit for c in covariates}, {}
    for name, pair in config.compensation.ends.items():
        key = f"compensation.ends.{name}"
        if name not in units:
            raise InputError(f"{key}: this run has no such covariate; {hint(name, [*units])}")
        low, high = (size(value, units[name], key) for value in pair)
        if not low < high:
            raise InputError(f"{key}: the lower end comes first, and [{pair[0]}, {pair[1]}] does not ascend")
        found[name] = (low, high)
    return found


def damping_of(config: RunConfig, mechanism: Mechanism) -> float:
    """Weight of the joint deviation beside the pose error that it explains [m/rad]: the config's, or the default."""
    if config.damping is not None:
        return config.damping
    return 0.01 if isinstance(mechanism, SerialArm) else 0.0


def _pseudoerror_settings(config: RunConfig, mechanism: Mechanism) -> dict[str, Any]:
    """Damping and bounds, by default those that suit the mechanism.

    Six-joint arms pass near singular poses all over their workspace: half of a UR10's rows have a condition number
    above 50. Damped, all of them can be learned from, and the deviation stays a smooth function of the joints.
    """
    damping = damping_of(config, mechanism)
    bound = config.max_condition
    if bound is None:
        bound = math.inf if damping > 0 else 50.0
    return {
        "rotation_weight": config.rotation_weight,
        "damping": damping,
        "max_condition": bound,
        "max_deviation": config.max_deviation,
    }


def _splits(
    config: RunConfig,
    positions: Tensor,
    columns: Mapping[str, Column],
    seeds: list[int],
    held: Tensor | None = None,
    targets: Tensor | None = None,
) -> list[Split]:
    split = config.split
    return [split_by(split, positions, columns, seed, split.validation, held, targets) for seed in seeds]


def _hash(*tensors: Tensor) -> str:
    digest = hashlib.sha256()
    for tensor in tensors:
        digest.update(tensor.contiguous().numpy().tobytes())
    return digest.hexdigest()


# Bytes for a row of a repeat, measured on runs of the tripod: rows, deviations and Jacobians of all kinds; and, of the
# one method that keeps a population, for each individual.
_ROW, _INDIVIDUAL = 10_000, 2_500


def memory_of_run(config: RunConfig, rows: int, joints: int) -> int:
    """About what a run takes at its peak, in bytes; the methods come one after the other."""
    methods = method_names(config)
    of_row = _ROW + (_INDIVIDUAL * config.ccnn.population if "ccnn" in methods else 0)
    # A Gaussian process has a matrix of all rows by all rows for each joint, its factor and its gradient.
    squared = 3 * 8 * joints * rows if "gp" in methods else 0
    return config.repeats * rows * (of_row + squared)


def check_memory(config: RunConfig, rows: int, joints: int) -> list[str]:
    """A sentence for who starts a run that takes more than half of the free memory.

    Raises:
        InputError: it takes more than `max_bytes`, or than is free; names the keys to lower.
    """
    needed, free = memory_of_run(config, rows, joints), free_memory()
    limit = config.max_bytes or free
    told = (
        f"{config.repeats} x {rows} rows (repeats x rows) take about {needed:,} bytes of memory "
        f"({needed / 1e9:,.1f} GB), and "
        + (f"{free or 0:,} are free" if config.max_bytes is None else f"max_bytes={config.max_bytes}")
    )
    if limit is not None and needed > limit:
        keys = [f"repeats ({config.repeats})"] * (config.repeats > 1)
        keys += [f"ccnn.population ({config.ccnn.population})"] * ("ccnn" in method_names(config))
        raise InputError(f"{told}; lower {' or '.join([*keys, 'the number of rows'])}")
    return [f"{told}: the system may stop the run."] if free is not None and needed > free / 2 else []


def free_memory() -> int | None:
    """Bytes that a new process could have; None where the system does not report it."""
    try:
        with open("/proc/meminfo", encoding="ascii") as about:
            lines = dict(line.split(":", 1) for line in about)
        return int(lines["MemAvailable"].split()[0]) * 1024
    except (OSError, KeyError, ValueError):
        pass
    try:
        # All of it: not every system reports what is free.
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (AttributeError, OSError, ValueError):
        return None
