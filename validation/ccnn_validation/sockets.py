"""A six-axis arm calibrated by a ball in the sockets of a plate, judged on the true machine.

`python -m ccnn_validation.sockets --seed N [--machines N] [--plain]`. The true arms are those of `delivered`: link
errors, zeros, gears and sag, in numpy. Only joints are recorded while the ball sits in one of two sockets, 50 mm apart,
of a plate that stood in four places. Ours (`ccnn run`, by the written file) stands beside a least-squares fit of links,
zeros and places, as one would write it in an hour, and beside one that knows the form of every error. Judged are places
at which no plate stood: wanted is the nominal arm's ball at ideal joints, in the base and with the ball's offset that
suit what each one's commands reach; a ball has no orientation.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from ccnn_validation.delivered.kinds import draw
from ccnn_validation.delivered.machine import Machine, resting
from ccnn_validation.delivered.product import Contestant
from ccnn_validation.delivered.rotation import matrix
from ccnn_validation.delivered.tables import read_commands

Array = NDArray[np.float64]
PLACES, EACH, NEW, POINTS = 4, 25, 3, 40
SOCKETS = np.array([[0, 0, 0], [0.05, 0, 0]])
# Scatter of a ball in its socket [m]; half range of the postures in a place, as a share of the box.
NOISE, POSTURE = 2e-5, 0.35
# What holds the links and zeros of the plain fit [m or rad].
PRIOR = 1e-3
FORMS = {"plain": ("links", "zeros"), "forms": ("links", "zeros", "gears", "sag", "masses")}


def ball(machine: Machine, unknowns: Array, joints: Array) -> Array:
    """Balls in the arm's base, `s x 3`: base frame and the tool's orientation are none."""
    known = unknowns.copy()
    known[:6], known[9:12] = 0.0, 0.0
    return machine.pose(known, joints, resting(joints)).position


def joints_at(where: Callable[[Array], Array], wanted: Array, joints: Array) -> Array:
    """Joints near the given ones at which the ball is where it is wanted, by steps of least size, `s x n`."""
    for _ in range(12):
        columns = [(where(joints + d) - where(joints - d)) / 2e-6 for d in 1e-6 * np.eye(joints.shape[1])]
        slope = np.stack(columns, -1)
        normal = slope @ slope.swapaxes(1, 2) + 1e-8 * np.eye(3)
        step = slope.swapaxes(1, 2) @ np.linalg.solve(normal, (wanted - where(joints))[..., None])
        joints = joints + np.clip(step[..., 0], -0.3, 0.3)
    return joints


def postures(machine: Machine, rng: np.random.Generator, middle: Array, count: int) -> Array:
    """Joints about a middle posture, `count x n`."""
    half = (machine.high - machine.low) / 2
    return middle + POSTURE * half * rng.uniform(-1, 1, (count, len(half)))


def rows_of(machine: Machine, rng: np.random.Generator) -> tuple[Array, Array, Array]:
    """Number of the place and of the socket, `s`, and joints `s x n`."""
    true, found = machine.vector("true"), []
    for place in range(PLACES):
        middle = machine.low + (machine.high - machine.low) * rng.uniform(0.3, 0.7, len(machine.low))
        at = ball(machine, true, middle[None])[0]
        turn = matrix(rng.normal(0, [0.05, 0.05, 2.0]))
        for socket, offset in enumerate(SOCKETS):
            wanted = at + turn @ offset + rng.normal(0, NOISE, (EACH, 3))
            start = postures(machine, rng, middle, EACH)
            joints = joints_at(lambda q: ball(machine, true, q), wanted, start)
            here = np.linalg.norm(ball(machine, true, joints) - wanted, axis=1) < 1e-9
            found.append(np.c_[np.full(here.sum(), place), np.full(here.sum(), socket), joints[here]])
    rows = np.concatenate(found)
    return rows[:, 0].astype(int), rows[:, 1].astype(int), rows[:, 2:]


def targets_of(machine: Machine, rng: np.random.Generator) -> Array:
    """Ideal joints at new places, `s x n`."""
    middles = machine.low + (machine.high - machine.low) * rng.uniform(0.3, 0.7, (NEW, len(machine.low)))
    return np.concatenate([postures(machine, rng, middle, POINTS) for middle in middles])


def by_scipy(machine: Machine, rows: tuple[Array, Array, Array], forms: tuple[str, ...]) -> Array:
    """The unknowns by least squares, the plate's places among them; what is not fitted stays nominal."""
    place, socket, joints = rows
    start = machine.vector("nominal")
    ends = np.cumsum([0, *(b.nominal.size for b in machine.blocks)])
    free = np.concatenate(
        [np.arange(6, 9)] + [np.arange(ends[k], ends[k + 1]) for k, b in enumerate(machine.blocks) if b.name in forms]
    )
    prior = machine.vector("prior")[free] if len(forms) > 2 else np.full(len(free), PRIOR)
    prior[:3], count = 0.1, len(free)

    def left(values: Array) -> Array:
        unknowns = start.copy()
        unknowns[free] += values[:count] * prior
        plates = values[count:].reshape(PLACES, 6)
        turns = np.stack([matrix(p[3:]) for p in plates])
        wanted = plates[place, :3] + np.einsum("sij,sj->si", turns[place], SOCKETS[socket])
        return np.concatenate([((ball(machine, unknowns, joints) - wanted) / NOISE).ravel(), values[:count]])

    at = ball(machine, start, joints)
    plates = np.zeros((PLACES, 6))
    for k in range(PLACES):
        here = [at[(place == k) & (socket == s)].mean(0) for s in (0, 1)]
        plates[k] = *here[0], 0, 0, np.arctan2(*(here[1] - here[0])[1::-1])
    found = least_squares(left, np.r_[np.zeros(count), plates.ravel()], x_scale="jac", max_nfev=60).x
    unknowns = start.copy()
    unknowns[free] += found[:count] * prior
    return unknowns


def by_package(machine: Machine, rows: tuple[Array, Array, Array], targets: Array, folder: Path) -> Array | None:
    """Commands to ideal joints by the written file."""
    place, socket, joints = rows
    names = ",".join(f"q{i + 1}[rad]" for i in range(joints.shape[1]))
    table = np.c_[place, joints, 1e3 * SOCKETS[socket]]
    header = f"placement[1],{names},x[mm],y[mm],z[mm]"
    np.savetxt(folder / "rows.csv", table, "%.12g", ",", header=header, comments="")
    np.savetxt(folder / "targets.csv", targets, "%.12g", ",", header=names, comments="")
    assert machine.files.text is not None
    text = machine.files.text.replace("tool_frame: unknown", "tool_offset: unknown")
    (folder / "arm.yaml").write_text(text + "frame_per: [placement]\n")
    (folder / "config.yaml").write_text("records: rows.csv\nmechanism: arm.yaml\n")
    contestant = Contestant(folder, "run")
    contestant.call("run", "config.yaml", "out=model", "save_report=false")
    contestant.call("compensate", "model/model.safetensors", "targets.csv", "commands.csv")
    path = folder / "commands.csv"
    return read_commands(path, joints.shape[1]).joints if path.is_file() else None


def reached(machine: Machine, targets: Array, commands: Array) -> float:
    """RMS of the true ball's distance from where it is wanted [m], in the base and with the offset that suit best."""
    nominal, true = machine.vector("nominal"), ball(machine, machine.vector("true"), commands)

    def left(frames: Array) -> Array:
        unknowns = nominal.copy()
        unknowns[6:9] = frames[6:]
        wanted = frames[:3] + ball(machine, unknowns, targets) @ matrix(frames[3:6]).T
        return np.asarray((true - wanted).ravel())

    start = np.r_[np.zeros(6), machine.vector("true")[6:9]]
    rest = least_squares(left, start, x_scale="jac").fun
    return float(np.sqrt((rest.reshape(-1, 3) ** 2).sum(1).mean()))


def judged(seed: int, extras: tuple[str, ...]) -> dict[str, float]:
    """Of one arm what is reached at new places [m], by who calibrated it; NaN where there were no commands."""
    machine = draw("offset", seed, extras)
    rng = np.random.default_rng([seed, 77])
    rows, targets = rows_of(machine, rng), targets_of(machine, rng)
    found = {"as drawn": reached(machine, targets, targets)}
    for name, forms in FORMS.items():
        unknowns = by_scipy(machine, rows, forms)
        drawn = machine.vector("nominal")
        # The ball is on the tool that was fitted, for the wanted place as well.
        drawn[6:9] = unknowns[6:9]
        wanted = ball(machine, drawn, targets)
        sent = joints_at(partial(ball, machine, unknowns), wanted, targets)
        found[f"SciPy, {name}"] = reached(machine, targets, sent)
    with TemporaryDirectory() as folder:
        commands = by_package(machine, rows, targets, Path(folder))
    found["ours"] = np.nan if commands is None else reached(machine, targets, commands)
    return found


def main() -> None:
    """Judge arms, the seeds counted from `--seed`."""
    options = argparse.ArgumentParser(description=__doc__)
    options.add_argument("--seed", type=int, required=True)
    options.add_argument("--machines", type=int, default=4)
    options.add_argument("--plain", action="store_true", help="links, zeros and gears only, no sag")
    given = options.parse_args()
    found = []
    for seed in range(given.seed, given.seed + given.machines):
        found.append(judged(seed, () if given.plain else ("sag",)))
        said = "   ".join(f"{who} {1e6 * value:.1f}" for who, value in found[-1].items())
        print(f"arm {seed} [µm]: {said}", flush=True)
    middle = {who: float(np.median([one[who] for one in found])) for who in found[0]}
    print("median [µm]: " + "   ".join(f"{who} {1e6 * value:.1f}" for who, value in middle.items()))


if __name__ == "__main__":
    main()
