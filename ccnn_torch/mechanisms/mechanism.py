"""Base class of mechanisms: named joints, pose coordinates and parameters, and batched differentiable kinematics."""

from __future__ import annotations

import copy
import inspect
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property, wraps
from typing import Any, Literal

import torch
from torch import Tensor, nn

from ccnn_torch.coordinates import Condition, Coordinate, Parameter
from ccnn_torch.errors import InputError
from ccnn_torch.mechanisms import branches as _branches, newton as _numeric
from ccnn_torch.mechanisms.gears import Motors
from ccnn_torch.mechanisms.pose import (
    CHANNELS,
    PoseError,
    coordinates_jacobian,
    frame_from_coordinates,
    frame_jacobian,
    pose_error,
)
from ccnn_torch.numerics.batching import expand_leading
from ccnn_torch.numerics.rotations import matrix_to_rotation_vector, wrap_angle
from ccnn_torch.numerics.sampling import drawn_within


class InverseKinematics(nn.Module):
    """The module that torch forward hooks sit on; it only calls `solve_inverse` of its mechanism."""

    def __init__(self, solve_inverse: Callable[..., Tensor]) -> None:
        super().__init__()
        # A bound method, not the mechanism: a child that holds its parent as a submodule would never end.
        self._solve = solve_inverse

    def forward(
        self,
        pose: Tensor,
        parameters: Tensor | None = None,
        guess: Tensor | None = None,
        covariates: Tensor | None = None,
        **ignored: object,
    ) -> Tensor:
        """Joints of a pose, as `Mechanism.solve_inverse`.

        `covariates` and further keywords are there for the hooks: the nominal kinematics do not depend on them.
        """
        return self._solve(pose, parameters, guess)


class Mechanism(nn.Module):
    """Base class of mechanisms.

    A new one gives `closure`, `solve_inverse` or `forward_kinematics`; all else has a
    numerical default. Closed forms may leave out the argument `guess`.

    Everything is float64 and SI, broadcasts over leading dims, parameters included (`r x 1 x k` parameters and `s x n`
    joints give `r x s x p` poses), and is differentiable in joints, pose and parameters. A row without a solution
    is returned as NaN: ask `reachable` first.

    Attributes:
        name: name in configs and model cards.
        joints, pose: coordinates in order, `n` and `p` of them.
        geometry: the `k` parameters in order.
        orientations: forms in which records may give the orientation; empty when the pose has its own coordinates.
        nominal: nominal parameters, `k` [SI], buffer.
        low, high: box of poses that `sample_workspace` draws from, `p` [SI], buffers.
        home_pose, home_joints: a configuration on the nominal branch, `p` and `n` [SI], buffers; where Newton starts.
        closed_form: which direction is a closed form of sums, products, roots, sines and cosines, so that it can be
            in an exported graph: ``forward``, ``inverse``, or None.
        inverse_kinematics: child module around `solve_inverse`, the place for forward hooks.
        takes: covariates that the nominal machine itself depends on: a simulator's; () for all others.
        frame_per, tool_per: columns of records that number groups of rows with a base or tool frame of their own.
        gears: of each joint what its drive's file tells: turns of the motor for a turn of the joint [1], or the lead of
            a screw [m], or None; () where nothing is told.
        motors: how far each motor turns, over its gear, for one unit of each joint, `n x n`; () where each joint has a
            motor of its own. What acts in the drives (gears, backlash, springs) is then of the motors, by the names of
            their joints.
    """

    nominal: Tensor
    low: Tensor
    high: Tensor
    home_pose: Tensor
    home_joints: Tensor
    orientations: tuple[str, ...] = ()
    takes: tuple[Condition, ...] = ()
    frame_per: tuple[str, ...] = ()
    tool_per: tuple[str, ...] = ()
    gears: tuple[float | None, ...] = ()
    motors: Motors = ()
    closed_form: Literal["forward", "inverse"] | None = None

    def __init__(
        self,
        name: str,
        joints: Sequence[Coordinate],
        pose: Sequence[Coordinate],
        geometry: Sequence[Parameter],
        low: Sequence[float],
        high: Sequence[float],
        home_pose: Sequence[float] | None = None,
        home_joints: Sequence[float] | None = None,
        keys: Mapping[str, Any] | None = None,
    ) -> None:
        """Name the parts; `home_pose` defaults to the middle of the box, `home_joints` to its inverse (from zeros).

        keys: of a machine of this package, whose name is also its spec.
        """
        super().__init__()
        verbs = ("closure", "solve_inverse", "forward_kinematics")
        if all(getattr(type(self), verb) is getattr(Mechanism, verb) for verb in verbs):
            raise InputError(f"mechanism '{name}' must define {', '.join(verbs[:2])} or {verbs[2]}, see Mechanism")
        self.name = name
        self.joints = tuple(joints)
        self.pose = tuple(pose)
        self.geometry = tuple(geometry)
        self.register_buffer("nominal", torch.tensor([g.nominal for g in self.geometry], dtype=torch.float64))
        self.register_buffer("low", torch.tensor(low, dtype=torch.float64))
        self.register_buffer("high", torch.tensor(high, dtype=torch.float64))
        middle = (self.low + self.high) / 2
        self.register_buffer("home_pose", middle if home_pose is None else middle.new_tensor(home_pose))
        self.register_buffer("home_joints", torch.zeros(len(self.joints), dtype=torch.float64))
        here = self.solve_inverse(self.home_pose) if home_joints is None else middle.new_tensor(home_joints)
        self.home_joints.copy_(here)
        self.inverse_kinematics = InverseKinematics(self.solve_inverse)
        # How to build it again: `spec` and `keys` of `load_mechanism`, which fills this in for a user's class.
        own = type(self).__module__.startswith("ccnn_torch.mechanisms.machines.")
        self.recipe: dict[str, Any] = {"spec": name, "keys": dict(keys or {})} if own else {}

    def __init_subclass__(cls, **keywords: Any) -> None:
        super().__init_subclass__(**keywords)
        for verb in ("solve_inverse", "forward_kinematics"):
            own = vars(cls).get(verb)
            if own is not None and len(inspect.signature(own).parameters) == 3:
                setattr(cls, verb, _without_guess(own))

    # The maths: a mechanism overrides one of these three, and what it has in closed form.

    def closure(self, pose: Tensor, joints: Tensor, parameters: Tensor | None = None) -> Tensor:
        """Loop closure, zero where pose and joints fit together.

        Args:
            pose: `... x p` [SI].
            joints: `... x n` [SI].
            parameters: `... x k` [SI], nominal when None.

        Returns:
            `... x c` [SI].
        """
        if type(self).solve_inverse is not Mechanism.solve_inverse:
            off = self.solve_inverse(pose, parameters, joints) - joints
            return torch.where(self._turning.to(off.device), wrap_angle(off), off)
        gap = self.forward_kinematics(joints, parameters, pose) - pose
        turning = torch.tensor([c.unit == "rad" for c in self.pose], device=gap.device)
        return torch.where(turning, wrap_angle(gap), gap)

    def solve_inverse(self, pose: Tensor, parameters: Tensor | None = None, guess: Tensor | None = None) -> Tensor:
        """Joints of a pose, the plain function behind `inverse_kinematics`; no hook ever acts on it.

        Args:
            pose: `... x p` [SI].
            parameters: `... x k` [SI], nominal when None.
            guess: `... x n` [SI], joints on the wanted branch; `home_joints` when None. Closed forms ignore it.

        Returns:
            `... x n` [SI].
        """
        start = self.home_joints if guess is None else guess
        return _numeric.solve(
            lambda joints, pose, parameters: self.closure(pose, joints, parameters),
            start,
            (pose, self.resolve(parameters)),
        )

    def forward_kinematics(
        self, joints: Tensor, parameters: Tensor | None = None, guess: Tensor | None = None
    ) -> Tensor:
        """Pose of the joints, on the nominal branch; of more joints than coordinates (cables) the closest to closing.

        Args:
            joints: `... x n` [SI].
            parameters: `... x k` [SI], nominal when None.
            guess: `... x p` [SI], a pose on the wanted branch; `home_pose` when None. Closed forms ignore it.

        Returns:
            `... x p` [SI].
        """
        start = self.home_pose if guess is None else guess
        return _numeric.solve(
            lambda pose, joints, parameters: self.closure(pose, joints, parameters),
            start,
            (joints, self.resolve(parameters)),
            closest=len(self.joints) > len(self.pose),
        )

    def controlled(self) -> Mechanism:
        """The nominal machine as its controller has it: in its own base, at the tool that it was given."""
        return self

    def commanded_joints(self, pose: Tensor, guess: Tensor | None = None) -> Tensor:
        """Joints for poses in the order commanded, `s x n` [SI]; NaN out of reach, rounding of the poses aside.

        Where there are several, those nearest to the previous row's, in the first row to `home_joints`.

        Args:
            pose: `s x p` [SI].
            guess: `s x n` [SI], joints on the branch to take.
        """
        return _branches.commanded_joints(self, pose, guess)

    def skeleton(self, pose: Tensor, joints: Tensor, parameters: Tensor | None = None) -> dict[str, Tensor]:
        """Its legs or links at one configuration as lines by name, `k x 3` [m] in the robot's frame; default: none.

        Args:
            pose: `p` [SI].
            joints: `n` [SI].
            parameters: `k` [SI], nominal when None.
        """
        return {}

    def frame(self, pose: Tensor) -> tuple[Tensor, Tensor | None]:
        """Position `... x 3` [m] and rotation matrix `... x 3 x 3` of the platform; None without orientation.

        The default reads x, y, z and rx, ry, rz (a rotation vector) by name; what is not there is 0.

        Raises:
            InputError: the pose has another angle: a mechanism with one overrides this and defines how it turns.
        """
        return frame_from_coordinates(pose, self.pose, self.name)

    def frame_slope(self, pose: Tensor) -> Tensor:
        """Derivative of position and (with orientation) rotation vector in the base frame by the pose coordinates.

        Closed form for the frame by name, by differentiation for another; pose `... x p` [SI].

        Returns:
            `... x 6 x p`, or `... x 3 x p` without orientation.
        """
        if type(self).frame is Mechanism.frame:
            return coordinates_jacobian(pose, self.pose, self.name)
        return frame_jacobian(self.frame, pose, len(self.channels))

    def pose_near(self, position: Tensor, rotation: Tensor | None) -> Tensor:
        """A pose whose frame is close to a given one: where a search for the closest pose starts, `... x p` [SI].

        The default reads x, y, z and rx, ry, rz by name and takes other coordinates from `home_pose`. A mechanism that
        overrides `frame` may override this as well, so that the search starts on the right side of the workspace.

        Args:
            position: `... x 3` [m].
            rotation: `... x 3 x 3`, or None where it is not known.
        """
        known = dict(zip(("x", "y", "z"), position.unbind(-1), strict=True))
        if rotation is not None:
            known |= zip(("rx", "ry", "rz"), matrix_to_rotation_vector(rotation).unbind(-1), strict=True)
        home = self.home_pose.expand(*position.shape[:-1], -1)
        return torch.stack([known.get(c.name, home[..., i]) for i, c in enumerate(self.pose)], dim=-1)

    # Bookkeeping, the same for all.

    def resolve(self, parameters: Tensor | None) -> Tensor:
        """The parameters given, or the nominal ones."""
        return self.nominal if parameters is None else parameters

    def values(self, parameters: Tensor | None) -> tuple[Tensor, ...]:
        """The parameters one by one in the order of `geometry`, each `...`."""
        return self.resolve(parameters).unbind(-1)

    def wrap(self, deviation: Tensor) -> Tensor:
        """A difference of joints, `... x n` [SI], with revolute ones (unit rad) brought to [-pi, pi]."""
        revolute = torch.tensor([j.unit == "rad" for j in self.joints], device=deviation.device)
        return torch.where(revolute, wrap_angle(deviation), deviation)

    @cached_property
    def _turning(self) -> Tensor:
        return _branches.turning(self)

    def nearest_joints(
        self,
        pose: Tensor,
        parameters: Tensor | None,
        guess: Tensor | None,
        rotation_weight: float,
        damping: float = 0.0,
    ) -> Tensor:
        """Joints whose pose is closest in (position, rotation_weight x rotation vector) [m].

        The default is `solve_inverse`: a mechanism with as many pose coordinates as joints reaches every pose exactly,
        and its joints are not damped.
        """
        return self.solve_inverse(pose, parameters, guess)

    def pose_error(self, measured: Tensor, reference: Tensor) -> PoseError:
        """Distance [m] and geodesic angle [rad] between two poses, `... x p` each.

        What one of them lacks (NaN) does not count; where it lacks all lengths or all angles, that error is NaN.
        """
        lacking = measured.isnan() | reference.isnan()
        if not bool(lacking.any()):
            return pose_error(self.frame(measured), self.frame(reference))
        whole = torch.where(measured.isnan(), reference, measured), torch.where(reference.isnan(), measured, reference)
        found = pose_error(*(self.frame(pose) for pose in whole))
        position, rotation = (
            error if error is None or not kind else torch.where(lacking[..., kind].all(-1), torch.nan, error)
            for error, kind in (
                (error, [k for k, c in enumerate(self.pose) if c.unit == unit])
                for error, unit in zip(found, ("m", "rad"), strict=True)
            )
        )
        assert position is not None
        return PoseError(position, rotation)

    def jacobian(self, joints: Tensor, parameters: Tensor | None = None, guess: Tensor | None = None) -> Tensor:
        """Derivative of position and (with orientation) rotation vector in the base frame; joints `... x n`.

        Returns:
            `... x 6 x n` ([m] above [rad], per joint unit), or `... x 3 x n` without orientation.
        """
        parameters, count = self.resolve(parameters), len(self.channels)
        at = expand_leading(joints, parameters, parameters if guess is None else guess)
        return frame_jacobian(lambda q: self.frame(self.forward_kinematics(q, parameters, guess)), at, count)

    def parameter_jacobian(
        self, joints: Tensor, parameters: Tensor | None = None, guess: Tensor | None = None
    ) -> Tensor:
        """The same by the parameters, at joints `... x n`; `... x 6 x k` or `... x 3 x k`, per parameter's unit."""
        values, count = self.resolve(parameters).expand(*joints.shape[:-1], -1), len(self.channels)
        return frame_jacobian(lambda theta: self.frame(self.forward_kinematics(joints, theta, guess)), values, count)

    def jacobian_at(self, pose: Tensor, joints: Tensor, parameters: Tensor | None = None) -> Tensor:
        """As `jacobian`, where the pose of the joints is known, `... x p` [SI]; NaN where that is.

        The default finds it again from there; a closed form at the pose saves that.
        """
        return self.jacobian(joints, parameters, pose)

    def parameter_jacobian_at(self, pose: Tensor, joints: Tensor, parameters: Tensor | None = None) -> Tensor:
        """As `parameter_jacobian`, where the pose of the joints is known."""
        return self.parameter_jacobian(joints, parameters, pose)

    def under(self, conditions: Mapping[str, Tensor]) -> Mechanism:
        """The machine under conditions of the rows that it is then asked about, `...` each [SI], by covariate.

        Itself, unless it `takes` some of them: closed forms know neither loads nor temperatures.
        """
        return self

    def lacking(self, conditions: Sequence[str]) -> list[Condition]:
        """Covariates that it depends on and that neither these names nor `under` supply."""
        return []

    def condition_number(
        self,
        joints: Tensor,
        rotation_weight: float = 0.04,
        parameters: Tensor | None = None,
        guess: Tensor | None = None,
    ) -> Tensor:
        """Condition number of the Jacobian with its rotation rows times `rotation_weight` [m/rad]; `...` [1]."""
        values = self.singular_values(joints, rotation_weight, parameters, guess)
        ratio = values[..., 0] / values[..., -1]
        return torch.where(torch.isfinite(ratio), ratio, torch.inf)

    def singular_values(
        self,
        joints: Tensor,
        rotation_weight: float = 0.04,
        parameters: Tensor | None = None,
        guess: Tensor | None = None,
    ) -> Tensor:
        """Singular values of the Jacobian with its rotation rows times `rotation_weight`, largest first [m per joint].

        With the loop closure F(X, q) = 0 the Jacobian is J = -(∂F/∂X)⁻¹ ∂F/∂q. The last is how little the platform
        moves when the joints do: 0 where ∂F/∂q is singular (first kind: a leg stretched or folded, a serial arm's
        singularity). The first is how much: infinite where ∂F/∂X is (second kind: the platform can move with the joints
        held; Gosselin and Angeles 1990).

        Returns:
            `... x n` (or fewer, as many as the pose has coordinates that are measured); NaN where the joints have no
            pose.
        """
        jacobian = self.jacobian(joints, parameters, guess) * self.channel_weights(rotation_weight)[:, None]
        known = torch.isfinite(jacobian).all(-1).all(-1)[..., None]
        values = torch.linalg.svdvals(torch.where(known[..., None], jacobian, torch.zeros_like(jacobian)))
        return torch.where(known, values, torch.nan)[..., : self.compared]

    def reachable(self, pose: Tensor, parameters: Tensor | None = None) -> Tensor:
        """Which poses `... x p` have joints on the nominal branch; `...`, bool."""
        return torch.isfinite(self.solve_inverse(pose, parameters)).all(-1)

    @property
    def grouped(self) -> bool:
        """Whether groups of rows have frames of their own."""
        return bool(self.frame_per or self.tool_per)

    @property
    def channels(self) -> tuple[Coordinate, ...]:
        """What position and rotation vector of `frame` are, side by side, `c` of them."""
        return CHANNELS if self.frame(self.home_pose)[1] is not None else CHANNELS[:3]

    def channel_weights(self, rotation_weight: float) -> Tensor:
        """Of angles `rotation_weight` [m/rad], of lengths 1; `c`."""
        return self.home_pose.new_tensor([rotation_weight if c.unit == "rad" else 1.0 for c in self.channels])

    @property
    def compared(self) -> int:
        """How many of the pose coordinates are measured; further ones say what a row's measurement was of."""
        return len(self.pose)

    def places(self, joints: Tensor, rows: Tensor | None) -> list[Tensor]:
        """Joints of each place that rows are of, `... x n` each [SI]: as a rule these, in one.

        Args:
            joints: commanded, `... x n` [SI].
            rows: as recorded, `... x p` [SI].
        """
        return [joints]

    @property
    def bounds(self) -> tuple[Tensor, Tensor]:
        """Box of poses that samples are drawn from: low and high, `p` each [SI]."""
        return self.low, self.high

    def sample_workspace(self, count: int, generator: torch.Generator) -> Tensor:
        """Reachable poses, uniform in the box; `count x p` [SI].

        Raises:
            InputError: fewer than one pose in a hundred of the box is reachable.
        """
        wrong = f"mechanism '{self.name}' reaches hardly any pose of its sampling box; check low and high"
        return drawn_within(self.low, self.high, count, generator, self.reachable, wrong)

    def sample_joints(self, count: int, generator: torch.Generator) -> Tensor:
        """Joints of sampled poses, `count x n` [SI]."""
        return self.solve_inverse(self.sample_workspace(count, generator))

    def with_nominal(self, parameters: Tensor) -> Mechanism:
        """A copy with other nominal parameters, `k` [SI] (fitted frames, identified geometry), without any hook."""
        twin = copy.deepcopy(self)
        twin.nominal.copy_(parameters)
        twin.inverse_kinematics = InverseKinematics(twin.solve_inverse)
        twin._follow_nominal()
        return twin

    def _follow_nominal(self) -> None:
        """Called when the nominal parameters have changed; for what is derived from them."""

    def describe(self) -> dict[str, Any]:
        """Everything `mechanism_from_description` needs, as JSON; floats survive it exactly.

        Raises:
            InputError: the class is not defined in a file (an interactive session), so it cannot be built again.
        """
        return {
            "name": self.name,
            **(self.recipe or self._own_file()),
            "joints": [j.header for j in self.joints],
            "pose": [c.header for c in self.pose],
            "parameters": {g.name: v for g, v in zip(self.geometry, self.nominal.tolist(), strict=True)},
        }

    def _own_file(self) -> dict[str, Any]:
        """Recipe of a mechanism that was made by its class and not by `load_mechanism`."""
        try:
            file = inspect.getfile(type(self))
        except (TypeError, OSError):
            raise InputError(
                f"mechanism '{self.name}': its class {type(self).__name__} is not defined in a file; write it to one "
                f"and use load_mechanism('file.py:{type(self).__name__}')"
            ) from None
        return {"spec": f"{file}:{type(self).__qualname__}", "keys": {}}

    def set_parameters(self, values: Mapping[str, float]) -> None:
        """Set nominal parameters by name [SI].

        Raises:
            InputError: a name that the mechanism does not have, or one that is missing.
        """
        names = [g.name for g in self.geometry]
        wrong = sorted(set(values) ^ set(names))
        if wrong:
            raise InputError(f"mechanism '{self.name}' has the parameters {', '.join(names)}; check {', '.join(wrong)}")
        self.nominal.copy_(self.nominal.new_tensor([float(values[n]) for n in names]))
        self._follow_nominal()


def _without_guess(verb: Callable[[Any, Tensor, Tensor | None], Tensor]) -> Callable[..., Tensor]:
    """The same verb, with the argument that a closed form ignores."""

    @wraps(verb)
    def ignoring(self: Any, given: Tensor, parameters: Tensor | None = None, guess: Tensor | None = None) -> Tensor:
        return verb(self, given, parameters)

    return ignoring
