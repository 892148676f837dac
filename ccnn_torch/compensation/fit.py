"""Fit a compensator to what a learner has learned: its limit, its domain, and a command that can be solved for."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor, nn

from ccnn_torch.compensation.any_machine import machine_of
from ccnn_torch.compensation.compensator import TOLERANCE, Compensator, default_limit
from ccnn_torch.compensation.domain import POINTS, Domain, spread_points
from ccnn_torch.compensation.machine import ASTRAY, FARTHEST, Machine
from ccnn_torch.compensation.routines import Functions, Variables, next_step, routines_of
from ccnn_torch.coordinates import Coordinate
from ccnn_torch.effects import Acting, Situation, default_gravity
from ccnn_torch.effects.found_machine import FoundMachine
from ccnn_torch.errors import InputError, MethodFailedError
from ccnn_torch.learners.constant import ConstantNetwork
from ccnn_torch.mechanisms import Mechanism
from ccnn_torch.training import Scaling

# A unique command exists below a slope of 1. At this one the fixed point takes 40 steps, and
# a slope that sampling missed still has room.
STEEPEST_DEVIATION = 0.5

# Points that are compared, how many a pass takes, how many climb on, and for how many rounds.
_AT_ONCE, _CLIMBERS, _ROUNDS = 256, 64, 12
# The steepest of the points tried is not the steepest of all.
_SAFETY = 1.25
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
# Of the largest deviation in and around the domain: what the whole deviation may be. An arm whose elbow is nearer to
# stretched than in any row needs twice as much, and is mistaken by more than a millimetre where it gets less.
_ROOM = 3.0
# Of the largest deviation of all joints of a unit: the least that counts for one of them. Where one joint alone is off,
# the others move by little on the way to the command, and by nothing in the end.
_BESIDE = 0.1


# Share of the limit to which single precision is right.
SINGLE_TOLERANCE = 1e-5


class Steepness(NamedTuple):
    """`lipschitz`: bound of the slope in units of the limits; `largest`: max|δ| in the same, at most 1."""

    lipschitz: float
    largest: float


def steepest(
    deviation: Callable[[Tensor, Tensor | None], Tensor],
    inputs: Tensor,
    domain: Domain,
    limit: Tensor,
    count: int = POINTS,
    at_once: int = _AT_ONCE,
) -> Steepness:
    """Find the steepest slope of δ over the domain and the transition around it, by sampling and hill climbing.

    Joints are measured in units of their limits, so that metres and radians, and joints of large and small deviations,
    count alike; the norm is the maximum row sum, which bounds the error of every joint.

    Args:
        deviation: (joints `s x n`, covariates `s x m` or None) -> δ `s x n` [SI].
        inputs: training inputs, `s x (n + m)` [SI].
        domain: fitted to them.
        limit: `n` [SI].
        count: inputs that are compared; of points between and around them there are six times as many.
        at_once: points that one pass takes; a geometry's many small operations take hardly longer for more of them.
    """
    n = len(limit)
    positive = limit[limit > 0]
    scale = torch.where(limit > 0, limit, positive.min() if len(positive) else torch.ones_like(limit))

    def slope(points: Tensor) -> tuple[Tensor, Tensor]:
        # In pieces: a network that compares each point with thousands of rows keeps a matrix for every operation.
        slopes, sizes = zip(*(slope_of_few(part) for part in torch.split(points, at_once)), strict=True)
        return torch.cat(slopes), torch.cat(sizes)

    def slope_of_few(points: Tensor) -> tuple[Tensor, Tensor]:
        joints = points[:, :n].clone().requires_grad_()
        value = deviation(joints, points[:, n:])
        # One row of the Jacobian of every point at once, since the points do not know of each other.
        rows = [torch.autograd.grad(value[:, i].sum(), joints, retain_graph=True)[0] for i in range(n)]
        jacobian = torch.stack(rows, 1) * scale / scale.unsqueeze(-1)
        return jacobian.abs().sum(-1).amax(-1), (value.detach().abs() / scale).amax(-1)

    generator = torch.Generator().manual_seed(0)
    points = spread_points(inputs, domain, generator, count)
    slopes, sizes = slope(points)
    chosen = slopes.topk(min(_CLIMBERS, len(points))).indices
    points, best = points[chosen], slopes[chosen]
    step = domain.half_range * 0.2
    for _ in range(_ROUNDS):
        draw = torch.randn(points.shape, generator=generator, dtype=points.dtype)
        candidates = domain.cage(points + step * draw)
        found, _ = slope(candidates)
        better = found > best
        points = torch.where(better.unsqueeze(-1), candidates, points)
        best = torch.maximum(best, found)
        step = step * 0.7
    return Steepness(_SAFETY * float(best.max()), min(1.0, float(sizes.max())))


def iterations_needed(found: Steepness, tolerance: float = TOLERANCE) -> int:
    """Smallest k, at least 1, with lipschitzᵏ · max|δ| ≤ tolerance, both in units of the limit."""
    if found.lipschitz == 0 or found.largest <= tolerance:
        return 1
    exact = math.log(tolerance / found.largest) / math.log(found.lipschitz)
    # A slope of exactly 1e-4 takes 3 steps, also where the quotient of the logarithms comes out as 3 + 4e-16.
    return max(1, math.ceil(exact - 1e-9))


def single_steps(compensator: Compensator) -> int:
    """Steps of the fixed point after which single precision shows no more."""
    return iterations_needed(Steepness(compensator.lipschitz, 1.0), SINGLE_TOLERANCE / 10)


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
    machine: Machine | None = None,
) -> Compensator:
    """Put guard, limit and fixed point around a trained network, and the identified machine beside it.

    What the network learned is damped about its mean where δ is otherwise too steep for a command to be solved for.

    Args:
        network: features -> standardised deviation, of one repeat.
        scaling: of that repeat, without the leading dimension.
        inputs: training inputs, commanded joints and then covariates, `s x (n + m)` [SI].
        deviations: training deviations of what the network learned, `s x n` [SI]; with a `machine` what it leaves.
            Their mean is the safe correction outside the domain.
        joints, covariates: coordinates in the order of the inputs.
        limit: hard limit of |δ|, `n` [SI], with a `machine` of what was learned; 1.5 times the largest training
            deviation of each joint when None.
        margin: how far beyond the training inputs δ is trusted, as a share of their half range.
        transition: width over which it then fades into the safe correction, as a share of the half range.
        sd_scale: what the network's standard deviation is multiplied by, `n` [1]; 1 when None.
        machine: the identified one, of one repeat.

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
    # Copies: what is compensated with does not change when the learner trains on.
    frozen, machine = copy.deepcopy((network, machine))
    frozen.requires_grad_(False)
    inputs, deviations = inputs.detach(), deviations.detach()
    if machine is not None:
        machine.ends = _of_other_days(covariates, inputs[:, n:]) | machine.ends
    limit = default_limit(deviations) if limit is None else limit.detach()
    if limit.shape != (n,) or not bool((limit >= 0).all() & torch.isfinite(limit).all()):
        raise InputError(f"limit must be one finite number of at least 0 for each of the {n} joints")
    sd_scale = torch.ones_like(limit) if sd_scale is None else sd_scale.detach().clone()
    if sd_scale.shape != (n,) or not bool((sd_scale > 0).all() & torch.isfinite(sd_scale).all()):
        raise InputError(f"sd_scale must be one finite number above 0 for each of the {n} joints")
    safe = torch.minimum(torch.maximum(deviations.mean(0), -limit), limit)
    safe_sd = (deviations - safe).square().mean(0).sqrt()
    reach = torch.cat([limit, limit.new_zeros(len(covariates))])
    domain = Domain.fit(inputs, reach, margin, transition)
    size = {} if machine is None else {"count": 512, "at_once": 1024}
    share = 1.0
    for _ in range(_DAMPINGS):
        scaled = copy.deepcopy(scaling)
        scaled.deviation.mul_(share)
        compensator = Compensator(
            *(frozen, scaled, domain, limit, safe, joints, covariates, 0.0, 1, sd_scale / share, safe_sd),
            *(False, machine),
        )
        slope = compensator.deviation if machine is None else compensator.learned
        found = steepest(slope, inputs, domain, limit, **size) if bool(limit.any()) else Steepness(0.0, 0.0)
        if not math.isfinite(found.lipschitz):
            raise MethodFailedError("the trained network gives values that are not finite within its domain")
        if found.lipschitz <= STEEPEST_DEVIATION:
            compensator.lipschitz, compensator.share = found.lipschitz, share
            compensator.iterations = iterations_needed(found)
            if machine is None:
                _count_steps(compensator, inputs)
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


@torch.no_grad()
def _count_steps(compensator: Compensator, inputs: Tensor) -> None:
    """Steps that the command takes, those of Broyden's method where it takes fewer; inputs: `s x (n + m)` [SI].

    They are counted until d = δ(q - d) holds at points in and around the domain, to what exports are right to and the
    rounding of a command and of its sum with δ. The steepest slope is met at few points, and by few steps.
    """
    most = compensator.iterations
    best = most, False
    points = spread_points(inputs, compensator.domain, torch.Generator().manual_seed(1), _COUNTED)
    for secant in (False, True):
        compensator.secant = secant
        functions, values = _begun(compensator, points, most)
        rounding = 2 * torch.finfo(points.dtype).eps * values["q"].abs()
        allowed = compensator.export_tolerance * compensator.limit + rounding
        for count in range(1, best[0]):
            functions.run(next_step(compensator), values)
            if bool(((values["found"] - values["correction"]).abs() <= allowed).all()):
                best = count, secant
                break
        if best[0] <= _GENTLE_STEPS:
            break
    compensator.iterations, compensator.secant = best


# Of the range of a temperature that was measured: how far beyond it effects go on, lengths growing as they did.
_WARMER = 0.5


def _of_other_days(covariates: Sequence[Coordinate], values: Tensor) -> dict[str, tuple[float, float]]:
    """Ends up to which effects follow each temperature, by its name [K]: another day is seldom as warm as that of the
    rows; values: `s x m` [SI]."""
    low, high = values.amin(0), values.amax(0)
    more = _WARMER * (high - low)
    ends = zip(covariates, (low - more).tolist(), (high + more).tolist(), strict=True)
    return {c.name: (lowest, highest) for c, lowest, highest in ends if c.unit == "K"}


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
    if machine.ends:
        # Every second one somewhere between the ends.
        low, high = compensator.ends
        share = torch.rand(points[::2, n:].shape, generator=torch.Generator().manual_seed(2), dtype=points.dtype)
        points[::2, n:] = low + (high - low) * share
    compensator.most.fill_(_FAR)
    compensator.domain.huge[:n] = FARTHEST
    rule, best = machine.rule, math.inf
    for doubling in range(_DOUBLINGS + 1):
        machine.rule = rule.farther(2.0**doubling)
        shares, correction, doubt = _settling(compensator, points)
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
    units = [joint.unit for joint in compensator.joints]
    alike = torch.tensor([[a == b for b in units] for a in units])
    others = _BESIDE * torch.where(alike, largest, 0.0).amax(-1)
    compensator.most.copy_(torch.maximum(_ROOM * torch.maximum(largest, others), compensator.limit))
    # More steps settle few more.
    compensator.iterations = _enough(shares)
    compensator.unsettled = shares[-1]
    if compensator.iterations > _GENTLE_STEPS // 2:
        # What was learned is no part of the Jacobian: Broyden's method finds what it does.
        compensator.secant = True
        faster = _settling(compensator, points)[0]
        compensator.secant = faster[-1] <= shares[-1] + _FEW and _enough(faster) < compensator.iterations
        compensator.iterations = _enough(faster) if compensator.secant else compensator.iterations


def _enough(shares: list[float]) -> int:
    """Steps after which hardly more points settle."""
    return next(k for k, share in enumerate(shares, 1) if share <= shares[-1] + _FEW)


def _settling(compensator: Compensator, inputs: Tensor) -> tuple[list[float], Tensor, Tensor]:
    """Share of the regular rows that have not settled after each step, and the last correction with its doubt."""
    (functions, values), shares = _begun(compensator, inputs, _MOST_STEPS), list[float]()
    regular = values["aim"][:, -1] <= 0
    correction, doubt = values["correction"].clone(), values["doubt"].clone()
    rows = torch.arange(len(inputs))
    for _ in range(_MOST_STEPS):
        functions.run(next_step(compensator), values)
        correction[rows], doubt[rows] = values["correction"], values["doubt"]
        shares.append(float((doubt[regular] > 0).double().mean()) if bool(regular.any()) else 0.0)
        # What has settled stays: only the others take another step.
        moving = (values["doubt"] > values["aim"][:, -1:]).squeeze(-1)
        if shares[-1] == 0:
            break
        rows, values = rows[moving], {name: value[moving] for name, value in values.items()}
    return shares, correction, doubt


def _begun(compensator: Compensator, inputs: Tensor, most: int) -> tuple[Functions, Variables]:
    """Functions with room for so many steps, and variables of inputs `s x (n + m)` [SI] after the first evaluation."""
    functions, start = Functions(compensator, most), routines_of(compensator)[0].statements
    return functions, functions.run(start[: start.index("step") + 1], functions.start(inputs))


ROWS = 2500
"""Rows that show where the machine is used."""
_FEWEST = 100


def all_over(nominal: Mechanism) -> Situation:
    """Rows all over the workspace of a machine of which nothing else is known."""
    joints = nominal.sample_joints(ROWS, torch.Generator().manual_seed(0))
    return Situation(nominal, joints, {}, default_gravity(nominal))


def rows_of(machine: FoundMachine) -> Situation:
    """Rows all over the region of a machine; of geometry alone all over its workspace, and where it was measured."""
    if len(machine.joints):
        return machine.rows(ROWS)
    rows, beside = all_over(machine.nominal), machine._replace(joints=machine.beside)
    return replace(rows, joints=torch.cat([rows.joints, beside.rows(ROWS).joints])) if len(machine.beside) else rows


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
        InputError, MethodFailedError: see `machine_of`, or few of the rows are poses.
    """
    nominal, names = rows.mechanism, [c.name for c in covariates]
    there = torch.isfinite(nominal.forward_kinematics(rows.joints)).all(-1) & torch.isfinite(rows.joints).all(-1)
    if int(there.sum()) < _FEWEST:
        raise MethodFailedError(
            f"{nominal.name} takes {int(there.sum())} of {len(there)} of its poses, too few for a model"
        )
    given = {name: rows.covariates[name][there] for name in names}
    fine = Situation(nominal, rows.joints[there], given, rows.gravity, travel=rows.travel)
    inputs = torch.cat([fine.joints, *(given[name][:, None] for name in names)], -1)
    still, turning = torch.zeros_like(fine.joints), torch.zeros(inputs.shape[-1], dtype=torch.bool)
    weights = torch.ones(1, len(still), dtype=torch.float64)
    scaling = Scaling.fit(inputs[None], still[None], weights, turning).repeat(0)
    network = ConstantNetwork(still[0], still[0])
    machine = machine_of(fine, acting, values, names, margin)
    return fit_compensator(network, scaling, inputs, still, nominal.joints, covariates, margin=margin, machine=machine)
