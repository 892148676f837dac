"""What effects see of the nominal machine (Jacobians, places, torques), in a form that can be exported.

Automatic differentiation and iterations until convergence have no place in an exported graph. So a `Situation` gets
what depends on the joints alone put in beforehand, and the effect's own code runs on top of it unchanged:

- of a serial arm exactly, as sums of products of sines and cosines (`_trigonometric`);
- of a machine with a closed form of one direction by that form and its central differences (`_closed_kinematics`);
- of any other as polynomials (`_chebyshev`).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor, nn

from ccnn_torch.compensation.expansions import ChebyshevExpansion, TrigonometricExpansion, expand, expand_arm
from ccnn_torch.compensation.kinematics import ClosedKinematics
from ccnn_torch.effects import Situation
from ccnn_torch.mechanisms import Mechanism, SerialArm

_WHAT = "kinematics that the effects need"
_NAMES = (
    "jacobian",
    "parameter_jacobian",
    "own_weight_torque",
    "inner_weight_torque",
    "weight_torque",
    "holding",
    "frame_slope",
    "visible",
    "pose",
    "platform",
)
# Error of a pose from which Newton's method comes to the right one, as a share of the largest.
_START = 0.1
# Parts of `platform`.
_POSITION, _ROTATION = "platform position", "platform rotation"


class _Watched(Situation):
    """Records which quantities are read."""

    def __getattribute__(self, name: str) -> Any:
        if name in _NAMES:
            object.__getattribute__(self, "__dict__").setdefault("_seen", set()).add(name)
        return object.__getattribute__(self, name)


def looked_at(situation: Situation, use: Callable[[Situation], object]) -> set[str]:
    """Names of the nominal machine's quantities that `use` takes from a situation.

    Args:
        situation: some rows, of which nothing has been worked out yet.
    """
    use(situation)
    watched = _Watched(situation.mechanism, situation.joints, situation.covariates, situation.gravity)
    # With everything at hand nothing is read only to compute something else.
    watched.__dict__.update({name: value for name, value in situation.__dict__.items() if name in _NAMES})
    use(watched)
    seen: set[str] = watched.__dict__.get("_seen", set())
    return seen


class Fields(nn.Module):
    """Quantities of the nominal machine as functions of the commanded joints.

    Attributes:
        layout: name and shape of each quantity.
        source: a module from joints `... x n` to the quantities side by side, `... x o` [SI], or a `ClosedKinematics`,
            which gives them by name; None where none is read.
        typical_torque, low, high, down: what a `Situation` takes from the workspace and from gravity.
    """

    typical_torque: Tensor
    low: Tensor
    high: Tensor
    down: Tensor

    def __init__(
        self,
        layout: list[tuple[str, tuple[int, ...]]],
        source: nn.Module | None,
        constants: dict[str, Tensor],
        samples: Situation,
    ) -> None:
        """constants: the tensors that are the same everywhere, by name; samples: of the workspace."""
        super().__init__()
        self.layout = layout
        self.source = source
        self._samples = (samples,)
        for name in ("typical_torque", "low", "high", "down"):
            self.register_buffer(name, constants[name].detach().clone())

    def fill(self, situation: Situation) -> Situation:
        """The same situation with everything that effects look at in it; fresh, with joints `s x n`."""
        values: dict[str, Any] = dict(self.values(situation.joints, {name for name, _ in self.layout}))
        if _POSITION in values:
            values["platform"] = values.pop(_POSITION), values.pop(_ROTATION, None)
        constants = {
            "typical_torque": self.typical_torque,
            "workspace": (self.low, self.high),
            "down": self.down,
            "samples": self._samples[0],
        }
        # A cached property that is in the instance's dictionary is not computed again.
        situation.__dict__.update(values | constants)
        return situation

    def jacobian(self, joints: Tensor) -> Tensor:
        """At joints `s x n`, `s x c x n`."""
        return self.values(joints, {"jacobian"})["jacobian"]

    def values(self, joints: Tensor, names: set[str]) -> dict[str, Tensor]:
        """Some of the quantities at joints `s x n`, each `s x shape`."""
        if self.source is None:
            return {}
        if isinstance(self.source, ClosedKinematics):
            return self.source.quantities(joints, names)
        flat = self.source(joints)
        out, start = {}, 0
        for name, shape in self.layout:
            end = start + math.prod(shape)
            if name in names:
                out[name] = flat[..., start:end].reshape(*joints.shape[:-1], *shape)
            start = end
        return out

    def describe(self) -> dict[str, Any]:
        """Everything `from_description` needs; the tensors are stored beside it."""
        about: dict[str, Any] = {"layout": [[name, list(shape)] for name, shape in self.layout]}
        if isinstance(self.source, TrigonometricExpansion):
            about["turns"] = self.source.turns
        elif isinstance(self.source, ChebyshevExpansion):
            about["degree"] = self.source.degree
        elif isinstance(self.source, ClosedKinematics):
            about["start"] = None if self.source.start is None else self.source.start.degree
        return about

    @classmethod
    def from_description(cls, description: dict[str, Any], mechanism: Mechanism) -> Fields:
        """Fields of the described shape, their tensors without meaning."""
        layout = [(name, tuple(shape)) for name, shape in description["layout"]]
        outputs, n = sum(math.prod(shape) for _, shape in layout), len(mechanism.joints)
        blank = torch.ones(n, dtype=torch.float64)

        def polynomial(degree: int, count: int) -> ChebyshevExpansion:
            return ChebyshevExpansion(blank.clone(), blank.clone(), degree, outputs=count)

        source: nn.Module | None = None
        if "turns" in description:
            source = TrigonometricExpansion(description["turns"], outputs)
        elif "degree" in description:
            source = polynomial(description["degree"], outputs)
        elif "start" in description:
            degree = description["start"]
            source = ClosedKinematics(mechanism, None if degree is None else polynomial(degree, len(mechanism.pose)))
        sizes = {"typical_torque": n, "low": n, "high": n, "down": 3}
        constants = {k: torch.ones(v, dtype=torch.float64) for k, v in sizes.items()}
        samples = Situation(mechanism, blank[None], {}, torch.zeros(3, dtype=torch.float64)).samples
        return cls(layout, source, constants, samples)


def make_fields(mechanism: Mechanism, gravity: Tensor, names: set[str], joints: Tensor, margin: float) -> Fields:
    """Quantities of the nominal machine over the domain of the training rows.

    Args:
        gravity: `3` [m/s²], base frame.
        joints: commanded joints of the training rows, `s x n` [SI].

    Raises:
        InputError, MethodFailedError: as `expand` and `expand_arm`.
    """

    def quantities(points: Tensor) -> dict[str, Tensor]:
        situation = Situation(mechanism, points, {}, gravity)
        # Where the machine cannot take the pose, other quantities are 0 and the Jacobian is NaN.
        lost = torch.where(torch.isfinite(situation.jacobian).flatten(1).all(-1), 0.0, torch.nan)
        found: dict[str, Tensor] = {}
        for name in _NAMES:
            if name in names and name != "platform":
                found[name] = getattr(situation, name)
        if "platform" in names:
            position, rotation = situation.platform
            found |= {_POSITION: position} | ({} if rotation is None else {_ROTATION: rotation})
        return {
            name: value.expand(len(points), *value.shape[1:]) + lost.reshape(-1, *[1] * (value.dim() - 1))
            for name, value in found.items()
        }

    def flat(points: Tensor) -> Tensor:
        return torch.cat([value.flatten(1) for value in quantities(points).values()], -1)

    whole = Situation(mechanism, joints[:2], {}, gravity)
    low, high = whole.workspace
    constants = {"typical_torque": whole.typical_torque, "low": low, "high": high, "down": whole.down}
    layout = [(name, tuple(value.shape[1:])) for name, value in quantities(joints[:2]).items()]
    source: nn.Module | None = None
    if layout and isinstance(mechanism, SerialArm):
        source = expand_arm(flat, [joint.unit == "rad" for joint in mechanism.joints], _WHAT)
    elif layout and mechanism.closed_form is not None:
        start = None
        if mechanism.closed_form == "inverse":
            start = expand(lambda q: Situation(mechanism, q, {}, gravity).pose, joints, margin, _WHAT, worst=_START)
        source = ClosedKinematics(mechanism, start)
    elif layout:
        source = expand(flat, joints, margin, _WHAT, [math.prod(shape) for _, shape in layout])
    return Fields(layout, source, constants, whole.samples)
