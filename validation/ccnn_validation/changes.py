"""Changes put into measured rows that a model has not seen: does `ccnn diagnose --since` tell which, where, how large?

`python -m ccnn_validation.changes MODEL RECORDS.csv [--rows 10] [--draws 20] [--seed 0] [--out CSV]`. RECORDS has whole
poses (x, y, z and a rotation vector rx, ry, rz) of an arm. A zero or a gain is put into the commands of one joint, a
motion into the poses, before or behind the machine; the rest is as measured. Nothing here uses a model of the machine.
"""

from __future__ import annotations

import argparse
import csv
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ccnn_torch import since
from ccnn_torch.effects.words import words_of
from ccnn_torch.records import read_table, write_table
from ccnn_torch.report.results.verify import SinceResults

Array = NDArray[np.float64]
ZERO, GAIN, MOTION = 5e-4, 5e-4, 5e-4
"""Size of a zero [rad] and of a gain [1], and of each coordinate of a motion [m], [rad] (standard deviation)."""
SURE = 0.9


@dataclass(frozen=True)
class Case:
    """Rows in SI by column, what was put into them as the verdict names it ('' = nothing), and its number if any."""

    columns: Mapping[str, Array]
    name: str
    size: float | None = None


def cases(columns: Mapping[str, Array], draw: np.random.Generator) -> Iterator[Case]:
    """The rows as they are, and with a zero, a gain, another place of the device and another tool."""
    joints = sorted(name for name in columns if name.startswith("q"))
    place = np.stack([columns[f"{axis}[m]"] for axis in "xyz"], 1)
    turn = Rotation.from_rotvec(np.stack([columns[f"r{axis}[rad]"] for axis in "xyz"], 1))
    yield Case(columns, "")
    joint, sign = joints[draw.integers(len(joints))], draw.choice([-1.0, 1.0])
    bare = joint.partition("[")[0]
    yield Case({**columns, joint: columns[joint] - sign * ZERO}, f"joint_offset {bare}", sign * ZERO)
    yield Case({**columns, joint: columns[joint] * (1 - sign * GAIN)}, f"joint_gain {bare}", sign * GAIN)
    shift, lean = draw.normal(0, MOTION, 3), Rotation.from_rotvec(draw.normal(0, MOTION, 3))
    yield Case(_with(columns, lean.apply(place) + shift, lean * turn), "frame")
    yield Case(_with(columns, place + turn.apply(draw.normal(0, MOTION, 3)), turn), "tool")


def _with(columns: Mapping[str, Array], place: Array, turn: Rotation) -> dict[str, Array]:
    named = {f"{axis}[m]": place[:, k] for k, axis in enumerate("xyz")}
    return {**columns, **named, **{f"r{axis}[rad]": turn.as_rotvec()[:, k] for k, axis in enumerate("xyz")}}


def judged(case: Case, said: SinceResults) -> dict[str, str]:
    """A line of the table: what was put in, what was told, and how good that is."""
    told = [one.name for one in said.changed]
    right = told == ([case.name] if case.name else [])
    like = not right and len(told) == 1 and _words(case.name) in said.changed[0].instead
    number = said.changed[0].numbers[0] if right and case.size is not None else None
    off = "" if number is None or case.size is None else f"{(number.value - case.size) / number.sd:.2f}"
    return {
        "change": case.name or "nothing",
        "told": " and ".join(told) or "nothing",
        "right": "yes" if right else "of its class" if like else "no",
        "probability": f"{said.probability:.3f}",
        "number off [sd]": off,
    }


def _words(name: str) -> str:
    """A change in the words of the verdict."""
    effect, _, part = name.partition(" ")
    return f"{words_of(effect).short} of {part}" if part else words_of(effect).short


def main() -> None:
    """Judge, print a summary, write the lines."""
    parser = argparse.ArgumentParser(prog="python -m ccnn_validation.changes", description=__doc__)
    parser.add_argument("model", type=Path)
    parser.add_argument("records", type=Path)
    parser.add_argument("--rows", type=int, default=10)
    parser.add_argument("--draws", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path)
    given = parser.parse_args()
    table = read_table(given.records)
    units = {name: "m" if name in "xyz" else "rad" for name in table.names if name in "xyz" or name[0] in "qr"}
    wanted = {
        name: unit for name, unit in units.items() if name in ("x", "y", "z", "rx", "ry", "rz") or name[1:].isdigit()
    }
    every = {f"{name}[{unit}]": table.column(name, unit) for name, unit in wanted.items()}
    lines = []
    with TemporaryDirectory() as folder:
        path = Path(folder) / "new.csv"
        for seed in range(given.seed, given.seed + given.draws):
            draw = np.random.default_rng(seed)
            rows = np.sort(draw.permutation(len(table))[: given.rows])
            for case in cases({name: values[rows] for name, values in every.items()}, draw):
                write_table(path, case.columns)
                lines.append(judged(case, since(given.model, path)))
    for kind in dict.fromkeys(line["change"].split()[0] for line in lines):
        mine = [line for line in lines if line["change"].split()[0] == kind]
        right = [sum(line["right"] == word for line in mine) for word in ("yes", "of its class")]
        print(f"{kind}: right {right[0]} of {len(mine)}, told as what rows do not tell from another name {right[1]}")
    sure = [line for line in lines if float(line["probability"]) >= SURE]
    off = [abs(float(line["number off [sd]"])) for line in lines if line["number off [sd]"]]
    print(f"claims at {SURE} or more: right {sum(line['right'] != 'no' for line in sure)} of {len(sure)}")
    print(f"numbers within 1.96 standard deviations: {sum(v < 1.96 for v in off)} of {len(off)}")
    if given.out is not None:
        with given.out.open("w", newline="", encoding="utf-8") as stream:
            writer = csv.DictWriter(stream, lines[0])
            writer.writeheader()
            writer.writerows(lines)


if __name__ == "__main__":
    main()
