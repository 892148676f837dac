"""A machine as it is: nominal and identified kinematics, effects, and the joints that bring it to a nominal pose."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from ccnn_torch.compensation.effects import PhysicalEffects
from ccnn_torch.compensation.expansions import ChebyshevExpansion, expand
from ccnn_torch.compensation.kinematics import (
    ClosedKinematics,
    Links,
    Placed,
    gauss_jordan,
    inverse,
)
from ccnn_torch.mechanisms import Framed, Mechanism, SerialArm, mechanism_from_description
from ccnn_torch.mechanisms.machines.links import compose, transform_of
from ccnn_torch.numerics.rotations import vee

# Keeps what is inverted regular in the middle of a singular pose: of what shows how near it is, and of a step [m²].
_NEAR, _REGULAR = 1e-10, 1e-12
# The way back is damped nearer to a singular pose only, so that it undoes every command that is not damped.
_BACK = 0.8
# How far the next step may move a joint that has settled [m or rad].
SETTLED = 1e-9
# How far in all, from which on it goes astray: the first step, which is near, is taken in the place of the last.
ASTRAY = 1e-3
# Joints beyond it are none: what their sines and cosines are differs from library to library [m or rad].
FARTHEST = 1e3
_MOST_NEWTON = 8
# Error of the polynomial from which Newton's method comes to the right pose, as a share of the largest.
_START = 0.1


class Rule(NamedTuple):
    """How commands are found near singular poses (Chiaverini 1997; Nakamura and Hanafusa 1986).

    Attributes:
        rotation_weight: η of orientation against position [m/rad].
        nearest: σ0, the smallest singular value below which a command is damped [m per joint unit].
        damping: λ0, the largest damping of a deviation, in the middle of a singular pose [m per joint unit].
    """

    rotation_weight: float = 0.04
    nearest: float = 0.002
    damping: float = 0.002

    def farther(self, times: float) -> Rule:
        """Damped from so many times as far from singular poses on, so many times as much."""
        return self._replace(nearest=times * self.nearest, damping=times * self.damping)


RULE = Rule()
"""What suits machines of about 1 m that miss by up to some millimetres."""


class Machine(nn.Module):
    """The identified machine, and the commands at which it reaches the nominal pose of ideal joints.

    f(q, c) = P(F(q + e_joints(q, c); θ), c), and the joints that minimise |W (f(c) - X)|² + λ² |c - q|² for the
    nominal pose X of ideal joints q; of serial arms and of others whose forward kinematics is a closed form.

    λ is fixed at q: 0 where no singular pose is near, so that the machine reaches X; the deviation is damped, not the
    step, so that the command does not depend on the number of steps. Every step is Gauss and Newton's with the
    identified Jacobian.

    Attributes:
        mechanism: with the nominal parameters, fitted frames included.
        identified: all parameters as they were identified, `k` [SI].
        effects: on joints and pose; None without any.
        rule: of commands near singular poses.
        low, high: limits of the joints, `n` [SI]; infinite where the machine's file has none.
        ends: lowest and highest value [SI] up to which effects follow a covariate, by its name, where these are wider
            than what was measured.
        export_tolerance: share of the largest deviation to which exports agree: lengths near 1 m are rounded.
    """

    kind = "forward"
    export_tolerance = 1e-9
    identified: Tensor
    low: Tensor
    high: Tensor

    def __init__(
        self, mechanism: Mechanism, identified: Tensor, effects: PhysicalEffects | None = None, rule: Rule = RULE
    ) -> None:
        super().__init__()
        # In a tuple, since the mechanism's own buffers are no part of the model.
        self._mechanism = (mechanism,)
        self.rule, self.effects = rule, effects
        self.ends: dict[str, tuple[float, float]] = {}
        self.register_buffer("identified", identified.detach().clone(), persistent=False)
        low, high = limits_of(mechanism)
        self.register_buffer("low", low, persistent=False)
        self.register_buffer("high", high, persistent=False)
        self._prepare()

    @property
    def mechanism(self) -> Mechanism:
        """The nominal machine."""
        return self._mechanism[0]

    @property
    def real(self) -> Mechanism:
        """The machine with the identified parameters as its nominal ones."""
        return self.mechanism.with_nominal(self.identified)

    def aim(self, joints: Tensor) -> Tensor:
        """What a command is to reach, for ideal joints `... x n` [SI]: pose and λ² side by side, `... x a`."""
        return self._aim(self._nominal.at(joints), self._identified.at(joints))

    def aim_back(self, moved: Tensor, covariates: Tensor) -> Tensor:
        """The same for the way back: the pose that the machine has; moved: command and what was learned there."""
        return self._aim(self.reached(moved, covariates), self._nominal.at(moved), _BACK)

    def next_correction(
        self, moved: Tensor, covariates: Tensor, ideal: Tensor, correction: Tensor, aim: Tensor
    ) -> Tensor:
        """What to subtract from the ideal joints next.

        Args:
            moved: command and what was learned there, `... x n` [SI].
            covariates: `... x m` [SI].
            ideal: joints, `... x n` [SI].
            correction: ideal joints less command, `... x n` [SI].
            aim: of the ideal joints.
        """
        return self._step(self.reached(moved, covariates), correction, aim)

    def next_back(self, joints: Tensor, correction: Tensor, aim: Tensor) -> Tensor:
        """The same for the way back: what to subtract from the command; joints: ideal ones, tried."""
        return self._step(self._nominal.at(joints), correction, aim)

    def within(self, ideal: Tensor, correction: Tensor, most: Tensor) -> Tensor:
        """A correction of at most `most`, `n`, that takes no joint farther beyond its limits than it is; all [SI]."""
        zero = torch.zeros_like(ideal)
        highest = torch.minimum(torch.maximum(ideal - self.low, zero), most)
        lowest = torch.maximum(torch.minimum(ideal - self.high, zero), -most)
        return torch.minimum(torch.maximum(correction, lowest), highest)

    def describe(self) -> dict[str, Any]:
        """Everything `from_description` needs; the tensors are stored beside it."""
        return {
            "kind": self.kind,
            "mechanism": self.mechanism.describe(),
            "identified": self.identified.tolist(),
            "effects": None if self.effects is None else self.effects.describe(),
            "rule": self.rule._asdict(),
            **({"ends": {name: list(pair) for name, pair in self.ends.items()}} if self.ends else {}),
        }

    @classmethod
    def from_description(cls, description: dict[str, Any]) -> Machine:
        """The machine as it was described, but for its tensors."""
        # The reader of the file that contains this decides whether code may run.
        mechanism = mechanism_from_description(description["mechanism"], allow_code=True)
        effects = None if description["effects"] is None else PhysicalEffects.from_description(description["effects"])
        identified = torch.tensor(description["identified"], dtype=torch.float64)
        more = cls._blank(mechanism, description)
        made = cls(mechanism, identified, effects, Rule(**description["rule"]), **more)
        made.ends = {name: (low, high) for name, (low, high) in description.get("ends", {}).items()}
        return made

    @classmethod
    def _blank(cls, mechanism: Mechanism, description: dict[str, Any]) -> dict[str, Any]:
        """What else it is made of, tensors without meaning."""
        return {}

    def _prepare(self) -> None:
        make = Links if isinstance(self.mechanism, SerialArm) else ClosedKinematics
        self._nominal, self._identified = make(self.mechanism), make(self.real)

    def reached(self, moved: Tensor, covariates: Tensor) -> Placed:
        """Where the real machine is at command and what was learned there `... x n`, and covariates `... x m` [SI]."""
        if self.effects is None:
            return self._identified.at(moved)
        joints, shift = self.effects.changes(moved, covariates)
        placed = self._identified.at(moved if joints is None else moved + joints)
        return placed if shift is None else placed.shifted(shift)

    def _aim(self, wanted: Placed, moving: Placed, share: float = 1.0) -> Tensor:
        """Pose wanted, and λ² of the kinematics that move."""
        parts = [wanted.position] if wanted.rotation is None else [wanted.position, wanted.rotation.flatten(-2)]
        pull = self._damping(self._slope(moving), share)
        lost = [placed.lost for placed in (wanted, moving) if placed.lost is not None]
        for one in lost:
            pull = pull + self.rule.damping**2 * one
        return torch.cat([*parts, pull], -1)

    def _slope(self, placed: Placed) -> Tensor:
        """Weighted Jacobian, transposed, `... x n x c`."""
        if placed.rotation is None:
            return placed.linear
        return torch.cat([placed.linear, self.rule.rotation_weight * placed.turning], -1)

    def _damping(self, slope: Tensor, share: float) -> Tensor:
        """λ² of a weighted Jacobian `... x n x c`, `... x 1` [m² per joint unit²]; it begins at a share of σ0."""
        square = slope @ slope.mT if slope.shape[-2] <= slope.shape[-1] else slope.mT @ slope
        unit = torch.eye(square.shape[-1], dtype=square.dtype)
        # A lower bound of the smallest singular value, squared.
        near = 1 / (inverse(square + _NEAR * unit) * unit).sum((-2, -1))
        full = share * self.rule.nearest
        return self.rule.damping**2 * torch.clamp_min(1 - near / full**2, 0.0).unsqueeze(-1)

    def _step(self, placed: Placed, correction: Tensor, aim: Tensor) -> Tensor:
        gap = aim[..., :3] - placed.position
        if placed.rotation is not None:
            turn = aim[..., 3:12].reshape(*aim.shape[:-1], 3, 3) @ placed.rotation.mT
            gap = torch.cat([gap, self.rule.rotation_weight * vee(turn)], -1)
        # Where the machine has no pose, back to the ideal joints.
        pull = aim[..., -1:] if placed.lost is None else aim[..., -1:] + placed.lost
        slope = self._slope(placed)
        unit = torch.eye(min(slope.shape[-2:]), dtype=slope.dtype)
        more = (pull.unsqueeze(-1) + _REGULAR) * unit
        if slope.shape[-2] <= slope.shape[-1]:
            right = slope @ gap.unsqueeze(-1) + (pull * correction).unsqueeze(-1)
            return correction - gauss_jordan(slope @ slope.mT + more, right).squeeze(-1)
        # More joints than coordinates: a step of least norm, so that nothing moves that need not.
        square = slope.mT @ slope
        kept = slope.mT @ correction.unsqueeze(-1)
        damped = slope @ gauss_jordan(square + more, gap.unsqueeze(-1) - kept)
        step: Tensor = damped + slope @ gauss_jordan(square + _REGULAR * unit, kept)
        return correction - step.squeeze(-1)


def limits_of(mechanism: Mechanism) -> tuple[Tensor, Tensor]:
    """Lowest and highest joints of the machine's file, `n` each [SI]; infinite where there are none."""
    none = torch.full((len(mechanism.joints),), math.inf, dtype=torch.float64)
    if not isinstance(mechanism, SerialArm) or not mechanism.has_limits:
        return -none, none
    # Exactly a full turn is what a joint without limits is sampled over.
    free = (mechanism.limits.abs() == math.pi).all(-1)
    return torch.where(free, -none, mechanism.limits[:, 0]), torch.where(free, none, mechanism.limits[:, 1])


def _inner(mechanism: Mechanism) -> Mechanism:
    """The machine itself, without the frames that it is seen through."""
    return mechanism.mechanism if isinstance(mechanism, Framed) else mechanism


class Frames(nn.Module):
    """What lies between the poses of a nominal and an identified machine whose frames differ a little.

    Both machines are seen through base and tool frames B F(q) T. A pose that is wanted of the identified one is
    F' = (B⁻¹ B')⁻¹ F (T' T⁻¹)⁻¹ of the machine inside.

    Attributes:
        inside: pose, frame and derivatives of the machine inside.
    """

    # Of Newton's method, from a pose that is off by what was identified.
    _STEPS = 3

    def __init__(self, mechanism: Framed, identified: Tensor, inside: ClosedKinematics) -> None:
        super().__init__()
        (base, _, tool), (real_base, _, real_tool) = mechanism.split(mechanism.nominal), mechanism.split(identified)
        before, after = transform_of(real_base), transform_of(real_tool)
        # Products of two rotations, row by row: rotation and shift.
        self._out = compose(_backward(transform_of(base)), before), compose(after, _backward(transform_of(tool)))
        self._in = _backward(self._out[0]), _backward(self._out[1])
        self._turn, self._lever = before[0], after[1]
        # In a tuple, since the polynomial is stored once.
        self._inside = (inside,)

    def into(self, pose: Tensor) -> Tensor:
        """Pose coordinates `... x p` of the identified machine inside, where the nominal one would have these."""
        return self._moved(pose, self._in)

    def out_of(self, pose: Tensor) -> Tensor:
        """The other way."""
        return self._moved(pose, self._out)

    def shift(self, pose: Tensor, seen: Tensor) -> Tensor:
        """A small shift of the frame that is seen, `... x 6` [m, rad], as one of the machine inside, at its pose."""
        turn, moved = (seen[..., k : k + 3] @ self._turn for k in (3, 0))
        _, rotation = self._inside[0].frame(pose)
        lever = (rotation @ self._lever.unsqueeze(-1)).squeeze(-1)
        return torch.cat([moved - torch.linalg.cross(turn, lever, dim=-1), turn], -1)

    def _moved(self, pose: Tensor, by: tuple[_Transform, _Transform]) -> Tensor:
        inside, rows = self._inside[0], pose.reshape(-1, pose.shape[-1])
        position, rotation = inside.frame(rows)
        rotation, position = compose(compose(by[0], (rotation, position)), by[1])
        for _ in range(self._STEPS):
            place, turn = inside.frame(rows)
            gap = torch.cat([position - place, vee(rotation @ turn.mT)], -1)
            rows = rows + inside.coordinates(rows, gap)
        return rows.reshape(pose.shape)


_Transform = tuple[Tensor, Tensor]


def _backward(by: _Transform) -> _Transform:
    return by[0].mT, -(by[0].mT @ by[1])


class InverseMachine(Machine):
    """g(P⁻¹(X, c); θ) - e_joints: every step finds the joints that the identified machine has at the pose.

    Poses X are those of the machine inside, where it is seen through frames.

    Attributes:
        start: polynomial from which Newton's method finds the nominal pose of ideal joints.
        newton: how many steps it takes.
    """

    kind = "inverse"

    def __init__(
        self,
        mechanism: Mechanism,
        identified: Tensor,
        effects: PhysicalEffects | None = None,
        rule: Rule = RULE,
        start: ChebyshevExpansion | None = None,
        newton: int = _MOST_NEWTON,
    ) -> None:
        assert start is not None
        super().__init__(mechanism, identified, effects, rule)
        self.start = start
        nominal, real = _inner(mechanism), _inner(self.real)
        # In a tuple, since the polynomial is stored once.
        self._closed = (ClosedKinematics(nominal, start), ClosedKinematics(real, start))
        self._frames = Frames(mechanism, identified, self._closed[0]) if isinstance(mechanism, Framed) else None
        self._solve, self._numbers = nominal.solve_inverse, (nominal.nominal, real.nominal)
        self.newton = newton

    def aim(self, joints: Tensor) -> Tensor:
        """Pose coordinates `... x p` [SI], and 1 where the machine cannot take the pose."""
        pose, there = self._closed[0].standing(joints, self.newton)
        pose = pose if self._frames is None else self._frames.into(pose)
        return self._flat_pose(pose, there, self._numbers[1])

    def aim_back(self, moved: Tensor, covariates: Tensor) -> Tensor:
        joints, shift = (None, None) if self.effects is None else self.effects.changes(moved, covariates)
        pose, there = self._closed[1].standing(moved if joints is None else moved + joints, self.newton)
        pose = pose if shift is None else pose + self._coordinates(pose, shift)
        pose = pose if self._frames is None else self._frames.out_of(pose)
        return self._flat_pose(pose, there, self._numbers[0])

    def next_correction(
        self, moved: Tensor, covariates: Tensor, ideal: Tensor, correction: Tensor, aim: Tensor
    ) -> Tensor:
        joints, shift = (None, None) if self.effects is None else self.effects.changes(moved, covariates)
        pose = aim[..., :-1]
        pose = pose if shift is None else pose - self._coordinates(pose, shift)
        wanted = self._solve(pose, self._numbers[1])
        # Command and what is added to it are the joints of the real machine.
        added = moved - (ideal - correction)
        found = ideal - wanted + (added if joints is None else added + joints)
        return _where_there(found, aim)

    def next_back(self, joints: Tensor, correction: Tensor, aim: Tensor) -> Tensor:
        found = joints + correction - self._solve(aim[..., :-1], self._numbers[0])
        return _where_there(found, aim)

    def describe(self) -> dict[str, Any]:
        return super().describe() | {"degree": self.start.degree, "newton": self.newton}

    @classmethod
    def _blank(cls, mechanism: Mechanism, description: dict[str, Any]) -> dict[str, Any]:
        unit = torch.ones(len(mechanism.joints), dtype=torch.float64)
        polynomial = ChebyshevExpansion(unit, unit.clone(), description["degree"], outputs=len(_inner(mechanism).pose))
        return {"start": polynomial, "newton": description["newton"]}

    def _prepare(self) -> None:
        pass

    def _flat_pose(self, pose: Tensor, there: Tensor, values: Tensor) -> Tensor:
        """Pose coordinates, and 0 where they are reached with these parameters, too, else 1."""
        reached = torch.isfinite(self._solve(pose, values)).all(-1, keepdim=True)
        return torch.cat([pose, torch.where(torch.logical_and(there, reached), 0.0, 1.0)], -1)

    def _coordinates(self, pose: Tensor, shift: Tensor) -> Tensor:
        """Pose coordinates `... x p` of a small shift `... x c` of the frame."""
        rows = pose.reshape(-1, pose.shape[-1])
        shift = shift.reshape(-1, shift.shape[-1])
        shift = shift if self._frames is None else self._frames.shift(rows, shift)
        found = self._closed[0].coordinates(rows, shift)
        return found.reshape(pose.shape)


def _where_there(found: Tensor, aim: Tensor) -> Tensor:
    """A correction, 0 where the machine cannot take the pose."""
    there = torch.where(aim[..., -1:] <= 0, found, torch.zeros_like(found))
    return torch.where(torch.isfinite(found), there, torch.zeros_like(found))


def closed_form_of(mechanism: Mechanism) -> str | None:
    """Which direction of a machine a command can take: that of the machine inside, where it is seen through frames."""
    if isinstance(mechanism, SerialArm):
        return "forward"
    if not isinstance(mechanism, Framed) or mechanism.grouped:
        return mechanism.closed_form
    inner = mechanism.mechanism
    turns = inner.frame(inner.home_pose)[1] is not None
    # Out of the plane, say, a frame may differ as no pose coordinate does.
    fits = not turns if inner.closed_form == "forward" else len(inner.pose) == 6
    return inner.closed_form if fits else None


def build_machine(
    mechanism: Mechanism,
    identified: Tensor,
    effects: PhysicalEffects | None,
    joints: Tensor,
    margin: float,
    rule: Rule = RULE,
) -> Machine | None:
    """The machine of a compensator; None for one without a closed form in either direction.

    Args:
        mechanism: with the nominal parameters, fitted frames included.
        identified: all parameters, `k` [SI].
        effects: on joints and pose; None without any.
        joints: commanded joints of the training rows, `s x n` [SI].
        margin: of the compensator's domain.

    Raises:
        InputError, MethodFailedError: as `expand`.
    """
    way = closed_form_of(mechanism)
    if way == "forward":
        return Machine(mechanism, identified, effects, rule)
    if way is None:
        return None
    inner = _inner(mechanism)
    start = expand(lambda q: inner.forward_kinematics(q), joints, margin, "pose", worst=_START)
    made = InverseMachine(mechanism, identified, effects, rule, start)
    made.newton = max(one.steps_needed(joints, _MOST_NEWTON) for one in made._closed)
    return made
