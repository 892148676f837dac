"""A case of the workshop: machine, plan, causes, their strength in units of the noise, and the noise."""

from __future__ import annotations

import zlib
from collections.abc import Callable, Mapping
from itertools import combinations, product

import numpy as np
from scipy.spatial.transform import Rotation

from ccnn_validation.sources.case import SourceCase, Truth
from ccnn_validation.sources.shop.arms import ARMS, arm
from ccnn_validation.sources.shop.box import Gantry
from ccnn_validation.sources.shop.cause import Cause, Random, seen
from ccnn_validation.sources.shop.columns import file_columns, pose_columns
from ccnn_validation.sources.shop.covariates import in_motion, measured_rows
from ccnn_validation.sources.shop.deal import Dealt
from ccnn_validation.sources.shop.library import LIBRARY
from ccnn_validation.sources.shop.machine import Array, Machine, Rows, difference
from ccnn_validation.sources.shop.outside import OUTSIDE
from ccnn_validation.sources.shop.parallel import Delta, FiveBar, Stewart

__all__ = ["built", "machine_of"]

_ARM = 0.4
"""The noise of angles is that of positions over this length [m]."""
_NOISE = (5e-6, 8e-5)
"""Standard deviation of a measured position, lowest and highest [m]."""
_WEAKEST, _STRONGEST, _STRONGEST_OF_TWO = 4.0, 30.0, 20.0
"""Causes in units of the noise."""
_OUTLIER = frozenset({"outlier"})
_BESIDE = {
    "sun": ("frame", "frame_drift"),
    "reclamp": ("tool", "frame", "frame_drift"),
    "clampslip": ("tool", "frame"),
    "loose": ("compliance", "backlash"),
}
"""Names that are no mistake beside "outside the library": the mean of what moves, the slope of what is loose."""
_NAMED_SINCE = {"bump": "frame_drift"}
"""Causes outside the library of the time that these cases were written, and their names in that of today."""
_ENOUGH = {"loose": (frozenset({"backlash"}),)}
"""A loose joint that the load pushes to either side is play."""


def machine_of(name: str, frames: str = "identity") -> Machine:
    """The machine of that name; an arm's frames are told, or `unknown`."""
    if name in ARMS:
        return arm(name, frames)
    if name in ("delta", "delta_linear"):
        return Delta(rails=name == "delta_linear")
    others: dict[str, Callable[[], Machine]] = {"gantry": Gantry, "five_bar": FiveBar, "stewart": Stewart}
    return others[name]()


def built(dealt: Dealt, seed: int, more: Mapping[str, Callable[[Machine, Random], Cause]] | None = None) -> SourceCase:
    """The case that was dealt; more: causes besides those of the workshop."""
    rng = np.random.default_rng([seed, zlib.crc32(dealt.name.encode())])
    first = dealt.causes[0]
    # With frames to be found, these would be no error of the machine.
    known = dealt.machine not in ("painter6", "arm7", "scara") or (
        {"frame", "tool", "bump", "sun", "joint_offset"} & set(dealt.causes)
    )
    machine = machine_of(dealt.machine, "unknown" if not known and rng.random() < 0.4 else "identity")
    free = machine.frames == "unknown"
    full = machine.turns and (rng.random() < 0.6 or free or machine.name == "stewart") and machine.name != "planar3r"
    plan = str(rng.choice(["random", "random", "grid", "cube"]))
    if first in ("transmission", "latency", "geometry", "wear") or dealt.kind == "pair" or free:
        plan = "random"
    count = int(rng.integers(120, 401))
    causes = (
        [{**LIBRARY, **OUTSIDE, **(more or {})}[name](machine, rng) for name in dealt.causes]
        if dealt.kind != "none"
        else []
    )
    needs = [need for cause in causes for need in cause.needs]
    needs += ["temperature", "time"] if first == "tempdrift" else []
    rows = (
        in_motion(machine, count, needs, rng) if "speed" in needs else measured_rows(machine, count, plan, needs, rng)
    )
    for cause in causes:
        rows.columns.update(cause.adds(rows) if cause.adds else {})
    strongest = _STRONGEST_OF_TWO if dealt.kind == "pair" else _STRONGEST
    channels = slice(2) if machine.axes == "xy" else slice(6 if full else 3)
    sigma, strengths = _noise(machine, rows, causes, strongest, channels, rng)
    clean = seen(machine, rows, causes, strengths)
    spread = sigma / np.array([1, 1, 1, _ARM, _ARM, _ARM])
    error = _drawn(first, clean[0], rng) * spread
    place, rotation = clean[0] + error[:, :3], Rotation.from_rotvec(error[:, 3:]).as_matrix() @ clean[1]
    turn, shift = Rotation.identity(), np.zeros(3)
    if free:
        # The tracker stands somewhere, nearly level.
        turn = Rotation.from_rotvec(rng.normal(0, 0.01, 3)) * Rotation.from_euler("z", rng.uniform(-3, 3))
        shift = rng.normal(0, 2, 3)
    given = rng.random() < 0.5
    text, keys = machine.told()
    return SourceCase(
        family={"pair": "pair", "none": f"noise {first}"}.get(dealt.kind, first),
        mechanism=text,
        mechanism_keys=keys,
        columns=file_columns(machine, rows, (turn.apply(place) + shift, turn.as_matrix() @ rotation), turn, full),
        noise={"m": sigma} | ({"rad": float(spread[3])} if full else {}) if given else None,
        truth=_truth(dealt, causes),
        # Free frames take up part of what a cause does; what is left to remove is not known here.
        clean=None if free else pose_columns(machine, clean, full=True),
        noise_kind=first if first in ("t3", "ar1") else "white",
    )


def _noise(
    machine: Machine, rows: Rows, causes: list[Cause], strongest: float, channels: slice, rng: np.random.Generator
) -> tuple[float, list[float]]:
    """Standard deviation of a position [m], and the causes' strengths: each some times the noise, 1/3 to 3 of usual."""
    wanted = [float(np.exp(rng.uniform(np.log(_WEAKEST), np.log(strongest)))) for _ in causes]
    sigma = float(np.exp(rng.uniform(*np.log(_NOISE))))
    if not causes:
        return sigma, []
    nominal, weight = machine.pose(rows.joints), np.array([1, 1, 1, _ARM, _ARM, _ARM])
    gaps = [
        float(np.sqrt(((difference(seen(machine, rows, [c], [1]), nominal) * weight)[:, channels] ** 2).mean()))
        for c in causes
    ]
    sigma = float(np.clip(min(gaps[0] / wanted[0], min(gaps) / 1.2), *_NOISE))
    return sigma, [float(np.clip(w * sigma / gap, 0.33, 3)) for w, gap in zip(wanted, gaps, strict=True)]


def _drawn(kind: str, places: Array, rng: np.random.Generator) -> Array:
    """Noise of unit variance, `s x 6`: white, of heavy tails (`t3`), related from row to row (`ar1`), or with channels
    that share it: all alike (`correlated`), or most of it across the line of sight of a tracker (`range_azimuth`)."""
    rows = len(places)
    noise = rng.standard_normal((rows, 6))
    if kind == "t3":
        return np.asarray(rng.standard_t(3, noise.shape) / np.sqrt(3))
    if kind == "ar1":
        for i in range(1, rows):
            noise[i] = 0.7 * noise[i - 1] + np.sqrt(1 - 0.49) * noise[i]
    if kind == "correlated":
        mixed = rng.normal(size=(3, 3))
        cov = mixed @ mixed.T + 0.05 * np.eye(3)
        noise[:, :3] = noise[:, :3] @ np.linalg.cholesky(cov).T / np.sqrt(np.trace(cov) / 3)
    if kind == "range_azimuth":
        # A tracker 2 to 4 m away: 5 times as good along its line of sight as across it.
        sight = places - places.mean(0) - Rotation.random(random_state=rng).apply([rng.uniform(2, 4), 0, 0])
        sight /= np.linalg.norm(sight, axis=1, keepdims=True)
        along = (noise[:, :3] * sight).sum(1, keepdims=True) * sight
        noise[:, :3] = (noise[:, :3] - 0.8 * along) / np.sqrt((2 + 0.2**2) / 3)
    return noise


def _truth(dealt: Dealt, causes: list[Cause]) -> Truth:
    """What a right answer says; bad rows are no mistake where there is no cause."""
    name = dealt.causes[0]
    if dealt.kind == "none":
        return Truth("none", (), (frozenset(), _OUTLIER), False)
    if name in _NAMED_SINCE:
        return Truth("single", dealt.causes, (frozenset({_NAMED_SINCE[name]}),), False)
    if dealt.kind == "outside":
        beside = _BESIDE.get(name, ())
        accepted = tuple(frozenset(some) for k in range(len(beside) + 1) for some in combinations(beside, k))
        return Truth("outside", dealt.causes, accepted, True, causes[0].answers, enough=_ENOUGH.get(name, ()))
    every = [frozenset(names) for names in product(*(cause.answers for cause in causes))]
    return Truth(dealt.kind, dealt.causes, tuple(n for n in every if len(n) == len(causes)), False)
