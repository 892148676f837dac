"""Fit a compensator to what a learner has learned: its limit, its domain, and a command that can be solved for."""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence

import torch
from torch import Tensor, nn

from ccnn_torch.compensation.compensator import Compensator, default_limit
from ccnn_torch.compensation.contraction import (
    STEEPEST_DEVIATION,
    Steepness,
    iterations_needed,
    spread_points,
    steepest,
)
from ccnn_torch.compensation.domain import Domain
from ccnn_torch.compensation.effects import PhysicalEffects
from ccnn_torch.compensation.expansions import ChebyshevExpansion
from ccnn_torch.compensation.machine import ASTRAY, FARTHEST, Machine
from ccnn_torch.compensation.secant import Step, secant_steps
from ccnn_torch.coordinates import Coordinate
from ccnn_torch.errors import InputError, MethodFailedError
from ccnn_torch.training import Scaling

# Rounds of damping, and the share of what was learned below which a compensator is not worth having.
_DAMPINGS = 6
_LEAST_SHARE = 0.1
# Where the fixed point takes more steps than this, Broyden's method takes fewer; below it its own operations cost more.
_GENTLE_STEPS = 8
# Training inputs among the points where its steps are counted.
_COUNTED = 512
# A machine's command: the most steps, how often the distance from singular poses at which it is damped may be doubled,
# how far a joint may move while that is found [m or rad], and the share of points for which no further step is taken.
_MOST_STEPS, _DOUBLINGS, _FAR, _FEW = 12, 3, 0.5, 1e-3
# Of the largest deviation in and around the domain: what the whole deviation may be.
_ROOM = 1.5


def fit_compensator(
    network: nn.Module,
    scaling: Scaling,
    inputs: Tensor,
    deviations: Tensor,
    joints: Sequence[Coordinate],
    covariates: Sequence[Coordinate] = (),
    limit: Tensor | None = None,
    margin: float = 0.1,
    transition: float = 0.5,
    sd_scale: Tensor | None = None,
    geometry: ChebyshevExpansion | None = None,
    effects: PhysicalEffects | None = None,
    machine: Machine | None = None,
) -> Compensator:
    """Put guard, limit and fixed point around a trained network, and the identified machine beside it.

    What the network learned is damped about its mean where δ is otherwise too steep for a command to be solved for.

    Args:
        network: features -> standardised deviation, of one repeat.
        scaling: of that repeat, without the leading dimension.
        inputs: training inputs, commanded joints and then covariates, `s x (n + m)` [SI].
        deviations: training deviations of what the network learned, `s x n` [SI]; with `geometry` or `effects` what
            these leave. The mean of the deviations that fade out is the safe correction outside the domain.
        joints, covariates: coordinates in the order of the inputs.
        limit: hard limit of |δ|, `n` [SI], with a `machine` of what was learned; 1.5 times the largest training
            deviation of each joint, geometry included, when None.
        margin: how far beyond the training inputs δ is trusted, as a share of their half range.
        transition: width over which it then fades into the safe correction, as a share of the half range.
        sd_scale: what the network's standard deviation is multiplied by, `n` [1]; 1 when None.
        geometry: deviation of the identified geometry, of one repeat.
        effects: deviation of known effects, of one repeat.
        machine: the identified one, where it has closed forms; in the place of the two.

    Raises:
        InputError: shapes do not fit together, or a limit or a scale is out of its range.
        MethodFailedError: δ is too steep for that even where little of what was learned is left.
    """
    n = len(joints)
    if inputs.shape[-1] != n + len(covariates) or deviations.shape != (len(inputs), n):
        raise InputError(
            f"training inputs {tuple(inputs.shape)} and deviations {tuple(deviations.shape)} do not fit "
            f"{n} joints and {len(covariates)} covariates"
        )
    inputs, deviations = inputs.detach(), deviations.detach()
    total = fading = deviations
    with torch.no_grad():
        if effects is not None:
            effects = copy.deepcopy(effects)
            total = fading = deviations + effects(inputs[:, :n] + deviations, inputs[:, n:])
        if geometry is not None:
            geometry = copy.deepcopy(geometry)
            total = fading = fading + geometry(inputs[:, :n] + fading)
    limit = default_limit(total) if limit is None else limit.detach()
    if limit.shape != (n,) or not bool((limit >= 0).all() & torch.isfinite(limit).all()):
        raise InputError(f"limit must be one finite number of at least 0 for each of the {n} joints")
    sd_scale = torch.ones_like(limit) if sd_scale is None else sd_scale.detach().clone()
    if sd_scale.shape != (n,) or not bool((sd_scale > 0).all() & torch.isfinite(sd_scale).all()):
        raise InputError(f"sd_scale must be one finite number above 0 for each of the {n} joints")
    safe = torch.minimum(torch.maximum(fading.mean(0), -limit), limit)
    safe_sd = (fading - safe).square().mean(0).sqrt()
    reach = torch.cat([limit, limit.new_zeros(len(covariates))])
    domain = Domain.fit(inputs, reach, margin, transition)
    # A copy: what is compensated with does not change when the learner trains on.
    frozen = copy.deepcopy(network).requires_grad_(False)
    alone = geometry is None and effects is None and machine is None
    size = {} if alone else {"count": 512, "at_once": 1024}
    machine = copy.deepcopy(machine)
    share = 1.0
    for _ in range(_DAMPINGS):
        scaled = copy.deepcopy(scaling)
        scaled.deviation.mul_(share)
        compensator = Compensator(
            *(frozen, scaled, domain, limit, safe, joints, covariates, 0.0, 1, sd_scale / share, safe_sd),
            *(geometry, effects, False, machine),
        )
        slope = compensator.deviation if machine is None else compensator.learned
        found = steepest(slope, inputs, domain, limit, **size) if bool(limit.any()) else Steepness(0.0, 0.0)
        if not math.isfinite(found.lipschitz):
            raise MethodFailedError("the trained network gives values that are not finite within its domain")
        if found.lipschitz <= STEEPEST_DEVIATION:
            compensator.lipschitz, compensator.share = found.lipschitz, share
            compensator.iterations = iterations_needed(found)
            if machine is None:
                _accelerate(compensator, inputs)
            else:
                settle(compensator, inputs)
            return compensator
        share *= 0.9 * STEEPEST_DEVIATION / found.lipschitz
        if share < _LEAST_SHARE:
            break
    raise MethodFailedError(
        f"the learned deviation changes by up to {found.lipschitz:.2g} of a joint's motion, and above "
        f"{STEEPEST_DEVIATION:g} the command cannot be solved for safely; train with more rows, fewer nodes or "
        "regularisation, and leave out rows near singular poses (max_condition)"
    )


def _accelerate(compensator: Compensator, inputs: Tensor) -> None:
    """Let Broyden's method find the command where that takes fewer steps; inputs: training inputs, `s x (n + m)`."""
    if compensator.iterations <= _GENTLE_STEPS:
        return
    points = spread_points(inputs, compensator.domain, torch.Generator().manual_seed(1), _COUNTED)
    n = len(compensator.joints)
    steps = secant_steps(
        lambda joints: compensator.deviation(joints, points[:, n:] if compensator.covariates else None),
        points[:, :n], compensator.limit, compensator.iterations, compensator.export_tolerance,
    )  # fmt: skip
    compensator.secant = steps < compensator.iterations
    compensator.iterations = steps


@torch.no_grad()
def settle(compensator: Compensator, inputs: Tensor) -> None:
    """Find how many steps the machine's command takes in and around the domain, and the bound of its deviation.

    The distance from singular poses at which it is damped is doubled as long as fewer points are damped or unsettled.

    Args:
        inputs: training inputs, `s x (n + m)` [SI].
    """
    machine, n = compensator.machine, len(compensator.joints)
    assert machine is not None
    points = spread_points(inputs, compensator.domain, torch.Generator().manual_seed(1), _COUNTED // 2)
    joints, covariates, strange = compensator._inputs(points[:, :n], points[:, n:])
    compensator.most.fill_(_FAR)
    compensator.domain.huge[:n] = FARTHEST
    rule, best = machine.rule, math.inf
    for doubling in range(_DOUBLINGS + 1):
        machine.rule = rule.farther(2.0**doubling)
        shares, correction, doubt = _settling(compensator, joints, covariates, strange)
        # Damped, or on its way for ever: the fewer the better.
        inexact = float((doubt > 0).double().mean())
        if inexact >= best:
            break
        best, kept, found = inexact, machine.rule, (shares, correction, doubt)
        if shares[-1] == 0:
            break
    machine.rule, (shares, correction, doubt) = kept, found
    near = doubt.squeeze(-1) <= ASTRAY
    largest = correction[near].abs().amax(0) if bool(near.any()) else compensator.limit
    compensator.most.copy_(torch.maximum(_ROOM * largest, compensator.limit))
    # More steps settle few more.
    compensator.iterations = _enough(shares)
    compensator.unsettled = shares[-1]
    if compensator.iterations > _GENTLE_STEPS // 2:
        # What was learned is no part of the Jacobian: Broyden's method finds what it does.
        compensator.secant = True
        faster = _settling(compensator, joints, covariates, strange)[0]
        compensator.secant = faster[-1] <= shares[-1] + _FEW and _enough(faster) < compensator.iterations
        compensator.iterations = _enough(faster) if compensator.secant else compensator.iterations


def _enough(shares: list[float]) -> int:
    """Steps after which hardly more points settle."""
    return next(k for k, share in enumerate(shares, 1) if share <= shares[-1] + _FEW)


def _settling(
    compensator: Compensator, joints: Tensor, covariates: Tensor, strange: Tensor
) -> tuple[list[float], Tensor, Tensor]:
    """Share of the regular rows that have not settled after each step, and the last correction with its doubt."""
    assert compensator.machine is not None
    aim = compensator.machine.aim(joints)
    regular = aim[:, -1] <= 0
    correction, shares, steps = torch.zeros_like(joints), list[float](), list[Step]()
    _, following, doubt = compensator.step(joints, covariates, strange, correction, aim)
    for _ in range(_MOST_STEPS):
        correction, steps = compensator.next_correction(following, correction, steps)
        _, following, doubt = compensator.step(joints - correction, covariates, strange, correction, aim)
        shares.append(float((doubt[regular] > 0).double().mean()) if bool(regular.any()) else 0.0)
        if shares[-1] == 0:
            break
    return shares, correction, doubt
