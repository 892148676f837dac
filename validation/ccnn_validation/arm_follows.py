"""A vertical arm of three joints: does its tool follow better where the corrected commands are sent?

`python -W ignore -m ccnn_validation.arm_follows --seed N [--machines K] [--without CAUSE] [--keep FOLDER]
[--ours NAMES]`. Base, shoulder and elbow; links of 6 and 5.5 kg, 2 kg at the tool; gears of 100:1. Each joint is driven
by PD at 1 kHz on the motor's encoder, with parts of speed and weight fed forward, some ms after the command; set points
and the encoders behind the gears are logged at 250 Hz. True causes, drawn for each arm, values for each joint: masses,
centres and inertias; another load; friction (bristles, at rest, by load, direction, degressive, warmer later); gains;
feedforward; delay; softer gears, softest near no torque; ripple of torque and transmission. What is not drawn is as the
data sheet has it. Logged: two sums of sines and one run of moves, 10 s each. Judged: three new motions that are sent
once: pick and place by S-curves, two turns of a circle, a line at 30 mm/s.

All know the data sheet. "shifted" sends commands earlier by the mean lag. "regression" is what the command is beyond
the measured motion, linear in weights, inverse dynamics, friction and lag. "plain script" fits a simulated rigid arm
with give of the gears by least squares, and iterates its error away. Ours: `ccnn diagnose --motion` and `compensate`,
with the servo without keys ("bare") and with those of the data sheet and how well they are known ("keys"), with the arm
as MJCF ("mjcf"), and with the simulator of the plain script ("simulator", arm_simulator.py). Told: RMS / peak of the
joints [mrad] and of the tool [mm] in each motion.
"""

from __future__ import annotations  # noqa: I001

import sys
import time as clock
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d, uniform_filter1d
from scipy.optimize import least_squares

from ccnn_validation import arm_simulator
from ccnn_validation.arm_sheet import BALANCE, BASE, C2, C3, DELAY, DRY, FORWARD, G, I2, I3, KD, KP, L2, L3, LOAD, M2
from ccnn_validation.arm_sheet import M3, MOTOR, PLACE, REACH, STIFF, WET, keys, mjcf
from ccnn_validation.arm_simulator import NAMES, SIZES, START, driven
from ccnn_validation.delivered.product import Contestant
from ccnn_validation.drawn import judge_motions

Array = NDArray[np.float64]
# Steps of the log, the controller and the truth [s]; samples of a run; of those judged, what is left out at both ends.
STEP, CONTROL, FINE, SAMPLES, EDGE = 4e-3, 1e-3, 2.5e-4, 2501, 75
# Of an encoder: standard deviation and step of a reading [rad].
NOISE, COUNT = 5e-6, 2 * np.pi / 2**19
CAUSES = ("masses", "load", "friction", "gains", "forward", "delay", "soft", "ripple")


class Arm:
    """A true arm."""

    def __init__(self, seed: int, without: str = "") -> None:
        rng = np.random.default_rng(seed)
        drawn = {name: rng.random() < 0.7 and name != without for name in CAUSES}
        self.causes = " ".join(name for name in CAUSES if drawn[name])

        def either(cause: str, low: float, high: float, none: float, count: int = 3) -> Array:
            value = rng.uniform(low, high, count)
            return value if drawn[cause] else np.full(count, none)

        # Moments of both links along and across them: mass, first, second of each, and the mixed one.
        mass = np.array([M2, M3]) * either("masses", 0.85, 1.15, 1, 2)
        along = np.array([C2, C3]) + either("masses", -0.015, 0.02, 0, 2)
        across, slim = either("masses", -0.015, 0.015, 0, 2), mass * 0.04**2
        about = np.array([I2, I3]) * either("masses", 0.8, 1.25, 1, 2) - slim
        self.links = np.stack(
            [mass, mass * along, mass * across, mass * along**2 + about, mass * across**2 + slim, mass * along * across]
        )
        load, far = LOAD * either("load", 0.7, 1.35, 1, 1)[0], L3 + either("load", -0.03, 0.05, 0, 1)[0]
        side = either("load", -0.04, 0.04, 0, 1)[0]
        self.links[:, 1] += load * np.array([1, far, side, far**2, side**2, far * side])
        self.base, self.motor = BASE * either("masses", 0.7, 1.4, 1, 1)[0], MOTOR * either("masses", 0.85, 1.15, 1)
        self.dry, self.wet = DRY * either("friction", 0.6, 1.8, 1), WET * either("friction", 0.6, 2.2, 1)
        self.rest, self.slow = self.dry * either("friction", 0.1, 0.5, 0.2), either("friction", 0.02, 0.08, 0.05)
        self.uneven, self.loaded = either("friction", -0.12, 0.12, 0), either("friction", 0.02, 0.06, 0)
        self.bend, self.warm = either("friction", 0.05, 0.2, 0), either("friction", 0.94, 1, 1)
        self.kp, self.kd = KP * either("gains", 0.9, 1.1, 1), KD * either("gains", 0.85, 1.15, 1)
        self.forward, self.late = either("forward", 0.55, 0.95, FORWARD), either("forward", 1e-3, 3e-3, 1e-3)
        self.balance, self.delay = either("forward", 0.5, 0.95, BALANCE), either("delay", 3e-3, 9e-3, DELAY, 1)[0]
        self.stiff, self.damp = STIFF * either("soft", 0.5, 0.9, 1), rng.uniform(0.03, 0.06, 3)
        self.free, self.zone = either("soft", 1e-4, 3e-4, 0), 3e-4
        self.ripple = np.array([1, 1, 0.5]) * either("ripple", 1, 3, 0)
        self.wave, self.phase = either("ripple", 3e-5, 1.5e-4, 0), rng.uniform(0, 6.28, (2, 3))

    def dynamics(self, q: Array, w: Array) -> tuple[Array, Array, Array]:
        """Inertias `n x 4` (yaw, and 22, 23, 33), and torques `n x 3` of speed and of weight, of the links."""
        (c2, s2), (c3, s3) = ((np.cos(a), np.sin(a)) for a in (q[:, 1], q[:, 1] + q[:, 2]))
        (_m2, x2, y2, xx2, yy2, xy2), (m3, x3, y3, xx3, yy3, xy3) = self.links.T
        er, ez, ur, uz, wr = L2 * c2, L2 * s2, x3 * c3 - y3 * s3, x3 * s3 + y3 * c3, x2 * c2 - y2 * s2
        wrr, wrz = xx2 * c2**2 + yy2 * s2**2 - 2 * xy2 * c2 * s2, (xx2 - yy2) * c2 * s2 + xy2 * (c2**2 - s2**2)
        urr, urz = xx3 * c3**2 + yy3 * s3**2 - 2 * xy3 * c3 * s3, (xx3 - yy3) * c3 * s3 + xy3 * (c3**2 - s3**2)
        dot, cross, whole = er * ur + ez * uz, er * uz - ez * ur, xx3 + yy3
        yaw = self.base + wrr + m3 * er**2 + 2 * er * ur + urr
        lift = xx2 + yy2 + m3 * L2**2 + 2 * dot + whole
        inertia = np.stack([yaw, lift, dot + whole, np.full(len(q), whole)], -1)
        turn2, turn3 = -2 * (wrz + m3 * er * ez + er * uz + ez * ur + urz), -2 * (er * uz + urz)
        w1, w2, w3 = w.T
        fast2 = (w2**2 - (w2 + w3) ** 2) * cross - 0.5 * w1**2 * turn2
        fast = np.stack([(turn2 * w2 + turn3 * w3) * w1, fast2, w2**2 * cross - 0.5 * w1**2 * turn3], -1)
        return inertia, fast, G * np.stack([0 * ur, wr + m3 * er + ur, ur], -1)

    def went(self, runs: list[Array], warm: bool = False) -> list[Array]:
        """Where the joints go [rad] by set points `s x 3` at 250 Hz, each of them a run that begins at rest."""
        sent, ahead = np.stack(runs), 0.6
        count, inner, beat = len(runs), round(STEP / FINE), round(CONTROL / FINE)
        times, tick = np.arange(SAMPLES) * STEP, np.arange(-ahead, (SAMPLES - 1) * STEP + CONTROL, CONTROL)
        refs = np.stack([[np.interp(tick - self.delay, times, run[:, k]) for k in range(3)] for run in sent], 1)
        refs = np.ascontiguousarray(refs.transpose(2, 1, 0))
        found, friction = np.empty_like(sent), self.warm if warm else 1.0
        qm, q, (vm, v, z, torque, fed, speed, seen) = sent[:, 0].copy(), sent[:, 0].copy(), np.zeros((7, count, 3))
        seen, inertia_at_gear = qm.copy(), 0.5 * self.motor
        damp, order, bristle = 2 * self.damp * np.sqrt(self.stiff * inertia_at_gear), 200, 8e4
        wanted, start = torque, round(ahead / FINE)
        for i in range((SAMPLES - 1) * inner + start + 1):
            if i >= start and (i - start) % inner == 0:
                found[:, (i - start) // inner] = q
            if i % beat == 0:
                ref, before = refs[i // beat], refs[max(i // beat - 1, 0)]
                fed = fed + CONTROL / (CONTROL + self.late) * ((ref - before) / CONTROL - fed)
                speed, seen = speed + 0.4 * ((qm - seen) / CONTROL - speed), qm
                c2, c3 = np.cos(ref[:, 1]), np.cos(ref[:, 1] + ref[:, 2])
                elbow = G * (M3 * C3 + LOAD * L3) * c3
                weight = np.stack([0 * c2, G * (M2 * C2 + (M3 + LOAD) * L2) * c2 + elbow, elbow], -1)
                wanted = self.kp * (ref - qm) + self.kd * (self.forward * fed - speed) + self.balance * weight
            torque = torque + FINE / 5e-4 * (wanted - torque)
            angle = order * qm
            give = qm + self.wave * np.sin(angle + self.phase[0]) - q
            gear = self.stiff * (give - self.free * np.tanh(give / self.zone)) + damp * (vm - v)
            most = self.dry * (1 + self.uneven * np.tanh(vm / 5e-3)) + self.loaded * np.abs(gear)
            most = friction * (most + self.rest * np.exp(-((vm / self.slow) ** 2)))
            z = (z + vm * FINE) / (1 + bristle * np.abs(vm) * FINE / most)
            brake = bristle * z + friction * self.wet * vm / (1 + self.bend * np.abs(vm))
            vm = vm + FINE / self.motor * (torque + self.ripple * np.sin(angle + self.phase[1]) - brake - gear)
            m, fast, weight = self.dynamics(q, v)
            p1, p2, p3 = (gear - fast - weight).T
            m11, m22, m23, m33 = m.T
            below = m22 * m33 - m23**2
            v = v + FINE * np.stack([p1 / m11, (m33 * p2 - m23 * p3) / below, (m22 * p3 - m23 * p2) / below], -1)
            qm, q = qm + FINE * vm, q + FINE * v
        return list(found)


def tool(q: Array) -> Array:
    """Where the tool is [m], from the shoulder."""
    out = L2 * np.cos(q[..., 1]) + L3 * np.cos(q[..., 1] + q[..., 2])
    up = L2 * np.sin(q[..., 1]) + L3 * np.sin(q[..., 1] + q[..., 2])
    return np.stack([out * np.cos(q[..., 0]), out * np.sin(q[..., 0]), up], -1)


def joints(at: Array) -> Array:
    """Joints that bring the tool there, the elbow up."""
    out, up = np.hypot(at[..., 0], at[..., 1]), at[..., 2]
    elbow = -np.arccos((out**2 + up**2 - L2**2 - L3**2) / (2 * L2 * L3))
    shoulder = np.arctan2(up, out) - np.arctan2(L3 * np.sin(elbow), L2 + L3 * np.cos(elbow))
    return np.stack([np.arctan2(at[..., 1], at[..., 0]), shoulder, elbow], -1)


def moves(places: Array, speeds: Array, rest: float) -> Array:
    """Ways between places [rad] at speeds [rad/s] of the fastest joint, S-curves, `SAMPLES`."""
    ways = zip(places[:-1], places[1:], speeds, strict=True)
    t = np.cumsum(np.r_[0.3, *([np.abs(b - a).max() / s, rest] for a, b, s in ways)])
    at = np.repeat(places, 2, 0)[: len(t) + 1]
    course = np.stack([np.interp(np.arange(SAMPLES) * STEP, np.r_[0, t], at[:, k]) for k in range(3)], -1)
    for width in (50, 25, 10):
        course = uniform_filter1d(course, width, axis=0, mode="nearest")
    return np.asarray(course)


def slopes(t: Array) -> Array:
    """From 0 to 1 in half a second and back at the end."""
    up = np.clip(np.minimum(t - 0.2, t[-1] - 0.2 - t) / 0.6, 0, 1)
    return np.asarray(up**3 * (10 - 15 * up + 6 * up**2))[:, None]


def logged(rng: np.random.Generator) -> list[Array]:
    """Set points of the three runs of the log, `s x 3` [rad]."""
    t, runs = np.asarray(np.arange(SAMPLES) * STEP, float), []
    for _ in range(2):
        rate = 2 * np.pi * np.array([0.1, 0.2, 0.3, 0.5, 0.8, 1.3])
        size = rng.normal(0, 1, (6, 3)) / np.arange(1, 7)[:, None]
        course = sum(np.sin(np.outer(t, rate)[:, i, None] + rng.uniform(0, 6, 3)) * size[i] for i in range(6))
        course = (course - course.mean(0)) * slopes(t)
        course *= np.minimum(REACH / np.abs(course).max(0), 1.3 / np.abs(np.gradient(course, STEP, axis=0)).max(0))
        runs.append(PLACE + course)
    places = PLACE + REACH * rng.uniform(-1, 1, (16, 3))
    places[[2, 5]] = places[[1, 4]] + rng.choice([-1, 1], (2, 3)) * rng.uniform(0.02, 0.05, (2, 3))
    speeds = np.exp(rng.uniform(np.log(0.4), np.log(1.4), 15))
    speeds[[1, 4]] = 0.04
    runs.append(moves(places, speeds, 0.2))
    return runs


def wanted(rng: np.random.Generator) -> dict[str, Array]:
    """The new runs, `s x 3` [rad]."""
    t = np.asarray(np.arange(SAMPLES) * STEP, float)
    places = []
    for side in (-1, 1, -1, 1):
        yaw, out, up = side * rng.uniform(0.3, 0.8), rng.uniform(0.57, 0.68), rng.uniform(-0.12, -0.02)
        above = np.array([out * np.cos(yaw), out * np.sin(yaw), up + 0.1])
        places += [above, above - [0, 0, 0.1], above]
    pick = moves(joints(np.array(places)), np.tile([0.5, 0.5, 1.1], 4)[:11], 0.15)
    angle = np.cumsum(slopes(t)[:, 0])
    angle = 4 * np.pi * angle / angle[-1] + rng.uniform(0, 6)
    yaw, tilt = rng.uniform(-0.4, 0.4), rng.uniform(0, np.pi)
    ahead, beside = np.array([np.cos(yaw), np.sin(yaw), 0]), np.array([-np.sin(yaw), np.cos(yaw), 0])
    steep = np.cos(tilt) * ahead + np.sin(tilt) * np.array([0, 0, 1])
    middle = rng.uniform(0.6, 0.64) * ahead + np.array([0, 0, rng.uniform(0, 0.05)])
    circle = middle + rng.uniform(0.07, 0.09) * (np.cos(angle)[:, None] * beside + np.sin(angle)[:, None] * steep)
    way = rng.uniform(0.3, 1) * beside + rng.uniform(-0.4, 0.4) * ahead + rng.uniform(-0.7, 0.7) * np.array([0, 0, 1])
    along = uniform_filter1d(np.clip(t - 0.7, 0, 8.6) - 4.3, 60, mode="nearest") * 0.03
    line = middle + along[:, None] * way / np.linalg.norm(way)
    return {"pick": pick, "circle": joints(circle), "line": joints(line)}


def smooth(course: Array, order: int = 0, sigma: float = 2.0) -> Array:
    """Derivatives of courses by time, smoothed over some samples."""
    return np.asarray(gaussian_filter1d(course, sigma, axis=0, order=order, mode="nearest")) / STEP**order


def earlier(course: Array, lag: Array) -> Array:
    """Columns moved forward by their lags [s]."""
    t = np.arange(len(course)) * STEP
    return np.stack([np.interp(t + lag[k], t, course[:, k]) for k in range(3)], -1)


def mean_lag(runs: list[Array], seen: list[Array]) -> Array:
    """By what each joint is late [s]."""
    speed = np.concatenate([smooth(run, 1) for run in runs])
    ahead = np.concatenate([c - q for q, c in zip(seen, runs, strict=True)])
    return np.asarray((speed * ahead).sum(0) / (speed**2).sum(0))


def shifted(runs: list[Array], seen: list[Array], new: list[Array]) -> list[Array]:
    """Send commands earlier by the mean lag of each joint."""
    return [earlier(run, mean_lag(runs, seen)) for run in new]


def regression(runs: list[Array], seen: list[Array], new: list[Array]) -> list[Array]:
    """What the command is beyond the motion, linear in weights, inverse dynamics, friction and lag of all joints."""

    def features(q: Array) -> Array:
        v, a, j, high = smooth(q, 1), smooth(q, 2), smooth(q, 3, 4.0), q[:, 1] + q[:, 2]
        c2, s2, c3, s3, ce, se = (f(x) for x in (q[:, 1], high, q[:, 2]) for f in (np.cos, np.sin))
        swing = [c2**2, c2 * c3, c3**2], [c2 * s2, c2 * s3, s2 * c3, c3 * s3]
        parts = [np.ones(len(q)), c2, s2, c3, s3, *q.T, *v.T, *a.T, *j.T, *np.tanh(v / 0.01).T, *np.tanh(v / 0.1).T]
        parts += [a[:, 1] * ce, a[:, 2] * ce, v[:, 1] ** 2 * se, v[:, 2] ** 2 * se, v[:, 1] * v[:, 2] * se]
        parts += [a[:, 0] * x for x in swing[0]] + [v[:, 0] ** 2 * x for x in swing[1]]
        parts += [v[:, 0] * v[:, k] * x for k in (1, 2) for x in swing[1]]
        return np.stack(parts, -1)

    known, more = np.concatenate([features(smooth(q)) for q in seen]), np.concatenate(runs) - np.concatenate(seen)
    found = np.linalg.lstsq(known, more, rcond=None)[0]
    return [run + features(run) @ found for run in new]


def plain_script(runs: list[Array], seen: list[Array], new: list[Array]) -> list[Array]:
    """Fit the simulated arm to the runs, and move the commands of new ones by the error that it predicts."""

    def residuals(u: Array) -> Array:
        off = [driven(c, STEP, START + SIZES * u) - q for c, q in zip(runs, seen, strict=True)]
        return np.asarray(np.r_[np.concatenate(off)[::2].ravel() / 3e-4, u])

    found = least_squares(residuals, np.zeros(len(START)), x_scale=1.0, diff_step=1e-4, max_nfev=15)
    numbers = START + SIZES * found.x
    print("  " + " ".join(f"{n} {v:.4g}" for n, v in zip(NAMES, numbers, strict=True)), file=sys.stderr)
    lag, corrected = mean_lag(runs, seen), []
    for goal in new:
        course, best = goal.copy(), (np.inf, goal)
        for _ in range(25):
            error = goal - driven(course, STEP, numbers)
            best = min(best, (float((error**2).mean()), course), key=lambda pair: pair[0])
            course = course + 0.6 * smooth(earlier(error, lag))
        corrected.append(best[1])
    return corrected


def ours(folder: Path, name: str, runs: list[Array], seen: list[Array], new: list[Array]) -> list[Array] | None:
    """Commands of `ccnn diagnose --motion` and `ccnn compensate`; None where there are none."""
    folder.mkdir(parents=True, exist_ok=True)
    t, head = np.arange(SAMPLES) * STEP, ",".join(f"command{k}[rad]" for k in (1, 2, 3))
    for i, (run, q) in enumerate(zip(runs, seen, strict=True), 1):
        columns = f"time[s],{head},q1[rad],q2[rad],q3[rad]"
        np.savetxt(folder / f"run{i}.csv", np.c_[t, run, q], "%.9g", ",", header=columns, comments="")
    many = np.concatenate([np.c_[np.full(SAMPLES, i), t, run] for i, run in enumerate(new)])
    np.savetxt(folder / "motion.csv", many, "%.9g", ",", header=f"run[1],time[s],{head}", comments="")
    (folder / "arm.py").write_text(Path(arm_simulator.__file__).read_text())
    (folder / "arm.xml").write_text(mjcf())
    contestant = Contestant(folder, "diagnose")
    (folder / "keys.yaml").write_text(keys())
    choices = {"mjcf": ["arm.xml"], "simulator": ["arm.py:ARM"], "keys": ["servo", "--config", "keys.yaml"]}
    options = ["--out", "found", "--mechanism", *choices.get(name, ["servo"])]
    start = clock.time()
    contestant.call("diagnose", *(word for i in (1, 2, 3) for word in ("--motion", f"run{i}.csv")), *options)
    between = clock.time()
    allow = ["--allow-code"] if name == "simulator" else []
    contestant.call("compensate", "found/identified_motion.json", "motion.csv", "commands.csv", *allow)
    told = f"  {name}: diagnose {between - start:.0f} s, compensate {clock.time() - between:.0f} s"
    print(told, contestant.said, file=sys.stderr)
    if not (folder / "commands.csv").is_file():
        return None
    rows = np.genfromtxt(folder / "commands.csv", delimiter=",", names=True, deletechars="")
    return list(np.stack([rows[f"corrected{k}[rad]"] for k in (1, 2, 3)], -1).reshape(len(new), SAMPLES, 3))


def judged(seed: int, without: str, folder: Path, names: list[str]) -> dict[str, dict[str, list[float]]]:
    """RMS and peak of the joints [mrad] and of the tool [mm], by contestant and new run."""
    arm, rng = Arm(seed, without), np.random.default_rng([seed, 1])
    print(f"seed {seed}: {arm.causes}", flush=True)
    runs, goals = logged(rng), wanted(rng)
    seen = [np.round((q + rng.normal(0, NOISE, q.shape)) / COUNT) * COUNT for q in arm.went(runs)]
    new, sent = list(goals.values()), {"as wanted": list(goals.values())}
    for script in (shifted, regression, plain_script):
        start = clock.time()
        sent[script.__name__.replace("_", " ")] = script(runs, seen, new)
        print(f"  {script.__name__}: {clock.time() - start:.0f} s", file=sys.stderr)
    for name in names:
        found = ours(folder / f"{seed}{without}" / name, name, runs, seen, new)
        if found is not None:
            sent[f"ours, {name}"] = found
    went = arm.went([run for many in sent.values() for run in many], warm=True)
    table: dict[str, dict[str, list[float]]] = {who: {} for who in sent}
    for j, who in enumerate(sent):
        for i, (kind, goal) in enumerate(goals.items()):
            q = went[j * len(new) + i]
            off, far = (1e3 * (q - goal))[EDGE:-EDGE], 1e3 * np.linalg.norm(tool(q) - tool(goal), axis=1)[EDGE:-EDGE]
            table[who][kind] = [np.sqrt((off**2).mean()), np.abs(off).max(), np.sqrt((far**2).mean()), far.max()]
    return table


def main() -> None:
    """Judge arms and print what each contestant's joints and tool are off the wanted motion."""
    judge_motions(__doc__, judged, CAUSES, "bare,keys,mjcf,simulator", "{:.2f} / {:.2f} mrad {:.2f} / {:.2f} mm")


if __name__ == "__main__":
    main()
