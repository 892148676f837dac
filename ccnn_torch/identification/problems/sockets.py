"""A ball on the tool in sockets of a plate that stood in unknown places: what of it a row shows.

It needs no measuring device. What such rows cannot tell by their nature is left out: the arm's base frame (the plate
moves along with it), the tool's orientation (only its point is held), the roll of a plate about a line of sockets.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from ccnn_torch.coordinates import Coordinate, Parameter
from ccnn_torch.mechanisms.frames.readings import Place, Reading, chosen, number_of
from ccnn_torch.numerics.rotations import nearest_rotation, rotation_vector_to_matrix

# Plausible errors of a plate's place and turn, after a start from the nominal machine [m, rad].
_PLACE, _TURN = 5e-3, 2e-2
# Directions in which points spread less than this share of their largest extent do not show a rotation.
_THIN = 1e-6


class Sockets(Reading):
    """The socket's place x on the plate, and what the ball b(q) is off it: b(q) - (c + s R x), in axes of the base.

    c and R are unknown per placement, the scale s of the plate where it has a tolerance. Sockets at known points give
    the scale; a single socket holds one unknown point. Along the axes of the plate the noise of b(q) would seem to show
    the roll about a line of sockets.
    """

    kind = "sockets"
    read = tuple(Coordinate(axis, "m") for axis in "xyz")
    given = (Coordinate("placement", "1"), *(Coordinate(f"socket_{axis}", "m") for axis in "xyz"))

    def __init__(self, placement: Tensor, points: Tensor, there: Tensor, tolerance: float = 0.0) -> None:
        """Take the rows and where the nominal machine sees them, from which turns count.

        Args:
            placement: number of each row's placement, `s`, any numbers.
            points: the socket's place on the plate, `s x 3` [m].
            there: the ball with the nominal machine, `s x 3` [m].
            tolerance: standard deviation of the plate's size, as a share [1]; 0 = it is exact.
        """
        self.groups: Sequence[float] = torch.unique(placement).tolist()
        self.keys, self._tolerance = {}, tolerance
        self.unknown = tuple(f"plate{n:g}" for n in self.groups)
        self.usual = (self.groups[0], 0.0, 0.0, 0.0)
        starts = [_plate(points[placement == n], there[placement == n]) for n in self.groups]
        turns = max(len(axes) for _, axes in starts)
        self._width = 3 + turns
        self._turned = torch.stack([turned for turned, _ in starts])
        self._axes = torch.stack([torch.nn.functional.pad(axes, (0, 0, 0, turns - len(axes))) for _, axes in starts])
        own = [(axis, "m", _PLACE) for axis in "xyz"] + [(f"turn{i + 1}", "rad", _TURN) for i in range(turns)]
        self.parameters = (
            *(Parameter(f"{plate}_{name}", unit, 0.0, scale=s) for plate in self.unknown for name, unit, s in own),
            *([Parameter("plate_scale", "1", 1.0, scale=tolerance)] if tolerance > 0 else []),
        )

    def __call__(self, place: Place, own: Tensor, given: Tensor) -> Tensor:
        point, number = given[..., 1:], number_of(given[..., 0], self.groups)
        mine = chosen(own, given[..., 0], self._width, self.groups)
        turn = rotation_vector_to_matrix((mine[..., 3:, None] * self._axes[number]).sum(-2))
        socket = (turn @ self._turned[number] @ point[..., None])[..., 0]
        if self._tolerance > 0:
            socket = socket * own[..., -1:]
        return point + place.position - mine[..., :3] - socket

    def suited(self, place: Place, rows: Tensor) -> Reading:
        """Turns counted from where this machine sees the plates."""
        return Sockets(rows[:, 3], rows[:, :3], place.position, self._tolerance)

    def start(self, place: Place, rows: Tensor, own: Tensor) -> Tensor:
        """The places; turns as the nominal machine sees them."""
        found, number = own.clone(), number_of(rows[:, 3], self.groups)
        for i, turned in enumerate(self._turned):
            mine = number == i
            found[self._width * i : self._width * i + 3] = (place.position - rows[:, :3] @ turned.mT)[mine].mean(0)
        return found


def _plate(points: Tensor, there: Tensor) -> tuple[Tensor, Tensor]:
    """Rotation `3 x 3` of a plate whose points `s x 3` are seen at `s x 3`; and the axes of the turns that the rows
    show, `t x 3`: all three, the two across a line of sockets, or none for a single one (Kabsch 1976)."""
    here = points - points.mean(0)
    rotation = nearest_rotation((there - there.mean(0)).mT @ here)
    _, extent, along = torch.linalg.svd(here)
    rank = int((extent > _THIN * max(1e-3, float(extent[0]))).sum())
    axes = torch.eye(3, dtype=points.dtype)
    return rotation, axes[:0] if rank == 0 else along[1:] @ rotation.mT if rank == 1 else axes
