"""The scores of one cell: one entry on one split of one set."""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from benchmarks.field.data import Data
from benchmarks.field.geometry import chain, solve
from benchmarks.field.protocol import Entry, Fit, Floats, Rows, errors, moved, rigid
from benchmarks.field.splits import SEED, halves, splits

REPLICATES, INJECTION = "replicates", "injection"
# What is added to a machine's rows: 2 mrad, 2 mm or 2 per mille.
SIZE = 2e-3


def tasks(data: Data, entry: Entry) -> list[str]:
    """What an entry is asked on a set: its splits, replicates, and known causes where poses show them."""
    if entry.sockets is not None and entry.sockets != data.rows.sockets:
        return []
    named = list(splits(data))
    causes = entry.changed is not None and not data.rows.sockets and data.rows.joints.shape[1] > 3
    return [*named, REPLICATES, *([INJECTION] if causes else [])]


def score(data: Data, entry: Entry, task: str) -> dict[str, Any]:
    """The scores of a task [SI]."""
    start = time.process_time()
    if task == INJECTION:
        found: dict[str, Any] = {"causes": injected(data.rows.take(splits(data)["random"][0]), entry)}
    else:
        train, test = splits(data)["random" if task == REPLICATES else task]
        held = data.rows.take(test)
        if task == REPLICATES:
            found = replicates([entry.fit(data.rows.take(half)) for half in halves(train)], held)
        else:
            fit, elsewhere = entry.fit(data.rows.take(train)), data.rows.take(np.concatenate([train, test])).several
            found = held_out(fit, held, data.floor, elsewhere)
        found |= {"training_rows": len(train), "held_out_rows": len(test)}
    return found | {"seconds": time.process_time() - start}


def aligned(rows: Rows, poses: Floats, target: Floats) -> Floats:
    """Poses after a rigid motion for each measuring frame, `n x p`."""
    found = poses.copy()
    for one in np.unique(rows.frame):
        at = rows.frame == one
        found[at] = moved(poses[at], *rigid(poses[at], target[at]))
    return found


def held_out(fit: Fit, rows: Rows, floor: float | None, elsewhere: bool) -> dict[str, Any]:
    """RMS of position and orientation, over the floor where it is known, and coverage of intervals.

    Args:
        elsewhere: not all rows, training rows too, are of one measuring frame.
    """
    poses = fit.predict(rows.joints, rows.covariates)
    gaps = errors(rows.poses, aligned(rows, poses, rows.poses) if elsewhere else poses)
    found: dict[str, Any] = {"position": rms(gaps[:, :3]), "largest": float(np.linalg.norm(gaps[:, :3], axis=1).max())}
    if gaps.shape[1] == 6:
        found["rotation"] = rms(gaps[:, 3:])
    if floor is not None:
        found["over_floor"] = found["position"] / floor
    if fit.half_width is not None and not elsewhere:
        found["coverage"] = float((np.abs(gaps) <= fit.half_width(rows.joints, rows.covariates)).mean())
    return found


def replicates(fits: list[Fit], rows: Rows) -> dict[str, Any]:
    """RMS by which two fits to two halves differ on the held-out rows."""
    one, other = (f.predict(rows.joints, rows.covariates) for f in fits)
    if rows.several:
        one, other = (aligned(rows, poses, rows.poses) for poses in (one, other))
    return {"position": rms(errors(one, other)[:, :3])}


def rms(gaps: Floats) -> float:
    """Root mean square of the length, of `n x 3`."""
    return float(np.sqrt((gaps**2).sum(1).mean()))


def injected(rows: Rows, entry: Entry) -> dict[str, dict[str, Any]]:
    """Whether an entry names a cause that was added to the second half of the rows, and the share of its size."""
    assert entry.changed is not None
    before, after = (rows.take(half) for half in halves(np.arange(len(rows.joints)), SEED))
    found = {}
    for cause in causes(rows):
        said = entry.changed(before, with_cause(after, cause))
        named = max(said, key=lambda name: abs(said[name]), default="nothing")
        found[cause] = {"named": named, "right": named == cause, "share": said.get(cause, 0.0) / SIZE}
    return found


def causes(rows: Rows) -> list[str]:
    """The zero of joint 3, the longest length of a link between the first and the last, and the gain of joint 2."""
    tables = {"a": np.abs(rows.arm.a), "d": np.abs(rows.arm.d)}
    lengths = {f"{n} {k + 1}": v[k] for n, v in tables.items() for k in range(1, len(v) - 1)}
    return ["zero 3", max(lengths, key=lambda name: lengths[name]), "gain 2"]


def with_cause(rows: Rows, cause: str) -> Rows:
    """Rows of the same machine with an error more: joints are read otherwise, or places are reached otherwise."""
    kind, number = cause.split()
    k = int(number) - 1
    if kind in ("zero", "gain"):
        joints = rows.joints.copy()
        joints[:, k] = joints[:, k] - SIZE if kind == "zero" else joints[:, k] / (1 + SIZE)
        return rows.with_values(joints=joints)
    solved, links = solve(rows, with_links=False), np.zeros((rows.joints.shape[1], 5))
    links[k, {"a": 0, "d": 2}[kind]] = SIZE
    there = chain(rows.arm, rows.joints, links, solved.tool)[:, :3] - solved.in_base(rows.joints)[:, :3]
    poses = rows.poses.copy()
    poses[:, :3] += there @ solved.base[0].T
    return rows.with_values(poses=poses)
