"""Where simulated machines are measured, what is measured there, and their random numbers."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ccnn_torch.config.sizes import Size, size
from ccnn_torch.coordinates import Coordinate
from ccnn_torch.errors import InputError
from ccnn_torch.mechanisms import Framed, Mechanism, SerialArm


def generator_of(*seeds: int) -> torch.Generator:
    """A generator of its own for each tuple of seeds; numpy's hashing makes neighbouring seeds independent."""
    state = np.random.SeedSequence(seeds).generate_state(1, np.uint64)[0]
    return torch.Generator().manual_seed(int(state >> np.uint64(1)))


def normal_draws(shape: Sequence[int], seeds: Sequence[int], *stream: int) -> Tensor:
    """Standard normal numbers, `r x shape`; machine k's depend on its own seed alone."""
    draws = [torch.randn(tuple(shape), generator=generator_of(s, *stream), dtype=torch.float64) for s in seeds]
    return torch.stack(draws)


@dataclass(frozen=True)
class Instrument:
    """What is measured of a machine.

    Attributes:
        view: the mechanism with what is measured as its pose, `o` coordinates.
        observe: (pose `... x p`, position `... x 3`, rotation `... x 3 x 3` or None) of the platform -> `... x o`.
        pose_of: `... x o` -> the pose that was measured, `... x p`.
    """

    view: Mechanism
    observe: Callable[[Tensor, Tensor, Tensor | None], Tensor]
    pose_of: Callable[[Tensor], Tensor]


def make_instrument(mechanism: Mechanism, points: Sequence[tuple[Size, Size, Size]] | None) -> Instrument:
    """The pose itself, or three points on the platform.

    Raises:
        InputError: points lie on one line, or the mechanism's inverse kinematics takes no measured frame.
    """
    if points is None:
        return Instrument(mechanism, lambda pose, position, rotation: pose, lambda observed: observed)
    place = torch.tensor([[size(v, "m", "simulate.points") for v in p] for p in points], dtype=torch.float64)
    if float(torch.linalg.cross(place[0] - place[1], place[2] - place[1]).norm()) < 1e-9:
        raise InputError("simulate.points: the three points lie on one line, which shows no rotation about it")
    if not (hasattr(mechanism, "joints_of_frame") and hasattr(mechanism, "pose_near")):
        raise InputError(
            f"simulate.points: {mechanism.name} takes no measured rotation matrix; measure its pose (remove points)"
        )
    view = PointsView(mechanism, place)
    return Instrument(view, lambda pose, *frame: view.seen(*frame), view.pose_of)


class PointsView(Mechanism):
    """A mechanism of which three points P1, P2, P3 on the platform are measured; pose p1_x, p1_y, …, p3_z [m].

    The rotation follows from them as in Sun et al. 2018, eq. 16 (u along P2P1, w normal to the plane, v = w x u), and
    the platform's position from their middle. Parameters and joints are the mechanism's own.
    """

    def __init__(self, mechanism: Mechanism, points: Tensor) -> None:
        """points: in the platform's frame, `3 x 3` [m]."""
        # In a tuple, so that the mechanism is not registered as a submodule.
        self._inner: Any = (mechanism,)
        self._turn = _triad(points)
        self._points = points
        home = self.seen(*mechanism.frame(mechanism.home_pose))
        super().__init__(
            name=f"{mechanism.name} by three points",
            joints=mechanism.joints,
            pose=[Coordinate(f"p{i + 1}_{c}", "m") for i in range(3) for c in "xyz"],
            geometry=mechanism.geometry,
            low=home.tolist(),
            high=home.tolist(),
            home_pose=home.tolist(),
            home_joints=mechanism.home_joints.tolist(),
        )
        self.nominal.copy_(mechanism.nominal)

    def seen(self, position: Tensor, rotation: Tensor | None) -> Tensor:
        """The points of a platform; position `... x 3` [m], rotation `... x 3 x 3`; returns `... x 9` [m]."""
        assert rotation is not None
        return (position[..., None, :] + self._points @ rotation.mT).flatten(-2)

    def pose_of(self, observed: Tensor) -> Tensor:
        """The mechanism's pose that is nearest to the measured frame; `... x 9` [m] -> `... x p` [SI]."""
        pose: Tensor = self._inner[0].pose_near(*self.frame(observed))
        return pose

    def frame(self, pose: Tensor) -> tuple[Tensor, Tensor]:
        """Position `... x 3` [m] and rotation `... x 3 x 3` from the points, `... x 9` [m]."""
        seen = pose.reshape(*pose.shape[:-1], 3, 3)
        rotation = _triad(seen) @ self._turn.mT
        return seen.mean(-2) - (rotation @ self._points.mean(0)), rotation

    def solve_inverse(self, pose: Tensor, parameters: Tensor | None = None, guess: Tensor | None = None) -> Tensor:
        """Joints of measured points, by the mechanism's real inverse kinematics; see `Mechanism.solve_inverse`."""
        position, rotation = self.frame(pose)
        joints: Tensor = self._inner[0].joints_of_frame(position, rotation, parameters)
        return joints


def _triad(points: Tensor) -> Tensor:
    """Eq. 16: columns u, v, w from three points; `... x 3 x 3` (a row each) -> `... x 3 x 3`."""
    first, second, third = points.unbind(-2)
    u = first - second
    u = u / torch.linalg.vector_norm(u, dim=-1, keepdim=True)
    w = torch.linalg.cross(u, third - second, dim=-1)
    w = w / torch.linalg.vector_norm(w, dim=-1, keepdim=True)
    return torch.stack([u, torch.linalg.cross(w, u, dim=-1), w], dim=-1)


# Rounds of drawing before a box counts as out of reach.
_ROUNDS = 50


class Places:
    """A box of places, and what machines with given parameters do there.

    A place is a pose, `p` [SI]; of a serial arm, whose poses are hard to reach with all joints inside their limits, it
    is a joint vector, `n` [SI]; of a mechanism seen from a measuring frame it is a pose of the mechanism itself.
    """

    def __init__(self, mechanism: Mechanism, truth: Tensor, box: Mapping[str, tuple[Size, Size]], circle: bool) -> None:
        """Set the box.

        Args:
            mechanism: with its nominal parameters.
            truth: parameters of the machines, `r x K` [SI]; a place is one that all of them reach.
            box: ranges in place of the mechanism's own, by coordinate.
            circle: only poses inside the maximal inscribed circle.

        Raises:
            InputError: a range names no coordinate or is empty, or the mechanism has no inscribed circle.
        """
        self.mechanism, self.truth = mechanism, truth
        own = mechanism.mechanism if isinstance(mechanism, Framed) else mechanism
        self._own = own
        coordinates = own.joints if isinstance(own, SerialArm) else own.pose
        edges = own.limits.T if isinstance(own, SerialArm) else torch.stack(own.bounds)
        self.low, self.high = (edge.clone() for edge in edges)
        names = [c.name for c in coordinates]
        self.circle: tuple[Tensor, Tensor] | None = None
        if circle:
            self.circle = self._inscribed(own)
            centre, radius = self.circle
            self.low, self.high = centre - radius, centre + radius
        for name, pair in box.items():
            if name not in names:
                raise InputError(f"simulate.box.{name}: there is no such coordinate; there are {', '.join(names)}")
            i = names.index(name)
            low, high = (size(v, coordinates[i].unit, f"simulate.box.{name}") for v in pair)
            if not low < high:
                raise InputError(f"simulate.box.{name}: must be [low, high] with low below high, got {list(pair)}")
            self.low[i], self.high[i] = low, high

    @staticmethod
    def _inscribed(mechanism: Mechanism) -> tuple[Tensor, Tensor]:
        find: Any = getattr(mechanism, "maximal_inscribed_circle", None)
        if find is None:
            raise InputError(
                f"simulate.circle: {mechanism.name} has no maximal inscribed circle; give the range as simulate.box"
            )
        centre, radius = find()
        return torch.as_tensor(centre, dtype=torch.float64), torch.as_tensor(radius, dtype=torch.float64)

    def taken(self, place: Tensor) -> tuple[Tensor, Tensor]:
        """Joints `r x s x n` and pose `r x s x p` of every machine at places `s x .` or `r x s x .`."""
        parameters = self.truth[:, None]
        if self._own is not self.mechanism or isinstance(self._own, SerialArm):
            joints, near = self.nominal(place)
            joints = joints.expand(len(self.truth), *joints.shape[-2:])
            return joints, self.mechanism.forward_kinematics(joints, parameters, near)
        pose = place.expand(len(self.truth), *place.shape[-2:])
        near = self.mechanism.solve_inverse(place)
        return self.mechanism.solve_inverse(pose, parameters, near.expand(len(self.truth), *near.shape[-2:])), pose

    def nominal(self, place: Tensor) -> tuple[Tensor, Tensor]:
        """Joints and pose of the nominal machine at places `... x .`."""
        if isinstance(self._own, SerialArm):
            return place, self.mechanism.forward_kinematics(place)
        joints = self._own.solve_inverse(place)
        return joints, place if self._own is self.mechanism else self.mechanism.forward_kinematics(joints)

    def usable(self, place: Tensor) -> Tensor:
        """Which places `s x .` every machine reaches, inside the circle where there is one; `s`, bool."""
        inside = torch.ones(len(place), dtype=torch.bool)
        if self.circle is not None:
            centre, radius = self.circle
            inside = torch.linalg.vector_norm(place - centre, dim=-1) <= radius
        if not isinstance(self._own, SerialArm):
            inside = inside & self._own.reachable(place)
        joints, pose = self.taken(place)
        usable: Tensor = inside & torch.isfinite(joints).all(-1).all(0) & torch.isfinite(pose).all(-1).all(0)
        return usable

    def even(self, count: int) -> Tensor:
        """Places of low discrepancy, `count x .`: a Halton sequence in the box, without unreachable places."""
        # Only here: scipy.stats takes half a second to load.
        from scipy.stats import qmc

        sequence = qmc.Halton(len(self.low), scramble=False)
        sequence.fast_forward(1)  # its first point is a corner
        return self._filled(count, lambda number: torch.from_numpy(sequence.random(number)))

    def random(self, count: int, generator: torch.Generator) -> Tensor:
        """Uniform places, `count x .`."""
        width = len(self.low)
        return self._filled(count, lambda number: torch.rand(number, width, generator=generator, dtype=torch.float64))

    def map(self, across: int) -> Tensor:
        """A square grid over the first two coordinates, the others in the middle; `m x .`, in reach only."""
        middle = (self.low + self.high) / 2
        lines = [torch.linspace(float(self.low[i]), float(self.high[i]), across, dtype=torch.float64) for i in (0, 1)]
        grid: Tensor = torch.cartesian_prod(*lines)
        place: Tensor = middle.expand(len(grid), -1).clone()
        place[:, :2] = grid
        return place[self.usable(place)]

    def _filled(self, count: int, draw: Any) -> Tensor:
        found: list[Tensor] = []
        for _ in range(_ROUNDS):
            place = self.low + (self.high - self.low) * draw(2 * count)
            found.append(place[self.usable(place)])
            if sum(map(len, found)) >= count:
                return torch.cat(found)[:count]
        raise InputError(
            f"simulate: hardly any pose of the box of {self.mechanism.name} can be reached by all machines; give a "
            "smaller range in simulate.box, or smaller simulate.errors"
        )
