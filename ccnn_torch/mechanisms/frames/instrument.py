"""A mechanism seen through an instrument: a camera, a wire, a dial gauge, a level or a second encoder on it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ccnn_torch.errors import InputError
from ccnn_torch.mechanisms.frames.fit import fit_frames
from ccnn_torch.mechanisms.frames.framed import Framed
from ccnn_torch.mechanisms.frames.partial import Seen
from ccnn_torch.mechanisms.frames.readings import Place, Reading, make_reading
from ccnn_torch.mechanisms.frames.set_ups import fit_set_ups
from ccnn_torch.mechanisms.machines.links import compose
from ccnn_torch.mechanisms.machines.serial import SerialArm
from ccnn_torch.mechanisms.mechanism import Mechanism
from ccnn_torch.mechanisms.pose import Frame
from ccnn_torch.numerics.least_squares import jacobian_of, levenberg_marquardt
from ccnn_torch.numerics.outliers import inlying
from ccnn_torch.numerics.rotations import rotation_vector_to_matrix

# Rounds in which rows that are gross outliers are left out of the fit of what is unknown.
_ROUNDS = 3


class Instrument(Seen):
    """A mechanism whose pose is what an instrument reads, and after it what the instrument was pointed at.

    The second part (a corner of a board, the number of an anchor) is given with each row and never compared: forward
    kinematics take it from `guess`, which is the row as it was recorded, and return it as it is. Parameters are the
    mechanism's, then the instrument's. What is read counts as a position along x, y, z of `frame` (lengths) or as a
    rotation vector (angles).

    Attributes:
        reading: the instrument.
        link: number of the link that holds it, 0 = the base; None = the tool or platform.
    """

    def __init__(self, mechanism: Mechanism, reading: Reading, link: int | None = None) -> None:
        """See the class.

        Raises:
            InputError: a link that there is not, or an instrument that needs an orientation on a machine without one.
        """
        links = len(mechanism.joints)
        if link is not None and not (isinstance(mechanism, SerialArm) and 0 <= link <= links):
            what = (
                f"write 0 to {links}" if isinstance(mechanism, SerialArm) else "only a serial arm has links; remove it"
            )
            raise InputError(f"link: {link} is no link of {mechanism.name}; {what}")
        if link is not None and not reading.on_links:
            raise InputError(f"link: how a {reading.kind} sits on a link has no parameters; only a level may be on one")
        own = torch.tensor([p.nominal for p in reading.parameters], dtype=torch.float64)
        usual = torch.tensor(reading.usual, dtype=torch.float64)
        at_home = _place(mechanism, link, reading, mechanism.home_joints, mechanism.nominal, usual)
        if reading.turns and at_home.rotation is None:
            raise InputError(f"mechanism '{mechanism.name}' has no orientation, which a {reading.kind} on it needs")
        home = [*reading(at_home, own, usual).tolist(), *reading.usual]
        super().__init__(mechanism, [*reading.read, *reading.given], home, reading.parameters)
        self.reading, self.link, self.known = reading, link, False

    @property
    def compared(self) -> int:
        """How many coordinates are read; the rest are given."""
        return len(self.reading.read)

    @property
    def unknown_frames(self) -> tuple[str, ...]:
        """What is fitted to rows first, as the names of its parameters begin: base and tool of an arm, an anchor."""
        if self.known:
            return ()
        unknown: tuple[str, ...] = getattr(self.mechanism, "unknown_frames", ())
        blind = self.reading.blind if self.link is None else ("tool",)
        return (*(name for name in unknown if name not in blind), *self.reading.unknown)

    def set_parameters(self, values: Mapping[str, float]) -> None:
        """As of a mechanism; nothing is unknown any more where values are not those that it was made with."""
        super().set_parameters(values)
        self.known = any(
            values[g.name] != g.nominal for g in self.geometry if g.name.partition("_")[0] in self.unknown_frames
        )

    def _own_file(self) -> dict[str, Any]:
        keys = {"mechanism": self.mechanism.describe(), "kind": self.reading.kind, **self.reading.keys}
        return {"spec": "instrument", "keys": keys if self.link is None else {**keys, "link": self.link}}

    def around(self, mechanism: Mechanism) -> Instrument:
        """The same instrument, with its parameters, on another machine."""
        found = Instrument(mechanism, self.reading, self.link)
        return found.with_nominal(torch.cat([mechanism.nominal, self.nominal[len(self.mechanism.geometry) :]]))  # type: ignore[return-value]

    def forward_kinematics(
        self, joints: Tensor, parameters: Tensor | None = None, guess: Tensor | None = None
    ) -> Tensor:
        """What is read with these joints, and what is given by `guess` (home without), `... x p` [SI]."""
        there, own, given = self._rows(joints, parameters, guess)
        read = self.reading(there, own, given)
        return torch.cat([read, given.expand(*read.shape[:-1], -1)], -1)

    def _rows(self, joints: Tensor, parameters: Tensor | None, guess: Tensor | None) -> tuple[Place, Tensor, Tensor]:
        """Where what holds the instrument is, the instrument's own parameters, and what is given."""
        values, count = self.resolve(parameters), len(self.mechanism.geometry)
        given = self.given(guess)
        there = _place(self.mechanism, self.link, self.reading, joints, values[..., :count], given)
        return there, values[..., count:], given

    def given(self, rows: Tensor | None) -> Tensor:
        """What the rows `... x p` were of, `... x g` [SI]; what is usual where there are none."""
        return (self.home_pose if rows is None else rows)[..., self.compared :]

    def places(self, joints: Tensor, rows: Tensor | None) -> list[Tensor]:
        """Of rows whose reading is of two places, both."""
        return [joints, self.given(rows).expand_as(joints)] if self.reading.twice else [joints]

    def sample_given(self, count: int, generator: torch.Generator) -> Tensor:
        """Rows of any anchor, plane or second place, `count x p` [SI]; nothing is read yet."""
        rows, groups = self.home_pose.expand(count, -1), torch.tensor(self.reading.groups, dtype=torch.float64)
        if self.reading.twice:
            given = self.mechanism.sample_joints(count, generator)
        elif len(groups):
            given = groups[torch.randint(len(groups), (count, 1), generator=generator)]
        else:
            return rows
        return torch.cat([rows[:, : self.compared], given], -1)

    def frame(self, pose: Tensor) -> Frame:
        """What is read: lengths as a position, angles as a rotation vector."""
        read = pose[..., : self.compared]
        read = torch.nn.functional.pad(read, (0, 3 - self.compared))
        if self.pose[0].unit == "m":
            return read, None
        return torch.zeros_like(read), rotation_vector_to_matrix(read)

    def by_place(self, joints: Tensor, parameters: Tensor | None, guess: Tensor | None) -> Tensor:
        """Change of `frame` by a shift and a turn (about its own point) of what holds the instrument, `... x c x 6`."""
        there, own, given = self._rows(joints, parameters, guess)

        def read(twist: Tensor) -> Tensor:
            turned = there.rotation
            if turned is not None:
                turned = rotation_vector_to_matrix(twist[..., 3:]) @ turned
            return self.reading(there._replace(position=there.position + twist[..., :3], rotation=turned), own, given)

        slope = jacobian_of(read, torch.zeros(*joints.shape[:-1], 6, dtype=joints.dtype))[1]
        slope = torch.nn.functional.pad(slope, (0, 0, 0, 3 - self.compared))
        return slope if self.pose[0].unit == "m" else torch.cat([torch.zeros_like(slope), slope], -2)

    def fitted(self, joints: Tensor, pose: Tensor, weights: Tensor | None = None) -> Tensor:
        """All parameters, those of `unknown_frames` fitted to rows, the rest nominal.

        Args:
            joints: `s x n` [SI].
            pose: readings and what they are of, `s x p` [SI].
            weights: `... x s`, 0 leaves a row out.

        Returns:
            `... x k` [SI].

        Raises:
            InputError: too few rows.
        """
        weights = torch.ones(len(joints), dtype=torch.float64) if weights is None else weights
        flat = [self._fitted_to(joints, pose, w) for w in weights.reshape(-1, len(joints))]
        return torch.stack(flat).reshape(*weights.shape[:-1], -1)

    def _fitted_to(self, joints: Tensor, pose: Tensor, weights: Tensor) -> Tensor:
        start = self.nominal.clone()
        count = len(self.mechanism.geometry)
        unknown = self.unknown_frames
        free = [k for k, g in enumerate(self.geometry) if g.name.partition("_")[0] in unknown]
        used = (weights > 0) & ~pose.isnan().any(-1)
        if not free:
            return start
        if int(used.sum()) * self.compared < len(free):
            raise InputError(
                f"{self.name}: {int(used.sum())} rows of {self.compared} readings cannot determine where the "
                f"{self.reading.kind} is ({len(free)} unknowns); measure more"
            )
        q, x = joints[used], pose[used]
        arm = self.mechanism
        if isinstance(arm, SerialArm) and arm.unknown_frames:
            stands, poses = self.reading.frames(q, x, start[count:])
            if poses is not None:
                start[:count] = fit_frames(arm, stands, poses)
        there = _place(arm, self.link, self.reading, q, start[:count], self.given(x))
        start[count:] = self.reading.start(there, x, start[count:])
        kept = torch.ones(len(q), dtype=torch.float64)
        for _ in range(_ROUNDS):

            def gap(values: Tensor, kept: Tensor = kept, start: Tensor = start) -> Tensor:
                full = start.expand(*values.shape[:-1], -1).index_copy(-1, torch.tensor(free), values)
                left = self.forward_kinematics(q, full, x) - x
                return left[:, : self.compared] * kept[:, None]

            found = levenberg_marquardt(
                lambda v, gap=gap: gap(v).flatten(),
                start[free],
                # A row's residual is of its own copy of the values: one pass for each reading and not for each row.
                lambda v, gap=gap: jacobian_of(gap, v.expand(len(q), -1))[1].flatten(0, 1),
                max_iterations=100,
            )
            start = start.index_copy(0, torch.tensor(free), found.value)
            left = self.forward_kinematics(q, start, x)[:, : self.compared] - x[:, : self.compared]
            kept = inlying(left.norm(dim=-1).nan_to_num(nan=torch.inf), kept >= 0, self.compared, len(free)).double()
        return start


def _place(
    mechanism: Mechanism, link: int | None, reading: Reading, joints: Tensor, values: Tensor, given: Tensor
) -> Place:
    """Where what holds an instrument is, also with the joints that are given where its reading is of two places."""
    there = place_of(mechanism, link, joints, values)
    return there._replace(second=place_of(mechanism, link, given, values).position) if reading.twice else there


def place_of(mechanism: Mechanism, link: int | None, joints: Tensor, values: Tensor) -> Place:
    """Where the link is that holds an instrument, or the tool or platform, in the measuring frame."""
    if link is not None and isinstance(mechanism, SerialArm):
        base = rotation_vector_to_matrix(values[..., 3:6]), values[..., :3]
        rotation, position = compose(base, mechanism.link_frames(joints, values)[link])
        return Place(position, rotation, joints)
    if isinstance(mechanism, SerialArm):
        return Place(*mechanism.forward_frame(joints, values), joints)
    return Place(*mechanism.frame(mechanism.forward_kinematics(joints, values)), joints)


def fit_unknown(
    mechanism: Mechanism,
    joints: Tensor,
    pose: Tensor,
    weights: Tensor | None = None,
    columns: Mapping[str, NDArray[np.float64]] | None = None,
) -> Tensor | None:
    """All parameters with the frames fitted that are unknown, as `fit_frames`; None where all are known."""
    if not getattr(mechanism, "unknown_frames", ()):
        return None
    if isinstance(mechanism, SerialArm):
        return fit_frames(mechanism, joints, pose, weights, columns=columns)
    if isinstance(mechanism, Framed):
        if mechanism.grouped:
            return fit_set_ups(mechanism, joints, pose, weights, columns)
        return mechanism.inlying_frames(joints, pose, weights)
    assert isinstance(mechanism, Instrument)
    return mechanism.fitted(joints, pose, weights)


def instrument(
    mechanism: Mechanism, kind: str, link: int | None = None, keys: Mapping[str, Any] | None = None
) -> Instrument:
    """A mechanism with an instrument of this kind.

    Args:
        keys: of the instrument, see `READINGS`.

    Raises:
        InputError: a kind or key that is not known.
    """
    return Instrument(mechanism, make_reading(kind, keys or {}, mechanism), link)
