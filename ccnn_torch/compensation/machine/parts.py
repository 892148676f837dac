"""The machine as an identification left it, in the parts that a compensator is made of."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

from ccnn_torch.compensation.effects.effects import Care, expand_effects, gains
from ccnn_torch.compensation.geometry.chebyshev import expand
from ccnn_torch.compensation.machine.inverse import build_machine
from ccnn_torch.effects import Acting, Situation
from ccnn_torch.mechanisms import Mechanism, SerialArm
from ccnn_torch.mechanisms.frames.fit import ROTATION_WEIGHT

# How much larger than at the rows what effects take from the kinematics may become.
_ABOVE = 1.1


def machine_parts(
    rows: Situation, acting: Sequence[Acting], values: Tensor, covariates: Sequence[str], margin: float
) -> dict[str, Any]:
    """Geometry and effects as `fit_compensator` takes them: a machine, or polynomials where it has no closed form.

    Args:
        rows: on the nominal machine, frames fitted, `s x n`; its region is what they fill.
        acting: effects on joints and pose.
        values: all parameters as identified, `k` [SI].
        covariates: names of the compensator's, in order.
        margin: of the compensator's domain.

    Raises:
        InputError, MethodFailedError: what effects see of the machine, or its geometry, is no polynomial of the joints.
    """
    mechanism = rows.mechanism
    closed = isinstance(mechanism, SerialArm) or mechanism.closed_form is not None
    effects = expand_effects(rows, acting, covariates, margin, None if closed else _care(rows)) if acting else None
    machine = build_machine(mechanism, values, effects, rows.joints, margin)
    if machine is not None:
        return {"machine": machine}
    geometry = None
    if not torch.equal(values, mechanism.nominal):
        geometry = expand(geometric_deviation(mechanism, mechanism.nominal, values), rows.joints, margin)
    return {"geometry": geometry, "effects": effects}


def geometric_deviation(
    mechanism: Mechanism, nominal: Tensor, identified: Tensor, guess: Tensor | None = None
) -> Callable[[Tensor], Tensor]:
    """The exact γ of one or many pairs of geometries.

    Args:
        nominal, identified: all parameters, `... x k` [SI], leading dims as the joints' to come.
        guess: poses near which forward kinematics are solved, `... x p` [SI]; the mechanism's home when None.
    """

    def exact(joints: Tensor) -> Tensor:
        pose = mechanism.forward_kinematics(joints, identified, guess)
        return mechanism.wrap(mechanism.solve_inverse(pose, nominal, joints) - joints)

    return exact


def _care(rows: Situation) -> Care:
    """Near singular poses effects of a machine without closed forms grow no further than at the rows."""
    care = Care(ROTATION_WEIGHT, 0.0)
    gain, inverse_gain = (_ABOVE * float(sizes.max()) for sizes in gains(rows.jacobian, care))
    return care._replace(gain=gain, inverse_gain=inverse_gain)
