"""Geometric parameters of any mechanism from measured rows, before a network learns the residual."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from ccnn_torch.errors import InputError
from ccnn_torch.identification.problems.inverse import inverse_problem
from ccnn_torch.identification.problems.links import fit_links
from ccnn_torch.identification.solvers.lm import solve_lm
from ccnn_torch.mechanisms import Mechanism, SerialArm

# As for links: noise and parameters in turn.
_ROUNDS = 3
# Of a joint [m or rad]: exact rows leave a residual of rounding, which must not outweigh every prior by division.
_LEAST_NOISE = 1e-12


def fit_geometry(
    mechanism: Mechanism, joints: Tensor, pose: Tensor, start: Tensor, weights: Tensor | None = None
) -> Tensor:
    """Fit all parameters in each repeat on its own rows; Bayesian least squares around the start.

    A serial arm is fitted by its pose (`fit_links`), any other mechanism by the residual of inverse calibration
    (`inverse_problem`). Every parameter is drawn to its start by a plausible error as standard deviation, against the
    noise that the rows show: what they do not determine keeps its value.

    Args:
        joints: commanded, `s x n` [SI].
        pose: measured, `s x p` [SI].
        start: `r x k` or `k` [SI]: nominal, a serial arm's frames fitted.
        weights: `r x s` or `s` [1]; 0 leaves a row out (held-out rows); all 1 when None.

    Returns:
        All parameters, as `start`.

    Raises:
        InputError: the mechanism has no parameters, or a training row's pose is out of its reach (named).
    """
    if isinstance(mechanism, SerialArm):
        return fit_links(mechanism, joints, pose, start, weights)
    if not mechanism.geometry:
        raise InputError(
            f"mechanism '{mechanism.name}' has no parameters that could be identified; write geometry=none"
        )
    weights = torch.ones(len(joints), dtype=torch.float64) if weights is None else weights
    repeats = max(len(start.reshape(-1, start.shape[-1])), len(weights.reshape(-1, len(joints))))
    by_repeat = weights.reshape(-1, len(joints)).expand(repeats, -1)
    begin = start.reshape(-1, start.shape[-1]).expand(repeats, -1)
    problem = inverse_problem(mechanism, joints, pose, by_repeat, start=begin)
    rows, value = (problem.weights > 0).sum(-1) * len(problem.channels), begin
    for _ in range(_ROUNDS):
        gap = problem.residual(value[:, None], *problem.data)
        # Where a row does not count it may have no joints at all.
        gap = torch.where((problem.weights > 0)[..., None], gap, 0.0)
        noise = (gap.square().sum((-2, -1)) / rows).mean().sqrt().clamp_min(_LEAST_NOISE)
        value = solve_lm(replace(problem, prior_sd=problem.scale / noise)).values
    return value.reshape(start.shape if weights.dim() == 1 else (repeats, -1))
