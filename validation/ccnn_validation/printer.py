"""A delta printer calibrated from heights of its bed and distances of marks, judged on the true machine.

`python -m ccnn_validation.printer [--seed N]`. The true printer is simulated here, in numpy, and shares no code with
the package; beside it stands a plain SciPy fit of the same rows. Both give commands for places of the bed that no row
was at: ours by the written file.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import fsolve, least_squares

from ccnn_torch.api import identify
from ccnn_torch.compensation import load_compensation

Array = NDArray[np.float64]
ROD, RADIUS, TOWERS = 0.25, 0.13, np.deg2rad([0.0, 120.0, 240.0])
# Errors of the true printer: rods and radii [m], towers [rad], endstops [m].
TRUE = np.array([4e-4, -3e-4, 6e-4, 5e-4, -7e-4, 3e-4, 2.6e-3, -3.5e-3, 0.9e-3, 3e-4, -4e-4, 2e-4])
PRIOR = np.repeat([1e-3, 1e-3, 5e-3, 1e-3], 3)
HEIGHT_NOISE, DISTANCE_NOISE = 1e-5, 2e-5
KEYS: dict[str, Any] = {"base": 0.18, "platform": 0.05, "rod": ROD}
# As its owner writes it, with the tolerances of `ccnn new --mechanism delta_printer`.
FILE = """machine: delta_printer
numbers:
  arm_length: 250 mm
  delta_radius: 130 mm
  tower: [0 deg, 120 deg, 240 deg]
"""


def carriages(place: Array, error: Array) -> Array:
    """Heights of the carriages at places `s x 3`, of a printer with errors; `s x 3` [m]."""
    rod, radius, tower, end = error.reshape(4, 3)
    across = (RADIUS + radius) * np.cos(TOWERS + tower) - place[:, :1]
    up = (RADIUS + radius) * np.sin(TOWERS + tower) - place[:, 1:2]
    heights: Array = place[:, 2:] + np.sqrt((ROD + rod) ** 2 - across**2 - up**2) - end
    return heights


def reached(joints: Array, near: Array, error: Array = TRUE) -> Array:
    """Where the nozzle is, `s x 3` [m]."""
    return np.array(
        [fsolve(lambda p, q=q: carriages(p[None], error)[0] - q, g) for q, g in zip(joints, near, strict=True)]
    )


def bed(rng: np.random.Generator, count: int) -> Array:
    radius, angle = 0.09 * np.sqrt(rng.uniform(0, 1, count)), rng.uniform(0, 2 * np.pi, count)
    places: Array = np.c_[radius * np.cos(angle), radius * np.sin(angle), np.zeros(count)]
    return places


def by_scipy(touched: Array, one: Array, two: Array, distance: Array) -> Array:
    """Errors `12` of the same rows by least squares with weak priors, as one would write it in an hour."""

    def left(error: Array) -> Array:
        start = np.zeros((1, 3))
        heights = reached(touched, np.repeat(start, len(touched), 0), error)[:, 2] / HEIGHT_NOISE
        here, there = (reached(q, np.repeat(start, len(q), 0), error) for q in (one, two))
        apart = (np.linalg.norm(here - there, axis=1) - distance) / DISTANCE_NOISE
        whole: Array = np.r_[heights, apart, error / PRIOR]
        return whole

    found: Array = least_squares(left, np.zeros(12), x_scale=PRIOR).x
    return found


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__)
    options.add_argument("--seed", type=int, default=0)
    rng = np.random.default_rng(options.parse_args().seed)
    # The probe triggers where the true bed is, up to its noise.
    touched = carriages(bed(rng, 40) + np.array([0, 0, 1.0]) * rng.normal(0, HEIGHT_NOISE, (40, 1)), TRUE)
    nominal = np.zeros(12)
    wanted_one, wanted_two = bed(rng, 8), bed(rng, 8)
    one, two = (carriages(wanted, nominal) for wanted in (wanted_one, wanted_two))
    marks = np.linalg.norm(reached(one, wanted_one) - reached(two, wanted_two), axis=1)
    marks = marks + rng.normal(0, DISTANCE_NOISE, 8)
    new = bed(rng, 200)

    def tell(what: str, joints: Array) -> None:
        there = reached(joints, new)
        apart, right = (np.linalg.norm(p[:100] - p[100:], axis=1) for p in (there, new))
        off = np.sqrt(np.mean((apart - right) ** 2))
        print(f"{what:<42} bed {1e6 * there[:, 2].std():6.1f} um   distances {1e6 * off:6.1f} um")

    tell("before", carriages(new, nominal))
    tell("SciPy, straight rails, both", carriages(new, by_scipy(touched, one, two, marks)))
    with TemporaryDirectory() as folder:
        heights, pairs = Path(folder) / "bed.csv", Path(folder) / "marks.csv"
        names = ["q1[m]", "q2[m]", "q3[m]"]
        second = [name.replace("[", "_b[") for name in names]
        np.savetxt(heights, np.c_[touched, np.zeros(40)], "%.9f", ",", header=",".join([*names, "z[m]"]), comments="")
        header = ",".join([*names, *second, "distance[m]"])
        np.savetxt(pairs, np.c_[one, two, marks], "%.9f", ",", header=header, comments="")
        keys: dict[str, Any] = {"mechanism": "delta_linear", "mechanism_keys": KEYS, "split": {"test": 0.15}}
        straight = {"parameters": {"fixed": ["lean*", "skew*"]}}
        beside = [{"kind": "pose", "records": str(heights), "noise": HEIGHT_NOISE}]
        constraint = {"kind": "distances", "tolerance": {"m": 1e-3, "rad": 5e-3}, "beside": beside}
        machine = Path(folder) / "printer.yaml"
        machine.write_text(FILE)
        printer: dict[str, Any] = {"mechanism": str(machine), "split": {"test": 0.15}}
        of_file = {"kind": "distances", "beside": beside}
        both: dict[str, Any] = {"records": str(pairs), "noise": DISTANCE_NOISE, "constraint": constraint}
        made = {
            "ours, straight rails, heights alone": identify(
                **keys, **straight, records=str(heights), noise=HEIGHT_NOISE
            ),
            "ours, straight rails, both": identify(**keys, **straight, **both),
            "ours, rails free, both": identify(**keys, **both),
            "ours, machine file, heights alone": identify(**printer, records=str(heights), noise=HEIGHT_NOISE),
            "ours, machine file, both": identify(**printer, **{**both, "constraint": of_file}),
        }
        for what, found in made.items():
            found.save(Path(folder) / what)
            model = load_compensation(Path(folder) / what / "identified.yaml")
            ideal = carriages(new, nominal)
            tell(what, model(ideal)["command"])


if __name__ == "__main__":
    main()
