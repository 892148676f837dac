"""A four-legged picker (Par4, Adept Quattro), calibrated by a tracker that sees one reflector beside the flange's axis.

`python -m ccnn_validation.quattro --seed N [--machines K] [--rows N] [--keep DIR]`. 80 places with 0, 1.5 and 3 kg, two
thermometers, ways of approach. Judged are 200 places of another day under 1 and 2.5 kg, in the frame that suits what is
reached best (six numbers; the turn of the flange but for its mean): as drawn, ours by the written file, a plain
script (geometry alone) and a fuller one (`quattro_script`).
"""

from __future__ import annotations

import argparse
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ccnn_validation.drawn import commanded
from ccnn_validation.quattro_robot import Conditions, Quattro
from ccnn_validation.quattro_script import Rows, drawn_inverse, fitted, send

Array = NDArray[np.float64]
NEW = 200
CLASS = Path(__file__).with_name("quattro_class.py")
CONFIG = """mechanism: quattro_class.py:Quattro
mechanism_keys: {gears: [33, 33, 33, 33]}
"""


def poses(count: int, rng: np.random.Generator, share: float) -> Array:
    """Of the reflector, `s x 4`: over the share of a cylinder of 0.6 m by 0.2 m, turned by as much as 150 degrees."""
    way, radius = rng.uniform(0, 2 * np.pi, count), 0.3 * share * np.sqrt(rng.uniform(0, 1, count))
    height, phi = rng.uniform(-0.1, 0.1, count) * share - 0.85, rng.uniform(-2.6, 2.6, count) * share
    x, y = radius * np.cos(way) + 0.06 * np.cos(phi), radius * np.sin(way) + 0.06 * np.sin(phi)
    return np.stack([x, y, height - 0.03, phi], -1)


def fit_frame(places: Array, to: Array) -> Array:
    """Places in the frame in which they are nearest to others, `s x 3` [m]."""
    turn, _ = Rotation.align_vectors(to - to.mean(0), places - places.mean(0))
    return np.asarray(turn.apply(places - places.mean(0)) + to.mean(0))


def told(at: Conditions) -> Rows:
    """What the user knows of rows."""
    return Rows(at.read[:, 0], at.read[:, 1], -9.81 * at.payload, at.way, at.turned)


def by_package(
    joints: Array, at: Conditions, places: Array, target: Array, after: Conditions, folder: Path
) -> Array | None:
    """Commands by the file that the program writes."""
    angles = ",".join(f"q{i}[rad]" for i in range(1, 5))
    names, known = at.columns()
    records = f"{angles},x[m],y[m],z[m],{names}", np.c_[joints, places, known]
    targets = f"{angles},{names}", np.c_[target, after.columns()[1]]
    flags = "--allow-code"
    return commanded(folder, CLASS.read_text(), records, targets, config=CONFIG, file="quattro_class.py", flags=flags)


def judged(seed: int, rows: int, folder: Path) -> dict[str, tuple[float, ...]]:
    """RMS and maximum of the place [um] and of the turn [mdeg], by who calibrated the machine."""
    robot, rng = Quattro(seed), np.random.default_rng([seed, 91])
    wanted = poses(rows, rng, 1.0)
    joints = drawn_inverse(wanted)
    at = Conditions(joints, wanted[:, 3], rng.choice([0.0, 1.5, 3.0], rows), 4.0, rng)
    # As the docs ask: a best fit to the drawing beforehand.
    places = fit_frame(robot.measured(joints, at, rng), wanted[:, :3])
    new = poses(NEW, rng, 0.95)
    target = drawn_inverse(new)
    after = Conditions(target, new[:, 3], rng.choice([1.0, 2.5], NEW), 8.0, rng)
    numbers, _ = fitted(joints, places, None)
    fuller, causes = fitted(joints, places, told(at))
    sent: dict[str, Array | None] = {"as drawn": target, "plain script": send(new, numbers)}
    sent["fuller script"] = send(new, fuller, told(after), causes)
    sent["ours"] = by_package(joints, at, places, target, after, folder)
    found: dict[str, tuple[float, ...]] = {}
    for who, commands in sent.items():
        if commands is None or np.isnan(commands).any():
            found[who] = (np.nan,) * 4
            continue
        place, phi = robot.reached(commands, after)
        off = 1e6 * np.linalg.norm(fit_frame(place, new[:, :3]) - new[:, :3], axis=1)
        turn = np.angle(np.exp(1j * (phi - new[:, 3])))
        turn = 1e3 * np.degrees(turn - turn.mean())
        found[who] = tuple(
            map(float, (np.sqrt((off**2).mean()), off.max(), np.sqrt((turn**2).mean()), abs(turn).max()))
        )
    return found


def main() -> None:
    """Judge machines and print what each contestant misses."""
    options = argparse.ArgumentParser(description=__doc__)
    options.add_argument("--seed", type=int, required=True)
    options.add_argument("--machines", type=int, default=1)
    options.add_argument("--rows", type=int, default=80)
    options.add_argument("--keep", type=Path, help="folder of the files; by default a temporary one")
    given = options.parse_args()
    every = []
    for seed in range(given.seed, given.seed + given.machines):
        with TemporaryDirectory() as temporary:
            folder = Path(temporary) if given.keep is None else given.keep.resolve() / str(seed)
            folder.mkdir(parents=True, exist_ok=True)
            found = judged(seed, given.rows, folder)
        every.append(found)
        for who, (rms, most, turn, far) in found.items():
            print(f"{seed} {who}: {rms:.1f} um, most {most:.1f}; {turn:.1f} mdeg, most {far:.1f}", flush=True)
    for who in every[0]:
        middle = np.median([found[who] for found in every], axis=0)
        print(f"median {who}: {middle[0]:.1f} um, most {middle[1]:.1f}; {middle[2]:.1f} mdeg, most {middle[3]:.1f}")


if __name__ == "__main__":
    main()
