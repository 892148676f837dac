"""What a good engineer fits in an hour to the rows of the wires, or of a tracker, with SciPy: plain and fuller."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from ccnn_validation.wire_arm_robot import COLD, DRAWN, EYES, GEARS, HOOK, Array, G, Visit, chain, tip, torque

__all__ = ["Fit", "fitted", "followed"]

_LENGTHS = np.tile([1.0, 0, 1, 0, 0], (6, 1)) * DRAWN
# Plausible sizes: links and hook; then springs under the payload, under 40 kg of arm, play, growth a kelvin of lengths
# and of two zeros, errors once a turn of the joint and of its motor.
_LINKS = np.tile([5e-4, 5e-4, 5e-4, 1e-3, 0], (6, 1))
_LINKS[1, 4] = 5e-4
_PLAIN = np.r_[_LINKS.ravel(), np.full(3, 1e-3)]
_FULLER = np.r_[
    np.array([4, 4, 4, 30, 30, 30]) * 1e-6, np.full(3, 4e-6), np.full(6, 5e-5), 2e-5, np.full(2, 3e-6),
    np.full(12, 5e-5), np.full(12, 2e-5),
]  # fmt: skip
# Of each wire: its eye, to 5 cm, its start, to half a millimetre, and its scale.
_WIRE = np.r_[np.full(3, 0.05), 5e-4, 5e-5]
_FRAME = np.r_[np.full(3, 2e-3), np.full(3, 4e-3)]


@dataclass
class Fit:
    """Numbers of the arm and of what looked at it, and what is left of a row, root mean square [m]."""

    arm: Array
    device: Array
    left: float


def flanges(x: Array, visit: Visit) -> Array:
    """The flange by the script's model, `s x 4 x 4`."""
    links, joints = DRAWN + x[:30].reshape(6, 5), visit.joints
    if len(x) == len(_PLAIN):
        return chain(joints, links)[2]
    give, own, play, growth, creep, turns, motors = np.split(x[33:], np.cumsum([6, 3, 6, 1, 2, 12]))
    heat = (visit.temperature - COLD)[:, None]
    grown = links + growth * heat[:, :, None] * _LENGTHS
    joints = joints + turns[:6] * np.sin(joints) + turns[6:] * (np.cos(joints) - 1)
    joints += motors[:6] * np.sin(GEARS * visit.joints) + motors[6:] * np.cos(GEARS * visit.joints)
    joints -= play / 2 * visit.direction
    joints[:, 1:3] += creep * heat
    axes, places, flange = chain(joints, grown)
    down = np.array([0.0, 0.0, -G])
    twist = give * torque(axes, places, tip(flange, visit.centre), np.multiply.outer(visit.mass, down))
    weight = np.tile(40 * down, (len(joints), 1))
    for number, joint, at in ((0, 1, 2), (1, 1, 4), (2, 2, 4)):
        twist[:, joint] += own[number] * torque(axes, places, places[:, at], weight)[:, joint]
    return chain(joints + twist, grown)[2]


def _shown(x: Array, device: Array, visit: Visit, wires: tuple[int, ...]) -> Array:
    """What the wires, or without any the tracker, would show, `s x k` [m]."""
    at = tip(flanges(x, visit), HOOK + x[30:33])
    if not wires:
        return np.asarray(Rotation.from_rotvec(device[:3]).apply(at) + device[3:])
    long = []
    for k, wire in zip(wires, device.reshape(-1, 5), strict=True):
        long.append(np.linalg.norm(at - EYES[k] - wire[:3], axis=-1) * (1 + wire[4]) + wire[3])
    return np.stack(long, -1)


def fitted(visit: Visit, read: Array, wires: tuple[int, ...], fuller: bool) -> Fit:
    """Least squares with a ridge of plausible sizes, weighed by what is left in the end; NaN: not read."""
    sizes = np.r_[_PLAIN, _FULLER] if fuller else _PLAIN
    prior = np.r_[sizes, np.tile(_WIRE, len(wires)) if wires else _FRAME]
    if wires and not fuller:
        prior[len(sizes) + 4 :: 5] = 0
    there, u, noise = ~np.isnan(read), np.zeros(len(prior)), 1e-4

    def missing(u: Array) -> Array:
        x = u * prior
        return np.asarray((_shown(x[: len(sizes)], x[len(sizes) :], visit, wires) - read)[there])

    for _ in range(3):
        sure = 1 / noise
        found = least_squares(
            lambda u, sure=sure: np.r_[missing(u) * sure, u], u, x_scale="jac", xtol=1e-6, max_nfev=15
        )
        u = found.x
        # As many numbers as rows support count against what is left.
        inside = found.jac[: int(there.sum())]
        used = float(np.trace(np.linalg.solve(found.jac.T @ found.jac, inside.T @ inside)))
        noise = float(np.sqrt((missing(u) ** 2).sum() / (there.sum() - used)))
    x = u * prior
    return Fit(x[: len(sizes)], x[len(sizes) :], noise)


def followed(fit: Fit, visit: Visit, wanted: Array) -> Array:
    """Commands at which the model's flange is where it should be, `s x 6` [rad]; a damped Jacobian of the drawing."""
    sent = Visit(**{**vars(visit), "joints": visit.joints.copy()})
    for _ in range(8):
        flange = flanges(fit.arm, sent)
        axes, places, _ = chain(sent.joints, DRAWN)
        end = flange[:, :3, 3]
        jacobian = np.concatenate([np.cross(axes, end[:, None] - places), axes], -1).swapaxes(1, 2)
        turn = Rotation.from_matrix(wanted[:, :3, :3]) * Rotation.from_matrix(flange[:, :3, :3]).inv()
        miss = np.concatenate([wanted[:, :3, 3] - end, turn.as_rotvec()], -1)[..., None]
        across = jacobian.swapaxes(1, 2)
        sent.joints += np.linalg.solve(across @ jacobian + 1e-6 * np.eye(6), across @ miss)[..., 0]
    return sent.joints
