"""The kinds of machines, and one of them drawn from a seed."""

from __future__ import annotations

import zlib
from collections.abc import Callable, Mapping
from functools import partial
from types import MappingProxyType

import numpy as np

from ccnn_validation.delivered.arm_files import dh_chain, dh_text, urdf_text
from ccnn_validation.delivered.arms import arm
from ccnn_validation.delivered.chain import Chain, place
from ccnn_validation.delivered.machine import Block, Files, Machine, Model
from ccnn_validation.delivered.parallel import delta_pose, five_bar_pose, hexagon, leg_lengths, stewart_pose
from ccnn_validation.delivered.rotation import Array

_LIMITS = 1.8
"""A URDF's limits: so many half ranges of the measured box from its middle."""
_LENGTH, _ANGLE, _GAIN = 3e-4, 5e-4, 3e-4
"""Standard deviations of a parallel machine's errors [m], [rad], [1]."""
_Draw = tuple[str, int, np.random.Generator, tuple[str, ...] | None]


def draw(kind: str, seed: int, extras: tuple[str, ...] | None = None) -> Machine:
    """The machine of a kind and a seed; the same for the same arguments.

    Args:
        kind: one of `KINDS`.
        seed: of all its numbers.
        extras: what an open chain has beside geometry, zeros and gears; None = drawn.

    Raises:
        KeyError: there is no such kind.
    """
    make = KINDS[kind]
    return make((kind, seed, np.random.default_rng([seed, zlib.crc32(kind.encode())]), extras))


def _noise(rng: np.random.Generator) -> tuple[float, float]:
    return float(np.exp(rng.uniform(*np.log([1e-5, 5e-5])))), 5e-5


def _extras(rng: np.random.Generator, possible: tuple[str, ...]) -> tuple[str, ...]:
    """Each in three of ten machines, sag and a payload never together."""
    drawn = [name for name, share in zip(possible, rng.random(len(possible)), strict=True) if share < 0.3]
    return tuple(name for name in drawn if not (name == "payload" and "sag" in drawn))


def _open(
    what: _Draw,
    chain: Chain,
    files: Files | None,
    box: list[tuple[float, float]],
    wrist: int,
    tool: float,
    possible: tuple[str, ...] = ("sag", "payload", "backlash", "thermal"),
) -> Machine:
    """An open chain whose box is given in degrees, or metres of a sliding joint."""
    kind, seed, rng, extras = what
    scale = np.array([np.pi / 180 if unit == "rad" else 1.0 for unit in chain.units])
    low, high = np.array(box).T * scale
    middle, half = (low + high) / 2, _LIMITS * (high - low) / 2
    files = files or Files("arm.urdf", {}, urdf_text(kind, chain, middle - half, middle + half))
    drawn = _extras(rng, possible)
    return arm(
        kind, seed, rng, chain, files, (low, high), wrist, tool, drawn if extras is None else extras, _noise(rng)
    )


def _wrist(rng: np.random.Generator) -> tuple[float, float]:
    """Range of a wrist's joint [deg]: through its singular pose, or away from it."""
    return (-80, 80) if rng.random() < 0.5 else (15, 100)


def _spherical(what: _Draw, sizes: tuple[float, ...], tool: float) -> Machine:
    """Six axes whose last three meet in a point: heights and lengths [m]."""
    pedestal, offset, upper, elbow, fore, hand = sizes
    origins = (
        place([0, 0, pedestal]),
        place([offset, 0, 0]),
        place([upper, 0, 0]),
        place([fore, 0, elbow]),
        place([0, 0, 0]),
        place([hand, 0, 0]),
    )
    axes = np.array([[0, 0, -1], [0, 1, 0], [0, 1, 0], [-1, 0, 0], [0, 1, 0], [-1, 0, 0]], float)
    chain = Chain(origins, axes, ("rad",) * 6, place([0, 0, 0]))
    box = [(-60, 60), (-80, -20), (20, 100), (-100, 100), _wrist(what[2]), (-120, 120)]
    return _open(what, chain, None, box, 4, tool)


def _offset(what: _Draw) -> Machine:
    """Six axes with an offset wrist, told as a Denavit-Hartenberg table."""
    a = [0, -0.425, -0.392, 0, 0, 0]
    alpha = [np.pi / 2, 0, 0, np.pi / 2, -np.pi / 2, 0]
    d = [0.089, 0, 0, 0.109, 0.095, 0.082]
    box = [(-90, 90), (-70, -20), (35, 110), (-150, -30), _wrist(what[2]), (-120, 120)]
    files = Files("arm.yaml", {}, dh_text(what[0], a, alpha, d))
    return _open(what, dh_chain(a, alpha, d), files, box, 4, 0.1)


def _scara(what: _Draw) -> Machine:
    origins = (place([0, 0, 0.38]), place([0.35, 0, 0]), place([0.3, 0, -0.05]), place([0, 0, 0]))
    axes = np.array([[0, 0, 1], [0, 0, 1], [0, 0, -1], [0, 0, 1]], float)
    chain = Chain(origins, axes, ("rad", "rad", "m", "rad"), place([0, 0, -0.02], [np.pi, 0, 0]))
    box = [(-100, 100), (15, 130), (0.02, 0.18), (-170, 170)]
    return _open(what, chain, None, box, 1, 0.05, ("backlash", "thermal"))


def _five_axis(what: _Draw) -> Machine:
    """Three slides that carry a fork head: C about z, then A about x."""
    origins = (place([0, 0, 0.5]), place([0.1, 0, 0]), place([0, 0.1, 0]), place([0, 0, -0.1]), place([0, 0, -0.12]))
    axes = np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [0, 0, 1], [1, 0, 0]], float)
    chain = Chain(origins, axes, ("m", "m", "m", "rad", "rad"), place([0, 0, -0.1], [np.pi, 0, 0]))
    box = [(0.0, 0.8), (0.0, 0.6), (-0.2, 0.3), (-160, 160), (-80, 80) if what[2].random() < 0.5 else (10, 90)]
    return _open(what, chain, None, box, 4, 0.15, ("backlash", "thermal"))


def _seven(what: _Draw) -> Machine:
    heights = (0.16, 0.2, 0.2, 0.22, 0.19, 0.21, 0.0)
    axes = np.array([[0, 0, 1], [0, 1, 0], [0, 0, 1], [0, -1, 0], [0, 0, 1], [0, 1, 0], [0, 0, 1]], float)
    chain = Chain(tuple(place([0, 0, h]) for h in heights), axes, ("rad",) * 7, place([0, 0, 0.126]))
    box = [(-90, 90), (-10, 80), (-60, 60), (-110, -30), (-90, 90), _wrist(what[2]), (-150, 150)]
    return _open(what, chain, None, box, 5, 0.08)


def _parallel(
    what: _Draw,
    unit: str,
    box: tuple[Array, Array],
    sizes: Mapping[str, tuple[Array, float]],
    pose: Model,
    files: Files,
) -> Machine:
    """A parallel machine, measured in its own base: sizes are nominal value and standard deviation of its error."""
    kind, seed, rng, _ = what
    blocks = []
    for name, (nominal, spread) in sizes.items():
        true = nominal + rng.normal(0, spread, nominal.shape)
        blocks.append(Block(name, nominal, true, np.full(nominal.shape, 2 * spread), nominal))
    units = (unit,) * len(box[0])
    return Machine(kind, seed, (), units, *box, None, tuple(blocks), pose, _noise(rng), files)


def _delta(what: _Draw) -> Machine:
    keys = {"base": 0.2, "crank": 0.25, "platform": 0.05, "rod": 0.6}
    sizes = {name: (np.full(3, value), _LENGTH) for name, value in keys.items()}
    sizes["angle"] = (np.array([0, 2, 4]) * np.pi / 3, _ANGLE)
    sizes |= {"offset": (np.zeros(3), 2 * _ANGLE), "gain": (np.ones(3), _GAIN)}
    return _parallel(what, "rad", (np.full(3, -0.1), np.full(3, 0.8)), sizes, delta_pose, Files("delta", keys, None))


def _stewart(what: _Draw) -> Machine:
    keys = {"base_radius": 0.4, "platform_radius": 0.25, "base_spread": 0.2, "platform_spread": 0.25, "height": 0.5}
    base, platform = hexagon(0.4, 0.2, False), hexagon(0.25, 0.25, True)
    home = np.array([0, 0, 0.5])
    length = leg_lengths(base, platform, home[None], np.eye(3)[None])[0]
    sizes = {
        "base": (base, _LENGTH),
        "platform": (platform, _LENGTH),
        "offset": (np.zeros(6), _LENGTH),
        "gain": (np.ones(6), _GAIN),
    }
    box = (length - 0.04, length + 0.04)
    return _parallel(what, "m", box, sizes, partial(stewart_pose, home), Files("stewart", keys, None))


def _five_bar(what: _Draw) -> Machine:
    keys = {"l": 0.3, "L": 0.45, "a": 0.2}
    sizes = {
        "crank": (np.full(2, keys["l"]), _LENGTH),
        "coupler": (np.full(2, keys["L"]), _LENGTH),
        "foot": (np.array([[-keys["a"], 0], [keys["a"], 0]]), _LENGTH),
        "gain": (np.ones(2), _GAIN),
        "offset": (np.zeros(2), 2 * _ANGLE),
    }
    box = (np.array([1.6, 0.7]), np.array([2.44, 1.54]))
    return _parallel(what, "rad", box, sizes, five_bar_pose, Files("five_bar", keys, None))


KINDS: Mapping[str, Callable[[_Draw], Machine]] = MappingProxyType(
    {
        "spherical": partial(_spherical, sizes=(0.4, 0.025, 0.455, 0.035, 0.42, 0.08), tool=0.1),
        "offset": _offset,
        "large": partial(_spherical, sizes=(0.75, 0.35, 1.15, -0.041, 1.2, 0.215), tool=0.3),
        "scara": _scara,
        "five_axis": _five_axis,
        "seven": _seven,
        "delta": _delta,
        "stewart": _stewart,
        "five_bar": _five_bar,
    }
)
