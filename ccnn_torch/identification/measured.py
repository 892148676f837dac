"""Rows of an identification: measured records, split, or another series of the same arm."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ccnn_torch.config.sizes import Size, sizes_by_name, sizes_of_joints, sizes_of_pose
from ccnn_torch.config.split import Given, held_out_notes, rows_of_test_file, split_by, with_test_file
from ccnn_torch.coordinates import force_of, torque_of
from ccnn_torch.errors import InputError
from ccnn_torch.identification.config import PER_LEG, IdentifyConfig
from ccnn_torch.mechanisms import (
    Framed,
    Giving,
    Instrument,
    Mechanism,
    Seen,
    SerialArm,
    as_measured,
    fit_frames,
    fit_unknown,
    judge_frames,
    load_mechanism,
    set_ups,
)
from ccnn_torch.mechanisms.frames.judge import far_rows
from ccnn_torch.mechanisms.frames.partial import completed
from ccnn_torch.records import Records, check_rows, load_records
from ccnn_torch.records.splits import Split
from ccnn_torch.records.table import PAYLOAD
from ccnn_torch.units import si_unit_of

# Each round of `command` shrinks the remainder by about the relative size of the errors.
_COMMAND_ROUNDS = 6


@dataclass(frozen=True)
class Kinematics:
    """A mechanism and whether its machines leave the nominal motion (`as_built`, `pose_near` of the mechanism)."""

    mechanism: Mechanism
    built: bool = False

    def frame(self, joints: Tensor, parameters: Tensor, guess: Tensor | None) -> tuple[Tensor, Tensor | None]:
        """Platform frame: position `... x 3` [m] and rotation `... x 3 x 3` (None without orientation)."""
        if self.built:
            mechanism: Any = self.mechanism
            position, rotation = mechanism.as_built(joints, parameters)
            return position, rotation
        return self.mechanism.frame(self.mechanism.forward_kinematics(joints, parameters, guess))

    def reached(self, joints: Tensor, parameters: Tensor, guess: Tensor | None) -> Tensor:
        """Pose, `... x p` [SI]; of a machine that leaves the nominal motion the pose nearest to its frame."""
        if not self.built:
            return self.mechanism.forward_kinematics(joints, parameters, guess)
        mechanism: Any = self.mechanism
        pose: Tensor = mechanism.pose_near(*self.frame(joints, parameters, guess))
        return pose

    def command(self, wanted: Tensor, parameters: Tensor, guess: Tensor) -> Tensor:
        """Joints that take a machine with these parameters to a pose, `... x n` [SI].

        Exact: off the nominal motion the inverse kinematics of the pose alone are a first guess, corrected by the
        joints between the wanted pose and the one reached until nothing is left.
        """
        joints = self.mechanism.solve_inverse(wanted, parameters, guess)
        if not self.built:
            return joints
        ideal = joints
        for _ in range(_COMMAND_ROUNDS):
            there = self.mechanism.solve_inverse(self.reached(joints, parameters, wanted), parameters, guess)
            joints = joints + self.mechanism.wrap(ideal - there)
        return joints


def make_kinematics(mechanism: Mechanism, built: bool) -> Kinematics:
    """Check that the mechanism knows how it is built."""
    if built and not (hasattr(mechanism, "as_built") and hasattr(mechanism, "pose_near")):
        raise InputError(
            f"simulate.as_built: {mechanism.name} never leaves its nominal motion, so that there is nothing to "
            "simulate; remove the key"
        )
    return Kinematics(mechanism, built)


@dataclass(frozen=True)
class Rows:
    """Measured configurations of `r` machines, rows in the order measured.

    Attributes:
        joints: as recorded, `r x s x n` [SI].
        observed: what was measured, `r x s x o` [SI]: pose coordinates of the view (NaN: not measured), or values of a
            constraint.
    """

    joints: Tensor
    observed: Tensor

    def of(self, machines: Tensor) -> Rows:
        """The rows of some machines."""
        return Rows(self.joints[machines], self.observed[machines])

    def and_these(self, others: Rows) -> Rows:
        """The rows with others behind them."""
        return Rows(torch.cat([self.joints, others.joints], 1), torch.cat([self.observed, others.observed], 1))

    def with_more(self, columns: Tensor) -> Rows:
        """The rows with further columns `s x m` behind their joints: the number of a set-up, torques."""
        return replace(self, joints=torch.cat([self.joints, columns.to(self.joints.dtype)[None]], -1))


@dataclass(frozen=True)
class Measured:
    """Everything that is fixed before the first solver starts.

    Attributes:
        mechanism: what is identified.
        kinematics: how its machines move.
        view: the mechanism as the instrument sees it; its pose coordinates are the columns of `Rows.observed`. The
            mechanism itself, or a view with the same parameters where points on the platform are measured.
        rows: from which all is identified.
        test: held-out rows; their `observed` are poses of the mechanism.
        start: where the search begins, `r x K` [SI]: nominal, or with the frames fitted.
        leg_rows: rows for one leg alone, by leg, where each leg has poses of its own; else empty.
        truth: the simulated machines' parameters, `r x K` [SI]; None for records.
        wanted, wanted_joints: held-out poses that machines are sent to, `r x t x p` [SI], and joints near by,
            `r x t x n` [SI], which select the branch; None for records.
        reached: true poses of the held-out rows, `r x t x p` [SI]; None for records.
        pose_noise: standard deviation of each observed coordinate, `o` [SI]; None where it is to be estimated.
        joint_noise: of the recorded joints, `n` [SI]; None where there is none.
        data_hash: SHA-256 of the records; empty for simulated data.
        notes: sentences for the person who reads the results.
        doubts: those of them that come first.
        name_rows: formats numbers of rows, held-out ones behind the others, as the user knows them; None for simulated
            data.
    """

    mechanism: Mechanism
    kinematics: Kinematics
    view: Mechanism
    rows: Rows
    test: Rows
    start: Tensor
    leg_rows: dict[int, Rows] = field(default_factory=dict)
    truth: Tensor | None = None
    wanted: Tensor | None = None
    wanted_joints: Tensor | None = None
    reached: Tensor | None = None
    pose_noise: Tensor | None = None
    joint_noise: Tensor | None = None
    data_hash: str = ""
    notes: list[str] = field(default_factory=list)
    doubts: list[str] = field(default_factory=list)
    name_rows: Callable[[Sequence[int]], str] | None = None

    @property
    def machines(self) -> int:
        return len(self.start)


def nominal_machine(config: IdentifyConfig) -> Mechanism:
    """The mechanism that the config names, an arm with the parameters of its links that it asks for."""
    mechanism = load_mechanism(config.mechanism, **config.mechanism_keys)
    if config.links == "lean" and isinstance(mechanism, SerialArm):
        return mechanism.with_leans()
    return mechanism


def held_by_priors(config: IdentifyConfig, mechanism: Mechanism) -> bool:
    """Whether links stay near nominal by priors, as beside a constraint: parts of poses leave much open."""
    plain = config.residual == "auto" and config.methods == ["lm"]
    of_each = isinstance(config.noise, dict) and not isinstance(mechanism, Instrument)
    return isinstance(mechanism, Seen) and plain and not of_each


def from_records(config: IdentifyConfig, mechanism: Mechanism, given: Given | None = None) -> Measured:
    """Load and split the records of a config, or those that Python has."""
    assert config.records is not None
    source = with_test_file(config.records if given is None else given, config.split)
    records, mechanism = read_records(config, source, mechanism)
    split = split_records(config, records)
    train, test = rows_of_split(records, split)
    columns = {name: values[split.train.numpy()] for name, values in records.columns.items()}
    # As beside a constraint the frames are fitted with the rest.
    start = mechanism.nominal[None] if held_by_priors(config, mechanism) else _start(mechanism, train, columns)
    far = list[str]()
    if isinstance(mechanism, SerialArm):
        about = train.joints[0], train.observed[0], start
        named = split.train.numpy()
        far = judge_frames(mechanism, *about, where=records.path, name_rows=lambda rows: records.name_rows(named[rows]))
        if far:
            error = mechanism.pose_error(mechanism.forward_kinematics(about[0], start), about[1])
            sound = ~far_rows(error, ~about[1].isnan().any(-1))[1].reshape(-1)
            split = replace(split, train=split.train[sound])
            train, test = rows_of_split(records, split)
            start = start[:, sound] if start.dim() > 2 else start
    joint_noise = None
    if config.joint_noise is not None:
        joint_noise = sizes_of_joints(config.joint_noise, mechanism.joints, "joint_noise")
    if isinstance(mechanism, SerialArm | Framed) and mechanism.grouped:
        mechanism, number, groups = set_ups(mechanism, records.columns, len(records))
        _refuse_unseen(groups, split, records)
        train, test = (rows.with_more(number[i, None]) for rows, i in ((train, split.train), (test, split.test)))
        start = mechanism.parameters_of(start[0], number[split.train])[None]
        # The number of a set-up has no noise.
        joint_noise = None if joint_noise is None else torch.nn.functional.pad(joint_noise, (0, 1))
    # Joints of measured poses are known as far as the torques do not move them.
    by_joints = config.residual == "inverse" or config.per_leg or any(m.endswith(PER_LEG) for m in config.methods)
    giving = [] if by_joints or isinstance(mechanism, Seen) else _torques(records, mechanism)
    if giving:
        far.append(
            "Joints were identified to give under the torques of the records (compliance q1 …): identified.yaml is the "
            "machine without torques, and commands that hold what joints give are those of ccnn diagnose or ccnn run."
        )
        torques = torch.stack([values for _, values in giving], -1)
        mechanism = Giving(mechanism, [i for i, _ in giving])
        train, test = (rows.with_more(torques[i]) for rows, i in ((train, split.train), (test, split.test)))
        start = torch.nn.functional.pad(start, (0, len(giving)))
        joint_noise = None if joint_noise is None else torch.nn.functional.pad(joint_noise, (0, len(giving)))
    numbers = torch.cat([split.train, split.test]).numpy()
    return Measured(
        mechanism=mechanism,
        kinematics=Kinematics(mechanism),
        view=mechanism,
        rows=train,
        test=test,
        start=start,
        pose_noise=_pose_noise(config.noise, mechanism),
        joint_noise=joint_noise,
        data_hash=records.data_hash,
        notes=[*held_out_notes(config.split, len(split.test), split), *notes_of(records), *far],
        name_rows=lambda rows: records.name_rows(numbers[rows]),
    )


def _pose_noise(noise: Size | dict[str, Size] | None, mechanism: Mechanism) -> Tensor | None:
    """Standard deviation of each pose coordinate, `p` [SI]; None where some of those that instruments read has none."""
    read, given = mechanism.pose[: mechanism.compared], len(mechanism.pose) - mechanism.compared
    if noise is None:
        return None
    if isinstance(noise, dict) and isinstance(mechanism, Instrument):
        sizes = sizes_by_name(noise, read, "noise", [math.nan] * len(read))
        if bool(sizes.isnan().any()):
            return None
    else:
        sizes = sizes_of_pose(noise, read, "noise")
    # What an instrument was pointed at is never compared.
    return torch.nn.functional.pad(sizes, (0, given), value=1.0)


def read_records(config: IdentifyConfig, source: Given, mechanism: Mechanism) -> tuple[Records, Mechanism]:
    """Records that fit a mechanism, and the mechanism as it was measured there (of its pose all, or a part)."""
    records = load_records(source, mechanism, [], learns=False, columns=config.columns, joint_map=config.joint_map)
    mechanism = as_measured(mechanism, records.pose_coordinates, records.path, records.pose)
    if not isinstance(mechanism, Framed) or not mechanism.unknown_frames:
        check_rows(records, mechanism)
        _check_joints(records, mechanism)
    return records, mechanism


def _check_joints(records: Records, mechanism: Mechanism) -> None:
    """Refuse rows whose joints the nominal machine cannot take: no residual is known there, and no error before."""
    reached = mechanism.forward_kinematics(records.joints, guess=completed(mechanism, records.joints, records.pose))
    lost = torch.nonzero(~torch.isfinite(reached).all(-1)).squeeze(-1).numpy()
    if len(lost):
        raise InputError(
            f"{records.path}: {mechanism.name} has no pose for the joints at {records.name_rows(lost)}; correct or "
            f"remove {'it' if len(lost) == 1 else 'them'}, or check the units and the order of the joints; "
            "poses in the frame of a measuring device need mechanism: framed (docs/how_to/mechanisms.md)"
        )


def split_records(config: IdentifyConfig, records: Records) -> Split:
    """Which rows are to identify from, and which judge."""
    held = rows_of_test_file(config.split, records.parts)
    return split_by(config.split, records.positions, records.columns, config.seed, 0.0, held, records.joints)


def rows_of_split(records: Records, split: Split) -> tuple[Rows, Rows]:
    """Rows to identify from, and rows that judge."""
    train, test = (Rows(records.joints[None, i], records.pose[None, i]) for i in (split.train, split.test))
    return train, test


def _start(mechanism: Mechanism, rows: Rows, columns: Mapping[str, NDArray[np.float64]]) -> Tensor:
    """Where the search starts, `1 x K`, `1 x s x K` with frames by group: what is unknown is fitted first.

    columns: of the rows, which number the groups.
    """
    joints, pose, fitted = rows.joints[0], rows.observed[0], None
    if isinstance(mechanism, SerialArm) and mechanism.grouped:
        fitted = fit_frames(mechanism, joints, pose, columns=columns)
    else:
        fitted = fit_unknown(mechanism, joints, pose, columns=columns)
    return (mechanism.nominal if fitted is None else fitted)[None].clone()


def _torques(records: Records, mechanism: Mechanism) -> list[tuple[int, Tensor]]:
    """Numbers of the joints whose torques at rest were recorded and vary, and these, `s` [N or N·m]."""
    found = []
    for i, joint in enumerate(mechanism.joints):
        name, unit = torque_of(joint), force_of(joint.unit)
        values = records.columns.get(name)
        if values is None or np.ptp(values) == 0:
            continue
        if si_unit_of(records.units[name], name) != unit:
            raise InputError(f"{records.path}: column '{name}' is in {records.units[name]}; write {name}[{unit}]")
        empty = np.flatnonzero(~np.isfinite(values))
        if len(empty):
            raise InputError(f"{records.path}: column '{name}' is empty at {records.name_rows(empty)}; fill it in")
        found.append((i, torch.from_numpy(values)))
    return found


def _refuse_unseen(groups: Sequence[tuple[str, Tensor]], split: Split, records: Records) -> None:
    """Raise InputError where a group of rows with a frame of its own has none to identify from."""
    for name, rows in groups:
        if not bool(rows[split.train].any()):
            raise InputError(
                f"{records.path}: {name} has {int(rows.sum())} held-out rows but none to identify from, so that its "
                "frame is not known; write split.kind=random or a smaller split.test, or leave these rows out"
            )


def notes_of(records: Records) -> list[str]:
    """Without those of columns that are no inputs here."""
    loads = [name for name in records.columns if name.startswith("load_") and np.ptp(records.columns[name]) > 0]
    notes = [note for note in records.notes if not note.startswith(("ignored columns", "column '", f"{PAYLOAD}["))]
    if loads:
        notes.append(
            f"{', '.join(loads)} {'acts' if len(loads) == 1 else 'act'} on no parameter of the geometry and "
            f"{'was' if len(loads) == 1 else 'were'} not used: ccnn diagnose and ccnn run find what gives under a load"
        )
    return notes
