"""One of the instruments on a machine: where what holds it is, and what it reads there."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from torch import Tensor

from ccnn_torch.coordinates import Parameter
from ccnn_torch.mechanisms.frames.fit import ROTATION_WEIGHT, best_closed_form
from ccnn_torch.mechanisms.frames.readings import Place, Reading
from ccnn_torch.mechanisms.machines.links import compose, transform_of
from ccnn_torch.mechanisms.machines.serial import FRAME, SerialArm
from ccnn_torch.mechanisms.mechanism import Mechanism
from ccnn_torch.numerics.batching import leading_shape
from ccnn_torch.numerics.rotations import rotation_vector_to_matrix

# Plausible error of where something is on the hand or in space, after a closed form [m], [rad].
_THERE = {"m": 0.02, "rad": 0.05}


@dataclass(frozen=True)
class Part:
    """One of the instruments on a machine.

    Attributes:
        reading: what it reads.
        link: number of the link that holds it, 0 = the base; None = the tool or platform.
        name: in front of its columns and parameters, where there are two of a kind.
        place: what is unknown of its place: `point` (of its own on the hand), `camera` (that, and the board's).
    """

    reading: Reading
    link: int | None = None
    name: str = ""
    place: str = ""

    def called(self, name: str) -> str:
        """A column or parameter of it."""
        return f"{self.name}.{name}" if self.name else name

    @property
    def frames(self) -> tuple[Parameter, ...]:
        """Parameters of its place, behind those of its reading."""
        kind = self.reading.kind
        parts = {"": {}, "point": {f"{kind}point": 3}, "camera": {"mount": 6, "stand": 6}}[self.place]
        return tuple(Parameter(f"{n}_{c}", u, 0.0, scale=_THERE[u]) for n, k in parts.items() for c, u in FRAME[:k])

    @cached_property
    def parameters(self) -> tuple[Parameter, ...]:
        """All of its own."""
        return tuple(replace(p, name=self.called(p.name)) for p in (*self.reading.parameters, *self.frames))

    @property
    def unknown(self) -> tuple[str, ...]:
        """Beginnings of the names of those that are fitted first."""
        own = dict.fromkeys(p.name.partition("_")[0] for p in self.frames)
        return tuple(self.called(name) for name in (*self.reading.unknown, *own))

    @property
    def blind(self) -> tuple[str, ...]:
        """Frames of an arm that it never shows."""
        return self.reading.blind if self.link is None else ("tool",)

    def __call__(self, there: Place, own: Tensor, given: Tensor) -> Tensor:
        """What it reads, `... x c` [SI]; own: its parameters `... x m`."""
        count = len(self.reading.parameters)
        own, frames = own[..., :count], own[..., count:]
        position, rotation = there.position, there.rotation
        if self.place:
            assert rotation is not None
            mount = frames[..., :3]
            position = position + (rotation @ mount[..., None])[..., 0]
        if self.place == "camera":
            assert rotation is not None
            back = rotation_vector_to_matrix(frames[..., 9:12]).mT
            rotation = back @ rotation @ rotation_vector_to_matrix(frames[..., 3:6])
            position = (back @ (position - frames[..., 6:9])[..., None])[..., 0]
        second = there.second
        if second is not None and there.turned is not None and self.place:
            second = second + (there.turned @ mount[..., None])[..., 0]
        return self.reading(there._replace(position=position, rotation=rotation, second=second), own, given)

    def start(self, there: Place, rows: Tensor, own: Tensor) -> Tensor:
        """Its parameters near those that suit rows `s x (c + g)` in which it read."""
        count = len(self.reading.parameters)
        found = own.clone()
        if self.place == "camera":
            stands, poses = self.reading.frames(there.joints, rows, own[:count])
            assert poses is not None and there.rotation is not None
            first = torch.stack([(there.joints == q).all(-1).double().argmax() for q in stands])
            pose = poses[:, :3], rotation_vector_to_matrix(poses[:, 3:])
            held = there.rotation[first], there.position[first], pose, torch.zeros(6, dtype=own.dtype)
            frames = best_closed_form(*held, torch.ones(len(poses), dtype=own.dtype), ROTATION_WEIGHT)
            turn = rotation_vector_to_matrix(frames[3:6])
            back = [-(turn.mT @ frames[:3]), -frames[3:6]]
            found[count:] = torch.cat([frames[6:], *back])
        found[:count] = self.reading.start(there, rows, own[:count])
        return found


def has_orientation(mechanism: Mechanism) -> bool:
    """Whether the tool or platform has one, also where only its position is measured."""
    return isinstance(mechanism, SerialArm) or mechanism.frame(mechanism.home_pose)[1] is not None


def all_read(
    parts: Sequence[Part], places: Sequence[Place], own: Tensor, given: Tensor, twist: Tensor | None = None
) -> Tensor:
    """What the instruments read, side by side, `... x c` [SI].

    Args:
        places: what holds each, as `all_places` says.
        own: their parameters, `... x m`.
        given: what they were pointed at, `... x g`.
        twist: shift and turn of what holds them, `... x 6`.
    """
    read = []
    each = torch.split(own, [len(part.parameters) for part in parts], -1)
    for part, there, values, here in zip(parts, places, each, _given_each(parts, given), strict=True):
        if twist is not None:
            turned = there.rotation
            if turned is not None:
                turned = rotation_vector_to_matrix(twist[..., 3:]) @ turned
            there = there._replace(position=there.position + twist[..., :3], rotation=turned)
        read.append(part(there, values, here))
    if len(read) == 1:
        return read[0]
    lead = leading_shape(*read)
    return torch.cat([one.expand(*lead, -1) for one in read], -1)


def _given_each(parts: Sequence[Part], given: Tensor) -> tuple[Tensor, ...]:
    """Of each instrument what it was pointed at."""
    return torch.split(given, [len(part.reading.given) for part in parts], -1)


def all_places(
    mechanism: Mechanism, parts: Sequence[Part], joints: Tensor, values: Tensor, given: Tensor
) -> list[Place]:
    """Where what holds each instrument is; values: of the mechanism, `... x k`; given: as of `all_read`."""
    held = {link: place_of(mechanism, link, joints, values) for link in dict.fromkeys(part.link for part in parts)}
    places = []
    for part, here in zip(parts, _given_each(parts, given), strict=True):
        there = held[part.link]
        if part.reading.twice:
            # Also with the joints that are given.
            other = place_of(mechanism, part.link, here, values)
            there = there._replace(second=other.position, turned=other.rotation)
        places.append(there)
    return places


def place_of(mechanism: Mechanism, link: int | None, joints: Tensor, values: Tensor) -> Place:
    """Where the link is that holds an instrument, or the tool or platform, in the measuring frame."""
    if link is not None and isinstance(mechanism, SerialArm):
        rotation, position = compose(transform_of(values[..., :6]), mechanism.link_frames(joints, values)[link])
        return Place(position, rotation, joints)
    if isinstance(mechanism, SerialArm):
        return Place(*mechanism.forward_frame(joints, values), joints)
    pose = mechanism.forward_kinematics(joints, values)
    return Place(*mechanism.frame(pose), joints, pose)


def tool_points(mechanism: Mechanism, joints: Tensor, parameters: Tensor | None = None) -> Tensor:
    """Position of the tool, `... x 3` [m]; joints `... x n` [SI], parameters `... x k` [SI]."""
    return place_of(mechanism, None, joints, mechanism.resolve(parameters)).position
