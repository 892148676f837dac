"""Measured records as the rows of an identification: split, and unknown frames fitted."""

from __future__ import annotations

import torch
from torch import Tensor

from ccnn_torch.config.sizes import sizes_of_joints, sizes_of_pose
from ccnn_torch.config.split import Given, held_out_notes, rows_of_test_file, split_by, with_test_file
from ccnn_torch.errors import InputError
from ccnn_torch.identification.config import IdentifyConfig
from ccnn_torch.identification.measured.kinematics import Kinematics
from ccnn_torch.identification.measured.measured import Measured, Rows
from ccnn_torch.mechanisms import Mechanism, SerialArm, fit_frames, judge_frames
from ccnn_torch.records import Records, check_rows, load_records


def from_records(config: IdentifyConfig, mechanism: Mechanism, given: Given | None = None) -> Measured:
    """Load and split the records of a config, or those that Python has."""
    assert config.records is not None
    source = with_test_file(config.records if given is None else given, config.split)
    records, mechanism = read_records(config, source, mechanism)
    train, test = split_records(config, records)
    start = _start(mechanism, train)
    far = []
    if isinstance(mechanism, SerialArm):
        far = judge_frames(mechanism, train.joints[0], train.observed[0], start, where=records.path)
    joint_noise = config.joint_noise
    return Measured(
        mechanism=mechanism,
        kinematics=Kinematics(mechanism),
        view=mechanism,
        rows=train,
        leg_rows={},
        test=test,
        start=start,
        pose_noise=None if config.noise is None else sizes_of_pose(config.noise, mechanism.pose, "noise"),
        joint_noise=None if joint_noise is None else sizes_of_joints(joint_noise, mechanism.joints, "joint_noise"),
        data_hash=records.data_hash,
        notes=[*held_out_notes(config.split, test.joints.shape[1]), *_notes(records), *far],
    )


def read_records(config: IdentifyConfig, source: Given, mechanism: Mechanism) -> tuple[Records, Mechanism]:
    """Records that fit a mechanism, and the mechanism as it was measured there (with or without orientation)."""
    records = load_records(source, mechanism, [], learns=False, columns=config.columns, joint_map=config.joint_map)
    if isinstance(mechanism, SerialArm):
        if mechanism.frame_per or mechanism.tool_per:
            raise InputError(
                f"{config.mechanism}: frame_per and tool_per give each group of rows a frame of its own; remove them "
                "to identify one machine, or identify from the rows of one group"
            )
        if records.orientation == "none" and mechanism.orientation != "none":
            mechanism = mechanism.with_orientation("none")
    elif len(records.pose_coordinates) != len(mechanism.pose):
        there = {c.name for c in records.pose_coordinates}
        missing = [c.header for c in mechanism.pose if c.name not in there]
        raise InputError(f"{records.path}: {mechanism.name} needs the columns {', '.join(missing)}, too")
    if not config.frame.base and not config.frame.tool:
        check_rows(records, mechanism)
        _check_joints(records, mechanism)
    return records, mechanism


def _check_joints(records: Records, mechanism: Mechanism) -> None:
    """Refuse rows whose joints the nominal machine cannot take: no residual is known there, and no error before."""
    reached = mechanism.forward_kinematics(records.joints, guess=records.pose)
    lost = torch.nonzero(~torch.isfinite(reached).all(-1)).squeeze(-1).numpy()
    if len(lost):
        raise InputError(
            f"{records.path}: {mechanism.name} has no pose for the joints at {records.name_rows(lost)}; correct or "
            f"remove {'it' if len(lost) == 1 else 'them'}, or check the units and the order of the joints"
        )


def split_records(config: IdentifyConfig, records: Records) -> tuple[Rows, Rows]:
    """Rows to identify from, and rows that judge."""
    held = rows_of_test_file(config.split, records.parts)
    split = split_by(config.split, records.positions, records.columns, config.seed, 0.0, held)
    train, test = (Rows(records.joints[None, i], records.pose[None, i]) for i in (split.train, split.test))
    return train, test


def _start(mechanism: Mechanism, rows: Rows) -> Tensor:
    """Where the search starts, `1 x K`: frames that are unknown have to be fitted first."""
    if not isinstance(mechanism, SerialArm) or not mechanism.unknown_frames:
        return mechanism.nominal[None].clone()
    return fit_frames(mechanism, rows.joints[0], rows.observed[0])[None]


def _notes(records: Records) -> list[str]:
    """Without those of columns that are no inputs here."""
    return [note for note in records.notes if not note.startswith(("ignored columns", "column '"))]
