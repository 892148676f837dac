"""Instruments: what each reads of the place of the link or tool that holds it, and what is unknown of it."""

from __future__ import annotations

import inspect
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import torch
from torch import Tensor

from ccnn_torch.coordinates import Coordinate, Parameter
from ccnn_torch.errors import InputError
from ccnn_torch.mechanisms.frames.board import board_poses
from ccnn_torch.mechanisms.mechanism import Mechanism
from ccnn_torch.mechanisms.pose import CHANNELS
from ccnn_torch.numerics.batching import expand_leading
from ccnn_torch.numerics.rotations import matrix_to_rotation_vector, rotation_vector_to_matrix
from ccnn_torch.records.commanded import SECOND

# Plausible errors: of a focal length and an image's centre as a share of it, of distortion, of a place that a tape
# measured, of a mounting's turn.
_FOCUS, _DISTORTION, _PLACE, _TURN = 0.01, 0.05, 0.02, 0.05
# No zero of a wire is farther off [m].
_LONGEST = 1.0
PIXEL = 1e-6
"""A pixel counts as this length on the image [m], as columns in px are read."""
# Numbers of a lens.
_LENS = 6
# Rows of an anchor or a plane.
_FEWEST = 4
# Poses from which frames are fitted in closed form.
_POSES = 5
# Nothing is seen nearer to a camera than this [m].
_BEHIND = 1e-3


class Place(NamedTuple):
    """Position `... x 3` [m] and rotation `... x 3 x 3` (or None) of what holds the instrument, joints `... x n`.

    pose: `... x p`, of a machine that is no serial arm.
    second, turned: position and rotation with the joints that are given, where the reading is of two places.
    """

    position: Tensor
    rotation: Tensor | None
    joints: Tensor
    pose: Tensor | None = None
    second: Tensor | None = None
    turned: Tensor | None = None


class Reading(ABC):
    """An instrument.

    Attributes:
        kind: its name in `READINGS`.
        keys: from which it was made.
        turns: whether it needs the orientation of what holds it.
        on_links: whether its parameters say how it sits on a link.
        twice: whether it is of two places of one machine, alike in both; the joints of the second are given.
        blind: frames of an arm that it never shows.
        groups: numbers of its anchors or planes in the column that is given.
        read: what it reads.
        given: what it was pointed at, columns of the records.
        usual: of what is given, where no row says it [SI].
        parameters: its own.
        unknown: beginnings of the names of those of them that are fitted before anything else.
        note: what a reader of results has to know; empty where nothing.
        looks: whether it shows something that stands, whose place is unknown, too, as that of the instrument is.
        behind: depth that counts for what is behind it [m]; NaN where such a row cannot be.
    """

    kind = ""
    note = ""
    looks = False
    behind: float = torch.nan
    turns = False
    on_links = False
    twice = False
    blind: tuple[str, ...] = ()
    groups: Sequence[float] = ()
    keys: dict[str, Any]
    read: tuple[Coordinate, ...]
    given: tuple[Coordinate, ...] = ()
    usual: tuple[float, ...] = ()
    parameters: tuple[Parameter, ...]
    unknown: tuple[str, ...]

    @abstractmethod
    def __call__(self, place: Place, own: Tensor, given: Tensor) -> Tensor:
        """What it reads, `... x c` [SI]; own `... x m`, given `... x g`."""

    def start(self, place: Place, rows: Tensor, own: Tensor) -> Tensor:
        """Its parameters near those that suit rows `s x (c + g)`, from the nominal ones, `m` [SI]."""
        return own

    def suited(self, place: Place, rows: Tensor) -> Reading:
        """The same, with its parameters counted from where these rows `s x (c + g)` show it, as far as that helps."""
        return self

    def frames(self, joints: Tensor, rows: Tensor, own: Tensor) -> tuple[Tensor, Tensor | None]:
        """Stands of the machine `t x n` and the whole poses that the rows show there, `t x 6`; None where none are."""
        return joints[:0], None


class Camera(Reading):
    """Pixels u, v of points of a board: pinhole with two terms of radial distortion.

    On the hand it looks at a board that stands; else it stands and looks at a board on the hand. The measuring frame
    of the machine is the board's (on the hand) or the camera's; the tool frame is the camera's or the board's. A pixel
    counts as 1 um on the image.
    """

    kind = "camera"
    looks = True
    note = "A pixel counts as 1 µm on the image: every µm of a position here is a pixel."
    turns = True
    read = (Coordinate("u", "m"), Coordinate("v", "m"))
    given: tuple[Coordinate, ...] = tuple(Coordinate(f"board_{axis}", "m") for axis in "xyz")
    usual: tuple[float, ...] = (0.0, 0.0, 0.0)

    def __init__(
        self,
        fx: float,
        cx: float,
        cy: float,
        fy: float | None = None,
        k1: float = 0.0,
        k2: float = 0.0,
        on_hand: bool = True,
        refine: bool = True,
        corners: int = 0,
        board_tolerance: float = 2e-4,
    ) -> None:
        """Focal lengths and centre in pixels, k1, k2 of the normalised radius [1]; fitted to the rows with `refine`.

        A board whose corners are known only to `board_tolerance` [m] has so many `corners`, which the column `corner`
        numbers from 1.
        """
        self.corners = len(_numbers(corners, "corners")) if corners else 0
        self.on_hand, self.unknown = on_hand, ("camera",) if refine else ()
        focus = fx if fy is None else fy
        self.keys = {"fx": fx, "cx": cx, "cy": cy, "fy": focus, "k1": k1, "k2": k2, "on_hand": on_hand}
        self.keys |= {"refine": refine, "corners": corners, "board_tolerance": board_tolerance}
        pixels, share = {"fx": fx, "fy": focus, "cx": cx, "cy": cy}, {"k1": k1, "k2": k2}
        self.parameters = (
            *(
                Parameter(f"camera_{n}", "m", v * PIXEL, scale=_FOCUS * fx * PIXEL, cause="camera")
                for n, v in pixels.items()
            ),
            *(Parameter(f"camera_{n}", "1", v, scale=_DISTORTION, cause="camera") for n, v in share.items()),
            *(
                Parameter(f"corner{i + 1}_{axis}", "m", 0.0, scale=board_tolerance)
                for i in range(self.corners)
                for axis in "xyz"
            ),
        )
        if self.corners:
            self.given, self.usual = (*self.given, Coordinate("corner", "1")), (*self.usual, 1.0)

    def __call__(self, place: Place, own: Tensor, given: Tensor) -> Tensor:
        assert place.rotation is not None
        point = given[..., :3]
        if self.corners:
            point = point + chosen(own[..., _LENS:], given[..., 3], 3, _numbers(self.corners, "corners"))
        if self.on_hand:
            seen = (place.rotation.mT @ (point - place.position)[..., None])[..., 0]
        else:
            seen = (place.rotation @ point[..., None])[..., 0] + place.position
        fx, fy, cx, cy, k1, k2 = own[..., :_LENS].unbind(-1)
        deep = seen[..., 2]
        ratio = seen[..., :2] / torch.where(deep > _BEHIND, deep, self.behind)[..., None]
        square = ratio.square().sum(-1)
        wide = 1 + k1 * square + k2 * square.square()
        return torch.stack([fx * ratio[..., 0] * wide + cx, fy * ratio[..., 1] * wide + cy], -1)

    def frames(self, joints: Tensor, rows: Tensor, own: Tensor) -> tuple[Tensor, Tensor | None]:
        """By the board's corners in each image."""
        fx, fy, cx, cy, k1, k2 = own[:_LENS].unbind(-1)
        ratio = torch.stack([(rows[:, 0] - cx) / fx, (rows[:, 1] - cy) / fy], -1)
        plain = ratio
        for _ in range(20):
            square = plain.square().sum(-1, keepdim=True)
            plain = ratio / (1 + k1 * square + k2 * square.square())
        return board_poses(joints, plain, rows[:, 2:5], self.on_hand)


class Wire(Reading):
    """Distance of the tool's point from anchors at unknown places, and what it shows too much: a draw wire, whose drum
    has a zero, a telescopic ball bar."""

    kind = "wire"
    read = (Coordinate("distance", "m"),)
    given = (Coordinate("anchor", "1"),)

    def __init__(self, anchors: int | Sequence[float] = 1, zero: float = 1e-3) -> None:
        """How many anchors there are, which the column `anchor` numbers from 1, or their numbers there; and how far the
        zero of a distance may be off [m], 0 of one that is exact."""
        if isinstance(zero, bool) or not isinstance(zero, (int, float)) or not 0 <= zero <= _LONGEST:
            raise InputError(f"zero: how far a wire's zero may be off, in m from 0 to {_LONGEST:g}, not {zero!r}")
        self.groups = _numbers(anchors, "anchors")
        self.keys = {"anchors": anchors, "zero": zero}
        self.unknown = tuple(f"anchor{n:g}" for n in self.groups)
        self.usual = (self.groups[0],)
        self.parameters = tuple(
            Parameter(f"{name}_{axis}", "m", 0.0, scale=_PLACE) for name in self.unknown for axis in "xyz"
        )
        if zero:
            # Of its own name: it is no part of where the anchor is, which is fitted before anything else.
            zeros = (f"wire{n:g}_zero" for n in self.groups)
            self.parameters += tuple(Parameter(n, "m", 0.0, scale=float(zero), cause="wire zero") for n in zeros)

    def __call__(self, place: Place, own: Tensor, given: Tensor) -> Tensor:
        groups, places = self.groups, 3 * len(self.groups)
        far = _apart(place.position, chosen(own[..., :places], given[..., 0], 3, groups))
        return far if own.shape[-1] == places else far + chosen(own[..., places:], given[..., 0], 1, groups)

    def start(self, place: Place, rows: Tensor, own: Tensor) -> Tensor:
        """|p|² - d² = 2 p·a - |a|² is linear in a and |a|²."""
        found = own.clone()
        for i, (p, d) in enumerate(_by_group(place, rows, self.groups, "anchor")):
            left = torch.cat([2 * p, -torch.ones_like(p[:, :1])], dim=-1)
            right = (p.square().sum(-1) - d.square())[:, None]
            found[3 * i : 3 * i + 3] = torch.linalg.lstsq(left, right, driver="gelsd").solution[:3, 0]
        return found


class Between(Reading):
    """Distance of two places that the machine itself reached: a scale bar, a tape between holes, a printed part."""

    kind = "between"
    twice = True
    blind = ("base",)
    read = (Coordinate("distance", "m"),)
    unknown = ()
    parameters = ()

    def __init__(self, mechanism: Mechanism) -> None:
        """The columns of the second place's joints are those of the first and `_b`."""
        self.keys = {}
        self.given = tuple(replace(j, name=f"{j.name}{SECOND}") for j in mechanism.joints)
        self.usual = tuple(mechanism.home_joints.tolist())

    def __call__(self, place: Place, own: Tensor, given: Tensor) -> Tensor:
        assert place.second is not None
        return _apart(place.position, place.second)


class Dial(Reading):
    """A dial gauge or a probe: height of the tool's point over planes at unknown places, along their normals."""

    kind = "dial"
    read = (Coordinate("reading", "m"),)
    given = (Coordinate("plane", "1"),)

    def __init__(
        self, normals: Sequence[Sequence[float]] = ((0.0, 0.0, 1.0),), planes: Sequence[float] | None = None
    ) -> None:
        """The normal of each plane, roughly, in the measuring frame; and the planes' numbers in the column `plane`,
        from 1 when None."""
        axes = torch.tensor([list(map(float, n)) for n in normals], dtype=torch.float64)
        if axes.dim() != 2 or axes.shape[-1] != 3 or bool((axes.norm(dim=-1) == 0).any()):
            raise InputError(f"normals: write a direction x, y, z for each plane, not {normals!r}")
        self.groups = _numbers(len(axes) if planes is None else planes, "planes", len(axes))
        self.keys = {"normals": [list(n) for n in normals], "planes": self.groups}
        self.usual = (self.groups[0],)
        full = torch.linalg.svd(axes[:, None], full_matrices=True)[2]
        self.axes = torch.cat([axes[:, None] / axes.norm(dim=-1)[:, None, None], full[:, 1:]], 1)
        self.unknown = tuple(f"plane{n:g}" for n in self.groups)
        self.parameters = tuple(
            Parameter(f"{name}_{part}", unit, 0.0, scale=scale)
            for name in self.unknown
            for part, unit, scale in (("height", "m", _PLACE), ("turn1", "rad", _TURN), ("turn2", "rad", _TURN))
        )

    def __call__(self, place: Place, own: Tensor, given: Tensor) -> Tensor:
        mine = chosen(own, given[..., 0], 3, self.groups)
        axes = self.axes[number_of(given[..., 0], self.groups)]
        turn = (mine[..., 1:, None] * axes[..., 1:, :]).sum(-2)
        normal = (rotation_vector_to_matrix(turn) @ axes[..., 0, :, None])[..., 0]
        return (place.position * normal).sum(-1, keepdim=True) - mine[..., :1]

    def suited(self, place: Place, rows: Tensor) -> Reading:
        """Normals of the planes near the points, towards where the readings rise."""
        normals = []
        for points, read in _by_group(place, rows, self.groups, "plane"):
            normal = torch.linalg.svd(points - points.mean(0), full_matrices=True)[2][-1]
            rising = float(((points @ normal) * (read - read.mean())).sum())
            normals.append((-normal if rising < 0 else normal).tolist())
        return Dial(normals, self.groups)

    def start(self, place: Place, rows: Tensor, own: Tensor) -> Tensor:
        """The heights; the normals as they are."""
        found = own.clone()
        for i, (p, r) in enumerate(_by_group(place, rows, self.groups, "plane")):
            found[3 * i] = (p @ self.axes[i, 0] - r).mean()
        return found


class Level(Reading):
    """An inclinometer or autocollimator's level: how far its x and y axes rise over the horizontal.

    The measuring frame's z is up.
    """

    kind = "level"
    turns = True
    on_links = True
    read = (Coordinate("tilt_x", "rad"), Coordinate("tilt_y", "rad"))
    unknown = ("level",)

    def __init__(self, mount: Sequence[float] = (0.0, 0.0, 0.0)) -> None:
        """How it sits on its link, roughly, a rotation vector [rad]."""
        if len(mount) != 3:
            raise InputError(f"mount: write a rotation vector of three numbers in rad, not {mount!r}")
        self.keys = {"mount": list(mount)}
        self.parameters = tuple(
            Parameter(f"level_{axis}", "rad", float(v), scale=_TURN)
            for axis, v in zip(("rx", "ry", "rz"), mount, strict=True)
        )

    def __call__(self, place: Place, own: Tensor, given: Tensor) -> Tensor:
        assert place.rotation is not None
        up = (place.rotation @ rotation_vector_to_matrix(own))[..., 2, :2]
        return torch.asin(up.clamp(-1 + 1e-12, 1 - 1e-12))


class Encoder(Reading):
    """A second encoder at the driven side of a joint: where the joint is, but for an offset."""

    kind = "encoder"
    unknown = ("encoder",)

    def __init__(self, joint: str, mechanism: Mechanism) -> None:
        """The joint; its column is the joint's name and `_second`."""
        names = [j.name for j in mechanism.joints]
        if joint not in names:
            raise InputError(f"joint: there is no joint {joint!r}; write one of {', '.join(names)}")
        self.number = names.index(joint)
        unit = mechanism.joints[self.number].unit
        self.keys = {"joint": joint}
        self.read = (Coordinate(f"{joint}_second", unit),)
        self.parameters = (Parameter("encoder_offset", unit, 0.0, scale=_PLACE if unit == "m" else _TURN),)

    def __call__(self, place: Place, own: Tensor, given: Tensor) -> Tensor:
        return place.joints[..., self.number : self.number + 1] + own


class Pose(Reading):
    """What a tracker or a probe sees of the tool's pose: any of x, y, z, and all of rx, ry, rz or none.

    Of a machine that has other coordinates (a tripod's phi) some of its own.
    """

    kind = "pose"
    unknown = ()
    parameters = ()

    def __init__(self, mechanism: Mechanism, pose: Sequence[str] | None = None) -> None:
        """Which coordinates there are columns of; all when None."""
        turned = bool(mechanism.orientations) or mechanism.frame(mechanism.home_pose)[1] is not None
        names = [c.name for c in (CHANNELS if turned else CHANNELS[:3])]
        wanted = names if pose is None else [*pose]
        self._own = bool(wanted) and not set(wanted) <= set(names) and set(wanted) <= {c.name for c in mechanism.pose}
        self.keys = {} if pose is None else {"pose": wanted}
        if self._own:
            self.read = tuple(c for c in mechanism.pose if c.name in wanted)
            self._seen = [mechanism.pose.index(c) for c in self.read]
            return
        angles = sum(name in names[3:] for name in wanted)
        if not wanted or not set(wanted) <= set(names) or angles not in (0, 3):
            raise InputError(
                f"pose: write some of {', '.join(names[:3])}{', and all of rx, ry, rz or none' if turned else ''}, "
                f"not {pose!r}"
            )
        self.turns = angles > 0
        self._seen = [k for k, name in enumerate(names) if name in wanted]
        self.read = tuple(CHANNELS[k] for k in self._seen)

    def __call__(self, place: Place, own: Tensor, given: Tensor) -> Tensor:
        whole = place.position
        if self._own:
            assert place.pose is not None
            whole = place.pose
        if self.turns:
            assert place.rotation is not None
            whole = torch.cat([whole, matrix_to_rotation_vector(place.rotation)], -1)
        return whole[..., self._seen]

    def frames(self, joints: Tensor, rows: Tensor, own: Tensor) -> tuple[Tensor, Tensor | None]:
        """As measured, where positions were."""
        there = (rows if self.turns else rows[:, :3])[:, : len(self._seen)]
        whole = self._seen[:3] == [0, 1, 2] and not self._own and len(joints) >= _POSES
        return joints, there if whole else None


_EVERY = (Camera, Wire, Dial, Level, Encoder, Between, Pose)
READINGS: dict[str, Callable[..., Reading]] = {c.kind: c for c in _EVERY}
"""Instruments by name."""


def make_reading(kind: str, keys: Mapping[str, Any], mechanism: Mechanism) -> Reading:
    """An instrument by name, with its keys.

    Raises:
        InputError: a kind or key that is not known, or one that is missing.
    """
    if kind not in READINGS:
        raise InputError(f"kind: there is no instrument {kind!r}; write one of {', '.join(READINGS)}")
    asks = [*inspect.signature(READINGS[kind]).parameters]
    takes = [name for name in asks if name != "mechanism"]
    wrong = [name for name in keys if name not in takes]
    if wrong:
        there = ", ".join(takes) or "none"
        raise InputError(f"mechanism 'instrument': a {kind} has no key {wrong[0]!r}; it has {there}")
    more = {"mechanism": mechanism} if "mechanism" in asks else {}
    try:
        return READINGS[kind](**keys, **more)
    except TypeError as reason:
        raise InputError(f"mechanism 'instrument': {kind}: {reason}; its keys are {', '.join(takes)}") from None


def _apart(here: Tensor, there: Tensor) -> Tensor:
    """Distance of points, `... x 1` [m], with a derivative where it is 0."""
    square: Tensor = (here - there).square().sum(-1, keepdim=True)
    return (square + 1e-24).sqrt()


def _numbers(given: int | Sequence[float], key: str, count: int | None = None) -> list[float]:
    """Numbers of groups: 1, 2 … where only how many is given; count: how many there have to be."""
    found = [float(n) for n in (range(1, given + 1) if isinstance(given, int) else given)]
    if not 1 <= len(found) <= 100 or len(set(found)) < len(found) or len(found) != (count or len(found)):
        raise InputError(f"{key}: {given!r} is no number of them; write 1 to 100")
    return found


def number_of(column: Tensor, groups: Sequence[float]) -> Tensor:
    """Which of the groups each row is of, from 0; what is no group's number is the nearest's."""
    return (column[..., None] - torch.tensor(groups, dtype=column.dtype)).abs().argmin(-1)


def chosen(own: Tensor, column: Tensor, width: int, groups: Sequence[float]) -> Tensor:
    """Of the parameters of all groups `... x (g w)` those of each row's, `... x w`."""
    number = number_of(column, groups)
    index = number[..., None] * width + torch.arange(width)
    return expand_leading(own, index).gather(-1, expand_leading(index, own))


def _by_group(place: Place, rows: Tensor, groups: Sequence[float], what: str) -> Iterator[tuple[Tensor, Tensor]]:
    """Positions `t x 3` and readings `t` of each group, whose number is the second column of the rows.

    Raises:
        InputError: a group of fewer than four rows.
    """
    for i, label in enumerate(groups):
        mine = number_of(rows[:, 1], groups) == i
        if int(mine.sum()) < _FEWEST:
            raise InputError(
                f"{what} {label:g}: needs at least {_FEWEST} rows that count, got {int(mine.sum())}; measure it more "
                "often, or leave its rows out of the records"
            )
        yield place.position[mine], rows[mine, 0]
