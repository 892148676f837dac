"""Any mechanism seen from a measuring device: base and tool frame as parameters beside its own."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from ccnn_torch.coordinates import Coordinate, Parameter
from ccnn_torch.errors import InputError
from ccnn_torch.mechanisms.frames.fit import best_closed_form, rigid_body_frame, whole_rows
from ccnn_torch.mechanisms.frames.partial import Around
from ccnn_torch.mechanisms.machines.links import compose, transform_of
from ccnn_torch.mechanisms.machines.serial import FRAME
from ccnn_torch.mechanisms.mechanism import Mechanism
from ccnn_torch.mechanisms.newton import carry_derivative
from ccnn_torch.mechanisms.pose import Frame, frame_gap
from ccnn_torch.numerics.batching import expand_leading
from ccnn_torch.numerics.least_squares import jacobian_of, levenberg_marquardt
from ccnn_torch.numerics.outliers import inlying
from ccnn_torch.numerics.rotations import matrix_to_rotation_vector, nearest_rotation, rotation_vector_to_matrix, skew


class Framed(Around):
    """base · mechanism · tool: its pose is the measured frame x, y, z [m], rx, ry, rz [rad] (a rotation vector).

    A mechanism without orientation has the pose x, y, z. Parameters in order: base_x … base_rz (where the mechanism's
    base is in the measuring frame; with `base`), those of the mechanism, tool_x … tool_rz (the measured point and
    axes on its platform; with `tool`); all frames are nominally the identity. A measured frame may have more
    coordinates than the mechanism has joints: `solve_inverse` gives the joints of the closest pose in
    (position, rotation_weight x rotation vector), where `closure` gives the remaining error. The frame of the
    mechanism's pose is that of the nominal machine: a parameter that moves the platform at given pose coordinates acts
    by the joints only.

    Attributes:
        mechanism: a copy of the mechanism, without hooks.
        rotation_weight: [m/rad].
    """

    @property
    def unknown_frames(self) -> tuple[str, ...]:
        """The frames that are to be fitted to rows first: all, where they are by group or nominally the identity."""
        base, _, tool = self.split(self.nominal)
        if not self.grouped and bool(base.any() or tool.any()):
            return ()
        return ("base",) * self.base + ("tool",) * self.tool

    @property
    def flat(self) -> bool:
        """Whether the mechanism moves in a plane, so that a measured z would be 0 and need not be given."""
        return [c.name for c in self.mechanism.pose] == ["x", "y"]

    def __init__(
        self,
        mechanism: Mechanism,
        base: bool = True,
        tool: bool = False,
        rotation_weight: float = 0.04,
        frame_per: Sequence[str] = (),
        tool_per: Sequence[str] = (),
    ) -> None:
        """See the class; frame_per, tool_per: as of `Mechanism`.

        Raises:
            InputError: a tool on a mechanism without orientation, where it would be a shift of the base, or groups of a
                frame that there is not.
        """
        for key, names, free in (("frame_per", frame_per, "base"), ("tool_per", tool_per, "tool")):
            if isinstance(names, str) or not all(isinstance(name, str) for name in names):
                raise InputError(f"mechanism 'framed': {key} must be a list of columns, e.g. [station], not {names!r}")
            if names and not (base if free == "base" else tool):
                raise InputError(f"mechanism 'framed': {key} needs a {free} frame; write {free}: true, or remove {key}")
        inner = mechanism.with_nominal(mechanism.nominal)
        turns = inner.frame(inner.home_pose)[1] is not None
        if tool and not turns:
            raise InputError(
                f"mechanism '{inner.name}' has no orientation: a tool frame would only shift the base; use tool=False"
            )
        taken = {f"{place}_{c}" for place in ("base", "tool") for c, _ in FRAME} & {g.name for g in inner.geometry}
        if taken:
            names = ", ".join(sorted(taken))
            raise InputError(
                f"mechanism '{inner.name}' has parameters that are called as the frames of 'framed' are: {names}; take "
                "a mechanism without frames of its own, or give these parameters other names (point_x)"
            )
        frames = {place: [Parameter(f"{place}_{c}", u, 0.0) for c, u in FRAME] for place in ("base", "tool")}
        start = inner.frame(inner.home_pose)
        super().__init__(
            name=f"framed_{inner.name}",
            joints=inner.joints,
            pose=[Coordinate(c, u) for c, u in (FRAME if turns else FRAME[:3])],
            geometry=[*(frames["base"] if base else []), *inner.geometry, *(frames["tool"] if tool else [])],
            low=(0.0,) * (6 if turns else 3),
            high=(0.0,) * (6 if turns else 3),
            home_pose=_coordinates(*start).tolist(),
            home_joints=inner.home_joints.tolist(),
        )
        self.mechanism, self.takes, self.gears, self.motors = inner, inner.takes, inner.gears, inner.motors
        self.base, self.tool, self.rotation_weight = base, tool, rotation_weight
        self.frame_per, self.tool_per = tuple(frame_per), tuple(tool_per)
        # Where the coordinates of the mechanism's pose are those of its frame there is nothing to search.
        plain = type(inner).frame is Mechanism.frame and type(inner).pose_near is Mechanism.pose_near
        self._plain = plain and (not turns or len(inner.pose) == 6)
        self._follow_nominal()

    def _own_file(self) -> dict[str, Any]:
        keys: dict[str, Any] = {"base": self.base, "tool": self.tool, "rotation_weight": self.rotation_weight}
        keys |= {key: list(names) for key in ("frame_per", "tool_per") if (names := getattr(self, key))}
        return {"spec": "framed", "keys": {"mechanism": self.mechanism.describe(), **keys}}

    def _follow_nominal(self) -> None:
        """The mechanism's own nominal parameters; the box around 256 fixed samples, since frames turn it."""
        self.mechanism.nominal.copy_(self.split(self.nominal)[1])
        self.mechanism._follow_nominal()
        self.home_joints.copy_(self.mechanism.home_joints)
        self.home_pose.copy_(self.seen(self.mechanism.home_pose, self.nominal))
        samples = self.sample_workspace(256, torch.Generator().manual_seed(0))
        # Coordinates that the mechanism does not move still need a box that is not empty.
        self.low.copy_(samples.amin(0) - 1e-6)
        self.high.copy_(samples.amax(0) + 1e-6)

    def controlled(self) -> Mechanism:
        """As of the mechanism inside."""
        return self.mechanism.controlled()

    def sample_workspace(self, count: int, generator: torch.Generator) -> Tensor:
        """Samples of the mechanism, as the measuring device sees them; `count x p` [SI]."""
        return self.seen(self.mechanism.sample_workspace(count, generator), self.nominal)

    def forward_kinematics(
        self, joints: Tensor, parameters: Tensor | None = None, guess: Tensor | None = None
    ) -> Tensor:
        """The mechanism's pose of the joints, seen through both frames."""
        values = self.resolve(parameters)
        near = None if guess is None else self.mechanism.pose_near(*self.unseen(guess, values)).detach()
        return self.seen(self.mechanism.forward_kinematics(joints, self.split(values)[1], near), values)

    def solve_inverse(self, pose: Tensor, parameters: Tensor | None = None, guess: Tensor | None = None) -> Tensor:
        """Joints of the closest pose: both frames are taken off, then the mechanism's own inverse kinematics."""
        return self.nearest_joints(pose, parameters, guess, self.rotation_weight)

    def nearest_joints(
        self,
        pose: Tensor,
        parameters: Tensor | None,
        guess: Tensor | None,
        rotation_weight: float,
        damping: float = 0.0,
    ) -> Tensor:
        """As `solve_inverse` with another weight [m/rad]."""
        values = self.resolve(parameters)
        return self.mechanism.solve_inverse(self._closest(pose, values, rotation_weight), self.split(values)[1], guess)

    def jacobian(self, joints: Tensor, parameters: Tensor | None = None, guess: Tensor | None = None) -> Tensor:
        """The mechanism's Jacobian, turned by the base and carried to the tool; see `Mechanism.jacobian`."""
        values = self.resolve(parameters)
        base, inner, tool = self.split(values)
        near = None if guess is None else self.mechanism.pose_near(*self.unseen(guess, values))
        rows = self.mechanism.jacobian(joints, inner, near)
        turn = rotation_vector_to_matrix(base[..., 3:])
        linear = turn @ rows[..., :3, :]
        platform = self.mechanism.frame(self.mechanism.forward_kinematics(joints, inner, near))[1]
        if platform is None:
            return linear
        angular = turn @ rows[..., 3:, :]
        lever = (turn @ platform @ tool[..., :3, None])[..., 0]
        return torch.cat([linear - skew(lever) @ angular, angular], dim=-2)

    def reachable(self, pose: Tensor, parameters: Tensor | None = None) -> Tensor:
        """Whether the mechanism reaches its closest pose; `...`, bool."""
        values = self.resolve(parameters)
        closest = self._closest(pose, values, self.rotation_weight)
        return self.mechanism.reachable(closest, self.split(values)[1])

    def inlying_frames(self, joints: Tensor, pose: Tensor, weights: Tensor | None = None) -> Tensor:
        """As `fitted_frames` to the rows that are no gross outliers; weights: `... x s`, 0 leaves a row out.

        A row that lacks a part of its pose (NaN) is left out.
        """
        weights, pose = whole_rows(pose, weights)
        fine = weights
        for _ in range(3):
            values = self.fitted_frames(joints, self.frame(pose), fine)
            error = self.pose_error(self.forward_kinematics(joints, values[..., None, :], pose), pose)
            turned = 0.0 if error.rotation is None else self.rotation_weight * error.rotation
            length = torch.hypot(error.position, torch.as_tensor(turned, dtype=joints.dtype)).nan_to_num(nan=torch.inf)
            fine = weights * inlying(length, weights > 0, len(self.pose), 6 * (self.base + self.tool))
        return values

    def fitted_frames(self, joints: Tensor, measured: Frame, weights: Tensor | None = None) -> Tensor:
        """Closed-form frames between the nominal mechanism's poses of the joints and measured ones.

        Args:
            joints: `... x s x n` [SI].
            measured: position `... x s x 3` [m] and rotation `... x s x 3 x 3` (or None).
            weights: `... x s` [1]; all 1 when None.

        Returns:
            All parameters, `... x k` [SI], the mechanism's own nominal. Where fewer than three joints have a pose all
            are nominal.
        """
        values = self.nominal.expand(*joints.shape[:-2], -1)
        inner = self.split(self.nominal)[1]
        guess = None
        # Iterative forward kinematics that start at home may end on another branch than from near the measured pose.
        for _ in range(2):
            position, rotation = self.mechanism.frame(self.mechanism.forward_kinematics(joints, inner, guess))
            known = torch.isfinite(position).all(-1)
            weighed = known.to(position.dtype) if weights is None else known * weights
            here = torch.where(known[..., None], position, 0.0), rotation
            if rotation is not None:
                here = here[0], torch.where(known[..., None, None], rotation, torch.eye(3, dtype=rotation.dtype))
            enough = ((weighed > 0).sum(-1) >= 3)[..., None]
            found = self._frames_between(here, measured, torch.where(enough, weighed, 1.0))
            values = torch.where(enough, found, self.nominal)
            guess = self.mechanism.pose_near(*self._unframed(measured, values[..., None, :]))
        return values.detach()

    def _frames_between(self, here: Frame, measured: Frame, weights: Tensor) -> Tensor:
        """All parameters, `... x k`, with the free frames in closed form."""
        inner = self.split(self.nominal)[1].expand(*weights.shape[:-1], -1)
        if self.base and not self.tool:
            return torch.cat([rigid_body_frame(here, measured, weights, self.rotation_weight), inner], dim=-1)
        assert here[1] is not None and measured[1] is not None  # a tool without orientation is refused
        if self.base:
            tool = self.split(self.nominal)[2]
            both = best_closed_form(here[1], here[0], measured, tool, weights, self.rotation_weight)
            return torch.cat([both[..., :6], inner, both[..., 6:]], dim=-1)
        share = (weights / weights.sum(-1, keepdim=True))[..., None]
        back = here[1].mT
        place = (share * (back @ (measured[0] - here[0])[..., None])[..., 0]).sum(-2)
        turn = nearest_rotation((share[..., None] * (back @ measured[1])).sum(-3))
        return torch.cat([inner, place, matrix_to_rotation_vector(turn)], dim=-1)

    def split(self, values: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Base frame `... x 6`, the mechanism's parameters, tool frame `... x 6`; 0 where a frame is no parameter."""
        none = torch.zeros_like(values[..., :1]).expand(*values.shape[:-1], 6)
        first, last = 6 if self.base else 0, values.shape[-1] - (6 if self.tool else 0)
        return (
            values[..., :6] if self.base else none,
            values[..., first:last],
            values[..., last:] if self.tool else none,
        )

    def own_values(self, values: Tensor) -> Tensor:
        """Of the parameters `... x k` those of the mechanism inside."""
        return self.split(values)[1]

    def seen(self, inner_pose: Tensor, values: Tensor) -> Tensor:
        """The mechanism's pose as the measuring device sees it, `... x p`."""
        base, _, tool = self.split(values)
        position, rotation = self.mechanism.frame(inner_pose)
        if rotation is None:
            return base[..., :3] + (rotation_vector_to_matrix(base[..., 3:]) @ position[..., None])[..., 0]
        whole = compose(compose(transform_of(base), (rotation, position)), transform_of(tool))
        return _coordinates(whole[1], whole[0])

    def unseen(self, pose: Tensor, values: Tensor) -> Frame:
        """The frame in the mechanism's base that the measuring device sees as the pose."""
        return self._unframed(self.frame(pose), values)

    def _unframed(self, seen: Frame, values: Tensor) -> Frame:
        """As `unseen`, of a frame."""
        base, _, tool = self.split(values)
        position, rotation = seen
        turn = rotation_vector_to_matrix(base[..., 3:]).mT
        there = (turn @ (position - base[..., :3])[..., None])[..., 0]
        if rotation is None:
            return there, None
        platform = turn @ rotation @ rotation_vector_to_matrix(tool[..., 3:]).mT
        return there - (platform @ tool[..., :3, None])[..., 0], platform

    def _closest(self, pose: Tensor, values: Tensor, rotation_weight: float) -> Tensor:
        """The mechanism's pose whose frame is closest to the measured one, `... x p'`, differentiable."""
        target = self.unseen(pose, values)
        start = self.mechanism.pose_near(*target)
        if self._plain:
            return start

        def gap(point: Tensor, position: Tensor, *rotation: Tensor) -> Tensor:
            there = rotation[0].reshape(*position.shape, 3) if rotation else None
            return frame_gap(self.mechanism.frame(point), (position, there), rotation_weight)

        data = (target[0],) if target[1] is None else (target[0], target[1].flatten(-2))
        plain = tuple(d.detach() for d in data)
        found = levenberg_marquardt(gap, expand_leading(start, *data).detach(), data=plain).value
        slope = jacobian_of(lambda point: gap(point, *plain), found)[1]
        return carry_derivative(found, slope, gap(found, *data))


def _coordinates(position: Tensor, rotation: Tensor | None) -> Tensor:
    return position if rotation is None else torch.cat([position, matrix_to_rotation_vector(rotation)], dim=-1)
