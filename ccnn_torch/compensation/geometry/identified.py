"""Identified geometry as a deviation of the joints: what its forms offer, and which one suits a mechanism."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

import torch
from torch import Tensor

from ccnn_torch.compensation.contraction import GENTLE, least_step, steepest
from ccnn_torch.compensation.domain import Domain
from ccnn_torch.compensation.geometry.expanded import expand_geometry
from ccnn_torch.compensation.geometry.serial import SerialGeometry
from ccnn_torch.mechanisms import Mechanism, SerialArm

# Tried by bisection; without a singular pose near by the first will do.
_DAMPINGS = tuple(0.01 * 1.3**k for k in range(16))
# Of the steepest slope that a compensator may have.
_SHARE = 0.75
# So many rows, and the points between and around them, show where the domain comes near singular poses.
_ROWS = 400


class Geometry(Protocol):
    """A module from commanded joints to γ(q) = g(f(q)) - q, f the identified forward and g the nominal inverse
    kinematics.

    Attributes:
        extrapolates: whether γ holds outside the domain of the training rows.
        export_tolerance: share of the limit to which exports agree, at most 1e-9.
    """

    extrapolates: bool
    export_tolerance: float

    def __call__(self, joints: Tensor) -> Tensor:
        """joints: `... x n` [SI]; returns γ, `... x n` [SI], finite for finite joints."""

    def describe(self) -> dict[str, Any]:
        """JSON with the key `kind`; see `register_network`."""


def geometric_deviation(
    mechanism: Mechanism,
    nominal: Tensor,
    identified: Tensor,
    rotation_weight: float = 0.04,
    damping: float = 0.01,
    guess: Tensor | None = None,
) -> Callable[[Tensor], Tensor]:
    """γ of one or many pairs of geometries: what a model file will hold for an arm, the exact γ for others.

    Args:
        nominal, identified: all parameters, `... x k` [SI], leading dims as the joints' to come.
        rotation_weight, damping: of a serial arm, see `SerialGeometry`.
        guess: poses near which forward kinematics are solved, `... x p` [SI]; the mechanism's home when None.
    """
    if isinstance(mechanism, SerialArm):
        return SerialGeometry(mechanism, nominal, identified, rotation_weight, damping)

    def exact(joints: Tensor) -> Tensor:
        pose = mechanism.forward_kinematics(joints, identified, guess)
        return mechanism.wrap(mechanism.solve_inverse(pose, nominal, joints) - joints)

    return exact


def fit_geometry_module(
    mechanism: Mechanism,
    nominal: Tensor,
    identified: Tensor,
    joints: Tensor,
    margin: float = 0.1,
    rotation_weight: float = 0.04,
    damping: float = 0.01,
) -> Geometry:
    """γ of one pair of geometries as a module that a model file can hold.

    Args:
        nominal, identified: all parameters, `k` [SI].
        joints: commanded joints of the training rows, `s x n` [SI].
        margin: of the domain, as in `fit_compensator`.
        rotation_weight, damping: as in `geometric_deviation`.

    Raises:
        InputError, MethodFailedError: as `expand_geometry`, for what is no serial arm.
    """
    deviation = geometric_deviation(mechanism, nominal, identified, rotation_weight, damping)
    if isinstance(deviation, SerialGeometry):
        return deviation
    return expand_geometry(deviation, joints, margin)


def settled_damping(
    mechanism: Mechanism,
    nominal: Tensor,
    identified: Tensor,
    joints: Tensor,
    limit: Tensor,
    rotation_weight: float,
    margin: float,
    slope: float = _SHARE * GENTLE,
) -> float:
    """The least damping of a serial arm's γ with which it is nowhere so steep that no command could be solved for.

    Near a singular pose γ changes fast, and the faster the less it is damped. Of the steepest slope that a compensator
    may have, a quarter is left to the network's part.

    Args:
        nominal, identified: `r x 1 x k` [SI].
        joints: commanded joints of all rows, `s x n` [SI]; held-out ones may be among them.
        limit: of the correction that the compensator will have, about, `n` [SI].
        rotation_weight, margin: as in `fit_geometry_module`.
        slope: the steepest that γ may be, in units of the limits [1].

    Returns:
        [m per joint unit], one for all repeats; 0 for what is no serial arm.
    """
    if not isinstance(mechanism, SerialArm):
        return 0.0
    low = 0
    for pair in zip(nominal[:, 0], identified[:, 0], strict=True):

        def gentle(step: int, pair: tuple[Tensor, Tensor] = pair) -> bool:
            return _steepness(mechanism, pair, joints, limit, rotation_weight, margin, _DAMPINGS[step]) <= slope

        # A repeat that needs no more damping than those before costs one look.
        low = least_step(gentle, len(_DAMPINGS) - 1, low)
    return _DAMPINGS[low]


def _steepness(
    arm: SerialArm,
    pair: tuple[Tensor, Tensor],
    joints: Tensor,
    limit: Tensor,
    rotation_weight: float,
    margin: float,
    damping: float,
) -> float:
    """Bound of the slope of one repeat's γ over the domain and its transition, in units of the limits."""
    module = SerialGeometry(arm, *pair, rotation_weight, damping)
    domain = Domain.fit(joints, limit, margin)

    def deviation(at: Tensor, _: Tensor | None) -> Tensor:
        return torch.minimum(torch.maximum(module(domain.cage(at)), -limit), limit)

    return steepest(deviation, joints, domain, limit, _ROWS, at_once=4096).lipschitz
