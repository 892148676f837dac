"""A machine as it is: nominal and identified kinematics, effects, and the joints that bring it to a nominal pose."""

from __future__ import annotations

import math
from abc import abstractmethod
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from ccnn_torch.compensation.effects import PhysicalEffects
from ccnn_torch.compensation.kinematics import ClosedKinematics, Links, Placed, gauss_jordan, inverse
from ccnn_torch.mechanisms import Mechanism, SerialArm, mechanism_from_description
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
    nominal pose X of ideal joints q.

    λ is fixed at q: 0 where no singular pose is near, so that the machine reaches X; the deviation is damped, not the
    step, so that the command does not depend on the number of steps. Every step is Gauss and Newton's.

    Attributes:
        kind: in model files.
        identified: all parameters as they were identified, `k` [SI].
        effects: on joints and pose; None without any.
        rule: of commands near singular poses.
        low, high: limits of the joints, `n` [SI]; infinite where the machine's file has none.
        ends: lowest and highest value [SI] up to which effects follow a covariate, by its name, where these are wider
            than what was measured.
        export_tolerance: share of the largest deviation to which exports agree: lengths near 1 m are rounded.
    """

    kind = ""
    export_tolerance = 1e-9
    identified: Tensor
    low: Tensor
    high: Tensor

    def __init__(
        self, identified: Tensor, low: Tensor, high: Tensor, effects: PhysicalEffects | None, rule: Rule
    ) -> None:
        super().__init__()
        self.rule, self.effects = rule, effects
        self.ends: dict[str, tuple[float, float]] = {}
        self.register_buffer("identified", identified.detach().clone(), persistent=False)
        self.register_buffer("low", low, persistent=False)
        self.register_buffer("high", high, persistent=False)

    @abstractmethod
    def nominal_at(self, joints: Tensor) -> Placed:
        """Where the nominal machine is at joints `... x n` [SI]."""

    @abstractmethod
    def identified_at(self, joints: Tensor) -> Placed:
        """Where the identified machine is, without effects, at joints `... x n` [SI]."""

    @abstractmethod
    def description(self) -> dict[str, Any]:
        """What `made` takes beside identified parameters, effects and rule; the tensors are stored beside it."""

    @classmethod
    @abstractmethod
    def made(
        cls, description: dict[str, Any], identified: Tensor, effects: PhysicalEffects | None, rule: Rule
    ) -> Machine:
        """The machine as it was described, its tensors without meaning."""

    def known(self, joints: Tensor) -> Tensor:
        """The nearest joints at which the kinematics are known, `... x n` [SI]; all of them are by default."""
        return joints

    def aim(self, joints: Tensor) -> Tensor:
        """What a command is to reach, for ideal joints `... x n` [SI]: pose and λ² side by side, `... x a`."""
        at = self.known(joints)
        return self._aim(self.nominal_at(at), self.identified_at(at))

    def aim_back(self, command: Tensor, learned: Tensor, covariates: Tensor) -> Tensor:
        """The same for the way back: the pose that the machine has; learned: at the command, `... x n` [SI]."""
        moved = self.known(command) + learned
        return self._aim(self.reached(moved, covariates), self.nominal_at(moved), _BACK)

    def next_correction(
        self, learned: Tensor, covariates: Tensor, ideal: Tensor, correction: Tensor, aim: Tensor
    ) -> Tensor:
        """What to subtract from the ideal joints next.

        Args:
            learned: at the command, `... x n` [SI].
            covariates: `... x m` [SI].
            ideal: joints, `... x n` [SI].
            correction: ideal joints less command, `... x n` [SI].
            aim: of the ideal joints.
        """
        return self._step(self.reached(self.known(ideal) - correction + learned, covariates), correction, aim)

    def next_back(self, command: Tensor, correction: Tensor, aim: Tensor) -> Tensor:
        """The same for the way back: what to subtract from the command, `... x n` [SI]."""
        return self._step(self.nominal_at(self.known(command) - correction), correction, aim)

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
            "identified": self.identified.tolist(),
            "effects": None if self.effects is None else self.effects.describe(),
            "rule": self.rule._asdict(),
            **self.description(),
            **({"ends": {name: list(pair) for name, pair in self.ends.items()}} if self.ends else {}),
        }

    @classmethod
    def from_description(cls, description: dict[str, Any]) -> Machine:
        """The machine as it was described, but for its tensors."""
        effects = None if description["effects"] is None else PhysicalEffects.from_description(description["effects"])
        identified = torch.tensor(description["identified"], dtype=torch.float64)
        made = cls.made(description, identified, effects, Rule(**description["rule"]))
        made.ends = {name: (low, high) for name, (low, high) in description.get("ends", {}).items()}
        return made

    def reached(self, moved: Tensor, covariates: Tensor) -> Placed:
        """Where the real machine is at command and what was learned there `... x n`, and covariates `... x m` [SI]."""
        if self.effects is None:
            return self.identified_at(moved)
        joints, shift = self.effects.changes(moved, covariates)
        placed = self.identified_at(moved if joints is None else moved + joints)
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


class ForwardMachine(Machine):
    """Of a serial arm, and of another whose forward kinematics is a closed form.

    Attributes:
        mechanism: with the nominal parameters, fitted frames included.
    """

    kind = "forward"

    def __init__(
        self, mechanism: Mechanism, identified: Tensor, effects: PhysicalEffects | None = None, rule: Rule = RULE
    ) -> None:
        super().__init__(identified, *limits_of(mechanism), effects, rule)
        # In a tuple, since the mechanism's own buffers are no part of the model.
        self._mechanism = (mechanism,)
        self._prepare()

    @property
    def mechanism(self) -> Mechanism:
        """The nominal machine."""
        return self._mechanism[0]

    @property
    def real(self) -> Mechanism:
        """The machine with the identified parameters as its nominal ones."""
        return self.mechanism.with_nominal(self.identified)

    def nominal_at(self, joints: Tensor) -> Placed:
        return self._nominal.at(joints)

    def identified_at(self, joints: Tensor) -> Placed:
        return self._identified.at(joints)

    def description(self) -> dict[str, Any]:
        return {"mechanism": self.mechanism.describe()}

    @classmethod
    def made(
        cls, description: dict[str, Any], identified: Tensor, effects: PhysicalEffects | None, rule: Rule
    ) -> ForwardMachine:
        # The reader of the file that contains this decides whether code may run.
        mechanism = mechanism_from_description(description["mechanism"], allow_code=True)
        return cls(mechanism, identified, effects, rule, **cls._blank(mechanism, description))

    @classmethod
    def _blank(cls, mechanism: Mechanism, description: dict[str, Any]) -> dict[str, Any]:
        """What else it is made of, tensors without meaning."""
        return {}

    def _prepare(self) -> None:
        make = Links if isinstance(self.mechanism, SerialArm) else ClosedKinematics
        self._nominal, self._identified = make(self.mechanism), make(self.real)


def limits_of(mechanism: Mechanism) -> tuple[Tensor, Tensor]:
    """Lowest and highest joints of the machine's file, `n` each [SI]; infinite where there are none."""
    none = torch.full((len(mechanism.joints),), math.inf, dtype=torch.float64)
    if not isinstance(mechanism, SerialArm) or not mechanism.has_limits:
        return -none, none
    # Exactly a full turn is what a joint without limits is sampled over.
    free = (mechanism.limits.abs() == math.pi).all(-1)
    return torch.where(free, -none, mechanism.limits[:, 0]), torch.where(free, none, mechanism.limits[:, 1])
