"""Conventions of a serial arm's links: their parameters, transforms, and what each parameter moves."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from ccnn_torch.coordinates import Parameter
from ccnn_torch.errors import InputError
from ccnn_torch.numerics.batching import stack_last
from ccnn_torch.numerics.rotations import (
    euler_zyx_to_matrix,
    matrix_to_euler_zyx,
    matrix_to_rotation_vector,
    rotation_vector_to_matrix,
)

# Sine of the angle between axes below which they count as parallel: Denavit-Hartenberg parameters of axes at a degree
# are as good as undetermined.
_PARALLEL = 0.02
# Plausible share by which a drive moves another joint, or its own too far: that of a gear or a scale.
_DRIVE = 1e-3
Transform = tuple[Tensor, Tensor]
LinkTransform = Callable[[Tensor, Tensor, Tensor, Tensor], tuple[Tensor, Tensor]]


def _standard(links: Tensor, turn: Tensor, slide: Tensor, axes: Tensor) -> tuple[Tensor, Tensor]:
    """Rz(q + theta) Tz(d) Tx(a) Rx(alpha) (Denavit and Hartenberg 1955); links `... x n x 4` = a, alpha, d, theta."""
    a, alpha, d, theta = links.unbind(-1)
    s, c, sa, ca = torch.sin(turn + theta), torch.cos(turn + theta), torch.sin(alpha), torch.cos(alpha)
    zero = torch.zeros_like(s)
    rotation = stack_last(c, -s * ca, s * sa, s, c * ca, -c * sa, zero, sa, ca)
    return rotation.reshape(*rotation.shape[:-1], 3, 3), stack_last(a * c, a * s, d + slide)


def _modified(links: Tensor, turn: Tensor, slide: Tensor, axes: Tensor) -> tuple[Tensor, Tensor]:
    """Rx(alpha) Tx(a) Rz(q + theta) Tz(d) (Craig 1986); links `... x n x 4` = a, alpha, d, theta."""
    a, alpha, d, theta = links.unbind(-1)
    s, c, sa, ca = torch.sin(turn + theta), torch.cos(turn + theta), torch.sin(alpha), torch.cos(alpha)
    zero = torch.zeros_like(s)
    rotation = stack_last(c, -s, zero, s * ca, c * ca, -sa, s * sa, c * sa, ca)
    return rotation.reshape(*rotation.shape[:-1], 3, 3), stack_last(a, -sa * (d + slide), ca * (d + slide))


def _origin(links: Tensor, turn: Tensor, slide: Tensor, axes: Tensor) -> tuple[Tensor, Tensor]:
    """URDF: a fixed origin, then the motion about or along an axis; links `... x n x 6` = x, y, z, roll, pitch, yaw."""
    fixed = euler_zyx_to_matrix(links[..., 3:].flip(-1))
    motion = rotation_vector_to_matrix(axes * turn[..., None])
    slid = (fixed @ (axes * slide[..., None])[..., None])[..., 0]
    return fixed @ motion, links[..., :3] + slid


Screws = tuple[Tensor, Tensor]
Frames = tuple[Tensor, Tensor]


def _standard_screws(links: Tensor, before: Frames, after: Frames, tip: Tensor, lean: Tensor) -> Screws:
    """Of theta and d about and along z of the frame before, of a and alpha along and about x of the frame after, as it
    is without the lean."""
    z, x = before[0][..., 2], _along_x(after[0], -lean)
    parts = [_shift(x), _turn(x, after[1], tip), _shift(z), _turn(z, before[1], tip)]
    return torch.stack([p[0] for p in parts], -2), torch.stack([p[1] for p in parts], -2)


def _modified_screws(links: Tensor, before: Frames, after: Frames, tip: Tensor, lean: Tensor) -> Screws:
    """Of alpha and a about and along x of the frame before, as it leans, of theta and d about and along z of the frame
    after."""
    x, z = _along_x(before[0], lean), after[0][..., 2]
    parts = [_shift(x), _turn(x, before[1], tip), _shift(z), _turn(z, after[1], tip)]
    return torch.stack([p[0] for p in parts], -2), torch.stack([p[1] for p in parts], -2)


def _origin_screws(links: Tensor, before: Frames, after: Frames, tip: Tensor, lean: Tensor) -> Screws:
    """Of x, y, z along the axes of the frame before, of roll, pitch and yaw about the origin that they lead to."""
    rotation, place = before
    origin = place + (rotation @ links[..., :3, None])[..., 0]
    pitch, yaw = links[..., 4:].unbind(-1)
    s, c, sp, cp = torch.sin(yaw), torch.cos(yaw), torch.sin(pitch), torch.cos(pitch)
    zero, one = torch.zeros_like(s), torch.ones_like(s)
    local = stack_last(c * cp, s * cp, -sp, -s, c, zero, zero, zero, one).reshape(*s.shape, 3, 3)
    axes = (rotation @ local.mT).mT
    slides = rotation.mT.expand(*axes.shape)
    lever = (tip - origin)[..., None, :].expand(axes.shape)
    turns = torch.linalg.cross(axes, lever, dim=-1)
    return torch.cat([slides, turns], -2), torch.cat([torch.zeros_like(axes), axes], -2)


def lean_screws(frames: Frames, tip: Tensor) -> Screws:
    """Of the lean of each link about y of the frame beside it."""
    return _turn(frames[0][..., 1], frames[1], tip)


def _along_x(frame: Tensor, lean: Tensor) -> Tensor:
    """The x axis, `... x 3`, of a frame `... x 3 x 3` that is turned about its y axis by `...` [rad]."""
    return frame[..., 0] * lean.cos()[..., None] - frame[..., 2] * lean.sin()[..., None]


def _shift(axis: Tensor) -> Screws:
    return axis, torch.zeros_like(axis)


def _turn(axis: Tensor, place: Tensor, tip: Tensor) -> Screws:
    return torch.linalg.cross(axis, tip - place, dim=-1), axis


SCREWS: dict[str, Callable[[Tensor, Frames, Frames, Tensor, Tensor], Screws]] = {
    "standard": _standard_screws,
    "modified": _modified_screws,
    "urdf": _origin_screws,
}
"""Convention -> velocity of a tip `... x n x 3` and rate of rotation by each parameter of each link, `... x n x k x 3`
each, in the arm's base: from links `... x n x k`, the frames before and after each (rotation `... x n x 3 x 3`, place
`... x n x 3`), the tip and the leans of the links `... x n`."""

# Transform, parameter names of a link, their units, and whether the joint axis is fixed in the frame before the link
# (standard DH: z of frame i - 1) or in the one behind it.
LINKS: dict[str, tuple[LinkTransform, tuple[str, ...], tuple[str, ...], bool]] = {
    "standard": (_standard, ("a", "alpha", "d", "theta"), ("m", "rad", "m", "rad"), True),
    "modified": (_modified, ("a", "alpha", "d", "theta"), ("m", "rad", "m", "rad"), False),
    "urdf": (_origin, ("x", "y", "z", "roll", "pitch", "yaw"), ("m", "m", "m", "rad", "rad", "rad"), False),
}


def transform_of(frame: Tensor) -> tuple[Tensor, Tensor]:
    """Rotation and translation of a frame's position and rotation vector, `... x 6` [m, rad]."""
    return rotation_vector_to_matrix(frame[..., 3:]), frame[..., :3]


def compose(first: tuple[Tensor, Tensor], second: tuple[Tensor, Tensor]) -> tuple[Tensor, Tensor]:
    """Product of two transforms, each (rotation `... x 3 x 3`, translation `... x 3`)."""
    rotation, translation = first
    return rotation @ second[0], translation + (rotation @ second[1][..., None])[..., 0]


def parallel_to_next(convention: str, links: Sequence[Sequence[float]], groups: Sequence[Sequence[int]]) -> list[int]:
    """Links (from 1) of a Denavit-Hartenberg table between joints whose axes are parallel by it, or are said to be.

    Four parameters cannot tilt such an axis against the other about the direction across both (Hayati 1983).

    groups: of joints (from 1) with parallel axes.
    """
    first = 0 if convention == "standard" else 1
    near = {i for i in range(first, len(links) - 1 + first) if abs(math.sin(links[i][1])) < _PARALLEL}
    told = {min(i, j) - 1 + first for group in groups for i in group for j in group if abs(i - j) == 1}
    return [i + 1 for i in sorted(near | told)]


MOUNT = ({"alpha": "NPAE", "theta": "IA"}, {"d": "CA", "theta": "IE"})
"""What astronomers call the parameters of the two links of a mount: axes that are not square, zero of the first joint,
collimation (over the length of the tube), zero of the second joint."""


def links_and_drives(
    convention: str,
    links: Sequence[Sequence[float]],
    joint_units: Sequence[str],
    drives: Sequence[Sequence[int]],
    leans: Sequence[Sequence[float]],
    directions: bool,
) -> list[Parameter]:
    """Parameters of the links, then of their leans, then of the drives; directions: whether it only points."""
    _, names, units, _ = LINKS[convention]
    senses = [{"theta": f"zero of joint {i}"} if unit == "rad" else {} for i, unit in enumerate(joint_units, 1)]
    found = []
    for i, (row, usual) in enumerate(zip(links, senses, strict=True)):
        sense = MOUNT[i] if directions and len(links) == len(MOUNT) else usual
        found += [
            Parameter(f"{p}{i + 1}", u, v, sense=sense.get(p, "")) for p, u, v in zip(names, units, row, strict=True)
        ]
    for link, lean in leans:
        i = int(link)
        first = i if convention == "standard" else i - 1
        found.append(Parameter(f"beta{i}", "rad", lean, sense=f"lean of axis {first + 1} against axis {first}"))
    for i, j in drives:
        to, by = joint_units[i - 1], joint_units[j - 1]
        found.append(Parameter(f"drive{i}{j}", "1" if to == by else f"{to}/{by}", 0.0, scale=_DRIVE))
    return found


def start_and_shares(own: Sequence[Parameter], numbers: Sequence[Mapping[str, Any]]) -> tuple[Tensor, Tensor]:
    """Parameters `l` without the numbers [SI], and what one unit of each number adds to them, `k x l`."""
    names = [p.name for p in own]
    shares = torch.zeros(len(numbers), len(own), dtype=torch.float64)
    for row, number in zip(shares, numbers, strict=True):
        for name, share in number["of"].items():
            row[names.index(name)] = share
    return torch.tensor([p.nominal for p in own], dtype=torch.float64), shares


def counting(convention: str, count: int, directions: bool) -> Tensor:
    """Which of the parameters of each link count, `n x k`: to directions of lengths those behind the last axis."""
    _, names, units, _ = LINKS[convention]
    found = torch.ones(count, len(names), dtype=torch.float64)
    if directions:
        behind = {"standard": ("a", "d"), "modified": ("d",), "urdf": ()}[convention]
        found[:, [k for k, unit in enumerate(units) if unit == "m"]] = 0.0
        found[-1, [k for k, p in enumerate(names) if p in behind]] = 1.0
    return found


def weighing(arm: str, masses: Sequence[float], centres: Sequence[Sequence[float]], count: int) -> dict[str, Tensor]:
    """Masses of an arm's links and their centres, NaN where these are not told."""
    if masses and not (len(masses) == count and min(masses) >= 0 < sum(masses) < math.inf):
        raise InputError(f"arm '{arm}': masses are {count} numbers [kg] of at least 0, one of them above")
    if centres and not (len(centres) == count and all(len(centre) in (0, 3) for centre in centres)):
        raise InputError(f"arm '{arm}': centres are {count} times x, y, z [m], or nothing")
    told = [list(centre) or [math.nan] * 3 for centre in centres or [()] * count]
    named = {"masses": masses, "_centres": told}
    return {key: torch.tensor(values, dtype=torch.float64) for key, values in named.items()}


class LinkFrames(NamedTuple):
    """Links with six parameters each, in the URDF form: `links` `n x 6` [m, rad]; `centres` of mass of these, [] where
    unknown; `last`, the constant part of the last one, which is behind its joint."""

    links: list[list[float]]
    centres: list[list[float]]
    last: Transform

    def from_last(self, frame: Tensor) -> list[float]:
        """A tool frame of the table, `6` [m, rad], as one behind the last joint."""
        turn, place = compose(self.last, transform_of(frame))
        return [*place.tolist(), *matrix_to_rotation_vector(turn).tolist()]


def link_frames_of(transforms: Transform, centres: Tensor, axis_before: bool) -> LinkFrames:
    """Of a table's links in their zero: rotations `n x 3 x 3` and places `n x 3` [m] from each to the one before.

    centres: of mass, each in the frame at its link's end, `n x 3` [m]; axis_before: whether a joint moves before its
    link's transform.
    """
    rotations, places = transforms
    links = torch.cat([places, matrix_to_euler_zyx(rotations).flip(-1)], dim=-1)
    last = torch.eye(3, dtype=torch.float64), torch.zeros(3, dtype=torch.float64)
    if axis_before:
        centres = (rotations @ centres.unsqueeze(-1)).squeeze(-1) + places
        links = torch.cat([torch.zeros_like(links[:1]), links[:-1]])
        last = rotations[-1], places[-1]
    return LinkFrames(links.tolist(), [[] if math.isnan(one[0]) else one for one in centres.tolist()], last)
