"""The rows of commanded joints with covariates, and quantities of the nominal machine derived from them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from weakref import WeakKeyDictionary

import numpy as np
import torch
from torch import Tensor

from ccnn_torch.coordinates import force_of, is_temperature
from ccnn_torch.mechanisms import Instrument, Mechanism, Seen, SerialArm, sees_directions
from ccnn_torch.mechanisms.gears import turns_of
from ccnn_torch.mechanisms.machines.serial import FRAME
from ccnn_torch.numerics.rotations import rotation_vector_to_matrix
from ccnn_torch.records.commanded import SECOND
from ccnn_torch.units import STANDARD_GRAVITY

REFERENCE = 293.15
"""Temperature at which a machine has its dimensions, ISO 1 [K]."""
PLATFORM_WEIGHT = 100.0
"""Weight of a platform of which nothing is known [N]."""
WEIGHTS = (10.0, 20.0, 40.0, 80.0, 160.0, 320.0, 640.0, 1280.0)
"""Weights that a machine may have [N], for weights that act on the joints together with a load that was recorded."""
_SAMPLES = 128
_SAMPLED: WeakKeyDictionary[Mechanism, dict[bytes, Tensor]] = WeakKeyDictionary()
# Share of the nominal spread below which coordinates that were shown are those of the rows.
_FAR_LESS = 0.5
# Cosine below which two axes are square to each other.
_SQUARE = 0.1
# Smallest force or torque of 1 N on a joint [N], [N·m], where gravity does not.
_LEAST = 0.1


def default_gravity(mechanism: Mechanism) -> Tensor:
    """Along -y for a machine that moves in the x-y plane alone, else along -z; `3` [m/s²], as `Situation` has it.

    A Denavit-Hartenberg table whose first joint slides has its z along the track; the arm on it stands along its first
    axis that turns.
    """
    if isinstance(mechanism, SerialArm) and (up := _standing(mechanism)) is not None:
        return -STANDARD_GRAVITY * up
    names = {c.name for c in mechanism.pose}
    flat = "z" not in names and {"x", "y"} <= names
    down = [0.0, -STANDARD_GRAVITY, 0.0] if flat else [0.0, 0.0, -STANDARD_GRAVITY]
    return torch.tensor(down, dtype=torch.float64)


def _standing(arm: SerialArm) -> Tensor | None:
    """The first axis that turns of an arm on a track, `3` [1]: square to the joints that slide before it, and to its
    own base's z; None for any other arm."""
    first = next((i for i, turns in enumerate(arm.revolute.tolist()) if turns), 0)
    if first == 0:
        return None
    _, axes = arm_axes(arm, arm.home_joints, arm.nominal)
    base = rotation_vector_to_matrix(arm.nominal[3:6])
    square = torch.stack([*axes[:first], base[:, 2]]) @ axes[first]
    if bool((square.abs() >= _SQUARE).any()):
        return None
    return axes[first] @ base if has_upright_base(arm) else axes[first]


def arm_axes(arm: SerialArm, joints: Tensor, values: Tensor) -> tuple[Tensor, Tensor]:
    """A point on each joint's axis and the axis' direction in the base frame, `... x n x 3` each [m], [1]."""
    frames = arm.link_frames(joints, values)
    holders = frames[:-1] if arm._axis_before else frames[1:]
    base = rotation_vector_to_matrix(values[..., 3:6])
    points = torch.stack([place for _, place in holders], -2) @ base.mT + values[..., None, :3]
    axes = (torch.stack([turn for turn, _ in holders], -3) @ arm.axes.unsqueeze(-1)).squeeze(-1) @ base.mT
    return points, axes


def has_upright_base(mechanism: Mechanism) -> bool:
    """Whether gravity is along one direction of the machine's own base, however the frames of the poses stand."""
    return isinstance(mechanism, SerialArm) and bool(mechanism.frame_per) and not sees_directions(mechanism)


def load_columns(mechanism: Mechanism) -> dict[str, str]:
    """Columns of the load on the platform with their units, whatever of the pose is measured: forces along its lengths,
    moments about its angles."""
    machine = mechanism.mechanism if isinstance(mechanism, Seen) else mechanism
    pose = {c.name: c.unit for c in machine.pose}
    if isinstance(machine, SerialArm) and machine.orientation == "none":
        pose = dict(FRAME)
    return {f"load_{name}": force_of(unit) for name, unit in pose.items()}


@dataclass(frozen=True)
class Situation:
    """Rows in the order measured, and the nominal machine in them.

    Attributes:
        mechanism: the nominal one.
        joints: commanded, `... x s x n` [SI].
        covariates: by name, `... x s` each [SI]: `time`, `temperature`, `load_NAME` (force along the pose coordinate
            NAME on the platform [N], or moment [N·m]), `direction1`…`directionN` (sign of the joint's last motion),
            `speed…`.
        gravity: `3` [m/s²], in the frame of the poses; of an arm with a base frame for each group of rows, in the arm's
            own base: a plate of sockets may stand in any direction.
        parameters: of the nominal machine, broadcast against the rows; None = its nominal ones.
        guess: poses near by, for mechanisms whose forward kinematics has no closed form, `... x s x p`; or None.
        travel: lowest and highest joints, `2 x n` [SI], of the rows that effects were fitted to; None where that does
            not matter. What follows a joint as no physical law says is held beyond them.
    """

    mechanism: Mechanism
    joints: Tensor
    covariates: Mapping[str, Tensor]
    gravity: Tensor
    parameters: Tensor | None = None
    guess: Tensor | None = None
    travel: Tensor | None = None

    @cached_property
    def machine(self) -> Mechanism:
        """The nominal one under the rows' covariates: a simulator may itself say what a load does."""
        return self.mechanism.under(self.covariates)

    @property
    def thermometers(self) -> list[str]:
        """Columns of the temperatures of parts, `temperature_NAME`."""
        return [n for n in self.covariates if is_temperature(n) and n != "temperature" and not n.endswith(SECOND)]

    @property
    def temperature(self) -> Tensor:
        """Of the surroundings, `... x s` [K]: the column, or the mean of the thermometers of parts without one."""
        if "temperature" in self.covariates:
            return self.covariates["temperature"]
        return torch.stack([self.covariates[name] for name in self.thermometers]).mean(0)

    @cached_property
    def whole(self) -> Situation:
        """The same rows of the mechanism with its whole pose, whatever of it is measured: loads act on all of it."""
        machine = self.mechanism
        if not isinstance(machine, Seen):
            return self
        guess = None if self.guess is None else machine.whole_guess(self.guess)
        inner = machine.inner_values(self.parameters)
        return replace(self, mechanism=machine.mechanism, guess=guess, parameters=inner)

    @cached_property
    def places(self) -> list[Situation]:
        """The rows; and where each is of two places of the machine, the same with the second one first.

        Covariates are of both places, but those of which a column with the ending `_b` has the second place's.
        """
        joints = self.mechanism.places(self.joints, self.guess)
        if len(joints) == 1:
            return [self]
        assert isinstance(self.mechanism, Instrument)
        turned = self.mechanism.with_second(self.pose, self.joints)
        covariates = {n: self.covariates.get(f"{n}{SECOND}", v) for n, v in self.covariates.items()}
        other = self.mechanism.elsewhere()
        return [self, replace(self, mechanism=other, joints=joints[1], guess=turned, covariates=covariates)]

    @cached_property
    def visits(self) -> Situation:
        """The machine itself with its whole pose, in the first place of every row and then in the second ones."""
        each = [place.whole for place in self.places]
        if len(each) == 1:
            return self.whole
        covariates = {n: torch.cat([one.covariates[n] for one in each]) for n in self.covariates}
        return replace(each[0], joints=torch.cat([one.joints for one in each]), covariates=covariates, guess=None)

    def moved(self, joints: Sequence[Tensor], parameters: Tensor | None) -> Situation:
        """The rows with other joints at each of their places, `... x s x n` [SI], and other parameters."""
        guess = self.pose
        if joints[1:]:
            assert isinstance(self.mechanism, Instrument)
            guess = self.mechanism.with_second(guess, joints[1])
        return replace(self, joints=joints[0], parameters=parameters, guess=guess)

    @cached_property
    def pose(self) -> Tensor:
        """Nominal pose at the commanded joints, `... x s x p` [SI]."""
        return self.machine.forward_kinematics(self.joints, self.parameters, self.guess).detach()

    @cached_property
    def place(self) -> Tensor:
        """Where in the workspace the rows are, `... x s x p` [SI]: `where_moved` of the nominal pose and the guess.

        Of rows of two places the nominal pose at the first.
        """
        if len(self.places) > 1:
            return self.whole.pose
        return self.pose if self.guess is None else where_moved(self.pose, self.guess)

    @property
    def lengths(self) -> list[int]:
        """Numbers of the coordinates of `place` that are lengths."""
        mechanism = self.mechanism if len(self.places) == 1 else self.whole.mechanism
        return [k for k, c in enumerate(mechanism.pose) if c.unit == "m"]

    @cached_property
    def jacobian(self) -> Tensor:
        """Derivative of position and rotation vector by the joints, `... x s x c x n`, c = 3 or 6; NaN without pose."""
        return self.machine.jacobian_at(self.pose, self.joints, self.parameters).detach()

    @cached_property
    def parameter_jacobian(self) -> Tensor:
        """The same by the mechanism's parameters, `... x s x c x k`."""
        return self.machine.parameter_jacobian_at(self.pose, self.joints, self.parameters).detach()

    @cached_property
    def frame_slope(self) -> Tensor:
        """Derivative of position and rotation vector by the pose coordinates, `... x s x c x p`."""
        return self.mechanism.frame_slope(_known(self.pose)).detach()[..., : self.mechanism.compared]

    @cached_property
    def visible(self) -> Tensor:
        """Projection onto what the pose coordinates can express, `... x s x c x c`.

        A machine with the pose y, z, phi is measured in these three: its shift along x is not measured.
        """
        rows = self.frame_slope
        if rows.shape[-1] == rows.shape[-2]:
            return torch.eye(rows.shape[-1], dtype=rows.dtype).expand_as(rows)
        span: Tensor = torch.linalg.qr(rows)[0]
        return span @ span.mT

    @cached_property
    def by_place(self) -> Tensor:
        """What an instrument reads by a shift and a turn of what holds it, `... x s x c x 6`; 0 where there is none."""
        assert isinstance(self.mechanism, Instrument)
        return torch.nan_to_num(self.mechanism.by_place(self.joints, self.parameters, self.guess)).detach()

    @cached_property
    def platform(self) -> tuple[Tensor, Tensor | None]:
        """Nominal position `... x s x 3` [m] and rotation matrix of the measured frame; 0 where there is no pose.

        A machine has a rotation also where only its position is measured.
        """
        if self.whole is not self:
            return self.whole.platform
        if isinstance(self.mechanism, SerialArm):
            return self.mechanism.forward_frame(self.joints, self.parameters)
        return self.mechanism.frame(_known(self.pose))

    @cached_property
    def samples(self) -> Situation:
        """The nominal machine at configurations all over its own workspace, without covariates.

        What an effect takes from here (a middle, a range) does not depend on the rows it is evaluated on.
        """
        machine, gravity = self.mechanism, self.gravity
        # Many situations have one machine, and where its joints are searched a sample is dear.
        kept = _SAMPLED.setdefault(machine, {})
        key = b"".join(v.numpy().tobytes() for v in (machine.nominal, *machine.bounds))
        if key not in kept:
            joints = machine.sample_joints(_SAMPLES, torch.Generator().manual_seed(0))
            kept[key] = joints[torch.isfinite(joints).all(-1)]
        return Situation(machine, kept[key], {}, gravity)

    @cached_property
    def workspace(self) -> tuple[Tensor, Tensor]:
        """Lowest and highest joints in samples of the mechanism's workspace, `n` each [joint's unit]."""
        return self.samples.joints.amin(0), self.samples.joints.amax(0)

    @cached_property
    def middle(self) -> Tensor:
        """Middle of the workspace of each joint, `n` [joint's unit]."""
        low, high = self.workspace
        return (low + high) / 2

    @cached_property
    def from_middle(self) -> Tensor:
        """Commanded joints less the middle of their workspace, `... x s x n` [joint's unit]."""
        return self.joints - self.middle

    @cached_property
    def _by_motors(self) -> Tensor | None:
        """Turns of the joints by those of the motors, `n x n`; None where each joint has its own."""
        if not self.mechanism.motors:
            return None
        # By numpy: a graph that is traced has no inverse of a constant.
        return torch.tensor(np.linalg.inv(np.array(self.mechanism.motors)), dtype=self.joints.dtype)

    @cached_property
    def motor_turns(self) -> Tensor:
        """How far the motor of each joint has turned, over its gear, at the commanded joints, `... x s x n`."""
        return turns_of(self.mechanism.motors, self.joints)

    def held_turns(self) -> tuple[Tensor, Tensor] | None:
        """`motor_turns` of joints held at the ends of `travel`, and how far each motor turns within, `n`; or None."""
        if self.travel is None:
            return None
        low, high = self.travel
        motors, inside = self.mechanism.motors, torch.minimum(torch.maximum(self.joints, low), high)
        far = high - low if not motors else torch.tensor(motors, dtype=low.dtype).abs() @ (high - low)
        return turns_of(motors, inside), far

    def fitted_to(self, rows: Tensor) -> Situation:
        """With the travel of some of the rows, `s` bool."""
        joints = torch.cat([place.joints[rows] for place in self.places])
        return replace(self, travel=torch.stack([joints.amin(0), joints.amax(0)]) if len(joints) else None)

    @cached_property
    def motor_jacobian(self) -> Tensor:
        """Derivative of position and rotation vector by the motors' turns, `... x s x c x n`; NaN without pose."""
        return self.jacobian if self._by_motors is None else self.jacobian @ self._by_motors

    def joints_by(self, motors: Tensor) -> Tensor:
        """What changes of the motors `... x n x m` change of the joints, `... x n x m`."""
        return motors if self._by_motors is None else self._by_motors @ motors

    def _on_motors(self, torque: Tensor) -> Tensor:
        """What torques on the joints `... x n` are on the motors, over their gears, by virtual work, `... x n`."""
        return torque if self._by_motors is None else torque @ self._by_motors

    def once(self, make: Callable[[Situation], Tensor]) -> Tensor:
        """What a function makes of these rows, kept with them from when it is first asked for."""
        kept: dict[Callable[[Situation], Tensor], Tensor] = self.__dict__.setdefault("_kept", {})
        if make not in kept:
            kept[make] = make(self)
        return kept[make]

    def with_covariates(self, covariates: Mapping[str, Tensor]) -> Situation:
        """The same rows under other covariates; the nominal pose and its derivatives stay as they were."""
        other = replace(self, covariates=covariates)
        other.__dict__.update({"pose": self.pose, "jacobian": self.jacobian, "frame_slope": self.frame_slope})
        return other

    @property
    def loaded(self) -> bool:
        """Whether a load on the platform was recorded."""
        return any(name in self.covariates for name in load_columns(self.mechanism))

    @cached_property
    def wrench(self) -> Tensor:
        """Force and moment about the base frame's axes of the load on the platform, `... x s x c` [N, N·m].

        The load is given along the pose coordinates; moments on an arm are about the axes of the base frame, and are
        not there (c = 3) where its position alone is measured and none was recorded.
        """
        zero = torch.zeros_like(self.joints[..., 0])
        along = [self.covariates.get(name) for name in load_columns(self.mechanism)]
        if len(self.mechanism.pose) == 3 and all(moment is None for moment in along[3:]):
            along = along[:3]
        force = torch.stack([zero if q is None else q.expand_as(zero) for q in along], -1)
        if self.mechanism.orientations:
            return force
        held: Tensor = self.holding @ force.unsqueeze(-1)
        return held.squeeze(-1)

    @cached_property
    def holding(self) -> Tensor:
        """Force and moment per unit of load along each pose coordinate, `... x s x c x p`."""
        rows = self.frame_slope
        inner = rows.mT @ rows
        eye = torch.eye(inner.shape[-1], dtype=inner.dtype, device=inner.device)
        inverse: Tensor = torch.linalg.solve(inner, eye.expand_as(inner))
        return rows @ inverse

    @cached_property
    def load_torque(self) -> Tensor:
        """Force or torque of the load on each joint, by virtual work, `... x s x n` [N or N·m]; 0 without a load.

        Drives hold minus this.
        """
        if not self.loaded:
            return torch.zeros_like(self.joints)
        if self.whole is not self:
            return self.whole.load_torque
        slope, wrench = _known(self.jacobian), self.wrench
        torque: Tensor = (slope.mT @ wrench[..., : slope.shape[-2]].unsqueeze(-1)).squeeze(-1)
        if wrench.shape[-1] == slope.shape[-2]:
            return self._on_motors(torque)
        # Of an arm whose position alone is measured: moments turn its joints about their axes.
        arm = self.mechanism
        assert isinstance(arm, SerialArm)
        values = arm.resolve(self.parameters)
        turned = (arm_axes(arm, self.joints, values)[1] @ wrench[..., 3:].unsqueeze(-1)).squeeze(-1) * arm.revolute
        coupled = arm.coupled(self.joints, values)
        turned = turned if coupled is None else (coupled.mT @ turned.unsqueeze(-1)).squeeze(-1)
        return self._on_motors(torque + turned)

    @cached_property
    def weight_torque(self) -> Tensor:
        """Force or torque on each joint of 1 N of weight on the platform, `... x s x n` [N or N·m per N]."""
        if self.whole is not self:
            return self.whole.weight_torque
        # As a matrix product: the ONNX exporter gets that of a stack of matrices with one vector wrong.
        torque: Tensor = _known(self.jacobian)[..., :3, :].mT @ self.down.unsqueeze(-1)
        return self._on_motors(torque.squeeze(-1))

    @cached_property
    def own_weight_torque(self) -> Tensor:
        """Force or torque on each joint of 1 N of the machine's own weight, `... x s x n` [N or N·m per N].

        Of an arm it is where its masses are, or, where these are not known, spread evenly over the origins of its links
        and the tool; of others it is the platform's.
        """
        if isinstance(self.whole.mechanism, SerialArm):
            return self.whole._links_torque(torch.ones_like)
        return self.weight_torque

    @cached_property
    def carried_torque(self) -> Tensor:
        """Force or torque on each joint of the load, and of an arm's own weight where its file tells its masses, by
        virtual work, `... x s x n` [N or N·m]: what springs of the drives carry."""
        arm = self.whole.mechanism
        if not isinstance(arm, SerialArm) or not len(arm.masses):
            return self.load_torque
        return self.load_torque + STANDARD_GRAVITY * arm.masses.sum() * self.own_weight_torque

    @cached_property
    def inner_weight_torque(self) -> Tensor:
        """As `own_weight_torque` of an arm whose links are the heavier the nearer they are to its base: each is
        multiplied by what falls linearly to 0 at the last."""
        return self.whole._links_torque(lambda far: 1 - far)

    def _links_torque(self, heavy: Callable[[Tensor], Tensor]) -> Tensor:
        """Torques of 1 N over the links of an arm, `... x s x n`; heavy: what each is multiplied by, by how far out it
        is, 0 to 1, `k`."""
        arm = self.mechanism
        assert isinstance(arm, SerialArm)
        values = arm.resolve(self.parameters)
        frames, base = arm.link_frames(self.joints, values), rotation_vector_to_matrix(values[..., 3:6])
        rotation, flange = frames[-1]
        tool = flange + (rotation @ values[..., -6:-3, None]).squeeze(-1)
        if len(arm.masses):
            places, share = arm.weighs(frames, tool)
        else:
            places = torch.stack([*(place for _, place in frames[1:]), tool], -2)
            share = torch.ones(places.shape[-2], dtype=places.dtype)
        share = share * heavy(torch.linspace(0, 1, len(share), dtype=places.dtype))
        points, axes = arm_axes(arm, self.joints, values)
        # What a joint moves: links from its own on.
        onward = torch.ones(points.shape[-2], len(share), dtype=places.dtype).triu() * share / share.sum()
        moved = onward.sum(-1)
        lever = onward @ (places @ base.mT + values[..., None, :3]) - moved[:, None] * points
        turned, slid = torch.linalg.cross(axes, lever, dim=-1), moved[:, None] * axes
        rates = torch.where(arm.revolute[:, None], turned, slid) * arm.signs[:, None]
        torque: Tensor = (rates @ self.down.unsqueeze(-1)).squeeze(-1)
        coupled = arm.coupled(self.joints, values)
        return self._on_motors(torque if coupled is None else (coupled.mT @ torque.unsqueeze(-1)).squeeze(-1))

    @cached_property
    def down(self) -> Tensor:
        """Unit vector along gravity in the frame of the poses, `3`, or `s x 3` where the frame is by row; 0 where there
        is none."""
        size: Tensor = torch.linalg.vector_norm(self.gravity)
        down = self.gravity / size.clamp_min(1e-300)
        if not has_upright_base(self.mechanism):
            return down
        turn = rotation_vector_to_matrix(self.mechanism.resolve(self.parameters)[..., 3:6])
        return (turn @ down[:, None]).squeeze(-1)

    def push(self, weight: Tensor, rows: Tensor | None = None) -> Tensor:
        """How hard weight and load push each joint along its coordinate, `... x s x n` [1].

        In units of what `PLATFORM_WEIGHT` typically requires of the joints of the same unit in the workspace.

        Args:
            weight: of the machine, `...` [N].
            rows: which are asked for, `t`; None = all.
        """
        own, load = self.own_weight_torque, self.load_torque
        own, load = (own, load) if rows is None else (v.index_select(-2, rows) for v in (own, load))
        return (own * weight[..., None, None] + load) / (self.typical_torque * PLATFORM_WEIGHT)

    @cached_property
    def typical_torque(self) -> Tensor:
        """Typical force or torque of 1 N of its own weight on joints in this one's unit, `n` [N or N·m per N]."""
        torques = self.samples.own_weight_torque.square().mean(0)
        units = [j.unit for j in self.mechanism.joints]
        alike = torch.tensor([[a == b for b in units] for a in units], dtype=torques.dtype)
        return (alike @ torques / alike.sum(-1)).sqrt().clamp_min(_LEAST)

    @cached_property
    def directed(self) -> list[int]:
        """Numbers, from 0, of the joints whose direction of approach is known."""
        return [i for i in range(self.joints.shape[-1]) if f"direction{i + 1}" in self.covariates]

    @cached_property
    def direction(self) -> Tensor:
        """Sign of each joint's last motion, `... x s x n` [1]; 0 for a joint without such a column."""
        columns = [self.covariates.get(f"direction{i + 1}") for i in range(self.joints.shape[-1])]
        zero = torch.zeros_like(self.joints[..., 0])
        return torch.stack([zero if d is None else d.expand_as(zero) for d in columns], -1)


def where_moved(nominal: Tensor, shown: Tensor) -> Tensor:
    """Nominal coordinates, but the middle of those that were shown where these vary far less over the rows,
    `... x s x c`.

    A machine that is led to one height, as that of a bed, is there: its nominal coordinate then varies by nothing but
    the gap, and what was shown by the noise, and any cause that goes by them would explain it.
    """
    shown = torch.where(torch.isfinite(shown), shown, nominal)
    spread, other = (values.amax(-2, keepdim=True) - values.amin(-2, keepdim=True) for values in (nominal, shown))
    return torch.where(other < _FAR_LESS * spread, shown.mean(-2, keepdim=True), nominal)


def _known(values: Tensor) -> Tensor:
    """0 where the nominal machine has no pose: an effect does nothing there."""
    return torch.nan_to_num(values, posinf=0.0, neginf=0.0)
