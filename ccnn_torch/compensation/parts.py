"""The machine as an identification left it, in the parts that a compensator is made of, or alone as one."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

from ccnn_torch.compensation.compensator import Compensator
from ccnn_torch.compensation.effects import Care, expand_effects, gains
from ccnn_torch.compensation.expansions import expand
from ccnn_torch.compensation.fit import fit_compensator
from ccnn_torch.compensation.machine import build_machine
from ccnn_torch.coordinates import Coordinate
from ccnn_torch.effects import Acting, Situation, default_gravity
from ccnn_torch.errors import MethodFailedError
from ccnn_torch.learners.constant import ConstantNetwork
from ccnn_torch.mechanisms import Mechanism, SerialArm
from ccnn_torch.mechanisms.frames.fit import ROTATION_WEIGHT
from ccnn_torch.training import Scaling

# How much larger than at the rows what effects take from the kinematics may become.
_ABOVE = 1.1
ROWS = 2500
"""Rows that show where the machine is used."""
_FEWEST = 100


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


def all_over(nominal: Mechanism) -> Situation:
    """Rows all over the workspace of a machine of which nothing else is known."""
    joints = nominal.sample_joints(ROWS, torch.Generator().manual_seed(0))
    return Situation(nominal, joints, {}, default_gravity(nominal))


def machine_alone(
    rows: Situation,
    values: Tensor,
    acting: Sequence[Acting] = (),
    covariates: Sequence[Coordinate] = (),
    margin: float = 0.1,
) -> Compensator:
    """The compensator of a machine that was identified, without a learner.

    Args:
        rows: on the nominal machine; what they fill is its domain.
        values: all parameters as identified, `k` [SI].
        acting: effects on joints and pose.
        covariates: of the rows, in order.
        margin: by how much the domain is larger than what the rows fill.

    Raises:
        InputError, MethodFailedError: see `machine_parts`, or few of the rows are poses.
    """
    nominal, names = rows.mechanism, [c.name for c in covariates]
    there = torch.isfinite(nominal.forward_kinematics(rows.joints)).all(-1) & torch.isfinite(rows.joints).all(-1)
    if int(there.sum()) < _FEWEST:
        raise MethodFailedError(
            f"{nominal.name} takes {int(there.sum())} of {len(there)} of its poses, too few for a model"
        )
    given = {name: rows.covariates[name][there] for name in names}
    fine = Situation(nominal, rows.joints[there], given, rows.gravity)
    inputs = torch.cat([fine.joints, *(given[name][:, None] for name in names)], -1)
    still, turning = torch.zeros_like(fine.joints), torch.zeros(inputs.shape[-1], dtype=torch.bool)
    weights = torch.ones(1, len(still), dtype=torch.float64)
    scaling = Scaling.fit(inputs[None], still[None], weights, turning).repeat(0)
    network = ConstantNetwork(still[0], still[0])
    parts = machine_parts(fine, acting, values, names, margin)
    return fit_compensator(network, scaling, inputs, still, nominal.joints, covariates, margin=margin, **parts)
