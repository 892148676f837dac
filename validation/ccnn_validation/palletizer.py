"""A palletizing robot of four axes whose bars keep the wrist level: who brings the gripper to new places?

`python -W ignore -m ccnn_validation.palletizer --seed N --machines K [--rows R] [--without CAUSE ...] [--ours NAME]`.

Base, two main arms (0.945 and 1.025 m), wrist about the vertical. The motor of the forearm sits at the shoulder: it
turns a crank, a rod along the upper arm turns the forearm's tail (its motor's angle is the forearm's to the base).
Two further parallelograms over a triangle at the elbow keep the wrist level. As true as one machine is in 120 lines:
lengths (0.1 to 0.5 mm), bars that are no exact pairs (0.1 to 0.3 mm: loops are closed as they are, the wrist tilts by
mrad), zeros (0.3 to 1.5 mrad), leans of all axes (0.1 to 0.4 mrad), reducers that give under weight and payload less a
spring's torque, rods that stretch (more where loops are flat), a base plate that tilts, gears that err once and twice a
motor's turn (20 to 50 urad, ratios on the data sheet) and once and twice a joint's turn, play that weight closes where
it beats friction, links that warm behind the motors and grow while rods stay cool. A tracker reads a reflector on the
gripper (U = 10 um + 6 um/m, k = 2) at 80 poses in four hours, with 0 and 60 kg, base and gripper unknown to some mm.
Told are commands, payload, the motors' thermometers, directions of the last motion.

Judged: 400 new poses of another day, in the frame and with the point of the gripper that fit best, RMS (and maximum).
"plain script" is least squares over lengths, zeros, leans, level, sag by the data sheet's masses, gears, play, growth;
"fuller script" closes the loops of the bars and adds all the causes that its author guessed; each also with a Gaussian
process on what is left. Ours: `ccnn run` with a class of one's own (palletizer_arm.py): ideal parallelograms, or bars,
with the ratios or without; "in Python" where no model file is written: the compensator itself.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel

from ccnn_validation.drawn import commanded
from ccnn_validation.palletizer_robot import (
    A1,
    A4,
    C3,
    CAUSES,
    CRANK,
    CW,
    D1,
    D4,
    L2,
    L3,
    LEVEL,
    MASS,
    NEW,
    POINT,
    RATIO,
    Array,
    G,
    Robot,
    carried,
    day,
    drawn,
    missed,
    spring_lever,
    swung,
    turned,
)  # fmt: skip

OWN = "mechanism: palletizer_arm.py:Palletizer\nmechanism_keys: {stand: true, allow_code: true%s}\n"
RATIOS = ", gears: [153, 171, 185, 81]"
SEEN = "mechanism: framed, keys: {mechanism: palletizer_arm.py:Palletizer, base: true, allow_code: true}"
# Without files: the compensator of `ccnn_torch.calibrate` on the targets, in SI, by rows of numbers.
PYTHON = """
import sys, numpy as np, torch, yaml, ccnn_torch as ct
found = ct.calibrate(**yaml.safe_load(open("config.yaml")), split={"test": 0.1}, out="python")
t = np.loadtxt("targets.csv", delimiter=",", skiprows=1)
joints, told = np.radians(t[:, :4]), np.c_[t[:, 4:8] + 273.15, t[:, 8:12], -9.81 * t[:, 12]]
names = [f"temperature_motor{k}" for k in (1, 2, 3, 4)] + [f"direction{k}" for k in (1, 2, 3, 4)] + ["load_z"]
compensator = found.compensator()
told = told[:, [names.index(one.name) for one in compensator.covariates]]
np.savetxt("python.txt", compensator(torch.tensor(joints), torch.tensor(told))[0].detach().numpy(), "%.17g")
"""
# Of ours: config. Rows are in a frame that was fitted to the drawing before, but of "framed", which fits it itself.
OURS = {
    "bars, in Python": OWN % f", bars: true{RATIOS}",
    "ideal": OWN % "",
    "ideal, ratios": OWN % RATIOS,
    "bars": OWN % ", bars: true",
    "bars, ratios": OWN % f", bars: true{RATIOS}",
    "framed": f"mechanism: instrument\nmechanism_keys: {{{SEEN}, kind: pose, pose: [x, y, z]}}\n",
}
# Of the scripts: numbers and how far each may be off; those behind the bar are of the fuller one alone.
PLAIN = {"long": (4, 5e-4), "zero": (2, 1.5e-3), "tilt": (1, 2e-3), "lean": (6, 5e-4), "soft": (2, 4e-7)}
PLAIN |= {"spring": (1, 4e3), "wave": (8, 4e-5), "gap": (4, 8e-5), "grow": (3, 4e-6)}
PLAIN |= {"base": (6, 0.0), "tool": (3, 0.0)}
FULL = {"bars": (7, 4e-4), "stretch": (2, 3e-8), "cool": (2, 4e-6), "plate": (2, 1e-8)}
FULL |= {"turn": (8, 2e-5), "rate": (1, 6e3)}
FREE, NOISE = 1e-2, 4e-5


class Script:
    """An engineer's model, fitted to the rows: numbers of the data sheet that may be wrong, all with priors."""

    def __init__(self, full: bool, joints: Array, told: Array, seen: Array) -> None:
        self.full, start = full, 0
        self.parts: dict[str, slice] = {}
        sizes = []
        for name, (count, size) in {**PLAIN, **(FULL if full else {})}.items():
            self.parts[name], start = slice(start, start + count), start + count
            sizes += [size or FREE] * count
        self.sizes, at = np.array(sizes), drawn(joints)
        place = at[0] + at[1].apply(POINT)
        self.turn, _ = Rotation.align_vectors(seen - seen.mean(0), place - place.mean(0))
        self.stand = seen.mean(0) - self.turn.apply(place.mean(0))
        weight = np.where(self.sizes == FREE, 0.1, 1.0)

        def residuals(u: Array) -> Array:
            left = (self.place(u * self.sizes, joints, told) - seen).ravel() / NOISE
            return np.asarray(np.r_[left, weight * u])

        found = least_squares(residuals, np.zeros(len(sizes)), x_scale="jac")
        self.x, self.left = found.x * self.sizes, -found.fun[: seen.size].reshape(-1, 3) * NOISE

    def flange(self, x: Array, joints: Array, told: Array) -> tuple[Array, Rotation]:
        """The flange in the robot's base, `s x 3` [m], and its frame."""
        n = {name: x[part] for name, part in self.parts.items()}
        load, count, q = told[:, 8], len(joints), joints + np.r_[0, n["zero"], 0]
        q = q + n["wave"][:4] * np.sin(RATIO * joints) + n["wave"][4:] * np.cos(RATIO * joints)
        a1, l2, l3, a4 = np.array([A1, L2, L3, A4]) + n["long"]
        lever, length = spring_lever(joints[:, 1])
        push = n["spring"] + (n["rate"] * (length - 0.5) if self.full else 0)
        pull = -G * np.cos(q[:, 1]) * L2 * (MASS[0] / 2 + MASS[1:].sum() + load) + lever * push
        lift = -G * np.cos(q[:, 2]) * (MASS[1] * C3 + (MASS[3] + load) * L3)
        flank = -told[:, 4:8]
        if self.full:
            torque = np.stack([0 * load, pull, lift, 0 * load], -1)
            flank = np.tanh((torque - 90 * told[:, 4:8]) / 40)
            for k in range(4):
                wave = (np.sin, np.cos)[k // 2]((1 + k % 2) * joints)
                q = q + wave * np.r_[0, n["turn"][[k, k + 4]], 0]
        q = q + n["gap"] / 2 * flank
        warm = told[:, :4] - 20
        l2, l3 = l2 * (1 + n["grow"][1] * warm[:, 1]), l3 * (1 + n["grow"][2] * warm[:, 3])
        column = 1 + n["grow"][0] * warm[:, 0]
        q2, q3 = q[:, 1] + n["soft"][0] * pull, q[:, 2] + n["soft"][1] * lift
        tilt = n["tilt"] + 0 * load
        arm = l2 * np.exp(1j * q2)
        if self.full:
            # Rods as much longer than the arms beside them as found, growing as the arms grow less than these.
            b, rods = n["bars"], n["cool"]
            q3 = q3 + n["stretch"][0] * lift / (CRANK * np.sin(q2 - q3)) ** 2
            aim, tip = np.exp(1j * q3), G * (MASS[3] * CW + load * A4) / LEVEL * n["stretch"][1]
            rod = L2 + n["long"][1] + b[1] + L2 * rods[0] * warm[:, 1]
            q3 = q3 + swung(arm, CRANK + b[0], -CRANK * aim, rod, -aim)
            rise = L2 + n["long"][1] + b[2] + L2 * rods[0] * warm[:, 1] + tip / np.sin(q2)
            first = swung(arm, LEVEL + b[3], -LEVEL + 0 * arm, rise, -1 + 0 * arm)
            hook = arm + (LEVEL + b[4]) * np.exp(1j * (np.pi / 2 + first + n["tilt"]))
            along = L3 + n["long"][2] + b[5] + L3 * rods[1] * warm[:, 3] + tip / np.cos(q3)
            tilt = swung(arm + l3 * np.exp(1j * q3), LEVEL, hook, along, 1j + 0 * arm) + b[6]
        reach = l3 * np.exp(1j * q3)
        base = turned(0, 0, q[:, 0], count)
        at = base.apply(np.stack([a1 * column, 0 * load, D1 * column], -1))
        plane = base * turned(n["lean"][0], 0, n["lean"][1], count)
        at = at + plane.apply(carried(arm))
        leans = (n["lean"][2] + 1j * n["lean"][3]) * np.exp(1j * q2)
        plane = plane * turned(leans.real, 0, leans.imag, count)
        at = at + plane.apply(carried(reach))
        plane = plane * turned(n["lean"][4], -tilt, 0, count)
        at = at + plane.apply(np.tile([a4, 0, -D4], (count, 1)))
        frame = plane * turned(n["lean"][5], 0, 0, count) * turned(0, 0, q[:, 3], count)
        if self.full:
            far = (MASS[1:].sum() + load) * (a1 + arm.real) + (MASS[3] + load) * reach.real
            moment = n["plate"] * G * far[:, None] * np.stack([-np.sin(q[:, 0]), np.cos(q[:, 0])], -1)
            about_x, about_y = moment.T
            tip_over = turned(about_x, about_y, 0.0, count)
            at, frame = tip_over.apply(at), tip_over * frame
        return at, frame

    def place(self, x: Array, joints: Array, told: Array) -> Array:
        """The reflector as the tracker sees it, `s x 3` [m]."""
        at, frame = self.flange(x, joints, told)
        return self.stood(x, at + frame.apply(POINT + x[self.parts["tool"]]))

    def stood(self, x: Array, at: Array) -> Array:
        """Places in the robot's base as the tracker sees them."""
        b = x[self.parts["base"]]
        return np.asarray(self.turn.apply(Rotation.from_rotvec(b[:3]).apply(at) + b[3:]) + self.stand)

    def commands(self, wanted: Array, told: Array, more: Array | float = 0.0) -> Array:
        """Joints at which the model has the places of the drawing, and its turn about the vertical, `s x 4` [rad]."""
        at, frame = drawn(wanted)
        goal = self.stood(self.x, at + frame.apply(POINT + self.x[self.parts["tool"]])) - more
        aim = wanted[:, 0] + wanted[:, 3]
        joints = wanted.copy()
        for _ in range(4):
            here = self.place(self.x, joints, told)
            steps = [(self.place(self.x, joints + step, told) - here) / 1e-7 for step in 1e-7 * np.eye(4)]
            slope = np.concatenate([np.stack(steps, -1), np.tile([1.0, 0, 0, 1], (len(joints), 1, 1))], 1)
            lack = np.c_[goal - here, aim - joints[:, 0] - joints[:, 3]]
            joints = joints + np.linalg.solve(slope, lack[..., None])[..., 0]
        return joints


def by_process(joints: Array, told: Array, left: Array, wanted: Array, then: Array) -> Array:
    """Scikit-learn: what is left of each coordinate over joints, temperature and payload, `s x 3`."""
    kernel, make = ConstantKernel(1.0) * RBF(np.full(6, 2.0)) + WhiteKernel(0.5), GaussianProcessRegressor
    rows, new = (np.c_[q, t[:, 1] / 10, t[:, 8] / 60] for q, t in ((joints, told), (wanted, then)))
    return np.stack([make(kernel, normalize_y=True, random_state=0).fit(rows, one).predict(new) for one in left.T], -1)


def table(joints: Array, told: Array, seen: Array) -> tuple[str, Array]:
    """Header and rows of a file; `seen` has no columns where nothing was measured."""
    names = [f"q{k}[deg]" for k in (1, 2, 3, 4)] + [f"temperature_motor{k}[degC]" for k in (1, 2, 3, 4)]
    names += [f"direction{k}[1]" for k in (1, 2, 3, 4)] + ["payload[kg]", "x[mm]", "y[mm]", "z[mm]"]
    return ",".join(names[: 13 + seen.shape[1]]), np.c_[np.degrees(joints), told, 1e3 * seen]


def judged(
    seed: int, rows: int, without: tuple[str, ...], names: list[str], kept: Path | None
) -> dict[str, tuple[float, float]]:
    """Root mean square and maximum of what one machine misses [m], by who calibrated it."""
    robot, rng = Robot(seed, without), np.random.default_rng([seed, 1])
    joints, told, inside = day(robot, rows, rng)
    seen = robot.measured(joints, told, inside, rng)
    wanted, then, warm = day(robot, NEW, rng)
    sent = {"as drawn": wanted}
    for full, who in ((False, "plain script"), (True, "fuller script")):
        script = Script(full, joints, told, seen)
        sent[who] = script.commands(wanted, then)
        more = by_process(joints, told, script.left, wanted, then)
        sent[f"{who} and process"] = script.commands(wanted, then, more)
        print(f"  {who}: leaves {1e6 * np.sqrt((script.left**2).sum(1).mean()):.0f} um", file=sys.stderr)
    text = (Path(__file__).parent / "palletizer_arm.py").read_text()
    for name in names:
        fitted = seen if name == "framed" else script.turn.inv().apply(seen - script.stand)
        records, targets = table(joints, told, fitted), table(wanted, then, np.empty((NEW, 0)))
        with TemporaryDirectory() as folder:
            place = Path(folder) if kept is None else kept / f"{seed}_{name}".replace(", ", "_").replace(" ", "_")
            place.mkdir(parents=True, exist_ok=True)
            file = "palletizer_arm.py"
            found = commanded(place, text, records, targets, "run", OURS[name], file, "--allow-code")
            if found is None and "Python" in name:
                subprocess.run([sys.executable, "-W", "ignore", "-c", PYTHON], cwd=place, check=False)
                found = np.loadtxt(place / "python.txt") if (place / "python.txt").is_file() else None
        sent[f"ours, {name}"] = np.full_like(wanted, np.nan) if found is None else found
    none = np.full((NEW, 3), np.nan)
    went = {who: none if np.isnan(q).any() else robot.reached(q, then, warm) for who, q in sent.items()}
    return {who: missed(wanted, places) for who, places in went.items()}


if __name__ == "__main__":
    options = argparse.ArgumentParser(description=__doc__)
    options.add_argument("--seed", type=int, required=True)
    options.add_argument("--machines", type=int, default=1)
    options.add_argument("--rows", type=int, default=80)
    options.add_argument("--without", nargs="*", choices=CAUSES, default=[])
    options.add_argument("--ours", nargs="*", choices=list(OURS), default=["ideal", "bars, in Python"])
    options.add_argument("--keep", type=Path)
    asked = options.parse_args()
    for number in range(asked.seed, asked.seed + asked.machines):
        result = judged(number, asked.rows, tuple(asked.without), asked.ours, asked.keep)
        shown = (f"{who} {1e6 * rms:.1f} ({1e6 * most:.0f})" for who, (rms, most) in result.items())
        print(f"{number} [µm]: " + "   ".join(shown), flush=True)
