"""Serial arms of any number of revolute and prismatic joints, from a DH table or a URDF chain."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from ccnn_torch.coordinates import Coordinate, Parameter
from ccnn_torch.errors import InputError
from ccnn_torch.mechanisms.branches import commanded_joints
from ccnn_torch.mechanisms.closest import Closest
from ccnn_torch.mechanisms.gears import moved_by, read_motors
from ccnn_torch.mechanisms.machines.drives import Drives
from ccnn_torch.mechanisms.machines.links import (
    LINKS,
    SCREWS,
    Frames,
    Screws,
    compose,
    counting,
    lean_screws,
    link_frames_of,
    links_and_drives,
    parallel_to_next,
    start_and_shares,
    transform_of,
    weighing,
)
from ccnn_torch.mechanisms.pose import Frame
from ccnn_torch.numerics.batching import stack_last
from ccnn_torch.numerics.rotations import (
    matrix_to_rotation_vector,
    rotation_vector_rate,
    rotation_vector_to_matrix,
    skew,
)

MOST_JOINTS = 100
"""Most joints of an arm; twice those of any snake that was built, and few enough for every matrix of all of them."""

# Keys of a description that is older than these, or has none of them, are not there.
_WHERE_GIVEN = ("goal_tool", "tables", "leans", "masses", "centres", "gears", "motors")
FRAME = (("x", "m"), ("y", "m"), ("z", "m"), ("rx", "rad"), ("ry", "rad"), ("rz", "rad"))


class SerialArm(Closest):
    """base · link 1 · … · link n · tool; pose x, y, z [m] and rotation vector rx, ry, rz [rad] in the record's frame.

    Parameters in order: the base frame (6: position, rotation vector), each link's (DH: a, alpha, d, theta; URDF: x, y,
    z, roll, pitch, yaw), those of leans and of drives, the tool frame (6). With `numbers` these stand in the place of
    those of links and drives: each adds to some of them, so that the links are linear in what people know of the
    machine.
    For records the guess of `solve_inverse` is the commanded joints.

    Attributes:
        unknown_frames: those of "base" and "tool" that must be fitted to records first (`frames.fit_frames`).
        frame_per, tool_per: record columns that number the groups with a base or tool frame of their own.
        parallel_axes: groups of joints (counted from 1) with parallel axes.
        orientation: "rotation_vector"; "none": the pose is x, y, z alone; or "direction": these are the unit vector in
            which the tool looks, so that only lengths behind the last axis count, and a shift of the base does nothing.
        rotation_weight: [m/rad].
        drives: pairs of joints i, j (from 1): the drive of joint j moves joint i as well, by parameter driveij for each
            unit; of i = j joint i is off by that share (lead, gear ratio).
        leans: links (from 1) with a fifth Denavit-Hartenberg parameter, betai [rad], by which the axis at the link's
            end (modified: its own) leans about y of the frame there: Ry(beta) after (modified: before) the others.
        masses: of the links, `n` [kg]; none where the file does not tell them.
        along_axis: which axis of the frame that a joint carries, from 0, is nearest to the joint's own.
        own_drives: what these and the tables of pitch errors do.
    """

    orientations = ("rotation_vector", "quaternion", "none")
    axes: Tensor
    signs: Tensor
    revolute: Tensor
    limits: Tensor
    _start: Tensor
    _shares: Tensor
    _leaning: Tensor
    counting: Tensor
    masses: Tensor
    _centres: Tensor

    def __init__(
        self,
        name: str,
        convention: str,
        links: Sequence[Sequence[float]],
        joint_types: Sequence[str] | None = None,
        joint_sign: Sequence[float] | None = None,
        axes: Sequence[Sequence[float]] | None = None,
        base: Sequence[float] = (0.0,) * 6,
        tool: Sequence[float] = (0.0,) * 6,
        limits: Sequence[Sequence[float]] | None = None,
        tool_offset: Sequence[float] | str | None = None,
        unknown_frames: Sequence[str] = (),
        frame_per: Sequence[str] = (),
        tool_per: Sequence[str] = (),
        parallel_axes: Sequence[Sequence[int]] = (),
        orientation: str = "rotation_vector",
        rotation_weight: float = 0.04,
        drives: Sequence[Sequence[int]] = (),
        numbers: Sequence[Mapping[str, Any]] = (),
        goal_tool: Sequence[float] | None = None,
        tables: Sequence[Sequence[Sequence[float]] | None] | None = None,
        leans: Sequence[Sequence[float]] = (),
        masses: Sequence[float] = (),
        centres: Sequence[Sequence[float]] = (),
        gears: Sequence[float | None] = (),
        motors: Mapping[str, Mapping[str, float]] | None = None,
    ) -> None:
        """Build from plain numbers [SI].

        Args:
            name: what the arm is called in cards and messages.
            convention: "standard" or "modified" (Denavit-Hartenberg), or "urdf".
            links: a row of link parameters per joint, `n x 4` or (urdf) `n x 6`.
            joint_types: "revolute" or "prismatic" per joint; all revolute when None.
            joint_sign: +1 or -1 per joint.
            axes: joint axes in the link's frame, `n x 3`; z when None.
            base, tool: frames, position and rotation vector.
            tool_offset: position of the tool, or "unknown"; replaces `tool` where the pose has no orientation.
            goal_tool: the tool that commanded poses are of, position and rotation vector; `tool` when None.
            limits: lowest and highest value per joint, for sampling only; a full turn or a metre when None.
            unknown_frames, frame_per, tool_per, parallel_axes, orientation, rotation_weight, drives, gears: see class.
            motors: as of `read_motors`.
            tables: of each joint the places and the errors of its pitch-error table there, or None.
            leans: pairs of a link (from 1), see the class, and its lean [rad].
            masses: of the links, `n` [kg]; unknown when there are none.
            centres: of mass of the links, each in the frame at its link's end, `n x 3` [m]; of an empty one halfway
                from its joint's axis to the next.
            numbers: fields of a `Parameter`, and `of`: what one unit of it adds to links' and drives' parameters, by
                name; `links` are then what is there without them.

        Raises:
            InputError: unknown convention or orientation, or masses that are none.
        """
        every = {k: v for k, v in locals().items() if k not in ("self", "__class__")}
        if convention not in LINKS or orientation not in ("rotation_vector", "none", "direction"):
            raise InputError(
                f"arm '{name}': convention is one of {', '.join(LINKS)}, orientation 'rotation_vector', 'none' or "
                f"'direction'; got '{convention}', '{orientation}'"
            )
        if not 1 <= len(links) <= MOST_JOINTS:
            raise InputError(f"arm '{name}': has {len(links)} joints that move; 1 to {MOST_JOINTS} can be handled")
        unknown = set(unknown_frames)
        if orientation != "rotation_vector" and tool_offset is not None:
            tool = (0.0,) * 6 if isinstance(tool_offset, str) else (*tool_offset, 0.0, 0.0, 0.0)
            unknown = unknown - {"tool"} | ({"tool"} if isinstance(tool_offset, str) else set())
        n, types = len(links), tuple(joint_types or ["revolute"] * len(links))
        self._transform, _, _, self._axis_before = LINKS[convention]
        pose = FRAME if orientation == "rotation_vector" else FRAME[:3]
        geometry = [Parameter(f"base_{c}", u, v) for (c, u), v in zip(FRAME, base, strict=True)]
        joints = [Coordinate(f"q{i}", "rad" if t == "revolute" else "m") for i, t in enumerate(types, 1)]
        driven = read_motors(motors, joints, f"arm '{name}': motors") if motors else ()
        # A ratio that the controller has a little wrong moves one joint by another one.
        drives = [*drives, *([] if numbers else moved_by(driven))]
        own = links_and_drives(convention, links, [j.unit for j in joints], drives, leans, orientation == "direction")
        start, shares = start_and_shares(own, numbers)
        if numbers:
            own = [Parameter(**{k: v for k, v in number.items() if k != "of"}) for number in numbers]
            geometry = [replace(p, held="base" not in unknown) for p in geometry]
        geometry += own
        geometry += [
            Parameter(f"tool_{c}", u, v, held=bool(numbers) and ("tool" not in unknown or (c, u) not in pose))
            for (c, u), v in zip(FRAME, tool, strict=True)
        ]
        super().__init__(
            name=name,
            joints=joints,
            pose=[Coordinate(c, u) for c, u in pose],
            geometry=geometry,
            low=[-math.pi] * len(pose),
            high=[math.pi] * len(pose),
            home_joints=[0.0] * n,
        )
        self.convention, self.orientation, self.rotation_weight = convention, orientation, rotation_weight
        self.unknown_frames, self.parallel_axes = tuple(sorted(unknown)), tuple(map(tuple, parallel_axes))
        self.frame_per, self.tool_per = tuple(frame_per), tuple(tool_per)
        self.gears, self.motors = tuple(gears), driven
        span = limits or [(-math.pi, math.pi) if t == "revolute" else (0.0, 1.0) for t in types]
        self.register_buffer("axes", torch.tensor(axes or [[0.0, 0.0, 1.0]] * n, dtype=torch.float64))
        self.register_buffer("signs", torch.tensor(joint_sign or [1.0] * n, dtype=torch.float64))
        self.register_buffer("revolute", torch.tensor([t == "revolute" for t in types]))
        self.register_buffer("limits", torch.tensor(span, dtype=torch.float64))
        self.own_drives = Drives(drives, tables or [None] * n)
        self.drives, self._named = tuple(map(tuple, drives)), bool(numbers)
        self.leans, self._links_size = tuple(int(i) for i, _ in leans), len(start) - len(drives) - len(leans)
        known = {"_start": start, "_shares": shares, "_leaning": torch.eye(n).double()[[i - 1 for i in self.leans]]}
        for key, value in {**known, **weighing(name, masses, centres, n)}.items():
            self.register_buffer(key, value, persistent=False)
        self.register_buffer("counting", counting(convention, n, orientation == "direction"))
        keys = {k: v for k, v in every.items() if v or k not in _WHERE_GIVEN}
        self.recipe = {"spec": "serial", "keys": json.loads(json.dumps(keys))}
        self._follow_nominal()
        carried = self.axes
        if self._axis_before:
            turns, _ = self.link_transforms(torch.zeros(n, dtype=torch.float64), self.nominal)
            carried = (turns.mT @ self.axes[..., None])[..., 0]
        self.along_axis: list[int] = carried.abs().argmax(-1).tolist()

    def _follow_nominal(self) -> None:
        """The best-conditioned of 64 fixed draws (many arms are singular at zero); the box of poses from the reach."""
        draws = self.sample_joints(64, torch.Generator().manual_seed(0))
        self.home_joints.copy_(draws[self.condition_number(draws, self.rotation_weight).argmin()])
        self.home_pose.copy_(self.forward_kinematics(self.home_joints))
        self.low[:3], self.high[:3] = self.nominal[:3] - self.reach, self.nominal[:3] + self.reach

    @property
    def reach(self) -> float:
        """Sum of the lengths of links and tool and of prismatic travel [m]; nothing is farther from the base."""
        rows = self.links(self.nominal)
        lengths = rows[:, :3] if self.convention == "urdf" else rows[:, (0, 2)]
        travel = self.limits.abs().amax(-1)[~self.revolute].sum()
        return float(lengths.norm(dim=-1).sum() + self.nominal[-6:-3].norm() + travel)

    @property
    def has_limits(self) -> bool:
        """Whether its file tells the limits of its joints."""
        return self.recipe["keys"]["limits"] is not None

    @cached_property
    def joint_of(self) -> dict[str, str]:
        """The joint before or in each link, by the names of the link's parameters; none where they have own words."""
        if self._named:
            return {}
        names = (*LINKS[self.convention][1], "beta")
        return {f"{p}{i}": joint.name for i, joint in enumerate(self.joints, 1) for p in names}

    def with_leans(self) -> SerialArm:
        """The same arm, nominal parameters included, with a fifth parameter of each link between parallel axes.

        An arm whose links are no Denavit-Hartenberg table, or that has parameters of its own, is returned as it is.
        """
        if self.convention == "urdf" or self._named:
            return self
        parallel = parallel_to_next(self.convention, self.links(self.nominal).tolist(), self.parallel_axes)
        if set(parallel) <= set(self.leans):
            return self
        every = self.lean_of_links(self.nominal).tolist()
        leans = [[i, every[i - 1]] for i in sorted({*parallel, *self.leans})]
        twin = SerialArm(**{**self.recipe["keys"], "leans": leans})
        own, behind = 6 + self._links_size, 6 + self._links_size + len(self.leans)
        added = self.nominal.new_tensor([lean for _, lean in leans])
        twin.nominal.copy_(torch.cat([self.nominal[:own], added, self.nominal[behind:]]))
        twin._follow_nominal()
        return twin

    def with_link_frames(self) -> SerialArm:
        """The same arm with six parameters a link, in the URDF form, nominal parameters and kinematics unchanged.

        They do what those of a table with its leans do, and every link may be off in every direction: with priors the
        better ones on measured arms. The nominal tool frame takes in the constant part of the last link; frames that
        are unknown stay so.
        """
        if self.convention == "urdf":
            return self
        keys, zero = self.recipe["keys"], torch.zeros(len(self.joints), dtype=torch.float64)
        there = link_frames_of(self.link_transforms(zero, self.nominal), self._centres, self._axis_before)
        goal = keys.get("goal_tool")
        twin = SerialArm(
            **{
                **keys,
                "convention": "urdf",
                "leans": [],
                "links": there.links,
                "base": self.nominal[:6].tolist(),
                "tool": there.from_last(self.nominal[-6:]),
                "goal_tool": None if goal is None else there.from_last(torch.tensor(goal, dtype=torch.float64)),
                "tool_offset": None,
                "unknown_frames": list(self.unknown_frames),
                "centres": there.centres if "centres" in keys else [],
            }
        )
        if self.drives:
            twin.nominal[-6 - len(self.drives) : -6] = self.of_drives(self.nominal)
            twin._follow_nominal()
        return twin

    def with_orientation(self, orientation: str) -> SerialArm:
        """The same arm, nominal parameters included, for poses of another kind: "none", "direction" …"""
        twin = SerialArm(**{**self.recipe["keys"], "orientation": orientation})
        kept = len(self.nominal) - (6 if self.recipe["keys"]["tool_offset"] is not None else 0)
        twin.nominal[:kept] = self.nominal[:kept]
        twin._follow_nominal()
        return twin

    def controlled(self) -> SerialArm:
        """The arm of its file in its own base; at the flange where its tool is unknown. Poses have an orientation."""
        keys = self.recipe["keys"]
        known = {"base": (0.0,) * 6, "tool_offset": None, "unknown_frames": (), "orientation": "rotation_vector"}
        # What was measured of an axis is no part of what its controller computes.
        known["tables"] = None
        return SerialArm(**{**keys, **known, "tool": keys.get("goal_tool") or keys["tool"]})

    def commanded_joints(self, pose: Tensor, guess: Tensor | None = None) -> Tensor:
        """See `Mechanism.commanded_joints`; of three joints the positions `s x 3` are enough."""
        return commanded_joints(self if pose.shape[-1] == 6 else self.with_orientation("none"), pose, guess)

    def fitting_branches(self, joints: Tensor, pose: Tensor) -> tuple[Tensor, str]:
        """Joints of commanded poses on the branch on which the measured poses fit best; see `frames.commanded`."""
        from ccnn_torch.mechanisms.frames.commanded import fitting_branches

        return fitting_branches(self, joints, pose)

    def sample_joints(self, count: int, generator: torch.Generator) -> Tensor:
        """Uniform within the joint limits, `count x n` [SI]."""
        draw = torch.rand(count, len(self.joints), generator=generator, dtype=torch.float64)
        return self.limits[:, 0] + (self.limits[:, 1] - self.limits[:, 0]) * draw

    def reachable(self, pose: Tensor, parameters: Tensor | None = None) -> Tensor:
        """Positions no farther from the base than the reach: necessary, not sufficient; `...`, bool."""
        values = self.resolve(parameters)
        distance: Tensor = torch.linalg.vector_norm(pose[..., :3] - values[..., :3], dim=-1)
        # Of a head that only turns every pose is that far.
        return distance <= self.reach * (1 + 1e-9)

    def in_own_base(self, position: Tensor, vectors: Tensor, parameters: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """A measured position `... x 3` [m] and vectors `... x v x 3` in the arm's own base, without the base frame."""
        values = self.resolve(parameters)
        turn = rotation_vector_to_matrix(values[..., 3:6])
        inside: Tensor = ((position - values[..., :3])[..., None, :] @ turn)[..., 0, :]
        return inside, vectors @ turn

    def skeleton(self, pose: Tensor, joints: Tensor, parameters: Tensor | None = None) -> dict[str, Tensor]:
        """The links between the frames; see `Mechanism.skeleton`."""
        values = self.resolve(parameters)
        frames = self.link_frames(joints, values)
        rotation, flange = frames[-1]
        points = [*(place for _, place in frames), flange + rotation @ values[..., -6:-3]]
        links = {f"link {i + 1}": torch.stack(points[i : i + 2]) for i in range(len(points) - 2)}
        return links | {"tool": torch.stack(points[-2:])}

    def flange(self, joints: Tensor, parameters: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Flange in the arm's own base, without base and tool frame: rotation `... x 3 x 3`, position `... x 3` [m]."""
        return self.link_frames(joints, self.resolve(parameters))[-1]

    def links(self, values: Tensor) -> Tensor:
        """Parameters of the links, `... x n x 4` (DH) or `... x n x 6`, of all parameters `... x k` [SI]."""
        own = self._of_links(values)[..., : self._links_size]
        return own.reshape(*values.shape[:-1], len(self.joints), -1) * self.counting

    def lean_of_links(self, values: Tensor) -> Tensor:
        """By which each link leans, `... x n` [rad]."""
        own = self._of_links(values)[..., self._links_size : self._links_size + len(self.leans)]
        return own @ self._leaning

    def _of_links(self, values: Tensor) -> Tensor:
        """Parameters of the links, then of their leans, then of the drives."""
        own = values[..., 6:-6]
        return self._start + own @ self._shares if self._named else own

    def coupled(self, joints: Tensor, values: Tensor) -> Tensor | None:
        """How joints move for each unit of the commands `... x n`, `... x n x n`; None where all drives are exact."""
        if not self.own_drives.count and not self.own_drives.curved:
            return None
        return self.own_drives.coupled(joints if self.own_drives.curved else None, self.of_drives(values))

    def of_drives(self, values: Tensor) -> Tensor:
        """Parameters of the drives, `... x d`, of all parameters `... x k` [SI]."""
        return self._of_links(values)[..., self._links_size + len(self.leans) :]

    def driven(self, joints: Tensor, values: Tensor) -> Tensor:
        """Joints as the drives move them, `... x n`."""
        if self.own_drives.curved:
            return self.own_drives.moved(joints, self.of_drives(values))
        coupled = self.coupled(joints, values)
        return joints if coupled is None else (coupled @ joints[..., None])[..., 0]

    def link_transforms(self, joints: Tensor, values: Tensor) -> tuple[Tensor, Tensor]:
        """From each link to the one before: rotation `... x n x 3 x 3` and translation `... x n x 3` [m].

        joints: as the drives move them.
        """
        motion = joints * self.signs
        turns, places = self._transform(self.links(values), motion * self.revolute, motion * ~self.revolute, self.axes)
        if not self.leans:
            return turns, places
        lean = self.lean_of_links(values)
        s, c, zero, one = lean.sin(), lean.cos(), torch.zeros_like(lean), torch.ones_like(lean)
        by = stack_last(c, zero, s, zero, one, zero, -s, zero, c).reshape(*lean.shape, 3, 3)
        if self._axis_before:
            return turns @ by, places
        return by @ turns, (by @ places[..., None])[..., 0]

    def link_frames(self, joints: Tensor, values: Tensor) -> list[tuple[Tensor, Tensor]]:
        """Frames of the links one after the other, n + 1 of them, from the arm's own base to the flange."""
        rotations, translations = self.link_transforms(self.driven(joints, values), values)
        lead = translations.shape[:-2]
        start = torch.eye(3, dtype=joints.dtype).expand(*lead, 3, 3), torch.zeros(*lead, 3, dtype=joints.dtype)
        frames = [start, (rotations[..., 0, :, :], translations[..., 0, :])]
        for i in range(1, len(self.joints)):
            frames.append(compose(frames[-1], (rotations[..., i, :, :], translations[..., i, :])))
        return frames

    def weighs(self, frames: Sequence[tuple[Tensor, Tensor]], tool: Tensor) -> tuple[Tensor, Tensor]:
        """Where its links weigh, `... x n x 3` [m], and their shares of the weight, `n` [1]; needs `masses`. Given are
        `link_frames` and the tool `... x 3` [m], both in the arm's own base."""
        holders = frames[:-1] if self._axis_before else frames[1:]
        ends = torch.stack([*(place for _, place in holders), tool], -2)
        told = torch.nan_to_num(self._centres).unsqueeze(-1)
        own = [(turn @ centre).squeeze(-1) + at for (turn, at), centre in zip(frames[1:], told, strict=True)]
        halfway = (ends[..., 1:, :] + ends[..., :-1, :]) / 2
        return torch.where(self._centres.isnan(), halfway, torch.stack(own, -2)), self.masses / self.masses.sum()

    def forward_frame(self, joints: Tensor, parameters: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Position `... x 3` [m] and rotation `... x 3 x 3` of the tool, also where the pose has no orientation."""
        values = self.resolve(parameters)
        base = rotation_vector_to_matrix(values[..., 3:6]), values[..., :3] * (self.orientation != "direction")
        whole = compose(base, self.link_frames(joints, values)[-1])
        rotation, position = compose(whole, transform_of(values[..., -6:]))
        return position, rotation

    def forward_kinematics(
        self, joints: Tensor, parameters: Tensor | None = None, guess: Tensor | None = None
    ) -> Tensor:
        """Closed form; see `Mechanism.forward_kinematics`."""
        position, rotation = self.forward_frame(joints, parameters)
        if self.orientation != "rotation_vector":
            return position
        return torch.cat([position, matrix_to_rotation_vector(rotation)], dim=-1)

    def _frame_at(self, joints: Tensor, values: Tensor, rows: Tensor) -> Frame:
        return self.forward_frame(joints, values)

    def jacobian(self, joints: Tensor, parameters: Tensor | None = None, guess: Tensor | None = None) -> Tensor:
        """Geometric Jacobian, closed form; see `Mechanism.jacobian`."""
        values = self.resolve(parameters)
        linear, angular = self._rates(self.link_frames(joints, values), values)
        base = rotation_vector_to_matrix(values[..., 3:6]).mT
        rates = linear @ base
        if self.orientation == "rotation_vector":
            rates = torch.cat([rates, angular @ base], dim=-1)
        coupled = self.coupled(joints, values)
        return rates.mT if coupled is None else rates.mT @ coupled

    def _rates(self, frames: list[Frames], values: Tensor) -> Screws:
        """Velocity of the tip and rate of rotation by each joint as driven, in the arm's own base; `... x n x 3`."""
        rotation, position = frames[-1]
        tip = position + (rotation @ values[..., -6:-3, None])[..., 0]
        holders = frames[:-1] if self._axis_before else frames[1:]
        axes = (torch.stack([f[0] for f in holders], dim=-3) @ self.axes[..., None])[..., 0]
        # A point on the axis gives the lever arm of a revolute joint; a prismatic one only moves along its axis.
        swept = torch.linalg.cross(axes, tip[..., None, :] - torch.stack([f[1] for f in holders], dim=-2), dim=-1)
        turning, signs = self.revolute[:, None], self.signs[:, None]
        return torch.where(turning, swept, axes) * signs, axes * (turning * signs)

    def _by_own(self, columns: Tensor, rates: Tensor, joints: Tensor) -> Tensor:
        """Columns of the parameters between the frames, `... x k x 3`, from those of links and leans `... x l x 3` and
        of the joints as driven `... x n x 3`."""
        if self.drives:
            by = self.own_drives.of(joints)
            more = [rates[..., i - 1, :] * by[..., k, None] for k, (i, _) in enumerate(self.drives)]
            columns = torch.cat([columns, torch.stack(more, -2).expand(*columns.shape[:-2], -1, 3)], -2)
        return self._shares @ columns if self._named else columns

    def parameter_jacobian(
        self, joints: Tensor, parameters: Tensor | None = None, guess: Tensor | None = None
    ) -> Tensor:
        """By the screw of each parameter, closed form; see `Mechanism.parameter_jacobian`."""
        values = self.resolve(parameters)
        frames = self.link_frames(joints, values)
        flange, place = frames[-1]
        tip = place + (flange @ values[..., -6:-3, None])[..., 0]
        rotations, places = (torch.stack([f[k] for f in frames], dim=-3 + k) for k in (0, 1))
        count, links = len(self.joints), self.links(values)
        lead = tip.shape[:-1]
        before = rotations[..., :-1, :, :].expand(*lead, count, 3, 3), places[..., :-1, :].expand(*lead, count, 3)
        after = rotations[..., 1:, :, :], places[..., 1:, :]
        tips = tip[..., None, :].expand(*lead, count, 3)
        moved, turned = SCREWS[self.convention](
            links.expand(*lead, *links.shape[-2:]), before, after, tips, self.lean_of_links(values)
        )
        leaning = self._leaning @ torch.stack(lean_screws(after if self._axis_before else before, tips))
        base = rotation_vector_to_matrix(values[..., 3:6])
        # `... x 3 x k` each, in the frame of the poses.
        linear, angular = (
            base @ self._by_own(torch.cat([part.flatten(-3, -2), lean], -2), rate, joints).mT
            for part, lean, rate in zip(
                (moved * self.counting[..., None], turned), leaning, self._rates(frames, values), strict=True
            )
        )
        base_rate, tool_rate = (rotation_vector_rate(values[..., k : k + 3]) for k in (3, values.shape[-1] - 3))
        lever = (base @ tip[..., None])[..., 0]
        whole = (base @ flange).expand(*lead, 3, 3)
        eye = torch.eye(3, dtype=tip.dtype).expand(*lead, 3, 3)
        none = torch.zeros_like(eye)
        shift = none if self.orientation == "direction" else eye
        rows = torch.cat([shift, -skew(lever) @ base_rate, linear, whole, none], -1)
        if self.orientation != "rotation_vector":
            return rows
        spins = torch.cat([none, base_rate.expand(*lead, 3, 3), angular, none, whole @ tool_rate], -1)
        return torch.cat([rows, spins], -2)
