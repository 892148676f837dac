"""An identified machine alone as a compensator, with a network that adds nothing."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from ccnn_torch.compensation.compensator import Compensator
from ccnn_torch.compensation.fit import fit_compensator
from ccnn_torch.compensation.machine.parts import machine_parts
from ccnn_torch.coordinates import Coordinate
from ccnn_torch.effects import Acting, Situation, default_gravity
from ccnn_torch.errors import MethodFailedError
from ccnn_torch.learners.constant import ConstantNetwork
from ccnn_torch.mechanisms import Mechanism
from ccnn_torch.training import Scaling

ROWS = 2500
"""Rows that show where the machine is used."""
_FEWEST = 100


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
