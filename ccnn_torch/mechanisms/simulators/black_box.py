"""A simulator as a mechanism: derivatives by central differences, all of them in one call; inverse by damped Newton."""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from ccnn_torch.coordinates import Condition, Coordinate, plausible_error
from ccnn_torch.errors import InputError
from ccnn_torch.mechanisms.closest import Closest
from ccnn_torch.mechanisms.newton import carry_derivative
from ccnn_torch.mechanisms.pose import Frame, frame_from_coordinates, frame_gap, frame_jacobian
from ccnn_torch.mechanisms.simulators.simulator import Calls, Simulator, described, try_simulator
from ccnn_torch.numerics.batching import leading_shape
from ccnn_torch.numerics.least_squares import levenberg_marquardt
from ccnn_torch.numerics.rotations import matrix_to_rotation_vector, rotation_vector_to_matrix
from ccnn_torch.numerics.sampling import drawn_within


def central_slope(
    machine: BlackBox,
    pose: Callable[[Tensor], Tensor],
    point: Tensor,
    step: Tensor,
    places: Sequence[str],
    bounds: tuple[Tensor, Tensor] | None = None,
) -> Tensor:
    """Derivative of position and rotation vector, `... x c x d`; one-sided at a bound and beside a row without a pose.

    Args:
        machine: whose frame counts.
        pose: `... x d` -> `... x p`, with further leading dims.
        point: `... x d`.
        step: of each coordinate, `d`.
        bounds: what they cannot pass, `d` each.
    """
    ahead = torch.diag(step).reshape(len(step), *[1] * (point.dim() - 1), len(step))
    if bounds is not None:
        point = torch.minimum(torch.maximum(point, bounds[0]), bounds[1])
    ends = torch.stack([point + ahead, point - ahead])
    if bounds is not None:
        ends = torch.minimum(torch.maximum(ends, bounds[0]), bounds[1])
    found = pose(ends)
    lost = ~torch.isfinite(found).all(-1)
    if bool(lost.any()):
        here = pose(point)
        _check_neighbours(machine, ends, lost.all(0) & torch.isfinite(here).all(-1), places)
        ends = torch.where(lost[..., None], point, ends)
        found = torch.where(lost[..., None], here, found)
    way = (ends[0] - ends[1]).sum(-1, keepdim=True)
    first, second = machine.frame(found[0]), machine.frame(found[1])
    change = first[0] - second[0]
    if first[1] is not None and second[1] is not None:
        change = torch.cat([change, matrix_to_rotation_vector(first[1] @ second[1].mT)], -1)
    # Where both ends are the point itself there is no way to go, and no change.
    return (change / torch.where(way == 0, 1.0, way)).movedim(0, -1)


def _check_neighbours(machine: BlackBox, ends: Tensor, nowhere: Tensor, places: Sequence[str]) -> None:
    if not bool(nowhere.any()):
        return
    k, *row = torch.nonzero(nowhere)[0].tolist()
    high, low = ends[(slice(None), k, *row, k)].tolist()
    raise InputError(
        f"simulator '{machine.name}' returns NaN with {places[k]} = {high:.6g} and {low:.6g}, and a pose between them "
        f"(row {row[-1] if row else 0}); let it take these values, or give a parameter another scale, or low and high"
    )


def differentiable_pose(machine: BlackBox, joints: Tensor, values: Tensor) -> Tensor:
    """Pose `... x p` of joints `... x n` and parameters `... x k`, with the differences as its first derivative."""
    found: Tensor = _Pose.apply(joints, values, machine)  # type: ignore[no-untyped-call]
    return found


class _Pose(torch.autograd.Function):
    @staticmethod
    def forward(joints: Tensor, values: Tensor, machine: BlackBox) -> Tensor:
        return machine.simulated(joints, values)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
        joints, values, ctx.machine = inputs
        ctx.save_for_backward(joints, values, output)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, Tensor | None, None]:
        joints, values, pose = ctx.saved_tensors
        parts: list[Tensor | None] = []
        for which, point in enumerate((joints, values)):
            if not ctx.needs_input_grad[which] or point.shape[-1] == 0:
                parts.append(None)
                continue
            # By a function of its own: a transform may have wrapped the tensors here, and a simulator wants plain ones.
            slope = _Slope.apply(joints, values, pose, ctx.machine, which)  # type: ignore[no-untyped-call]
            parts.append((gradient.unsqueeze(-2) @ slope).squeeze(-2).sum_to_size(point.shape))
        return parts[0], parts[1], None


class _Slope(torch.autograd.Function):
    """Derivative of the pose coordinates, `... x p x d`: of the frame by differences, and back to the coordinates."""

    @staticmethod
    def forward(joints: Tensor, values: Tensor, pose: Tensor, machine: BlackBox, which: int) -> Tensor:
        slope = (machine.parameter_jacobian if which else machine.jacobian)(joints, values)
        rows = frame_jacobian(machine.frame, torch.nan_to_num(pose)).detach()
        back: Tensor = torch.linalg.pinv(rows) @ slope
        return back

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
        ctx.mark_non_differentiable(output)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[None, ...]:
        return None, None, None, None, None


# Configurations all over the workspace: searches start from the nearest.
_STARTS = 256
# Of a machine as built: a parameter is moved by this share of its plausible error.
_SHARE = 0.1
# How far a pose may be missed [m].
_MISSED = 1e-7
_SETTLED = 1e-10


class BlackBox(Closest):
    """A `Simulator` in the place of closed forms.

    It differentiates in joints and parameters (first derivatives, by differences; not in covariates). Where it has
    more pose coordinates than joints, `solve_inverse` gives the joints of the closest pose.

    Attributes:
        simulator: its declaration.
        conditions: covariates that its rows are simulated under, by name; what is not there has its usual value.
    """

    joint_low: Tensor
    joint_high: Tensor
    starts: Tensor
    start_poses: Tensor

    def __init__(self, simulator: Simulator) -> None:
        """Try it at configurations of its workspace.

        Raises:
            InputError: the declaration is wrong, or the simulator fails, or has no pose in most of its workspace.
        """
        simulator = simulator.checked()
        self.simulator = simulator
        self.takes = tuple(c for c in simulator.covariates if isinstance(c, Condition))
        self.conditions: dict[str, Tensor] = {}
        self._calls = Calls(simulator)
        low, high = (torch.tensor([getattr(j, end) for j in simulator.joints]).double() for end in ("low", "high"))
        pose = [c for c in simulator.pose if isinstance(c, Coordinate)]
        nominal = torch.tensor([p.nominal for p in simulator.parameters], dtype=torch.float64)
        home = (low + high) / 2 if simulator.home is None else torch.tensor(simulator.home, dtype=torch.float64)
        home_pose = self._calls.pose(home, nominal, {})
        if not bool(torch.isfinite(home_pose).all()):
            raise InputError(
                f"simulator '{simulator.name}' returns NaN at its home configuration, "
                f"{described(simulator, home, {})}; set home to commands at which it has a pose"
            )
        super().__init__(
            name=simulator.name,
            joints=[Coordinate(j.name, j.unit) for j in simulator.joints],
            pose=pose,
            geometry=list(simulator.parameters),
            low=[0.0] * len(pose),
            high=[0.0] * len(pose),
            home_pose=home_pose.tolist(),
            home_joints=home.tolist(),
        )
        self.register_buffer("joint_low", low)
        self.register_buffer("joint_high", high)
        self.register_buffer("starts", torch.zeros(0, len(low), dtype=torch.float64))
        self.register_buffer("start_poses", torch.zeros(0, len(pose), dtype=torch.float64))
        self._follow_nominal()
        try_simulator(simulator, self._calls, self.home_joints, self.starts, nominal)

    def _follow_nominal(self) -> None:
        self.home_pose.copy_(self.forward_kinematics(self.home_joints))
        joints = self.sample_joints(_STARTS, torch.Generator().manual_seed(0))
        poses = self.forward_kinematics(joints)
        self.starts, self.start_poses = joints, poses
        # Coordinates that it does not move still need a box that is not empty.
        self.low.copy_(poses.amin(0) - 1e-6)
        self.high.copy_(poses.amax(0) + 1e-6)

    def under(self, conditions: Mapping[str, Tensor]) -> BlackBox:
        """The same under conditions of its rows, `...` each [SI]; what it does not take is left aside."""
        mine = {c.name: conditions[c.name].double() for c in self.takes if c.name in conditions}
        if not mine:
            return self
        twin = copy.copy(self)
        twin.conditions = {**self.conditions, **mine}
        return twin

    def lacking(self, conditions: Sequence[str]) -> list[Condition]:
        """An input that it does not receive: it has its usual value."""
        return [c for c in self.takes if c.name not in conditions and c.name not in self.conditions]

    def words(self, joints: Tensor, row: int) -> str:
        """Commands `n` of a row, and the conditions of the row of this number, for a sentence."""
        here = {n: v if v.dim() == 0 else v[row] for n, v in self.conditions.items()}
        return described(self.simulator, joints, here)

    # The maths.

    def forward_kinematics(
        self, joints: Tensor, parameters: Tensor | None = None, guess: Tensor | None = None
    ) -> Tensor:
        """What the simulator gives under the conditions, `... x p` [SI]; NaN in rows where it has no pose."""
        values = self.resolve(parameters)
        return differentiable_pose(self, joints, values)

    def simulated(self, joints: Tensor, values: Tensor) -> Tensor:
        """The same without derivatives."""
        return self._calls.pose(joints, values, self.conditions)

    def frame(self, pose: Tensor) -> Frame:
        """By the declared frame; else x, y, z and rx, ry, rz by name, and phi about the axis that has no length."""
        if self.simulator.frame is not None:
            return self.simulator.frame(pose)
        names = [c.name for c in self.pose]
        if "phi" not in names:
            return frame_from_coordinates(pose, self.pose, self.name)
        columns = dict(zip(names, pose.unbind(-1), strict=True))
        zero = torch.zeros_like(pose[..., 0])
        position = torch.stack([columns.get(c, zero) for c in "xyz"], -1)
        turn = torch.stack([zero if c in columns else columns["phi"] for c in "xyz"], -1)
        return position, rotation_vector_to_matrix(turn)

    def jacobian(self, joints: Tensor, parameters: Tensor | None = None, guess: Tensor | None = None) -> Tensor:
        """See `Mechanism.jacobian`; all differences in one call."""
        values = self.resolve(parameters)
        step = self.simulator.step * (self.joint_high - self.joint_low) / 2
        places = [j.name for j in self.joints]
        point = joints.detach().expand(*leading_shape(joints, values), -1)
        return central_slope(self, lambda q: self._calls.pose(q, values, self.conditions), point, step, places)

    def parameter_jacobian(
        self, joints: Tensor, parameters: Tensor | None = None, guess: Tensor | None = None
    ) -> Tensor:
        """See `Mechanism.parameter_jacobian`; all differences in one call, one-sided at a bound."""
        values = self.resolve(parameters)
        step = _SHARE * torch.tensor([plausible_error(p) for p in self.geometry], dtype=torch.float64)
        places = [p.name for p in self.geometry]
        bounds = self._calls.low, self._calls.high
        point = values.detach().expand(*leading_shape(joints, values), -1)
        return central_slope(self, lambda v: self._calls.pose(joints, v, self.conditions), point, step, places, bounds)

    def solve_inverse(self, pose: Tensor, parameters: Tensor | None = None, guess: Tensor | None = None) -> Tensor:
        """Joints by damped Newton from the nearest of some hundred configurations, or from the guess.

        NaN where the pose is missed by more than 1e-7 m, unless there are fewer joints than pose coordinates.
        """
        return self.nearest_joints(pose, parameters, guess, self.rotation_weight)

    def nearest_joints(
        self,
        pose: Tensor,
        parameters: Tensor | None,
        guess: Tensor | None,
        rotation_weight: float,
        damping: float = 0.0,
    ) -> Tensor:
        """See `Mechanism.nearest_joints`."""
        values = self.resolve(parameters)
        lead = leading_shape(pose, values) if guess is None else leading_shape(pose, values, guess)
        target, given = pose.expand(*lead, -1), values.expand(*lead, -1)
        start = self._start(target.detach()) if guess is None else guess.expand(*lead, -1)
        names = list(self.conditions)
        conditions = [self.conditions[n].expand(lead)[..., None] for n in names]

        def machine(rows: tuple[Tensor, ...]) -> BlackBox:
            return self.under({n: row[..., 0] for n, row in zip(names, rows, strict=True)})

        def gap(joints: Tensor, pose: Tensor, values: Tensor, *rows: Tensor) -> Tensor:
            there = machine(rows).forward_kinematics(joints, values)
            return frame_gap(self.frame(there), self.frame(pose), rotation_weight)

        def slope(joints: Tensor, pose: Tensor, values: Tensor, *rows: Tensor) -> Tensor:
            found = machine(rows).jacobian(joints, values).clone()
            found[..., 3:, :] *= rotation_weight
            return torch.nan_to_num(found)

        plain = (target.detach(), given.detach(), *conditions)
        solved = levenberg_marquardt(gap, start.detach(), slope, plain, tolerance=_SETTLED)
        missed = (2 * solved.cost).sqrt() > _MISSED
        lost = missed if len(self.pose) <= len(self.joints) else ~torch.isfinite(solved.cost)
        x = torch.where(lost[..., None], self.home_joints, solved.value)
        found = carry_derivative(x, slope(x, *plain), gap(x, target, given, *conditions))
        return torch.where(lost[..., None], torch.nan, found)

    def _start(self, pose: Tensor) -> Tensor:
        """Joints of the configuration nearest to each pose, `... x n`."""
        there, size = self.start_poses, (self.high - self.low).clamp_min(1e-3)
        distance = torch.cdist(torch.nan_to_num(pose / size).reshape(-1, pose.shape[-1]), there / size)
        return self.starts[distance.argmin(-1)].reshape(*pose.shape[:-1], -1)

    def reachable(self, pose: Tensor, parameters: Tensor | None = None) -> Tensor:
        """Which poses `... x p` have joints (with fewer joints than coordinates: any pose that is finite); `...`."""
        if len(self.pose) > len(self.joints):
            return torch.isfinite(pose).all(-1)
        return super().reachable(pose, parameters)

    def sample_joints(self, count: int, generator: torch.Generator) -> Tensor:
        """Commands that have a pose, uniform in the joints' workspace; `count x n` [SI].

        Raises:
            InputError: fewer than one in a hundred has a pose.
        """
        wrong = (
            f"simulator '{self.name}' returns NaN nearly everywhere between low and high of its joints; make them "
            "narrower, or let it return a pose"
        )
        return drawn_within(
            self.joint_low,
            self.joint_high,
            count,
            generator,
            lambda joints: torch.isfinite(self.forward_kinematics(joints)).all(-1),
            wrong,
        )

    def _own_file(self) -> dict[str, Any]:
        raise InputError(
            f"simulator '{self.name}' was made in Python and has no name to load it by; write it to a file and use "
            "load_mechanism('file.py:NAME')"
        )
