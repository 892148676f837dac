"""A tracker measures the repaired machine; the diagnosis judges it by the model before the repair."""

from __future__ import annotations

import re
import time
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from ccnn_torch import diagnose, load_mechanism, load_records
from ccnn_torch.diagnosis.page.data import About
from ccnn_torch.diagnosis.page.first_screen import ON_SCREEN, first_screen
from ccnn_torch.errors import InputError
from ccnn_validation.delivered.arm_files import urdf_text
from ccnn_validation.delivered.chain import Chain, chain_pose
from ccnn_validation.delivered.rotation import Array, difference
from ccnn_validation.repairs.arms import COLUMNS, Repair, chain_of, numbers

ROWS, NEW_ROWS = 60, 300
LENGTH_NOISE, ANGLE_NOISE = 5e-5, 1e-4
"""Of the tracker, one standard deviation [m, rad]."""
BASE = np.array([1.2, -0.8, 0.4, 0.02, -0.01, 2.1])
"""Where the arm stands before the tracker: position [m] and rotation vector [rad]."""
KEPT = 1.2
"""Times what a verdict promises that its numbers may leave when they are typed in."""
_VISIBLE = 3 * LENGTH_NOISE
_FRAME = np.zeros(6)
_UNITS = {
    "m": 1e3,
    "mm": 1.0,
    "µm": 1e-3,
    "nm": 1e-6,
    "°": 1.0,
    "rad": 180 / np.pi,
    "mrad": 0.18 / np.pi,
    "µrad": 1.8e-4 / np.pi,
}


@dataclass
class Replay:
    """What the diagnosis said of a repaired machine, and what its numbers are worth.

    Attributes:
        repair: what was replayed.
        said: what is wrong, as the screen says, or the sentence of a refusal.
        refused: whether that is one.
        content: as in diagnosis.json; empty after a refusal.
        shown: number, error found, 95 % and what to enter, as the screen has them.
        before, typed: median position error of the model [mm], in frames fitted anew, before the repair and with what
            the screen shows typed in.
        kept: RMS position error of new measured poses after typing, over what the verdict promises.
        seconds: of the diagnosis.
        frames: what the screen says of the fitted base and tool.
    """

    repair: Repair
    said: str = ""
    refused: bool = False
    content: dict[str, Any] = field(default_factory=dict)
    shown: list[tuple[str, ...]] = field(default_factory=list)
    before: float = float("nan")
    typed: float = float("nan")
    kept: float = float("nan")
    seconds: float = 0.0
    frames: str = ""

    @property
    def outcome(self) -> str:
        """`same numbers` as people changed, `same motion` by others, `in the frames`, `told` by a refusal, or `no`."""
        if self.refused:
            return "told" if 1e-3 * self.typed < _VISIBLE else "no"
        if 1e-3 * self.before < _VISIBLE:
            return "in the frames" if self.content["verdict"]["none"] else "no"
        if not self.kept <= KEPT:
            return "no"
        return "same numbers" if all(_is_the_repair(self.repair, row) for row in self.shown) else "same motion"


def replayed(repair: Repair, folder: Path, seed: int = 0) -> Replay:
    """The verdict on a repaired machine, and what its numbers are worth.

    Args:
        repair: the repair.
        folder: for the model and the rows.
        seed: of the joints and the noise.
    """
    rng = np.random.default_rng(seed)
    old, truth = numbers(repair, False), chain_of(numbers(repair, True))
    found = Replay(repair)
    joints, fresh = drawn_joints(old, ROWS, rng), drawn_joints(old, NEW_ROWS, rng)
    rows, noisy, clean = measured(truth, joints, rng), measured(truth, fresh, rng), measured(truth, fresh, None)
    model, records = folder / "arm.urdf", folder / "rows.csv"
    low, high = np.radians(old[:-1, 9:11]).T
    with warnings.catch_warnings():
        # A pitch of 90° leaves roll and yaw free.
        warnings.simplefilter("ignore", UserWarning)
        model.write_text(urdf_text("arm", chain_of(old), low, high))
    names = [f"q{i + 1}[rad]" for i in range(len(low))]
    header = ",".join([*names, *(f"{n}[m]" for n in "xyz"), *(f"r{n}[rad]" for n in "xyz")])
    table = np.c_[joints, rows[1], Rotation.from_matrix(rows[2]).as_rotvec()]
    np.savetxt(records, table, "%.9f", ",", header=header, comments="")
    found.before = median(chain_of(old), clean)
    noise = dict.fromkeys(("x", "y", "z"), LENGTH_NOISE) | dict.fromkeys(("rx", "ry", "rz"), ANGLE_NOISE)
    mechanism, start = load_mechanism(str(model)), time.perf_counter()
    try:
        said = diagnose(load_records(records, mechanism), mechanism, noise=noise, seed=seed)
    except InputError as error:
        found.said, found.refused = str(error).removeprefix(f"{records}: "), True
        signs, offsets = counted(found.said, len(low))
        found.typed = median(chain_of(old), (signs * fresh + offsets, *clean[1:]))
        return found
    finally:
        found.seconds = time.perf_counter() - start
    found.content = dict(said.to_json())
    screen = first_screen(found.content, About(), ON_SCREEN)
    found.said = screen[0].text
    found.frames = next((answer.text for answer in screen if answer.label == "Fitted frames"), "")
    found.shown = [tuple(row) for answer in screen if answer.table is not None for row in answer.table.rows]
    chain, offsets = typed_in(old, found.shown)
    found.typed = median(chain, (fresh + offsets, *clean[1:]))
    fitted = frames(chain, (joints + offsets, *rows[1:]))
    gone = errors(chain, (fresh + offsets, *noisy[1:]), fitted)
    found.kept = float(np.sqrt((gone**2).sum(1).mean()) / found.content["gap"]["after"])
    return found


Poses = tuple[Array, Array, Array]
"""Joints `s x n` [rad], positions `s x 3` [m] and orientations `s x 3 x 3`."""


def drawn_joints(table: Array, count: int, rng: np.random.Generator) -> Array:
    """Joints within nine tenths of the limits, `count x n` [rad]."""
    low, high = np.radians(np.clip(table[:-1, 9:11], -180, 180)).T
    middle, reach = (low + high) / 2, 0.45 * (high - low)
    return rng.uniform(middle - reach, middle + reach, (count, len(low)))


def measured(chain: Chain, joints: Array, rng: np.random.Generator | None) -> Poses:
    """Poses of a machine as the tracker has them, or as they are where no random numbers are given."""
    position, rotation = chain_pose(chain, joints, BASE, _FRAME)
    if rng is None:
        return joints, position, rotation
    turn = Rotation.from_rotvec(rng.normal(0, ANGLE_NOISE, position.shape)).as_matrix()
    return joints, position + rng.normal(0, LENGTH_NOISE, position.shape), turn @ rotation


def errors(chain: Chain, rows: Poses, fitted: Array) -> Array:
    """Position errors of a model in a base and a tool frame `12`; `s x 3` [m]."""
    return np.asarray(rows[1] - chain_pose(chain, rows[0], fitted[:6], fitted[6:])[0])


def frames(chain: Chain, rows: Poses) -> Array:
    """Base and tool frame in which a model fits rows best, `12`."""

    def left(values: Array) -> Array:
        turn = difference(chain_pose(chain, rows[0], values[:6], values[6:])[1], rows[2]) / ANGLE_NOISE
        whole: Array = np.r_[(errors(chain, rows, values) / LENGTH_NOISE).ravel(), turn.ravel()]
        return whole

    found: Array = least_squares(left, np.r_[BASE, _FRAME], x_scale="jac").x
    return found


def median(chain: Chain, rows: Poses) -> float:
    """Median position error in frames fitted to the same rows [mm]."""
    return float(1e3 * np.median(np.linalg.norm(errors(chain, rows, frames(chain, rows)), axis=1)))


def counted(said: str, joints: int) -> tuple[Array, Array]:
    """Sign and offset [rad] of each joint, as a refusal tells them."""
    signs, offsets = np.ones(joints), np.zeros(joints)
    for joint, sign, offset, angle in re.findall(r'q(\d+): "(-?)q\d+(?: ([+-]) ([\d.]+) deg)?"', said):
        signs[int(joint) - 1] = -1.0 if sign else 1.0
        offsets[int(joint) - 1] = np.radians(float(offset + angle)) if angle else 0.0
    if alone := re.search(r"joint q(\d+) seems to count in the other direction", said):
        signs[int(alone[1]) - 1] = -1.0
    return signs, offsets


def typed_in(table: Array, shown: Sequence[tuple[str, ...]]) -> tuple[Chain, Array]:
    """The model and its joints' offsets [rad] after what the screen shows was typed in, digit by digit."""
    table, offsets = table.copy(), np.zeros(len(table) - 1)
    for name, error, _, *enter in shown:
        if enter and (cell := _cell(name)) and enter[0] != "–":
            table[cell[0] - 1, COLUMNS.index(cell[1])] = read(enter[0])
        elif joint := re.search(r"joint (\d+)$", name):
            offsets[int(joint[1]) - 1] += np.radians(read(error))
    return chain_of(table), offsets


def read(text: str) -> float:
    """A printed number in mm or °; of `0.01 rad = 0.573°` the last one."""
    number, unit = re.fullmatch(r"(.*= )?(?:± )?(\S+?) ?([a-zµ°]+)", text).group(2, 3)  # type: ignore[union-attr]
    return float(number) * _UNITS[unit]


def _cell(name: str) -> tuple[int, str] | None:
    """Joint and column that a printed name of a link's number means."""
    found = re.search(r"link (\d+) (x|y|z|roll|pitch|yaw)\d+$", name)
    return (int(found[1]), found[2]) if found else None


def _is_the_repair(repair: Repair, row: tuple[str, ...]) -> bool:
    """Whether a number to enter is one that people changed, within its interval."""
    cell, interval = _cell(row[0]), row[2]
    return cell in repair.new and abs(read(row[-1]) - repair.new[cell]) <= read(interval)
