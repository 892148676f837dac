"""How near singular poses known effects are compensated: as near as the command can still be solved for."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from ccnn_torch.compensation.contraction import GENTLE, least_step, steepest
from ccnn_torch.compensation.domain import Domain
from ccnn_torch.compensation.effects.effects import Care, PhysicalEffects, expand_effects, gains
from ccnn_torch.effects import Acting, Situation
from ccnn_torch.mechanisms import SerialArm

# Of the rows' gains, by bisection: the shares of the rows that lie below; and above the largest by so much.
_SHARES = (1.0, 0.99, 0.98, 0.97, 0.96, 0.94, 0.92, 0.9, 0.87, 0.84, 0.8, 0.75, 0.7, 0.6, 0.5, 0.3)
_ABOVE = 1.1
_DAMPINGS = tuple(0.01 * 1.3**k for k in range(16))
# Of the steepest slope that a compensator may have: the rest is for network and geometry, and a gentle slope takes
# fewer steps to the command.
_SHARE = 0.6
_ROWS = 512


def settled_effects(
    situation: Situation,
    acting: Sequence[Acting],
    covariates: Sequence[str],
    limit: Tensor,
    margin: float,
    rotation_weight: float,
    damping: float,
) -> PhysicalEffects:
    """The module of `expand_effects`, held back near singular poses no more than it must.

    There a load or a weight moves joints and platform out of all proportion, and fast: an arm's deviation is damped
    more, that of another machine grows no further where its Jacobian, or the inverse, is larger than at most rows.

    Args:
        situation: the training rows, `s x n`.
        acting: effects with their numbers.
        covariates: names of the compensator's covariates, in order.
        limit: of the correction that the compensator will have, about, `n` [SI].
        margin: of the compensator's domain.
        rotation_weight: of rotation against position [m/rad].
        damping: least one of an arm [m per joint unit].

    Raises:
        InputError, MethodFailedError: as `expand_effects`.
    """
    rows, names = situation.joints, list(covariates)
    columns = [situation.covariates.get(name, torch.zeros_like(rows[:, 0])) for name in names]
    inputs = torch.cat([rows, *(column.unsqueeze(-1) for column in columns)], -1)
    domain = Domain.fit(inputs, torch.cat([limit, limit.new_zeros(len(names))]), margin)
    care = Care(rotation_weight, damping)
    if isinstance(situation.mechanism, SerialArm):
        module = expand_effects(situation, acting, names, margin, care)

        def hold_back(step: int) -> None:
            module.care = module.care._replace(damping=max(damping, _DAMPINGS[step]))
    else:
        sizes = torch.stack(gains(situation.jacobian, care))
        most = torch.quantile(sizes, torch.tensor(_SHARES, dtype=sizes.dtype), dim=-1)
        most[0] *= _ABOVE
        module = expand_effects(situation, acting, names, margin, care)

        def hold_back(step: int) -> None:
            gain, inverse_gain = most[step].tolist()
            module.care = module.care._replace(gain=gain, inverse_gain=inverse_gain)

    if not module.fields.layout:
        return module

    def gentle(step: int) -> bool:
        hold_back(step)
        return _steepness(module, inputs, domain, limit) <= _SHARE * GENTLE

    # By as little as it takes.
    hold_back(least_step(gentle, len(_SHARES) - 1))
    return module


def _steepness(module: PhysicalEffects, inputs: Tensor, domain: Domain, limit: Tensor) -> float:
    """Bound of the slope over the domain and its transition, as the compensator limits and fades it."""
    n = len(limit)

    def deviation(joints: Tensor, covariates: Tensor | None) -> Tensor:
        assert covariates is not None
        caged = domain.cage(torch.cat([joints, covariates], -1))
        fade = torch.relu(1 - domain.excess(caged))
        value = fade * fade * module(caged[..., :n], caged[..., n:])
        return torch.minimum(torch.maximum(value, -limit), limit)

    return steepest(deviation, inputs, domain, limit, _ROWS, at_once=4096).lipschitz
