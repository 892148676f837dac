"""A mechanism of whose pose the instrument shows some coordinates: a probe z, a tracker x, y, z, a level rx, ry."""

from __future__ import annotations

import copy
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any, Self

import torch
from torch import Tensor

from ccnn_torch.coordinates import Condition, Coordinate, Parameter
from ccnn_torch.errors import InputError
from ccnn_torch.mechanisms.closest import Closest
from ccnn_torch.mechanisms.machines.serial import SerialArm
from ccnn_torch.mechanisms.mechanism import Mechanism
from ccnn_torch.mechanisms.pose import Frame
from ccnn_torch.numerics.batching import leading_shape


class Around(Closest):
    """A mechanism that is another one, `mechanism`, seen or placed in some way."""

    mechanism: Mechanism

    def under(self, conditions: Mapping[str, Tensor]) -> Self:
        """The mechanism inside under them."""
        inner = self.mechanism.under(conditions)
        if inner is self.mechanism:
            return self
        twin = copy.copy(self)
        twin._modules = {**self._modules, "mechanism": inner}
        return twin

    def lacking(self, conditions: Sequence[str]) -> list[Condition]:
        """As of the mechanism inside."""
        return self.mechanism.lacking(conditions)


class Seen(Around, ABC):
    """A mechanism as something shows it: its pose is what is read, which may be less than the mechanism's whole pose.

    Joints are the mechanism's, parameters too, with those of what reads it behind them. Where joints are more than
    readings, `nearest_joints` gives the joints nearest to the guess that reach them.

    Attributes:
        mechanism: a copy of the mechanism, without hooks.
    """

    def __init__(
        self, mechanism: Mechanism, pose: Sequence[Coordinate], home: Sequence[float], own: Sequence[Parameter] = ()
    ) -> None:
        """Take the mechanism, what is read and given, the row at home, and what else is unknown.

        Raises:
            InputError: the mechanism has frames per group of rows.
        """
        if mechanism.grouped:
            raise InputError(
                f"mechanism '{mechanism.name}' has frames per group of rows (frame_per, tool_per), which only whole "
                "poses determine; leave the keys out, and give the rows of one group"
            )
        inner = mechanism.with_nominal(mechanism.nominal)
        super().__init__(
            name=inner.name,
            joints=inner.joints,
            pose=pose,
            geometry=[*inner.geometry, *own],
            low=[v - 1e-6 for v in home],
            high=[v + 1e-6 for v in home],
            home_pose=home,
            home_joints=inner.home_joints.tolist(),
        )
        self.nominal[: len(inner.nominal)].copy_(inner.nominal)
        self.mechanism, self.takes, self.gears, self.motors = inner, inner.takes, inner.gears, inner.motors

    def inner_values(self, parameters: Tensor | None) -> Tensor | None:
        """Of the parameters `... x k` those of the mechanism inside; None where none are given."""
        return None if parameters is None else parameters[..., : len(self.mechanism.geometry)]

    def _follow_nominal(self) -> None:
        self.mechanism.nominal.copy_(self.nominal[: len(self.mechanism.geometry)])
        self.mechanism._follow_nominal()
        self.home_joints.copy_(self.mechanism.home_joints)
        self.home_pose.copy_(self.forward_kinematics(self.home_joints))

    def whole_guess(self, pose: Tensor) -> Tensor | None:
        """A whole pose of the mechanism inside near one that shows this, `... x p'` [SI]; None where nothing says."""
        return None

    def shown_by(self, names: Sequence[str]) -> Seen | None:
        """As columns of these names alone show it, where that is another way of seeing; else None."""
        return None

    @abstractmethod
    def around(self, mechanism: Mechanism) -> Seen:
        """Another mechanism seen in the same way."""

    def controlled(self) -> Mechanism:
        """As of the mechanism inside."""
        return self.mechanism.controlled()

    def sample_joints(self, count: int, generator: torch.Generator) -> Tensor:
        """Of the mechanism, `count x n` [SI]."""
        return self.mechanism.sample_joints(count, generator)

    def reachable(self, pose: Tensor, parameters: Tensor | None = None) -> Tensor:
        """All that is finite: what is not seen may be anything; `...`, bool."""
        return torch.isfinite(pose).all(-1).expand(leading_shape(pose, self.resolve(parameters)))

    def skeleton(self, pose: Tensor, joints: Tensor, parameters: Tensor | None = None) -> dict[str, Tensor]:
        """As of the mechanism, in the pose of the joints."""
        inner = self.inner_values(parameters)
        return self.mechanism.skeleton(self.mechanism.forward_kinematics(joints, inner), joints, inner)


class Partial(Seen):
    """A mechanism of whose pose some coordinates are measured.

    `frame` takes the others from the home pose, so that no error is seen in them.

    Attributes:
        seen: numbers of the coordinates that are measured, among those of the mechanism.
    """

    def __init__(self, mechanism: Mechanism, pose: Sequence[str]) -> None:
        """Take the mechanism, and the names of the coordinates that are measured.

        Raises:
            InputError: none is named, or one that the mechanism's pose has not.
        """
        names = [c.name for c in mechanism.pose]
        strange = [name for name in pose if name not in names]
        if strange or not pose:
            what = f"has no pose coordinate '{strange[0]}'" if strange else "needs a pose coordinate that is measured"
            raise InputError(f"mechanism '{mechanism.name}' {what}; it has {', '.join(names)}")
        seen = [k for k, name in enumerate(names) if name in pose]
        super().__init__(mechanism, [mechanism.pose[k] for k in seen], mechanism.home_pose[seen].tolist())
        self.seen = seen
        self.low.copy_(mechanism.low[seen])
        self.high.copy_(mechanism.high[seen])

    def _own_file(self) -> dict[str, Any]:
        keys = {"mechanism": self.mechanism.describe(), "pose": [c.name for c in self.pose]}
        return {"spec": "partial", "keys": keys}

    def _follow_nominal(self) -> None:
        super()._follow_nominal()
        for own in ("home_pose", "low", "high"):
            getattr(self, own).copy_(getattr(self.mechanism, own)[self.seen])

    def around(self, mechanism: Mechanism) -> Seen:
        """Another mechanism of which the same coordinates are measured."""
        return Partial(mechanism, [c.name for c in self.pose])

    def sample_workspace(self, count: int, generator: torch.Generator) -> Tensor:
        """What is seen of samples of the mechanism; `count x p` [SI]."""
        return self.mechanism.sample_workspace(count, generator)[..., self.seen]

    def forward_kinematics(
        self, joints: Tensor, parameters: Tensor | None = None, guess: Tensor | None = None
    ) -> Tensor:
        """What is seen of the mechanism's pose of the joints, `... x p` [SI]."""
        near = None if guess is None else self.whole_guess(guess)
        return self.mechanism.forward_kinematics(joints, parameters, near)[..., self.seen]

    def frame(self, pose: Tensor) -> Frame:
        """The mechanism's frame where all that is not seen is as in the home pose; no rotation where no angle is."""
        position, rotation = self.mechanism.frame(self.whole_guess(pose))
        return position, rotation if any(c.unit == "rad" for c in self.pose) else None

    def whole_guess(self, pose: Tensor) -> Tensor:
        """The mechanism's whole pose, with the home pose in what is not seen: of `... x p` the `... x p'` [SI]."""
        columns = [*self.mechanism.home_pose.expand(*pose.shape[:-1], -1).unbind(-1)]
        for i, k in enumerate(self.seen):
            columns[k] = pose[..., i]
        return torch.stack(columns, -1)


def completed(mechanism: Mechanism, joints: Tensor, pose: Tensor, parameters: Tensor | None = None) -> Tensor:
    """Poses `... x p` with what was not measured (NaN) as the machine has it at the joints."""
    if not bool(pose.isnan().any()):
        return pose
    guess = torch.where(pose.isnan(), mechanism.home_pose, pose)
    return torch.where(pose.isnan(), mechanism.forward_kinematics(joints, parameters, guess), pose)


# Share of the usual length by which the lengths of unit vectors differ.
_UNIT = 1e-5


def as_measured(
    mechanism: Mechanism, pose: Sequence[Coordinate], where: str = "records", measured: Tensor | None = None
) -> Mechanism:
    """The mechanism as records with these pose coordinates show it: itself, an arm by positions alone or by directions,
    or `Partial`.

    A machine whose file says that its pose is a position stays what it is.

    Args:
        where: the file, which opens the sentence.
        measured: their poses, `s x p` [SI]: positions that are all as far from the origin are directions.

    Raises:
        InputError: frames would have to be fitted to rows that show too little of them.
    """
    names, whole = [c.name for c in pose], [c.name for c in mechanism.pose]
    if isinstance(mechanism, SerialArm) and names == ["x", "y", "z"] != whole and _are_directions(measured):
        looking = mechanism.with_orientation("direction")
        if bool(looking.revolute.all()) and "tool" not in looking.unknown_frames:
            return looking
    if names == whole or not set(names) < set(whole):
        return mechanism
    fewer = mechanism.shown_by(names) if isinstance(mechanism, Seen) else None
    if fewer is not None:
        return fewer
    if isinstance(mechanism, SerialArm) and names == ["x", "y", "z"]:
        return mechanism.with_orientation("none")
    unknown = getattr(mechanism, "unknown_frames", ())
    if unknown:
        raise InputError(
            f"{where}: of the pose {', '.join(whole)} only {', '.join(names)} was measured, and the "
            f"{' and the '.join(unknown)} of {mechanism.name} {'is' if len(unknown) == 1 else 'are'} fitted to whole "
            f"poses; give {', '.join(n for n in whole if n not in names)} as well, or a machine with its place among "
            "its own parameters (docs/how_to/mechanisms.md, 'A reflector alone')"
        )
    return Partial(mechanism, names)


def sees_directions(mechanism: Mechanism) -> bool:
    """Whether the pose is the unit vector in which the tool looks."""
    return isinstance(mechanism, SerialArm) and mechanism.orientation == "direction"


def _are_directions(measured: Tensor | None) -> bool:
    """Whether positions `s x 3` are unit vectors."""
    if measured is None:
        return False
    length = torch.linalg.vector_norm(measured[torch.isfinite(measured).all(-1)], dim=-1)
    return len(length) > 1 and bool(((length - 1).abs() < _UNIT).all())
