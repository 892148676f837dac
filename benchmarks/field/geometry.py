"""SciPy geometry: least squares on Denavit-Hartenberg tables in formulas of its own, without ccnn_torch."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import least_squares

from benchmarks.field.protocol import ROTATION, Arm, Fit, Floats, Rows, errors, matrices, moved, rigid, vectors

# Tolerances of a link [m, rad], and the error that they weigh against: a weak pull to nominal.
_LINK, _LEFT = np.array([5e-3, 1e-2, 5e-3, 1e-2, 1e-2]), 3e-4


@dataclass(frozen=True)
class Solved:
    """Errors of the links' a, alpha, d, theta and a rotation about y `k x 5` [m, rad]; tool `3` or `6`; base frame."""

    arm: Arm
    links: Floats
    tool: Floats
    base: tuple[Floats, Floats]

    def in_base(self, joints: Floats) -> Floats:
        """Poses in the robot's base, `n x p`."""
        return chain(self.arm, joints, self.links, self.tool)

    def predict(self, joints: Floats, covariates: Floats) -> Floats:
        return moved(self.in_base(joints), *self.base)


def chain(arm: Arm, joints: Floats, links: Floats, tool: Floats) -> Floats:
    """Poses of the tool in the base, `n x 3` or, where the tool has a rotation, `n x 6`."""
    turn, place = np.broadcast_to(np.eye(3), (len(joints), 3, 3)), np.zeros((len(joints), 3))
    table = np.stack([arm.a, arm.alpha, arm.d, arm.theta, np.zeros_like(arm.a)], 1) + links
    for k, (a, alpha, d, theta, beta) in enumerate(table):
        about_z, about_x, about_y = _turn(joints[:, k] + theta, 2), _turn(alpha, 0), _turn(beta, 1)
        if arm.modified:
            place = place + turn @ about_x @ np.array([a, 0, 0])
            turn = turn @ (about_x @ about_y) @ about_z
            place = place + turn[:, :, 2] * d
        else:
            turn = turn @ about_z
            place = place + turn[:, :, 2] * d + turn[:, :, 0] * a
            turn = turn @ (about_x @ about_y)
    place = place + turn @ tool[:3]
    return place if len(tool) == 3 else np.hstack([place, vectors(turn @ matrices(tool[3:]))])


def _turn(angle: Floats | float, axis: int) -> Floats:
    c, s = np.cos(angle), np.sin(angle)
    found = np.zeros((*np.shape(angle), 3, 3))
    i, j = (axis + 1) % 3, (axis + 2) % 3
    found[..., axis, axis], found[..., i, i], found[..., j, j], found[..., i, j], found[..., j, i] = 1, c, c, -s, s
    return found


def solve(rows: Rows, with_links: bool = True, residual: Callable[[Rows, Floats], Floats] | None = None) -> Solved:
    """Fit frames, and links with a weak pull to nominal; the measuring frames are eliminated (Kabsch)."""
    k, pose = rows.joints.shape[1], rows.poses.shape[1]
    count, weight = (5 * k if with_links else 0), np.repeat([1.0, ROTATION], 3)[:pose]
    pull, left = _LEFT / np.tile(_LINK, k)[:count], residual or in_frames

    def parts(values: Floats) -> tuple[Floats, Floats]:
        return np.pad(values[:count], (0, 5 * k - count)).reshape(k, 5), values[count:]

    def missed(values: Floats) -> Floats:
        gaps = left(rows, chain(rows.arm, rows.joints, *parts(values)))
        return np.concatenate([(gaps * weight).ravel(), pull * values[:count]])

    start = np.zeros(count + pose)
    if pose == 6:
        start[-3:] = _tool_rotation(rows)
    links, tool = parts(least_squares(missed, start, method="lm" if with_links else "trf", x_scale="jac").x)
    found = Solved(rows.arm, links, tool, (np.eye(3), np.zeros(3)))
    return found if rows.several else replace(found, base=rigid(found.in_base(rows.joints), rows.poses))


def in_frames(rows: Rows, poses: Floats) -> Floats:
    """Errors after the best rigid motion for each measuring frame, `n x p`, in the measuring frames."""
    gaps = np.empty_like(poses)
    for one in np.unique(rows.frame):
        at = rows.frame == one
        gaps[at] = errors(rows.poses[at], moved(poses[at], *rigid(poses[at], rows.poses[at])))
    return gaps


def _tool_rotation(rows: Rows) -> Floats:
    """The tool's rotation vector at nominal geometry, from relative rotations (hand-eye)."""
    flange = matrices(chain(rows.arm, rows.joints, np.zeros((rows.joints.shape[1], 5)), np.zeros(6))[:, 3:])
    measured = matrices(rows.poses[:, 3:])
    one, other = (vectors(r @ np.roll(r, 1, 0).transpose(0, 2, 1)) for r in (flange, measured))
    u, _, vt = np.linalg.svd(other.T @ one)
    base = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    u, _, vt = np.linalg.svd((flange.transpose(0, 2, 1) @ base.T @ measured).sum(0))
    return vectors((u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt)[None]).reshape(3)


def nominal(rows: Rows) -> Fit:
    """Nominal geometry with fitted frames."""
    return Fit(solve(rows, with_links=False).predict)


def scipy_geometry(rows: Rows) -> Fit:
    """All links by least squares."""
    return Fit(solve(rows).predict)


def links_changed(before: Rows, after: Rows) -> dict[str, float]:
    """What two fits differ by."""
    gaps = solve(after).links - solve(before).links
    names = ("a", "alpha", "d", "zero", "beta")
    return {f"{name} {k + 1}": float(gaps[k, i]) for k in range(len(gaps)) for i, name in enumerate(names)}


def mukca(rows: Rows) -> Fit:
    """Sockets as MUKCa has them: the ball stays in place in each socket, and sockets are 50 mm apart."""

    def residual(rows: Rows, poses: Floats) -> Floats:
        gaps = np.empty_like(poses)
        for frame in np.unique(rows.frame):
            means, places, ways = [], [], []
            for place in np.unique(rows.poses, axis=0):
                at = (rows.frame == frame) & (rows.poses == place).all(1)
                if at.any():
                    means.append(poses[at].mean(0))
                    places.append(place)
                    ways.append(at)
                    gaps[at] = poses[at] - means[-1]
            if len(means) == 2:
                # The error of the distance, shared between the sockets along the line between them.
                line = means[1] - means[0]
                short = np.linalg.norm(places[1] - places[0]) - np.linalg.norm(line)
                for at, side in zip(ways, (0.5, -0.5), strict=True):
                    gaps[at] += side * short * line / np.linalg.norm(line)
        return gaps

    return Fit(solve(rows, residual=residual).predict)
