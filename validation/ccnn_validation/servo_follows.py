"""A stage of two ball screws: does the table follow better where the corrected commands are sent?

`python -m ccnn_validation.servo_follows --seed N [--machines N] [--without CAUSE] [--keep FOLDER] [--ours NAMES]`. Each
axis has a cascade of its own (position gain, feedforward of speed, speed by PI) on the motor's encoder, at 20 kHz; a
linear scale reads the table at 1 kHz. True causes, drawn for each axis: another mass, a feedforward that is less than
set and late, stick-slip of the guides, a soft screw, play in the nut, one or two samples of delay, a lead that grows,
bends and returns with each turn, cogging. Three runs of 8 s are logged: moves, slow ways, sines. Judged are three new
runs that are sent once: S-curves to other places at other speeds, a sweep of sines, a circle with two turns.

All know the data sheet: gains, feedforward, masses, friction, lead. "shifted" sends the commands earlier by the mean
lag. "regression" is what the command is beyond the measured motion, as a linear function of that. "plain script" fits
a simulated cascade by least squares and iterates its error away. Ours: `ccnn diagnose --motion`, `ccnn compensate` with
the mechanism servo without keys ("ours, bare"), with those of the data sheet ("ours, keys"), and with simulators in
Python ("linear cascade", and "cascade" with dry friction and delays). Told: RMS / peak in the plane of each run [µm],
and the RMS of x and y.
"""

from __future__ import annotations

import sys
import time as clock
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d, uniform_filter1d
from scipy.optimize import least_squares

from ccnn_validation.delivered.product import Contestant
from ccnn_validation.drawn import judge_motions

Array = NDArray[np.float64]
# Step of the log, of the truth [s]; samples of a run; of those judged, what is left out at both ends.
STEP, FINE, SAMPLES, EDGE = 1e-3, 5e-5, 8001, 200
# By the data sheet: position gain [1/s], speed's gain [N s/m] and integral time [s], share of the speed that is fed
# forward, mass of motor and screw as the table sees it and of the table [kg], friction [N s/m, N], lead [m].
KP, KV, TI, FORWARD, MOTOR, TABLE, VISCOUS, COULOMB, LEAD = 60.0, 56e3, 8e-3, 0.9, 118.0, 60.0, 500.0, 40.0, 0.01
# Of an encoder: standard deviation and step of a reading [m].
NOISE, COUNT = 1e-7, 1e-7
CAUSES = ("mass", "forward", "friction", "soft", "play", "delay", "lead", "cogging")
KEYS = (
    f"mechanism_keys={{position_gain: {KP}, speed_gain: {KV}, integral_time: {TI}, forward: {FORWARD}, "
    f"inertia: {MOTOR + TABLE}, viscous: {VISCOUS}, coulomb: {COULOMB}}}"
)
SIMULATOR = '''"""Two axes under a cascade: position gain, feedforward of speed, PI of the speed."""
import numba
import numpy as np
from scipy.signal import cont2discrete, lfilter


class STAGE:
    parameters = {f"{name}{k}": value for k in (1, 2) for name, value in (
        ("mass", 178.0), ("viscous", 500.0), ("position_gain", 60.0), ("forward", 0.9), ("speed_gain", 56e3))}

    def simulate(self, time, commands, parameters):
        found, step = commands.copy(), (time[-1] - time[0]) / (len(time) - 1)
        for k in range(commands.shape[1]):
            mass, viscous, kp, forward, kv = (
                parameters[f"{name}{k + 1}"] for name in ("mass", "viscous", "position_gain", "forward", "speed_gain"))
            pi = kv * np.array([1, 1 / 8e-3])
            below = np.polyadd([mass, viscous, 0, 0], np.polymul(pi, [1, kp]))
            b, a, _ = cont2discrete((np.polymul(pi, [forward, kp]), below), step, "foh")
            found[:, k] = lfilter(b[0], a, commands[:, k] - commands[0, k]) + commands[0, k]
        return found


@numba.njit
def driven(c, step, delay, kp, forward, lag, mass, viscous, dry):
    """The same with dry friction and delays, two steps to a sample."""
    found, at, total, v, fed, h = c.copy(), c[0], 0.0, 0.0, 0.0, step / 2
    before = c[0]
    for i in range(1, 2 * len(c) - 1):
        late = max(i / 2 - delay / step, 0.0)
        k = int(late)
        ref = c[k] + (late - k) * (c[min(k + 1, len(c) - 1)] - c[k])
        fed += h / (h + max(lag, 0.0)) * ((ref - before) / h - fed)
        before, aim = ref, kp * (ref - at) + forward * fed
        push = mass / h * v + 56e3 * aim + total
        v = (push - min(max(push, -dry), dry)) / (mass / h + viscous + 56e3)
        total += 56e3 / 8e-3 * h * (aim - v)
        at += v * h
        if i % 2 == 0:
            found[i // 2] = at
    return found


class CASCADE:
    parameters = {f"{name}{k}": value for k in (1, 2) for name, value in (
        ("delay", 5e-4), ("position_gain", 60.0), ("forward", 0.9), ("lag", 5e-4), ("mass", 178.0), ("viscous", 500.0),
        ("coulomb", 40.0))}

    def simulate(self, time, commands, parameters):
        step = (time[-1] - time[0]) / (len(time) - 1)
        names = ("delay", "position_gain", "forward", "lag", "mass", "viscous", "coulomb")
        found = commands.copy()
        for k in range(commands.shape[1]):
            numbers = (float(parameters[f"{name}{k + 1}"]) for name in names)
            found[:, k] = driven(np.ascontiguousarray(commands[:, k]), step, *numbers)
        return found
'''


class Axes:
    """True axes, each number of all of them in one row; an axis is one of the columns of the commands."""

    def __init__(self, seed: int, without: str = "") -> None:
        rng, two = np.random.default_rng(seed), 2
        drawn = {name: (rng.random(two) < 0.6) & (name != without) for name in CAUSES}
        self.causes = [" ".join(name for name in CAUSES if drawn[name][k]) for k in range(two)]

        def either(cause: str, low: float, high: float, none: float) -> Array:
            return np.where(drawn[cause], rng.uniform(low, high, two), none)

        sign = rng.choice([-1, 1], two)
        self.motor = MOTOR * (1 + sign * either("mass", 0.02, 0.08, 0.0))
        self.table = TABLE * (1 + sign * either("mass", 0.3, 0.8, 0.0))
        self.forward, self.late = FORWARD * either("forward", 0.93, 0.99, 1.0), either("forward", 5e-4, 1.5e-3, 1e-4)
        # Friction of guides and of the nut: dry, at rest beyond that [N], speed at which that is gone [m/s], viscous.
        self.dry, self.rest = either("friction", 60, 180, 25), either("friction", 20, 90, 0.0)
        self.slow, self.wet = rng.uniform(2e-3, 1e-2, two), VISCOUS * either("friction", 0.8, 3, 1.0)
        self.nut, self.before = rng.uniform(10, 20, two), rng.uniform(1.5e7, 4e7, two)
        self.stiff, self.play = either("soft", 4e7, 1e8, 4e8), either("play", 2e-6, 1e-5, 0.0)
        self.delay = either("delay", 1e-3, 2e-3, 2e-4)
        self.grow, self.bow = sign * either("lead", 3e-5, 1.5e-4, 0.0), either("lead", -8e-6, 8e-6, 0.0)
        self.wave, self.phase = either("lead", 1e-6, 5e-6, 0.0), rng.uniform(0, 6.28, (two, two))
        self.cog, self.poles = either("cogging", 20, 70, 0.0), rng.choice([4, 6, 8], two)

    def lead(self, at: Array) -> Array:
        """What the screws' leads add [m] where the motor is `at`."""
        turn = 2 * np.pi / LEAD * at + self.phase[0]
        return np.asarray(self.grow * at + self.bow * (at / 0.15) ** 2 + self.wave * np.sin(turn))

    def went(self, runs: list[Array]) -> list[Array]:
        """Where the table goes [m] by commands `s x 2` at 1 kHz, each of them a run that begins at rest."""
        count, inner = len(runs), round(STEP / FINE)
        sent = np.stack(runs, 1)
        times, fine = np.arange(len(sent)) * STEP, np.arange((len(sent) - 1) * inner + 1) * FINE
        refs = np.stack(
            [
                np.stack([np.interp(fine - self.delay[k], times, sent[:, i, k]) for k in range(2)], -1)
                for i in range(count)
            ],
            1,
        )
        shape, found = (count, 2), np.empty_like(sent)
        xm, vm, vl, force, total, fed, zm, zl = sent[0].copy(), *(np.zeros(shape) for _ in range(7))
        xl = xm + self.lead(xm)
        found[0], half, damp = xl, self.play / 2, 0.06 * np.sqrt(self.stiff * self.table)
        bristle = 4e7
        for i in range(1, len(fine)):
            ref = refs[i]
            fed = fed + FINE / (self.late + FINE) * ((ref - refs[i - 1]) / FINE - fed)
            off = KP * (ref - xm) + self.forward * fed - vm
            total = total + KV / TI * FINE * off
            force = force + FINE / 4e-4 * (KV * off + total - force)
            gap = xm + self.lead(xm) - xl
            spring = gap - np.clip(gap, -half, half)
            spring = self.stiff * spring + damp * (vm - vl) * (spring != 0)
            # Bristles (LuGre), implicit in their deflection, so that no step is too long for them.
            zm = (zm + vm * FINE) / (1 + bristle * np.abs(vm) * FINE / self.nut)
            most = self.dry + self.rest * np.exp(-((vl / self.slow) ** 2))
            zl = (zl + vl * FINE) / (1 + self.before * np.abs(vl) * FINE / most)
            torque = self.cog * np.sin(2 * np.pi * self.poles / LEAD * xm + self.phase[1])
            vm = vm + FINE / self.motor * (force + torque - spring - bristle * zm - 0.3 * self.wet * vm)
            vl = vl + FINE / self.table * (spring - self.before * zl - 0.7 * self.wet * vl)
            xm, xl = xm + vm * FINE, xl + vl * FINE
            if i % inner == 0:
                found[i // inner] = xl
        return [found[:, i] for i in range(count)]


def moves(places: Array, speeds: Array, rate: float, rest: float) -> Array:
    """Ways between places [m] at speeds [m/s], `SAMPLES`; accelerations `rate` [m/s²], rounded over 50 ms."""
    pieces: list[Array] = [np.full(400, places[0])]
    for a, b, speed in zip(places[:-1], places[1:], speeds, strict=True):
        way, speed = abs(b - a), min(speed, np.sqrt(rate * abs(b - a)))
        ramp, whole = speed / rate, way / speed + speed / rate
        t = np.arange(0, whole, STEP)
        done = np.minimum(t, ramp) ** 2 * rate / 2 + speed * np.clip(t - ramp, 0, whole - 2 * ramp)
        late = np.clip(t - whole + ramp, 0, ramp)
        pieces += [a + np.sign(b - a) * (done + speed * late - rate * late**2 / 2), np.full(int(rest / STEP), b)]
    whole_course = np.concatenate(pieces)[:SAMPLES]
    course = np.pad(whole_course, (0, SAMPLES - len(whole_course)), mode="edge")
    return np.asarray(uniform_filter1d(uniform_filter1d(course, 40, mode="nearest"), 10, mode="nearest"))


def slopes(t: Array) -> Array:
    """From 0 to 1 in half a second and back at the end."""
    up = np.clip(np.minimum(t - 0.3, t[-1] - 0.3 - t) / 0.5, 0, 1)
    return np.asarray(up**3 * (10 - 15 * up + 6 * up**2))


def logged(rng: np.random.Generator) -> list[Array]:
    """Commands of the three runs of the log, `s x 2` [m]: moves, slow ways, sines."""
    t = np.asarray(np.arange(SAMPLES) * STEP, dtype=np.float64)
    runs: list[list[Array]] = [[], [], []]
    for _ in range(2):
        runs[0].append(moves(rng.uniform(-0.12, 0.12, 25), rng.uniform(0.05, 0.25, 24), 3.0, 0.15))
        end, speed = rng.uniform(0.09, 0.12), rng.uniform(0.05, 0.07)
        runs[1].append(moves(end * np.array([-1, 1, -1, 1.0]), np.full(3, speed), 1.0, 0.2))
        size, rate = np.array([0.05, 0.012, 0.003, 0.0008]), np.array([0.35, 1.1, 2.7, 5.3]) * rng.uniform(0.9, 1.1, 4)
        runs[2].append(slopes(t) * (np.sin(np.outer(t, 2 * np.pi * rate) + rng.uniform(0, 6, 4)) @ size))
    return [np.stack(run, -1) for run in runs]


def wanted(rng: np.random.Generator) -> dict[str, Array]:
    """The new runs, `s x 2` [m]."""
    t = np.asarray(np.arange(SAMPLES) * STEP, dtype=np.float64)
    s_curves, sweep = [], []
    for _ in range(2):
        s_curves.append(moves(rng.uniform(-0.11, 0.11, 15), rng.uniform(0.08, 0.2, 14), 2.0, 0.25))
        rate = 0.5 * 8 ** (t / t[-1])
        angle = 2 * np.pi * np.cumsum(rate) * STEP
        sweep.append(
            rng.uniform(-0.05, 0.05) + slopes(t) * 0.12 / (2 * np.pi * rate) * np.sin(angle + rng.uniform(0, 6))
        )
    angle = np.cumsum(np.clip(np.minimum(t - 0.4, 7.4 - t) / 0.6, 0, 1))
    angle = 4 * np.pi * uniform_filter1d(angle / angle[-1], 60, mode="nearest") + rng.uniform(0, 6)
    circle = rng.uniform(-0.05, 0.05, 2) + rng.uniform(0.03, 0.05) * np.stack([np.cos(angle), np.sin(angle)], -1)
    return {"S-curves": np.stack(s_curves, -1), "sweep": np.stack(sweep, -1), "circle": circle}


def smooth(course: Array, order: int = 0, sigma: float = 3.0) -> Array:
    """Derivatives of courses by time, smoothed over some samples."""
    return np.asarray(gaussian_filter1d(course, sigma, axis=0, order=order, mode="nearest")) / STEP**order


def shifted(runs: list[Array], seen: list[Array], new: list[Array]) -> list[Array]:
    """Send commands earlier by the mean lag of each axis."""
    speed = np.concatenate([smooth(run, 1) for run in runs])
    lag = -(speed * np.concatenate([q - c for q, c in zip(seen, runs, strict=True)])).sum(0) / (speed**2).sum(0)
    return [earlier(run, lag) for run in new]


def earlier(course: Array, lag: Array) -> Array:
    """Columns moved forward by their lags [s]."""
    t = np.arange(len(course)) * STEP
    return np.stack([np.interp(t + lag[k], t, course[:, k]) for k in range(course.shape[1])], -1)


def regression(runs: list[Array], seen: list[Array], new: list[Array]) -> list[Array]:
    """What the command is beyond the motion, linear in place, the screw's turn, speed, its sign, and so on."""

    def features(q: Array) -> Array:
        v, a, j, turn = smooth(q, 1), smooth(q, 2), smooth(q, 3, 5.0), 2 * np.pi * q / LEAD
        return np.stack(
            [1 + 0 * q, q, q**2, np.sin(turn), np.cos(turn), v, a, j, np.tanh(v / 2e-3), np.tanh(v / 2e-2)], -1
        )

    known = np.concatenate([features(smooth(q)) for q in seen])
    more = np.concatenate([c - smooth(q) for q, c in zip(seen, runs, strict=True)])
    found = [np.linalg.lstsq(known[:, k], more[:, k], rcond=None)[0] for k in range(2)]
    return [run + np.stack([features(run)[:, k] @ found[k] for k in range(2)], -1) for run in new]


# Of the plain script: numbers by the data sheet, and how far each may well be off. Delay [s], gain, feedforward and its
# lag [s], mass, viscous and dry friction, more of that at rest, lead (growth, bend, sine, cosine), play, give [s²].
START = np.array([5e-4, KP, FORWARD, 5e-4, MOTOR + TABLE, VISCOUS, COULOMB, 0, 0, 0, 0, 0, 3e-6, 0])
SIZES = np.array([1e-3, 1, 0.03, 1e-3, 20, 300, 60, 30, 1e-4, 1e-5, 3e-6, 3e-6, 3e-6, 5e-7])


def cascade(x: Array, sent: Array) -> Array:
    """The plain script's table `s x n` by commands `s x n`, one set of numbers in each column of `x`."""
    t, step, parts = np.arange(len(sent)) * STEP, STEP / 2, 2
    late = np.arange((len(sent) - 1) * parts + 1) * step
    delay, kp, forward, lag, mass, viscous, dry, rest, *lead, play, give = x
    refs = np.stack([np.interp(late - delay[k], t, sent[:, k]) for k in range(sent.shape[1])], -1)
    at, table, total, v, fed = (
        refs[0].copy(),
        refs[0].copy(),
        np.zeros_like(mass),
        np.zeros_like(mass),
        np.zeros_like(mass),
    )
    found, free = np.empty_like(sent), 1 / (mass / step + viscous + KV)
    found[0] = table
    for i in range(1, len(refs)):
        fed = fed + step / (step + np.maximum(lag, 0)) * ((refs[i] - refs[i - 1]) / step - fed)
        aim, before = kp * (refs[i] - at) + forward * fed, v
        most = np.maximum(dry + rest * np.exp(-((v / 5e-3) ** 2)), 0)
        push = mass / step * v + KV * aim + total
        v = (push - np.clip(push, -most, most)) * free
        total = total + KV / TI * step * (aim - v)
        at = at + v * step
        pulled = at - give * (v - before) / step
        table = np.clip(table, pulled - play / 2, pulled + play / 2)
        if i % parts == 0:
            found[i // parts] = table
    turn = 2 * np.pi / LEAD * found
    return np.asarray(
        found + lead[0] * found + lead[1] * (found / 0.15) ** 2 + lead[2] * np.sin(turn) + lead[3] * np.cos(turn)
    )


def fitted(sent: Array, measured: Array) -> Array:
    """Numbers of the plain script by the runs of one axis, `s x runs` [m]."""
    count = len(START)

    def left(u: Array) -> Array:
        sets = np.repeat(START[:, None] + SIZES[:, None] * u, sent.shape[1], 1)
        found = cascade(sets, np.tile(sent, u.shape[1])).reshape(len(sent), -1, sent.shape[1])
        return np.asarray((found - measured[:, None]).swapaxes(0, 1).reshape(-1, sent.size)[:, ::4] * 1e6)

    def residuals(u: Array) -> Array:
        return np.asarray(np.r_[left(u[:, None])[0], u])

    def jacobian(u: Array) -> Array:
        many = left(np.c_[u, u[:, None] + 1e-3 * np.eye(count)])
        return np.asarray(np.r_[(many[1:] - many[0]).T / 1e-3, np.eye(count)])

    return np.asarray(START + SIZES * least_squares(residuals, np.zeros(count), jacobian, max_nfev=40).x)


def plain_script(runs: list[Array], seen: list[Array], new: list[Array]) -> list[Array]:
    """Fit the cascade to each axis, and move the commands of new runs by the error that it predicts."""
    corrected = [run.copy() for run in new]
    for k in range(2):
        sent, measured, goal = (np.stack([run[:, k] for run in data], -1) for data in (runs, seen, new))
        numbers = np.repeat(fitted(sent, measured)[:, None], len(new), 1)
        course, best = goal.copy(), np.full(len(new), np.inf)
        for _ in range(12):
            error = goal - cascade(numbers, course)
            size = np.sqrt((error**2).mean(0))
            for i in np.flatnonzero(size < best):
                best[i], corrected[i][:, k] = size[i], course[:, i]
            course = course + 0.8 * smooth(error, 0, 2.0)
    return corrected


def ours(folder: Path, name: str, runs: list[Array], seen: list[Array], new: list[Array]) -> list[Array] | None:
    """Commands of `ccnn diagnose --motion` and `ccnn compensate`; None where there are none."""
    folder.mkdir(parents=True, exist_ok=True)
    t, motion = np.arange(SAMPLES) * STEP, ",".join(f"command{k}[mm]" for k in (1, 2))
    for i, (run, q) in enumerate(zip(runs, seen, strict=True), 1):
        table = np.c_[t, 1e3 * run, 1e3 * q]
        np.savetxt(folder / f"run{i}.csv", table, "%.8g", ",", header=f"time[s],{motion},q1[mm],q2[mm]", comments="")
    many = np.concatenate([np.c_[np.full(SAMPLES, i), t, 1e3 * run] for i, run in enumerate(new)])
    np.savetxt(folder / "motion.csv", many, "%.8g", ",", header=f"run[1],time[s],{motion}", comments="")
    (folder / "stage.py").write_text(SIMULATOR)
    contestant = Contestant(folder, "diagnose")
    choices = {"bare": ["servo"], "keys": ["servo", KEYS]}
    options = (choices | {"linear cascade": ["stage.py:STAGE"], "cascade": ["stage.py:CASCADE"]})[name]
    options = ["--mechanism", options[0], "--out", "found", *options[1:]]
    start = clock.time()
    contestant.call("diagnose", *(word for i in (1, 2, 3) for word in ("--motion", f"run{i}.csv")), *options)
    between = clock.time()
    allow = ["--allow-code"] if name.endswith("cascade") else []
    contestant.call("compensate", "found/identified_motion.json", "motion.csv", "commands.csv", *allow)
    print(
        f"  {name}: diagnose {between - start:.0f} s, compensate {clock.time() - between:.0f} s",
        contestant.said,
        file=sys.stderr,
    )
    path = folder / "commands.csv"
    if not path.is_file():
        return None
    rows = np.genfromtxt(path, delimiter=",", names=True, deletechars="")
    columns = np.stack([rows[f"corrected{k}[mm]"] for k in (1, 2)], -1) / 1e3
    return list(columns.reshape(len(new), SAMPLES, 2))


def judged(seed: int, without: str, folder: Path, names: list[str]) -> dict[str, dict[str, list[float]]]:
    """RMS and peak in the plane, RMS of x and y of the following error [µm], by contestant and new run."""
    axes, rng = Axes(seed, without), np.random.default_rng([seed, 1])
    print(f"seed {seed}: x has {axes.causes[0]}; y has {axes.causes[1]}")
    runs = logged(rng)
    seen = [np.round((q + rng.normal(0, NOISE, q.shape)) / COUNT) * COUNT for q in axes.went(runs)]
    goals = wanted(rng)
    new, sent = list(goals.values()), {"as wanted": list(goals.values())}
    for script in (shifted, regression, plain_script):
        start = clock.time()
        sent[script.__name__.replace("_", " ")] = script(runs, seen, new)
        print(f"  {script.__name__}: {clock.time() - start:.0f} s", file=sys.stderr)
    for name in names:
        found = ours(folder / f"{seed}{without}" / name.replace(" ", "_"), name, runs, seen, new)
        if found is not None:
            sent[f"ours, {name}"] = found
    went = axes.went([run for many in sent.values() for run in many])
    table: dict[str, dict[str, list[float]]] = {}
    for j, who in enumerate(sent):
        table[who] = {}
        for i, (kind, goal) in enumerate(goals.items()):
            off = 1e6 * (went[j * len(new) + i] - goal)[EDGE:-EDGE]
            far = np.linalg.norm(off, axis=1)
            table[who][kind] = [np.sqrt((far**2).mean()), far.max(), *np.sqrt((off**2).mean(0))]
    return table


def main() -> None:
    """Judge stages and print what each contestant's table is off the wanted motion."""
    judge_motions(__doc__, judged, CAUSES, "bare,keys,linear cascade,cascade", "{:.2f} / {:.2f} ({:.2f}, {:.2f})")


if __name__ == "__main__":
    main()
