"""Replicates of one machine, each diagnosed by itself: do the verdicts agree, and does one repair the other's rows?

`CCNN_MEASURED=DIR python -m ccnn_validation.replicates [--only WORD] [--out CSV]`. No truth is needed. Halves are drawn
in blocks of ten rows, so that readings of one target stay together and the order holds; days, nights and placements are
as measured, each beside the next. Without `CCNN_MEASURED`, the folder that holds `ur10_a/records.csv` and the like,
only robots whose rows are in the repository are judged.
"""

from __future__ import annotations

import argparse
import csv
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ccnn_torch import diagnose, load_mechanism, load_records
from ccnn_torch.diagnosis import Diagnosis
from ccnn_torch.diagnosis.residual.linearisation import remainder
from ccnn_torch.effects import Acting, moved
from ccnn_torch.effects.found_machine import machine_of_block
from ccnn_torch.errors import InputError
from ccnn_torch.mechanisms import Mechanism
from ccnn_validation.blind.report import Block, share
from ccnn_validation.repairs.replay import KEPT

HEADER = (
    "machine, replicates",
    "names",
    "probability",
    "same names",
    "numbers that agree",
    "frames alone, promised",
    "as told, own → crossed",
    "machine, own → crossed",
)
BLOCK, MOST = 10, 500
"""Rows that stay together in a half, and rows of a replicate at most."""
JOINT_95 = 1.96
_DATA = Path(__file__).parents[2] / "experiments" / "data"
_STEPS = 5
"""Of the fit of the frames."""
_SAME_SHAPE = 0.05
"""Share by which periods and the like may differ for the numbers to be of the same thing."""


@dataclass(frozen=True)
class Machine:
    """A machine that was measured more than once.

    Attributes:
        name: of it.
        mechanism: its nominal file.
        apart: whether the replicates are of different times, so that what follows the time is not shared.
        replicates: what each is, and the lines of its CSV file, the header first.
    """

    name: str
    mechanism: Path
    apart: bool
    replicates: Mapping[str, Sequence[str]]


@dataclass(frozen=True)
class Pair:
    """What two verdicts have in common.

    Attributes:
        names: of each, `outside` beside them where something is there that no name describes, `refused` for rows that
            are refused.
        probability: of each; NaN for what is refused.
        same: whether every name of one is a name of the other or in the class of one.
        agree: whether each number that both tell is within the joint 95 % interval, by effect and number.
        other_shape: numbers that both tell, of a period or the like that differs.
        alone: numbers of names in common that one tells and the other does not.
        left: RMS of the position in the rows of both [m], unknown frames fitted anew to them, by `WAYS`.
    """

    names: tuple[list[str], list[str]]
    probability: tuple[float, float]
    same: bool
    agree: Mapping[str, bool]
    other_shape: int
    alone: int
    left: Mapping[str, float]


WAYS = ("bare", "promised", "told", "told crossed", "machine", "machine crossed")
"""Without effects; as the verdict promises for rows that it does not know; with the numbers told, its own and the
other's; with the machine of diagnosis.json, where geometry and effects are fitted together, its own and the other's."""


@dataclass(frozen=True)
class Repair:
    """What a verdict says the machine is: nominal, parameters [SI] or None for those of the rows, and effects."""

    nominal: Mechanism | None
    values: Tensor | None
    acting: Sequence[Acting]


def diagnosed(lines: Sequence[str], mechanism: Path) -> Diagnosis | None:
    """The verdict on the rows of a file, as a user gets it; None where they are refused."""
    with TemporaryDirectory() as folder:
        path = Path(folder) / "records.csv"
        path.write_text("\n".join(lines) + "\n", encoding="utf-8")
        machine = load_mechanism(str(mechanism))
        try:
            return diagnose(load_records(path, machine, learns=False), machine)
        except InputError as problem:
            print(str(problem).partition(": ")[2])
            return None


def compared(one: Diagnosis | None, two: Diagnosis | None, apart: bool) -> Pair:
    """Two verdicts on one machine side by side; apart: as in `Machine`."""
    said = [_listed(d) for d in (one, two)]
    names = ([*said[0]], [*said[1]])
    same = all(
        name in theirs or any(name in entry["indistinguishable_from"] for entry in theirs.values())
        for mine, theirs in (said, said[::-1])
        for name in mine
    )
    agree, shapes, alone = {}, 0, 0
    for name in [n for n in names[0] if n in names[1]]:
        a, b = (_numbers(entry[name]) for entry in said)
        alone += len(a.keys() ^ b.keys())
        for number in [n for n in a if n in b]:
            if _same_shape(number, *(entry[name]["parameters"] for entry in said)):
                (value, sd), (other, its) = a[number], b[number]
                agree[f"{name} {number}"] = abs(value - other) <= JOINT_95 * float(np.hypot(sd, its))
            else:
                shapes += 1
    left = dict.fromkeys(WAYS, float("nan")) if one is None or two is None else _left(one, two, apart)
    chances = [float("nan") if d is None else float(d.verdict["probability"]) for d in (one, two)]
    return Pair(names, (chances[0], chances[1]), same, agree, shapes, alone, left)


def _left(one: Diagnosis, two: Diagnosis, apart: bool) -> dict[str, float]:
    both = (one, two)
    told, found = [as_told(d, apart) for d in both], [as_machine(d, apart) for d in both]
    sets = {
        "bare": [Repair(None, None, ())] * 2,
        "told": told,
        "told crossed": told[::-1],
        "machine": found,
        "machine crossed": found[::-1],
    }
    rms = {w: torch.cat([squares(d, r) for d, r in zip(both, s, strict=True)]) for w, s in sets.items()}
    promised = float(np.sqrt(np.mean([d.gap["after"] ** 2 for d in both])))
    return {way: promised if way == "promised" else float(rms[way].mean().sqrt()) for way in WAYS}


def _listed(said: Diagnosis | None) -> dict[str, Mapping[str, Any]]:
    """The names of a verdict with their entries, that of what no name describes empty."""
    empty: Mapping[str, Any] = {"indistinguishable_from": [], "parameters": {}}
    if said is None:
        return {"refused": empty}
    entries = {e["name"]: e for e in said.effects}
    found = {name: entries.get(name, empty) for name in said.verdict["effects"]}
    return found | ({"outside": empty} if said.verdict["outside_library"] else {})


def _numbers(entry: Mapping[str, Any]) -> dict[str, tuple[float, float]]:
    """Value and standard deviation of each number that is told."""
    every = entry["parameters"].items()
    told = {name: p for name, p in every if p.get("sd") is not None and not p.get("searched")}
    return {name: (p["value"], p["sd"]) for name, p in told.items() if p["value"]}


def _same_shape(number: str, one: Mapping[str, Any], two: Mapping[str, Any]) -> bool:
    """Whether what a number multiplies has the same period, time constant and the like: of its joint, or of all."""
    shapes = [{n: p["value"] for n, p in every.items() if p.get("searched")} for every in (one, two)]
    joints = {n.split()[0] for every in (one, two) for n in every} - {number.split()[0]}
    mine = [n for n in {**shapes[0], **shapes[1]} if " " not in n or n.split()[0] not in joints]
    return all(
        n in shapes[0] and n in shapes[1] and np.isclose(shapes[0][n], shapes[1][n], rtol=_SAME_SHAPE) for n in mine
    )


def as_told(said: Diagnosis, apart: bool) -> Repair:
    """The effects with the numbers that are told, on the nominal machine; apart: without what drifts with the time."""
    return Repair(None, None, [a for a in said.acting if not (apart and _in_time(a))])


def as_machine(said: Diagnosis, apart: bool) -> Repair:
    """The machine of diagnosis.json; as told where a file can hold none."""
    if said.machine is None:
        return as_told(said, apart)
    found = machine_of_block(said.machine, "diagnosis.json")
    return Repair(found.nominal, found.values, found.acting)


def _in_time(one: Acting) -> bool:
    return one.effect.name in ("drift", "frame_drift")


def squares(said: Diagnosis, repair: Repair) -> Tensor:
    """Squared position errors [m²] of a repaired model in the rows that a diagnosis counted, unknown frames fitted."""
    here, measured, white = said.analysis.situation, said.analysis.measured, said.analysis.whitening
    unknown = getattr(here.mechanism, "unknown_frames", ())
    # One replicate is one group of rows, whose frames are the same in all of them.
    values = here.mechanism.resolve(here.parameters)
    values = values if values.dim() == 1 else values[0]
    if repair.nominal is not None and repair.values is not None:
        frames = dict(zip((g.name for g in here.mechanism.geometry), values.unbind(-1), strict=True))
        here = replace(here, mechanism=repair.nominal, parameters=None)
        # Of an arm's positions the machine is corrected as a whole.
        unseen = len(here.mechanism.pose) - measured.shape[-1]
        measured = torch.cat([measured, torch.full((len(measured), unseen), torch.nan, dtype=measured.dtype)], -1)
        start = dict(zip((g.name for g in here.mechanism.geometry), repair.values, strict=True))
        start |= {n: v for n, v in frames.items() if n.partition("_")[0] in unknown}
        values = torch.stack([*start.values()], -1)
    loose = [k for k, g in enumerate(here.mechanism.geometry) if g.name.partition("_")[0] in unknown]
    counted, acting = white.counted & ~said.analysis.near_singular, repair.acting

    def error(at: Tensor) -> Tensor:
        return white(remainder(here, measured, acting, at))[counted].nan_to_num().flatten()

    for _ in range(_STEPS if loose else 0):
        columns = white(moved(here, acting, values).parameter_jacobian[..., loose])[counted].nan_to_num()
        step = torch.zeros_like(values)
        step[..., loose] = torch.linalg.lstsq(columns.flatten(0, 1), error(values), driver="gelsd").solution
        # Where rows hardly show a frame, a whole step may lead far away.
        tries = [values + share * step for share in (1.0, 0.3, 0.1, 0.0)]
        values = min(tries, key=lambda at: float(error(at).square().sum()))
    return remainder(here, measured, acting, values)[counted, :3].square().sum(-1)


def halves(lines: Sequence[str], seed: int) -> dict[str, list[str]]:
    """Two halves of a file, in blocks of rows drawn at random."""
    header, *rows = lines
    blocks = np.array_split(np.arange(len(rows)), max(2, len(rows) // BLOCK))
    order = np.random.default_rng(seed).permutation(len(blocks))
    chosen = [sorted(order[i::2][: MOST // BLOCK]) for i in (0, 1)]
    return {f"half {i + 1}": [header, *(rows[k] for b in mine for k in blocks[b])] for i, mine in enumerate(chosen)}


def _by(lines: Sequence[str], word: str, where: Mapping[str, str]) -> dict[str, list[str]]:
    """The rows of each value of a column, among those that have these values in others."""
    header, *rows = lines
    names = [name.partition("[")[0] for name in header.split(",")]
    found: dict[str, list[str]] = {}
    for row in rows:
        cells = dict(zip(names, row.split(","), strict=True))
        if all(cells[name] == value for name, value in where.items()):
            found.setdefault(f"{word} {cells[word]}", [header]).append(row)
    return found


def _lines(path: Path) -> list[str]:
    if not path.is_file():
        raise InputError(f"{path}: there is no such file; CCNN_MEASURED is the folder that holds ur10_a and the like")
    return path.read_text(encoding="utf-8").splitlines()


def machines(folder: Path | None, seed: int) -> dict[str, Callable[[], Machine]]:
    """Machines with replicates, by name; folder: of what is not in the repository; seed: of halves."""

    def halved(name: str, mechanism: Path, records: Path) -> tuple[str, Callable[[], Machine]]:
        return name, lambda: Machine(name, mechanism, False, halves(_lines(records), seed))

    found = [
        halved("UR10, series b", _DATA / "ur10.yaml", _DATA / "ur10_b_500.csv"),
        halved("UR5", _DATA / "ur5.yaml", _DATA / "ur5.csv"),
        halved("WAM", _DATA / "wam.yaml", _DATA / "wam.csv"),
    ]
    if folder is None:
        return dict(found)
    series = {f"series {x}": folder / f"ur10_{x}" / "records.csv" for x in "ab"}
    found.append(halved("UR10, series a", _DATA / "ur10.yaml", series["series a"]))

    def days() -> Machine:
        drawn = {name: halves(_lines(path), seed)["half 1"] for name, path in series.items()}
        return Machine("UR10", _DATA / "ur10.yaml", True, drawn)

    def nights() -> Machine:
        sky = folder / "mmt_telescope"
        every = {n: _lines(sky / f"mmt_{n}.csv") for n in ("20210821", "20230702", "20230924")}
        return Machine("MMT telescope", sky / "nominal.yaml", True, every)

    def placed(name: str, of: str, where: Mapping[str, str]) -> tuple[str, Callable[[], Machine]]:
        lines, nominal = folder / of / "records.csv", folder / of / "nominal.yaml"
        return name, lambda: Machine(name, nominal, True, _by(_lines(lines), "placement", where))

    found += [("UR10", days), ("MMT telescope", nights), placed("KUKA iiwa", "kuka_mukca", {})]
    found += [placed(f"Panda {robot}", "panda_mukca", {"robot": robot}) for robot in "136"]
    camera = folder / "panda_camera"
    found.append(halved("Panda, camera", camera / "nominal.yaml", camera / "records.csv"))
    return dict(found)


def row(machine: str, labels: Sequence[str], pair: Pair) -> tuple[str, ...]:
    """A line of the table."""
    said = [" + ".join(sorted(names)) or "nothing" for names in pair.names]
    beside = [(pair.other_shape, "other period"), (pair.alone, "told by one")]
    more = "".join(f", {count} {what}" for count, what in beside if count)
    left = {way: "–" if value != value else f"{float(f'{1e6 * value:.3g}'):g}" for way, value in pair.left.items()}
    return (
        f"{machine}, {' / '.join(labels)}",
        said[0] if said[0] == said[1] else " / ".join(said),
        " / ".join("–" if p != p else f"{p:.2f}" for p in pair.probability),
        "yes" if pair.same else "no",
        (f"{sum(pair.agree.values())} of {len(pair.agree)}" if pair.agree else "–") + more,
        f"{left['bare']}, {left['promised']}",
        f"{left['told']} → {left['told crossed']}",
        f"{left['machine']} → {left['machine crossed']}",
    )


def summary(pairs: Sequence[Pair]) -> dict[str, Block]:
    """Shares of pairs and of numbers, each with its 95 % interval."""
    numbers = [fine for pair in pairs for fine in pair.agree.values()]
    other = sum(pair.other_shape for pair in pairs)
    # Nothing is crossed where nothing is named.
    named = [p.left for p in pairs if p.left["bare"] == p.left["bare"] and any({*n} - {"outside"} for n in p.names)]
    return {
        "pairs with the same names": share(p.same for p in pairs if "refused" not in p.names[0] + p.names[1]),
        "numbers within the joint 95 % interval": share(numbers),
        "numbers of the same period": share([True] * len(numbers) + [False] * other),
        "numbers told, better than none in the other's rows": share(x["told crossed"] < x["bare"] for x in named),
        "machine, better than none in the other's rows": share(x["machine crossed"] < x["bare"] for x in named),
        "machine crossed within 1.2 of its own": share(x["machine crossed"] <= KEPT * x["machine"] for x in named),
    }


def main() -> None:
    """Compare the replicates of all machines, or of those whose name holds a word."""
    options = argparse.ArgumentParser(prog="python -m ccnn_validation.replicates", description=__doc__)
    options.add_argument("--only", default="", help="machines whose name holds this")
    options.add_argument("--seed", type=int, default=0, help="of the halves")
    options.add_argument("--out", type=Path, help="a CSV of the table")
    given = options.parse_args()
    folder = os.environ.get("CCNN_MEASURED")
    rows, pairs = [], []
    for name, make in machines(Path(folder) if folder else None, given.seed).items():
        if given.only.lower() not in name.lower():
            continue
        machine = make()
        said = {label: diagnosed(lines, machine.mechanism) for label, lines in machine.replicates.items()}
        for labels in pairwise(said):
            pairs.append(compared(said[labels[0]], said[labels[1]], machine.apart))
            rows.append(row(name, labels, pairs[-1]))
            print("\n  ".join([rows[-1][0], *map(": ".join, zip(HEADER[1:], rows[-1][1:], strict=True))]), flush=True)
            print(f"  beside: {', '.join(n for n, fine in pairs[-1].agree.items() if not fine) or '–'}", flush=True)
    for name, block in summary(pairs).items():
        if block["of"]:
            print(f"{name}: {block['count']} of {block['of']} [{block['low']:.2f}, {block['high']:.2f}]")
    if given.out:
        with open(given.out, "w", encoding="utf-8", newline="") as file:
            csv.writer(file, lineterminator="\n").writerows([HEADER, *rows])


if __name__ == "__main__":
    main()
