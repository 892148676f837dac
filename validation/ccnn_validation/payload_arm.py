"""An industrial arm with gears that give, links with weight and eccentric encoders, judged under other payloads.

`python -m ccnn_validation.payload_arm --seed N [--machines N] [--rows N]`. A tracker measures positions alone, with
0, 6 and 12 kg on the flange, whose forces are recorded. Ours (`ccnn run`, by the written file) stands beside a plain
SciPy fit of links, eccentricities and springs, and scikit-learn's Gaussian process over joints and payload; "ours told"
has the key `compensation.ends` for the largest payload. Judged are other places under 3 and 9 kg, and under 15 kg, in
the frame and at the tool point that suit what is reached best.
"""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel

from ccnn_validation.drawn import commanded, judge_machines

Array = NDArray[np.float64]
# Of the drawing, a row a joint: a [m], alpha [rad], d [m], theta, lean about y [rad]; the reflector on the flange [m].
DRAWN = np.zeros((6, 5))
DRAWN[:3, 0], DRAWN[[0, 3, 5], 2] = [0.26, 0.68, -0.035], [0.675, 0.67, 0.115]
DRAWN[:, 1] = np.pi / 2 * np.array([-1, 0, -1, 1, -1, 0])
TOOL, START = np.array([0.03, 0.0, 0.15]), np.array([0, 0, 0, 0, 0, 0, 0.03, 0.0, 0.15])
LOW, HIGH = np.radians([-90, -100, -60, -150, -100, -150]), np.radians([90, -30, 50, 150, 100, 150])
# Of a measured coordinate and of a joint's stop; places judged; acceleration of gravity.
NOISE, STOP, NEW, G = 20e-6, 8e-6, 300, 9.81
PAYLOADS, OTHERS = (0.0, 6.0, 12.0), (3.0, 9.0, 15.0)
FILE = """{robot: arm, dof: 6, convention: standard Denavit-Hartenberg, units: {length: m, angle: deg},
a: [0.26, 0.68, -0.035, 0, 0, 0], alpha: [-90, 0, -90, 90, -90, 0], d: [0.675, 0, 0, 0.67, 0, 0.115],
theta: [0, 0, 0, 0, 0, 0], base_frame: unknown, tool_offset: unknown}
"""


def chain(joints: Array, links: Array) -> tuple[Array, Array, Array]:
    """Axes and places of the joints, `s x 6 x 3`, and the flange, `s x 4 x 4`."""
    at, axes, places = np.tile(np.eye(4), (len(joints), 1, 1)), [], []
    for k, (a, alpha, d, theta, lean) in enumerate(links):
        axes.append(at[:, :3, 2])
        places.append(at[:, :3, 3])
        c, s, ca, sa = np.cos(joints[:, k] + theta), np.sin(joints[:, k] + theta), np.cos(alpha), np.sin(alpha)
        o, i = np.zeros_like(c), np.ones_like(c)
        rows = [[c, -s * ca, s * sa, a * c], [s, c * ca, -c * sa, a * s], [o, i * sa, i * ca, i * d], [o, o, o, i]]
        at = at @ np.moveaxis(np.array(rows), -1, 0)
        at[:, :3, :3] = at[:, :3, :3] @ Rotation.from_euler("y", lean).as_matrix()
    return np.stack(axes, 1), np.stack(places, 1), at


def tip(flange: Array, tool: Array) -> Array:
    return np.asarray(flange[:, :3, :3] @ tool + flange[:, :3, 3])


def torque(axes: Array, places: Array, at: Array, mass: Array | float, joints: int = 6) -> Array:
    """Of a mass at a point on the first joints, which carry it, `s x 6` [N m]."""
    pull = np.cross(axes, at[:, None] - places)[..., 2] * (-G * np.asarray(mass))[..., None]
    return np.asarray(pull * (np.arange(6) < joints))


class Arm:
    """The true arm: its controller knows the drawing alone."""

    def __init__(self, seed: int) -> None:
        rng = np.random.default_rng(seed)
        self.links = DRAWN + rng.normal(0, [3e-4, 3e-4, 3e-4, 6e-4, 0], (6, 5))
        self.links[1, 4], self.tool = rng.normal(0, 3e-4), TOOL + rng.normal(0, 5e-4, 3)
        self.give = np.array([1.0, 1.4, 2.2, 9, 11, 16]) * 1e-6 * rng.uniform(0.7, 1.4, 6)
        self.eccentric = rng.uniform(20e-6, 120e-6, 6)
        self.phase, self.gear = rng.uniform(0, 2 * np.pi, (2, 6)), rng.uniform(0, 25e-6, 6)
        self.mass, self.reach = np.array([70.0, 45.0, 12.0]), rng.uniform(0.4, 0.55, 3)
        self.balance, self.centre = rng.uniform(0.5, 0.8), np.array([0.0, 0.0, 0.12]) + rng.normal(0, 0.02, 3)
        self.turn, self.stand = Rotation.from_rotvec([0, 0, rng.uniform(-3, 3)]), rng.normal(0, 2, 3)

    def reached(self, joints: Array, payload: Array) -> Array:
        """The reflector in the arm's base, `s x 3` [m]: springs at rest under links and payload."""
        wave = self.eccentric * np.sin(joints + self.phase[0]) + self.gear * np.sin(2 * joints + self.phase[1])
        axes, places, flange = chain(joints + wave, self.links)
        twist = np.zeros_like(joints)
        for k, (mass, share) in enumerate(zip(self.mass, self.reach, strict=True), 1):
            centre = places[:, k] + share * (places[:, k + 1] - places[:, k])
            twist += torque(axes, places, centre, mass, k + 1)
        # A spring of joint 2 carries a part of the weight of the arm.
        twist[:, 1] *= 1 - self.balance
        twist += torque(axes, places, tip(flange, self.centre), payload)
        return tip(chain(joints + wave + self.give * twist, self.links)[2], self.tool)

    def measured(self, joints: Array, payload: Array, rng: np.random.Generator) -> Array:
        """As a tracker that stands upright reads it, `s x 3` [m]."""
        place = self.reached(joints + rng.normal(0, STOP, joints.shape), payload)
        return np.asarray(self.turn.apply(place) + self.stand + rng.normal(0, NOISE, place.shape))


def off(x: Array, flange: Array, places: Array) -> Array:
    """Places in another frame, less those of a point on the flange, flat [m]; `x`: rotation vector, shift, point."""
    return np.asarray((Rotation.from_rotvec(x[:3]).apply(places) + x[3:6] - tip(flange, x[6:])).ravel())


def missed(wanted: Array, reached: Array) -> float:
    """Root mean square of what is missed in the best frame, with the best point on the nominal flange [m]."""
    found = least_squares(lambda x: off(x, wanted, reached), START, x_scale=1e-3)
    return float(np.sqrt((found.fun**2).sum() / len(wanted)))


PRIOR = np.r_[np.tile([5e-4, 5e-4, 5e-4, 1e-3, 0], 6), np.full(12, 1e-4), np.full(6, 2e-5), np.full(3, 3e-6)]
PRIOR[9] = 5e-4


def model(x: Array, joints: Array, payload: Array) -> Array:
    """The plain script's flange, `s x 4 x 4`: links, eccentricities, springs under the payload and 50 kg of arm."""
    links, shift = DRAWN + x[:30].reshape(6, 5), joints + x[30:36] * np.sin(joints) + x[36:42] * (np.cos(joints) - 1)
    axes, places, flange = chain(shift, links)
    twist = x[42:48] * torque(axes, places, tip(flange, TOOL), payload)
    for number, joint, at in ((48, 1, 2), (49, 1, 4), (50, 2, 4)):
        twist[:, joint] += x[number] * torque(axes, places, places[:, at], 50.0)[:, joint]
    return chain(shift + twist, links)[2]


def in_base(joints: Array, places: Array) -> Array:
    """Measured places in the frame that suits the drawing best, `s x 3` [m]."""
    drawn = tip(chain(joints, DRAWN)[2], TOOL)
    turn, _ = Rotation.align_vectors(drawn - drawn.mean(0), places - places.mean(0))
    return np.asarray(turn.apply(places - places.mean(0)) + drawn.mean(0))


def by_script(joints: Array, payload: Array, places: Array) -> Array:
    """Numbers of the plain script: least squares with a ridge of plausible sizes; frame and tool are free."""
    at = in_base(joints, places)

    def left(u: Array) -> Array:
        missing = off(START + u[51:] * 1e-3, model(u[:51] * PRIOR, joints, payload), at)
        return np.asarray(np.r_[missing / 4e-5, u[:51], 0.1 * u[51:]])

    return np.asarray(least_squares(left, np.zeros(60)).x[:51] * PRIOR)


def corrected(wanted: Array, flange: Array, joints: Array) -> Array:
    """Joints moved by what the flange is off, `s x 6`; a damped Jacobian of the drawing."""
    axes, places, _ = chain(joints, DRAWN)
    end = flange[:, :3, 3]
    jacobian = np.concatenate([np.cross(axes, end[:, None] - places), axes], -1).swapaxes(1, 2)
    turn = Rotation.from_matrix(wanted[:, :3, :3]) * Rotation.from_matrix(flange[:, :3, :3]).inv()
    miss = np.concatenate([wanted[:, :3, 3] - end, turn.as_rotvec()], -1)[..., None]
    across = jacobian.swapaxes(1, 2)
    return np.asarray(joints + np.linalg.solve(across @ jacobian + 1e-6 * np.eye(6), across @ miss)[..., 0])


def by_process(joints: Array, payload: Array, places: Array) -> list[GaussianProcessRegressor]:
    """Scikit-learn: position error over joints and payload, in the best frame and with the best tool."""
    at, flange = in_base(joints, places), chain(joints, DRAWN)[2]
    error = least_squares(lambda x: off(x, flange, at), START).fun.reshape(-1, 3)
    kernel = ConstantKernel(1.0) * RBF([1.0] * 7) + WhiteKernel(0.01)
    make = GaussianProcessRegressor
    return [make(kernel, normalize_y=True, random_state=0).fit(np.c_[joints, payload / 10], e) for e in error.T]


# Of the config, for an arm that will carry as much as 15 kg.
TOLD = "mechanism: machine.yaml\ncompensation: {ends: {load_z: [-150 N, 0 N]}}\n"


def by_package(
    joints: Array, payload: Array, places: Array, wanted: Array, after: Array, **config: str
) -> Array | None:
    """Commands to the joints wanted, by the written file."""
    names = ",".join([*(f"q{k}[rad]" for k in range(1, 7)), "load_z[N]"])
    records = f"{names},x[m],y[m],z[m]", np.c_[joints, -G * payload, places]
    with TemporaryDirectory() as folder:
        return commanded(Path(folder), FILE, records, (names, np.c_[wanted, -G * after]), **config)


def judged(seed: int, rows: int) -> dict[str, float]:
    """Root mean square of what one arm misses [m], by who calibrated it; NaN where there were no commands."""
    arm, rng = Arm(seed), np.random.default_rng([seed, 1])
    joints, payload = rng.uniform(LOW, HIGH, (rows, 6)), rng.choice(PAYLOADS, rows)
    places = arm.measured(joints, payload, rng)
    target, after = rng.uniform(LOW + 0.1, HIGH - 0.1, (NEW, 6)), rng.choice(OTHERS, NEW)
    # As a planner does it: not near the wrist's singular place.
    target[:, 4] = rng.choice([-1, 1], NEW) * rng.uniform(0.3, 1.6, NEW)
    wanted = chain(target, DRAWN)[2]
    script, fitted = target, wanted.copy()
    numbers, fits = by_script(joints, payload, places), by_process(joints, payload, places)
    for _ in range(8):
        script = corrected(wanted, model(numbers, script, after), script)
    fitted[:, :3, 3] += np.stack([fit.predict(np.c_[target, after / 10]) for fit in fits], -1)
    sent = {"as drawn": target, "plain script": script, "scikit-learn": corrected(wanted, fitted, target)}
    given = joints, payload, places, target, after
    for who, commands in (("ours", by_package(*given)), ("ours told", by_package(*given, config=TOLD))):
        sent[who] = np.full_like(target, np.nan) if commands is None else commands
    found = {}
    for who, joint in sent.items():
        for load, part in (("to 9 kg", after <= max(PAYLOADS)), ("at 15 kg", after > max(PAYLOADS))):
            lost, tips = np.isnan(joint).any(), arm.reached(joint[part], after[part])
            found[f"{who} {load}"] = np.nan if lost else missed(wanted[part], tips)
    return found


if __name__ == "__main__":
    judge_machines(__doc__, judged, 100)
