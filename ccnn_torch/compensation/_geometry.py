"""Identified geometry as a deviation of the joints: what its forms offer, and which one suits a mechanism."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

from torch import Tensor

from ccnn_torch.compensation._expanded_geometry import expand_geometry
from ccnn_torch.compensation._serial_geometry import SerialGeometry
from ccnn_torch.mechanisms import Mechanism, SerialArm

__all__ = ["Geometry", "fit_geometry_module", "geometric_deviation"]


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
        guess: poses near which forward kinematics stand, `... x p` [SI]; the mechanism's home when None.
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
