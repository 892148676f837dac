"""A mechanism seen through instruments: tracker, camera, wire, gauge, level, second encoder, in rows of any of them."""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ccnn_torch.coordinates import Coordinate
from ccnn_torch.errors import InputError
from ccnn_torch.mechanisms.frames.fit import fit_frames
from ccnn_torch.mechanisms.frames.framed import Framed
from ccnn_torch.mechanisms.frames.part import Part, all_places, all_read, has_orientation
from ccnn_torch.mechanisms.frames.partial import Seen
from ccnn_torch.mechanisms.frames.readings import READINGS, Place, Pose, make_reading
from ccnn_torch.mechanisms.frames.set_ups import fit_set_ups
from ccnn_torch.mechanisms.machines.serial import SerialArm
from ccnn_torch.mechanisms.mechanism import Mechanism
from ccnn_torch.mechanisms.pose import Frame, PoseError, frame_gap, frame_jacobian
from ccnn_torch.numerics.least_squares import jacobian_of, levenberg_marquardt
from ccnn_torch.numerics.outliers import inlying
from ccnn_torch.numerics.rotations import rotation_vector_to_matrix

# Rounds in which rows that are gross outliers are left out of the fit of what is unknown.
_ROUNDS = 3


class Instrument(Seen):
    """A mechanism whose pose is what instruments read, side by side, and after it what they were pointed at.

    The second part (a corner of a board, the number of an anchor) is given with each row and never compared: forward
    kinematics take it from `guess`, which is the row as it was recorded, and return it as it is. Parameters are the
    mechanism's, then those of each instrument. Readings stand for the position of `frame`, lengths and angles alike;
    the orientation that a tracker sees is its rotation.

    Attributes:
        parts: the instruments; one that reads orientations is the last.
    """

    def __init__(self, mechanism: Mechanism, *parts: Part) -> None:
        """See the class.

        Raises:
            InputError: a link that there is not, two instruments alike, or one that needs an orientation on a machine
                without one.
        """
        self._check_links(mechanism, parts)
        parts = tuple(sorted(parts, key=lambda part: isinstance(part.reading, Pose) and part.reading.turns))
        read = [Coordinate(part.called(c.name), c.unit) for part in parts for c in part.reading.read]
        given = [Coordinate(part.called(c.name), c.unit) for part in parts for c in part.reading.given]
        own = [p for part in parts for p in part.parameters]
        for names in ([c.name for c in (*read, *given)], [p.name for p in own]):
            twice = next((name for name in names if names.count(name) > 1), None)
            if twice is not None:
                raise InputError(
                    f"instruments: two have {twice!r}; give one of them a name, which stands in front of its columns "
                    f"and parameters: name: second for second.{twice}"
                )
        usual = torch.tensor([v for part in parts for v in part.reading.usual], dtype=torch.float64)
        start = torch.tensor([p.nominal for p in own], dtype=torch.float64)
        turned = has_orientation(mechanism)
        blind = next((p.reading.kind for p in parts if (p.reading.turns or p.place) and not turned), None)
        if blind is not None:
            raise InputError(f"mechanism '{mechanism.name}' has no orientation, which a {blind} on it needs")
        places = all_places(mechanism, parts, mechanism.home_joints, mechanism.nominal, usual)
        home = all_read(parts, places, start, usual)
        super().__init__(mechanism, [*read, *given], [*home.tolist(), *usual.tolist()], own)
        self.parts, self.known, self._only_twice = parts, False, False

    @staticmethod
    def _check_links(mechanism: Mechanism, parts: Sequence[Part]) -> None:
        links = len(mechanism.joints)
        for link, reading in ((part.link, part.reading) for part in parts if part.link is not None):
            if not (isinstance(mechanism, SerialArm) and 0 <= link <= links):
                arm = isinstance(mechanism, SerialArm)
                what = f"write 0 to {links}" if arm else "only a serial arm has links; remove it"
                raise InputError(f"link: {link} is no link of {mechanism.name}; {what}")
            if not reading.on_links:
                raise InputError(
                    f"link: how a {reading.kind} sits on a link has no parameters; only a level may be on one"
                )

    @property
    def note(self) -> str:
        """What a reader of results has to know; empty where nothing."""
        return " ".join(part.reading.note for part in self.parts if part.reading.note)

    @property
    def compared(self) -> int:
        """How many coordinates are read; the rest are given."""
        return sum(len(part.reading.read) for part in self.parts)

    @property
    def _turns(self) -> bool:
        """Whether the last three readings are an orientation."""
        last = self.parts[-1].reading
        return isinstance(last, Pose) and last.turns

    @property
    def channels(self) -> tuple[Coordinate, ...]:
        """The readings; lengths of no name where these are fewer than three."""
        read = self.pose[: self.compared]
        plain, turns = (read[:-3], read[-3:]) if self._turns else (read, ())
        return (*plain, *[Coordinate("", "m")] * (3 - len(plain)), *turns)

    @property
    def unknown_frames(self) -> tuple[str, ...]:
        """What is fitted to rows first, as the names of its parameters begin: base and tool of an arm, an anchor."""
        if self.known:
            return ()
        unknown: tuple[str, ...] = getattr(self.mechanism, "unknown_frames", ())
        shown = [name for name in unknown if not all(name in part.blind for part in self.parts)]
        return (*shown, *self.unknown_parts)

    @property
    def unknown_parts(self) -> tuple[str, ...]:
        """Of these names those of the instruments themselves, whether or not they are known by now."""
        return tuple(name for part in self.parts for name in part.unknown)

    def set_parameters(self, values: Mapping[str, float]) -> None:
        """As of a mechanism; nothing is unknown any more where values are not those that it was made with."""
        super().set_parameters(values)
        self.known = any(
            values[g.name] != g.nominal for g in self.geometry if g.name.partition("_")[0] in self.unknown_frames
        )

    def _own_file(self) -> dict[str, Any]:
        keys: dict[str, Any] = {"mechanism": self.mechanism.describe()}
        each = []
        for part in self.parts:
            own = {"kind": part.reading.kind, **part.reading.keys}
            own |= {} if part.link is None else {"link": part.link}
            own |= {"name": part.name} if part.name else {}
            each.append(own | ({"own_point": True} if part.place == "point" else {}))
        return {"spec": "instrument", "keys": keys | (each[0] if self.alone else {"instruments": each})}

    @property
    def alone(self) -> bool:
        """Whether it is one instrument, whose place is the tool frame."""
        return len(self.parts) == 1 and not self.parts[0].place and not self.parts[0].name

    def around(self, mechanism: Mechanism) -> Instrument:
        """The same instruments, with their parameters, on another machine."""
        found = Instrument(mechanism, *self.parts)
        return found.with_nominal(torch.cat([mechanism.nominal, self.nominal[len(self.mechanism.geometry) :]]))  # type: ignore[return-value]

    def shown_by(self, names: Sequence[str]) -> Instrument | None:
        """With the instruments of whose readings there are columns, where these are some of several."""
        there = [part for part in self.parts if any(part.called(c.name) in names for c in part.reading.read)]
        if not 0 < len(there) < len(self.parts):
            return None
        fewer = Instrument(self.mechanism, *there)
        values = dict(zip((p.name for p in self.geometry), self.nominal.tolist(), strict=True))
        fewer.set_parameters({p.name: values[p.name] for p in fewer.geometry})
        return fewer if [c.name for c in fewer.pose] == [*names] else None

    def forward_kinematics(
        self, joints: Tensor, parameters: Tensor | None = None, guess: Tensor | None = None
    ) -> Tensor:
        """What is read with these joints, and what is given by `guess` (home without), `... x p` [SI]."""
        values, given = self.resolve(parameters), self.given(guess)
        read = self._read(self._places(joints, values, given), values, given)
        if self._only_twice:
            twice = [part.reading.twice for part in self.parts for _ in part.reading.read]
            read = torch.where(torch.tensor(twice), read, 0.0)
        return torch.cat([read, given.expand(*read.shape[:-1], -1)], -1)

    def _places(self, joints: Tensor, values: Tensor, given: Tensor) -> list[Place]:
        return all_places(self.mechanism, self.parts, joints, values[..., : len(self.mechanism.geometry)], given)

    def _read(self, places: list[Place], values: Tensor, given: Tensor, twist: Tensor | None = None) -> Tensor:
        return all_read(self.parts, places, values[..., len(self.mechanism.geometry) :], given, twist)

    def given(self, rows: Tensor | None) -> Tensor:
        """What the rows `... x p` were of, `... x g` [SI]; what is usual where there are none."""
        return (self.home_pose if rows is None else rows)[..., self.compared :]

    def _second(self) -> slice | None:
        """Of all columns the joints of the second place; None where rows have one place."""
        first = self.compared
        for part in self.parts:
            if part.reading.twice:
                return slice(first, first + len(self.joints))
            first += len(part.reading.given)
        return None

    def places(self, joints: Tensor, rows: Tensor | None) -> list[Tensor]:
        """Of rows whose reading is of two places, both."""
        second = self._second()
        if second is None:
            return [joints]
        there = (self.home_pose if rows is None else rows)[..., second].expand_as(joints)
        # A row without a second place shows nothing of it.
        return [joints, torch.where(there.isnan(), joints, there)]

    def with_second(self, rows: Tensor, joints: Tensor) -> Tensor:
        """Rows `... x p` with other joints `... x n` of the second place."""
        second = self._second()
        assert second is not None
        return torch.cat([rows[..., : second.start], joints, rows[..., second.stop :]], -1)

    def elsewhere(self) -> Instrument:
        """As what is read changes with the second place, given as the first: nothing else does."""
        twin = copy.copy(self)
        twin._only_twice = True
        return twin

    def hand(self, joints: Tensor) -> Tensor:
        """Where the nominal tool or platform is, `... x 3` [m]: of what is read nothing need be a place."""
        return self.mechanism.frame(self.mechanism.forward_kinematics(joints))[0]

    def sample_given(self, count: int, generator: torch.Generator) -> Tensor:
        """Rows of any anchor, plane or second place, `count x p` [SI]; nothing is read yet."""
        columns = [self.home_pose[: self.compared].expand(count, -1)]
        for reading in (part.reading for part in self.parts):
            groups = torch.tensor(reading.groups, dtype=torch.float64)
            if reading.twice:
                columns.append(self.mechanism.sample_joints(count, generator))
            elif len(groups):
                columns.append(groups[torch.randint(len(groups), (count, 1), generator=generator)])
            else:
                columns.append(torch.tensor(reading.usual, dtype=torch.float64).expand(count, -1))
        return torch.cat(columns, -1)

    def frame(self, pose: Tensor) -> Frame:
        """What is read, `... x c`, but an orientation, which is the rotation."""
        read = pose[..., : self.compared]
        plain = read[..., :-3] if self._turns else read
        plain = torch.nn.functional.pad(plain, (0, max(0, 3 - plain.shape[-1])))
        return plain, rotation_vector_to_matrix(read[..., -3:]) if self._turns else None

    def pose_error(self, measured: Tensor, reference: Tensor) -> PoseError:
        """Over the lengths [m] and over the angles [rad] that were read; NaN where none was."""
        here, there = (torch.where(pose.isnan(), 0.0, pose) for pose in (measured, reference))
        gap = frame_gap(self.frame(here), self.frame(there), 1.0)
        known = ~(measured.isnan() | reference.isnan())[..., : self.compared]
        units = [c.unit for c in self.pose[: self.compared]]
        padded = [k for k, c in enumerate(self.channels) if c.name]
        gap = torch.where(known, gap[..., padded], 0.0)
        sizes = []
        for unit in ("m", "rad"):
            mine = [k for k, u in enumerate(units) if u == unit]
            size = gap[..., mine].norm(dim=-1)
            sizes.append(torch.where(known[..., mine].any(-1), size, torch.nan) if mine else size)
        return PoseError(sizes[0], sizes[1] if "rad" in units else None)

    def singular_values(
        self,
        joints: Tensor,
        rotation_weight: float = 0.04,
        parameters: Tensor | None = None,
        guess: Tensor | None = None,
    ) -> Tensor:
        """The largest alone: readings that show the same are no singularity."""
        return super().singular_values(joints, rotation_weight, parameters, guess)[..., :1]

    def by_place(self, joints: Tensor, parameters: Tensor | None, guess: Tensor | None) -> Tensor:
        """Change of `frame` by a shift and a turn (about its own point) of what holds them, `... x c x 6`."""
        values, given = self.resolve(parameters), self.given(guess)
        places = self._places(joints, values, given)

        def read(twist: Tensor) -> Frame:
            return self.frame(self._read(places, values, given, twist))

        return frame_jacobian(read, torch.zeros(*joints.shape[:-1], 6, dtype=joints.dtype), len(self.channels))

    def _shown(self, joints: Tensor, rows: Tensor) -> list[tuple[Part, Tensor, Tensor, Tensor]]:
        """Each instrument with the joints `t x n` at which it read, and what it read and was pointed at there,
        `t x (c + g)`, and the latter alone."""
        found, read, given = list[tuple[Part, Tensor, Tensor, Tensor]](), 0, self.compared
        for part in self.parts:
            count = len(part.reading.read)
            ends = read + count, given + len(part.reading.given)
            mine = torch.cat([rows[:, read : ends[0]], rows[:, given : ends[1]]], -1)
            whole = ~mine.isnan().any(-1)
            found.append((part, joints[whole], mine[whole], mine[whole, count:]))
            read, given = ends
        return found

    def noise_groups(self) -> list[int]:
        """Of each reading which of them have one noise: those of one instrument in one unit."""
        every = [(i, c.unit) for i, part in enumerate(self.parts) for c in part.reading.read]
        return [[*dict.fromkeys(every)].index(one) for one in every]

    @property
    def given_of(self) -> dict[str, list[str]]:
        """Columns of what an instrument was pointed at, and those of its readings that need them."""
        return {
            part.called(given.name): [part.called(c.name) for c in part.reading.read]
            for part in self.parts
            for given in part.reading.given
        }

    def fitted(self, joints: Tensor, pose: Tensor, weights: Tensor | None = None) -> Tensor:
        """All parameters, those of `unknown_frames` fitted to rows, the rest nominal.

        Args:
            joints: `s x n` [SI].
            pose: readings and what they are of, `s x p` [SI]; NaN where not measured.
            weights: `... x s`, 0 leaves a row out.

        Returns:
            `... x k` [SI].

        Raises:
            InputError: too few rows.
        """
        weights = torch.ones(len(joints), dtype=torch.float64) if weights is None else weights
        flat = [self._fitted_to(joints, pose, w, self.unknown_frames) for w in weights.reshape(-1, len(joints))]
        return torch.stack(flat).reshape(*weights.shape[:-1], -1)

    def suited(self, joints: Tensor, pose: Tensor) -> Instrument:
        """Itself where closed forms put the instruments by rows, their parameters counted from where rows show them."""
        parts, machine = list[Part](), self.mechanism.nominal
        values = [machine]
        for part, q, rows, given in self._shown(joints, pose):
            (place,) = all_places(self.mechanism, [part], q, machine, given)
            parts.append(replace(part, reading=part.reading.suited(place, rows)))
            own = torch.tensor([p.nominal for p in parts[-1].parameters], dtype=torch.float64)
            values.append(parts[-1].start(place, rows, own))
        return Instrument(self.mechanism, *parts).with_nominal(torch.cat(values))  # type: ignore[return-value]

    def placed(self, joints: Tensor, pose: Tensor) -> Instrument:
        """Itself where the instruments stand as suits rows best, the machine, its frames and a lens as they are."""
        lens = [name for part in self.parts if part.reading.looks for name in map(part.called, part.reading.unknown)]
        unknown = () if self.known else tuple(name for name in self.unknown_parts if name not in lens)
        weights = torch.ones(len(joints), dtype=torch.float64)
        return self.with_nominal(self._fitted_to(joints, pose, weights, unknown))  # type: ignore[return-value]

    def _fitted_to(self, joints: Tensor, pose: Tensor, weights: Tensor, unknown: Sequence[str]) -> Tensor:
        free = [k for k, g in enumerate(self.geometry) if g.name.partition("_")[0] in unknown]
        used = (weights > 0) & ~pose[:, : self.compared].isnan().all(-1)
        if not free:
            return self.nominal.clone()
        q, x = joints[used], pose[used]
        seen = ~x[:, : self.compared].isnan()
        if int(seen.sum()) < len(free):
            kinds = ", ".join(part.reading.kind for part in self.parts)
            raise InputError(
                f"{self.name}: {int(used.sum())} rows with {int(seen.sum())} readings cannot determine where the "
                f"{kinds} {'is' if len(self.parts) == 1 else 'are'} ({len(free)} unknowns); measure more"
            )
        start = self._begun(q, x, unknown)
        x = torch.where(x.isnan(), self.home_pose, x)
        # Where the machine is known it stands where it stands.
        stands = free[0] >= len(self.mechanism.geometry)
        places = self._places(q, start, self.given(x)) if stands else None
        group = torch.tensor(self.noise_groups())
        groups = torch.nn.functional.one_hot(group).double()
        kept, scale = torch.ones(len(q), dtype=torch.float64), torch.ones(self.compared, dtype=torch.float64)
        for _ in range(_ROUNDS):

            def gap(values: Tensor, kept: Tensor = kept, start: Tensor = start, scale: Tensor = scale) -> Tensor:
                full = start.expand(*values.shape[:-1], -1).index_copy(-1, torch.tensor(free), values)
                return torch.where(seen, self._left(q, full, x, places), 0.0) / scale * kept[:, None]

            if groups.shape[-1] > 1:
                # Readings of different kinds weigh as they scatter.
                left = gap(start[free]) * scale
                size = (left.square() @ groups).sum(0) / (seen.double() @ groups).sum(0).clamp_min(1)
                scale = (groups @ size.sqrt()).clamp_min(1e-12)

            def both(values: Tensor, gap: Callable[..., Tensor] = gap, scale: Tensor = scale) -> tuple[Tensor, Tensor]:
                # A row's residual is of its own copy of the values: one pass for each reading and not for each row.
                every = values.expand(len(q), -1)
                value, slope = jacobian_of(lambda at: gap(at, scale=scale), every, copies=self.compared)
                return value.flatten(), slope.flatten(0, 1)

            found = levenberg_marquardt(gap, start[free], both=both, max_iterations=100)
            start = start.index_copy(0, torch.tensor(free), found.value)
            left = torch.where(seen, self._left(q, start, x, places), 0.0) / scale
            length = left.norm(dim=-1) * (self.compared / seen.sum(-1)).sqrt()
            kept = inlying(length.nan_to_num(nan=torch.inf), kept >= 0, self.compared, len(free)).double()
        return start

    def _left(self, joints: Tensor, values: Tensor, rows: Tensor, places: list[Place] | None) -> Tensor:
        """From what was read to what these parameters say, `s x c`; places: of what holds the instruments, if known."""
        given = self.given(rows)
        read = self._read(places or self._places(joints, values, given), values, given)
        gap = frame_gap(self.frame(read), self.frame(rows), 1.0)
        return gap[..., [k for k, c in enumerate(self.channels) if c.name]]

    def _begun(self, joints: Tensor, rows: Tensor, unknown: Sequence[str]) -> Tensor:
        """All parameters near those that suit rows, from closed forms."""
        start, arm, first = self.nominal.clone(), self.mechanism, len(self.mechanism.geometry)
        own, each = torch.split(start[first:], [len(part.parameters) for part in self.parts]), self._shown(joints, rows)
        if isinstance(arm, SerialArm) and {*arm.unknown_frames} & {*unknown}:
            for (part, q, mine, _), values in zip(each, own, strict=True):
                stands, poses = (q, None) if part.place else part.reading.frames(q, mine, values)
                if poses is not None:
                    shown = arm if poses.shape[-1] == len(arm.pose) else arm.with_orientation("none")
                    start[:first] = fit_frames(shown, stands, poses)
                    break
        found = [start[:first]]
        for (part, q, mine, given), values in zip(each, own, strict=True):
            (place,) = all_places(arm, [part], q, start[:first], given)
            found.append(part.start(place, mine, values))
        return torch.cat(found)


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


def instrument(mechanism: Mechanism, instruments: Sequence[Mapping[str, Any]]) -> Instrument:
    """A mechanism with instruments.

    Args:
        instruments: of each its `kind`, its keys (see `READINGS`), and `link`, `name` or `own_point`.

    Raises:
        InputError: none, a kind or key that is not known, or no list of these.
    """
    if isinstance(instruments, str | Mapping) or not instruments:
        raise InputError("instruments: write a list, e.g. [{kind: wire, anchors: 2}, {kind: level}, {kind: pose}]")
    return Instrument(mechanism, *(make_part(about, mechanism, len(instruments) > 1) for about in instruments))


def make_part(about: Mapping[str, Any], mechanism: Mechanism, among: bool = False) -> Part:
    """One instrument of a mechanism, from its kind and keys.

    among: whether it stands beside others, so that a camera has a place of its own.

    Raises:
        InputError: a kind or key that is not known.
    """
    if not isinstance(about, Mapping) or not isinstance(about.get("kind"), str):
        raise InputError(f"instruments: {about!r} has no kind; write one of {', '.join(READINGS)}")
    keys = {k: v for k, v in about.items() if k not in ("kind", "link", "name", "own_point")}
    reading = make_reading(about["kind"], keys, mechanism)
    camera = reading.looks and among
    if camera:
        # What it does not look at in a row must not spoil the row.
        reading.behind = 1.0
    place = "camera" if camera else "point" if about.get("own_point") else ""
    return Part(reading, about.get("link"), str(about.get("name") or ""), place)
