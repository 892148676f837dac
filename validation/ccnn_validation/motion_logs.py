"""Logs of one axis with a cause that was drawn, and whether `ccnn diagnose --motion` names it.

`python -m ccnn_validation.motion_logs --seed N [--seeds N] [--families A,B] --out FILE`. An axis with a position
controller is simulated in steps of 0.1 ms by the implicit Euler method, in which dry friction stops it by projection
(Moreau 1988). Each family has causes that the library has a name for, or a torque that it has none for, which is to be
told as outside with its driver. Signs, sizes, gain, inertia, damping and three motions are drawn; an encoder of 16384
steps reads the position at 100 Hz. Families that begin with `free` have a model without any value.
"""

from __future__ import annotations

import argparse
import json
import zlib
from collections import Counter
from collections.abc import Callable, Sequence
from itertools import permutations
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from ccnn_validation.delivered.product import Contestant

try:
    import numba
except ImportError:
    numba = None  # type: ignore[assignment]

Array = NDArray[np.float64]
STEP, SAMPLES, ENCODER = 1e-4, 500, 2 * np.pi / 16384
# Of one turn: what is constant or linear in the model, and what only the machine has.
PARAMETERS = (
    "gain",
    "inertia",
    "damping",
    "dry",
    "sine",
    "cosine",
    "cube",
    "twice",
    "phase",
    "faster",
    "root",
    "teeth",
)

OUTSIDE = {
    "q3": "position",
    "q3+coulomb": "position",
    "sin2q": "position",
    "sin2q+coulomb": "position",
    "v3": "speed",
    "v3+coulomb": "speed",
    "root": "speed",
}
NAMED = (
    *("none", "gravity", "coulomb", "backlash", "servo_gain", "viscous", "cogging", "delay", "offset", "inertia"),
    *("gravity+coulomb", "delay+coulomb", "gravity+viscous"),
    *("free:backlash", "free:coulomb+gravity", "free:gravity"),
)
# Beside the root of the speed friction may be named, which is nearly the same.
BESIDE_ROOT = frozenset({"coulomb", "viscous", "stribeck"})
# Of a model without values a lag is right as any of these, and the small inertia as none or one of them.
LAGS, LAGS_OR_INERTIA = ("servo_gain", "viscous", "delay"), ("inertia", "delay")


def _course(time: Array, asked: Array, count: int, late: float, order: float, values: Array) -> Array:
    """Positions at each step; values: as in `PARAMETERS`."""
    gain, inertia, damping, dry, sine, cosine, cube, twice, phase, faster, root, teeth = values
    q, v, k, found = asked[0], 0.0, 0, np.empty(count)
    for i in range(count):
        found[i], t = q, time[0] + i * STEP - late
        while k < len(time) - 2 and time[k + 1] <= t:
            k += 1
        u = asked[k] + (asked[k + 1] - asked[k]) * min(max((t - time[k]) / (time[k + 1] - time[k]), 0.0), 1.0)
        torque = gain * (u - q) - sine * np.sin(q) - cosine * np.cos(q) - cube * q**3
        torque -= twice * np.sin(2 * q + phase) + teeth * np.sin(order * q)
        resistance = inertia + STEP * (damping + faster * v * v) + STEP * STEP * gain
        if root > 0 and abs(v) > 1e-9:
            resistance += STEP * root / np.sqrt(max(abs(v), 1e-3))
        push = inertia * v + STEP * torque
        v = 0.0 if abs(push) <= STEP * dry else (push - STEP * dry * np.sign(push)) / resistance
        q += STEP * v
    return found


course = cast(Callable[..., Array], _course if numba is None else numba.njit(_course))


def command(kind: int, rng: np.random.Generator) -> Callable[[Array], Array]:
    """Two sines, a triangle, or a chirp."""
    rate, size = rng.uniform(0.85, 1.2), rng.uniform(0.8, 1.0)
    if kind == 1:
        return lambda t: size * 2 / np.pi * np.arcsin(np.sin(1.9 * rate * t))
    if kind == 0:
        return lambda t: np.clip(t / 0.5, 0, 1) * size * (0.65 * np.sin(2.0 * rate * t) + 0.35 * np.sin(6.1 * rate * t))
    turns = 2 * np.pi
    return lambda t: (
        np.clip(t / 0.5, 0, 1)
        * size
        * (0.8 * np.sin(1.3 * rate * t) + 0.25 * np.sin(turns * (0.3 * t + 0.18 * rate * t**2)))
    )


Values = dict[str, float]
CAUSES: dict[str, Callable[[Values, float, np.random.Generator], Values]] = {
    "none": lambda real, size, rng: {},
    "q3": lambda real, size, rng: {"cube": 0.15 * size * real["gain"]},
    "sin2q": lambda real, size, rng: {"twice": 0.06 * size * real["gain"], "phase": rng.uniform(0, 6.28)},
    "v3": lambda real, size, rng: {"faster": 0.006 * size * real["gain"]},
    "root": lambda real, size, rng: {"root": 0.03 * size * real["gain"]},
    "gravity": lambda real, size, rng: {
        "sine": 0.08 * size * real["gain"],
        "cosine": 0.02 * real["gain"] * rng.uniform(-1, 1),
    },
    "coulomb": lambda real, size, rng: {"dry": 0.02 * size * real["gain"]},
    "backlash": lambda real, size, rng: {"play": 0.03 * size},
    "servo_gain": lambda real, size, rng: {"gain": real["gain"] * np.exp(rng.choice([-1, 1]) * 0.3 * size)},
    "viscous": lambda real, size, rng: {"damping": real["damping"] * (1 + 0.4 * size)},
    "inertia": lambda real, size, rng: {"inertia": real["inertia"] * (1 + 0.6 * size)},
    "cogging": lambda real, size, rng: {"teeth": 0.02 * size * real["gain"], "order": float(rng.integers(8, 20))},
    "delay": lambda real, size, rng: {"delay": 0.02 * size},
    "offset": lambda real, size, rng: {"offset": 0.02 * size * rng.choice([-1, 1])},
}
"""What a cause of a size changes of an axis."""


def drawn(family: str, seed: int) -> tuple[dict[str, float], str]:
    """Values of the model, and the log."""
    rng = np.random.default_rng([seed, zlib.crc32(family.encode())])
    gain = rng.uniform(1.5, 6.0)
    rate, share = rng.uniform(3.5, 7.0), rng.uniform(0.5, 1.1)
    inertia = gain / (2 * np.pi * rate) ** 2
    damping = 2 * share * np.sqrt(gain * inertia)
    if family.startswith("free:"):
        damping = gain * rng.uniform(0.015, 0.04)
        inertia = damping * rng.uniform(0.002, 0.004)
    real = dict.fromkeys(PARAMETERS, 0.0) | {"gain": gain, "inertia": inertia, "damping": damping}
    keys = {} if family.startswith("free:") else {"gain": gain, "inertia": inertia, "viscous": damping}
    beside = {"delay": 0.0, "order": 1.0, "play": 0.0, "offset": 0.0}
    for cause in family.removeprefix("free:").split("+"):
        size = rng.uniform(0.6, 1.4)
        for name, value in CAUSES[cause](real, size, rng).items():
            (real if name in real else beside)[name] = value
    lines = ["time[s],run[1],command1[rad],q1[rad]"]
    for run in range(3):
        time = np.arange(SAMPLES) * 0.01 + rng.uniform(0, 1e-4, SAMPLES)
        time -= time[0]
        asked = command(run, rng)(time)
        count, values = int(time[-1] / STEP) + 2, np.array([*real.values()])
        q = course(time, asked + beside["offset"], count, beside["delay"], beside["order"], values)
        if beside["play"]:
            q = q.copy()
            for i in range(1, count):
                q[i] = min(max(q[i - 1], q[i] - beside["play"] / 2), q[i] + beside["play"] / 2)
        seen = np.interp(time, np.arange(count) * STEP, q)
        seen = np.round(seen / ENCODER + 0.3 * rng.standard_normal(SAMPLES)) * ENCODER
        lines += [f"{t:.17g},{run},{u:.17g},{x:.17g}" for t, u, x in zip(time, asked, seen, strict=True)]
    return {name: float(value) for name, value in keys.items()}, "\n".join(lines) + "\n"


def accepted(family: str) -> list[frozenset[str]]:
    """Sets of names that are right."""
    names = frozenset(family.removeprefix("free:").split("+")) - {"none"}
    if not family.startswith("free:"):
        return [names]
    sets = [names, *(names | {lag} for lag in LAGS)]
    return [*sets, *(one | {more} for one in sets for more in LAGS_OR_INERTIA)]


def grade(family: str, verdict: dict[str, Any], effects: Sequence[dict[str, Any]]) -> str:
    """`right`, `class` (names that the program says it cannot tell from the right ones), `partly` (outside, by another
    driver or beside wrong names), `outside` of what has a name, or `wrong`."""
    names = frozenset(verdict["effects"])
    if family in OUTSIDE:
        beside = BESIDE_ROOT if family == "root" else frozenset(family.split("+")[1:])
        if not verdict["outside_library"]:
            return "wrong"
        followed = {verdict["driver"], *verdict.get("drivers", ())}
        return "right" if OUTSIDE[family] in followed and names <= beside else "partly"
    if verdict["outside_library"]:
        return "outside"
    like = {one["name"]: {one["name"], *one["indistinguishable_from"]} for one in effects}
    sets = accepted(family)
    if names in sets:
        return "right"
    alike = (
        all(true in like[name] for name, true in zip(sorted(names), order, strict=True))
        for one in sets
        if len(one) == len(names)
        for order in permutations(one)
    )
    return "class" if any(alike) else "wrong"


def judged(family: str, seed: int) -> dict[str, Any]:
    """What the program says of one log."""
    keys, log = drawn(family, seed)
    given = [f"mechanism_keys={json.dumps(keys)}"] if keys else []
    with TemporaryDirectory() as folder:
        (Path(folder) / "log.csv").write_text(log)
        called = Contestant(Path(folder), "diagnose")
        arguments = ("--motion", "log.csv", "--mechanism", "servo", "--out", "out", *given)
        row: dict[str, Any] = {"family": family, "seed": seed}
        if not called.call("diagnose", *arguments):
            return row | {"grade": "refused", "probability": 0.0, "names": [], "driver": None, "said": called.said}
        found = json.loads((Path(folder) / "out" / "diagnosis.json").read_text())
    verdict = found["verdict"]
    row |= {"grade": grade(family, verdict, found["effects"]), "probability": verdict["probability"]}
    return row | {"names": verdict["effects"], "driver": verdict["driver"], "said": found["cautions"]}


def main() -> None:
    """Judge the families, and print a line for each log and the table."""
    options = argparse.ArgumentParser(description=__doc__)
    options.add_argument("--seed", type=int, required=True)
    options.add_argument("--seeds", type=int, default=1)
    options.add_argument("--families", default=",".join((*OUTSIDE, *NAMED)))
    options.add_argument("--out", type=Path, required=True)
    given = options.parse_args()
    families, rows = given.families.split(","), []
    if unknown := [one for one in families if one not in (*OUTSIDE, *NAMED)]:
        options.error(f"no family {unknown[0]}; there are {', '.join((*OUTSIDE, *NAMED))}")
    for family in families:
        for seed in range(given.seed, given.seed + given.seeds):
            rows.append(judged(family, seed))
            own = rows[-1]
            said = [*(own["names"] or ["nothing"]), *([f"outside by {own['driver']}"] if own["driver"] else [])]
            print(f"{family} {seed}: {own['grade']}, {own['probability']:.3f}: {', '.join(said)}", flush=True)
    given.out.write_text("".join(json.dumps(row) + "\n" for row in rows))
    print("| verdict | logs | mean probability |\n| --- | ---: | ---: |")
    for verdict, count in Counter(row["grade"] for row in rows).most_common():
        mean = np.mean([row["probability"] for row in rows if row["grade"] == verdict])
        print(f"| {verdict} | {count} | {mean:.2f} |")


if __name__ == "__main__":
    main()
