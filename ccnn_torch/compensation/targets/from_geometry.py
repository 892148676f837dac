"""An identified machine alone as a compensator of nominal commands, with a network that adds nothing."""

from __future__ import annotations

import torch
from torch import Tensor

from ccnn_torch.compensation.compensator import Compensator, default_limit
from ccnn_torch.compensation.contraction import STEEPEST_DEVIATION
from ccnn_torch.compensation.fit import fit_compensator
from ccnn_torch.compensation.geometry.identified import fit_geometry_module, settled_damping
from ccnn_torch.compensation.model_files.identified import IdentifiedGeometry
from ccnn_torch.errors import MethodFailedError
from ccnn_torch.learners.constant import ConstantNetwork
from ccnn_torch.training import Scaling

_ROWS, _FEWEST = 2500, 100
_WEIGHT, _MARGIN = 0.04, 0.0
# Joints nearer to a singular pose are left out; of the others the first of these shares about their middle with which a
# closed form is found.
_CONDITION, _SHARES = 30.0, (1.0, 0.5, 0.2)
# Of the steepest deviation that a compensator may have all but what is found beside the points tried.
_SLOPE = 0.9 * STEEPEST_DEVIATION
# What the closed form may leave of the error in position, RMS: it is damped near singular poses.
_LEFT = 0.2


def compensator_of_geometry(model: IdentifiedGeometry) -> tuple[Compensator, str]:
    """The compensator, and a sentence that says what it leaves.

    The exact command is solved for by iteration; an arm gets two damped steps in its place (`SerialGeometry`), another
    machine a polynomial. The domain is what the machine's own sampled joints fill.

    Raises:
        MethodFailedError: the machine takes few of its nominal poses, or the closed form leaves more than a fifth.
    """
    sampled = model.nominal.sample_joints(_ROWS, torch.Generator().manual_seed(0))
    near = model.nominal.condition_number(sampled, _WEIGHT).detach() < _CONDITION
    exact = model(sampled.numpy())
    near &= torch.from_numpy(exact["inside_domain"])
    joints, commands = sampled[near], torch.from_numpy(exact["command"])[near]
    if len(joints) < _FEWEST:
        raise MethodFailedError(
            f"{model.path}: the identified machine takes {len(joints)} of {_ROWS} nominal poses away from singular "
            "ones, too few for a closed form; export it as linuxcnc or urdf"
        )
    order = ((joints - joints.mean(0)) / joints.std(0).clamp_min(1e-9)).norm(dim=-1).argsort()
    for share in _SHARES:
        some = order[: max(_FEWEST, int(share * len(order)))].sort().values
        # Every fifth is kept to judge by.
        judged = torch.arange(len(some)) % 5 == 0
        try:
            made = _fitted(model, joints[some[~judged]], commands[some[~judged]])
            break
        except MethodFailedError:
            if share == _SHARES[-1]:
                raise MethodFailedError(
                    f"{model.path}: the correction is so large or so near singular poses that it has no closed form "
                    f"even over the middle {share:.0%} of its range; export it as linuxcnc or urdf"
                ) from None
    seen = joints[some[judged]]
    before, after = (_error(model, seen, at) for at in (seen, made(seen)[0]))
    if not after <= _LEFT * before:
        raise MethodFailedError(
            f"{model.path}: as a closed form the correction leaves {after:.2g} m of {before:.2g} m (RMS), which is too "
            "much; train with it (ccnn run … geometry=identify), or export it as linuxcnc or urdf"
        )
    where = "over its range" if share == 1 else f"over the middle {share:.0%} of its range"
    return made, (
        f"Identified geometry alone, as a closed form: {where}, singular poses left out, it leaves {after:.2g} m of "
        f"the error in position of {before:.2g} m (RMS)."
    )


def _fitted(model: IdentifiedGeometry, joints: Tensor, commands: Tensor) -> Compensator:
    nominal, first, second = model.nominal, model.nominal.nominal, model.identified.nominal
    limit, still = default_limit(joints - commands), torch.zeros_like(commands)
    damping = settled_damping(nominal, first[None, None], second[None, None], commands, limit, _WEIGHT, _MARGIN, _SLOPE)
    geometry = fit_geometry_module(nominal, first, second, commands, _MARGIN, _WEIGHT, damping)
    rows, turning = torch.ones(1, len(still), dtype=torch.float64), torch.zeros(len(limit), dtype=torch.bool)
    scaling = Scaling.fit(commands[None], still[None], rows, turning).repeat(0)
    network = ConstantNetwork(still[0], still[0])
    return fit_compensator(network, scaling, commands, still, model.joints, (), limit, _MARGIN, geometry=geometry)


@torch.no_grad()
def _error(model: IdentifiedGeometry, ideal: Tensor, command: Tensor) -> float:
    """RMS of the position that the real machine misses [m]; of the angle where it has no position [rad]."""
    wanted = model.nominal.forward_kinematics(ideal)
    error = model.identified.pose_error(model.identified.forward_kinematics(command, guess=wanted), wanted)
    far = error.position if error.rotation is None or bool((error.position > 0).any()) else error.rotation
    return float(far.square().mean().sqrt())
