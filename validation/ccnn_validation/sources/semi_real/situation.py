"""Rows drawn from a robot, with what a careful user recorded beside them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .arm import Arm
from .kinds import Floats
from .robots import Robot

__all__ = ["Rows", "draw_rows", "smooth_course"]

LOADS = {"ur10_a": 60.0, "ur10_b": 60.0, "ur5_tracker": 40.0, "wam_tracker": 25.0}


@dataclass(frozen=True)
class Rows:
    """Rows of a case.

    Attributes:
        robot: where they are from.
        arm: nominal arm with its fitted tool point.
        joints: `s x n` [rad].
        position: `s x 3` [m], turn: `s x 3` [rad] or None; as measured.
        direction: `s x n`, the sign of each joint's last motion.
        way: `s x n` [rad], how long that motion was.
        time: `s` [s], temperature: `s` [degC].
        load: force on the measured point along the tracker's axes, `s x 3` [N].
        speed: `s x n` [rad/s], along `direction`.
        span: travel of each joint, `n` [rad]; middle: `n` [rad].
        lever: how far a joint moves the measured point, root mean square, `n` [m/rad].
    """

    robot: Robot
    arm: Arm
    joints: Floats
    position: Floats
    turn: Floats | None
    direction: Floats
    way: Floats
    time: Floats
    temperature: Floats
    load: Floats
    speed: Floats
    span: Floats
    middle: Floats
    lever: Floats

    def good_joints(self, shortest: float = 0.1, travel: float = 0.6) -> NDArray[np.intp]:
        """Joints that move the measured point and that were moved themselves, as numbers from 0."""
        return np.flatnonzero((self.lever > shortest) & (self.span > travel))

    def torque(self) -> Floats:
        """Torque of the load on the joints, `s x n` [N*m]: the force is along the tracker's axes, as the pose is."""
        slopes = self.arm.jacobian(self.joints)[:, :3]
        return ((self.load @ self.robot.seen.base)[:, None] @ slopes)[:, 0]


def draw_rows(robot: Robot, rng: np.random.Generator) -> Rows:
    """Rows in the order measured, with covariates that nothing depends on yet."""
    total = len(robot.joints)
    if robot.name == "ur5_tracker":
        count = int(rng.integers(100, 401))
        start = int(rng.integers(0, total - count + 1))
        kept = np.arange(start, start + count)
    else:
        kept = np.sort(rng.permutation(total)[: min(400, total)])
    joints = robot.joints[kept]
    count, n = joints.shape
    # The WAM's own errors depend on the direction it came from: there the last, short approach is drawn.
    drawn = robot.name == "wam_tracker" or rng.random() < 0.4
    direction = rng.choice([-1.0, 1.0], (count, n)) if drawn else robot.direction[kept]
    way = np.abs(np.diff(joints, axis=0, prepend=joints[:1]))
    way[0] = way.mean(0)
    pace = rng.uniform(20, 120)
    time = np.cumsum(pace * rng.uniform(0.7, 1.5, count))
    time -= time[0]
    slopes = robot.seen.arm.jacobian(joints)[:, :3]
    return Rows(
        robot=robot,
        arm=robot.seen.arm,
        joints=joints,
        position=robot.position[kept],
        turn=None if robot.turn is None else robot.turn[kept],
        direction=direction,
        way=rng.uniform(0.02, 0.3, (count, n)) if drawn else way,
        time=time,
        temperature=smooth_course(rng, time, rng.uniform(19, 23), rng.uniform(1, 3))[0],
        load=rng.normal(0, LOADS[robot.name], (count, 3)),
        speed=direction * rng.uniform(0.02, 0.6, (count, n)),
        span=np.ptp(joints, axis=0),
        middle=(joints.max(0) + joints.min(0)) / 2,
        lever=np.sqrt((slopes**2).sum(1).mean(0)),
    )


def smooth_course(
    rng: np.random.Generator, time: Floats, middle: float, swing: float, lag: float = 0.0
) -> tuple[Floats, Floats]:
    """A hall's temperature, a part of the day's swing with heating that comes and goes, and what follows it late.

    Args:
        rng: draws the course.
        time: `s` [s].
        middle: mean temperature [degC].
        swing: how far it goes, standard deviation over the rows [K].
        lag: time constant of what follows the hall [s]; its answer to sines is known in closed form.

    Returns:
        The hall's temperature and that of what follows it, `s` each [degC].
    """
    periods = np.array([1.4, 0.45, 0.13]) * time.max() * rng.uniform(0.8, 1.25, 3)
    phases, sizes = rng.uniform(0, 2 * np.pi, 3), np.array([1.0, 0.7, 0.35]) * rng.uniform(0.7, 1.3, 3)
    rate = 2 * np.pi / periods
    now = (sizes * np.sin(np.outer(time, rate) + phases)).sum(1)
    late = (sizes / np.hypot(1, rate * lag) * np.sin(np.outer(time, rate) + phases - np.arctan(rate * lag))).sum(1)
    scale = swing / now.std()
    return middle + scale * (now - now.mean()), middle + scale * (late - now.mean())
