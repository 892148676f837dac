"""An identified machine alone as a compensator, with a network that adds nothing."""

from __future__ import annotations

import torch

from ccnn_torch.compensation.compensator import Compensator
from ccnn_torch.compensation.fit import fit_compensator
from ccnn_torch.compensation.geometry.expanded import expand_geometry
from ccnn_torch.compensation.geometry.identified import geometric_deviation
from ccnn_torch.compensation.machine.inverse import build_machine
from ccnn_torch.errors import MethodFailedError
from ccnn_torch.learners.constant import ConstantNetwork
from ccnn_torch.mechanisms import Mechanism
from ccnn_torch.training import Scaling

_ROWS, _FEWEST = 2500, 100
_MARGIN = 0.0


def machine_alone(nominal: Mechanism, identified: Mechanism) -> Compensator:
    """The compensator of a machine of which the geometry alone is known; its domain is what sampled joints fill.

    Raises:
        MethodFailedError: the machine has no closed form, and its geometry is no polynomial either.
    """
    joints = nominal.sample_joints(_ROWS, torch.Generator().manual_seed(0))
    there = torch.isfinite(nominal.forward_kinematics(joints)).all(-1)
    joints = joints[there & torch.isfinite(joints).all(-1)]
    if len(joints) < _FEWEST:
        raise MethodFailedError(f"{nominal.name} takes {len(joints)} of {_ROWS} of its poses, too few for a model")
    values, still = identified.nominal, torch.zeros_like(joints)
    machine = build_machine(nominal, values, None, joints, _MARGIN)
    geometry = None
    if machine is None:
        geometry = expand_geometry(geometric_deviation(nominal, nominal.nominal, values), joints, _MARGIN)
    rows, turning = torch.ones(1, len(still), dtype=torch.float64), torch.zeros(still.shape[-1], dtype=torch.bool)
    scaling = Scaling.fit(joints[None], still[None], rows, turning).repeat(0)
    network = ConstantNetwork(still[0], still[0])
    about = (network, scaling, joints, still, nominal.joints)
    return fit_compensator(*about, margin=_MARGIN, geometry=geometry, machine=machine)
