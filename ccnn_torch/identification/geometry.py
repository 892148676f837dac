"""Geometric parameters of any mechanism from measured rows, for the network to learn only what they leave."""

from __future__ import annotations

import torch
from torch import Tensor

from ccnn_torch.batching import leading_shape
from ccnn_torch.errors import InputError
from ccnn_torch.identification.links import fit_links
from ccnn_torch.least_squares import jacobian_of, levenberg_marquardt
from ccnn_torch.mechanisms import Mechanism, SerialArm

__all__ = ["fit_geometry"]

_TOLERANCE = {"m": 1e-3, "rad": 2e-3, "1": 2e-3}
# As for links: noise and parameters in turn.
_ROUNDS = 3


def fit_geometry(
    mechanism: Mechanism, joints: Tensor, pose: Tensor, start: Tensor, weights: Tensor | None = None
) -> Tensor:
    """Fit all parameters in each repeat on its own rows; Bayesian least squares around the start.

    A serial arm is fitted by its pose (`fit_links`). Any other mechanism by the residual of inverse calibration,
    g(X; parameters) - q (Zhuang, Yan and Masory 1998), each joint against the noise that its rows show. Every parameter
    is drawn to its start by a plausible error as standard deviation, 1 mm, 2 mrad or 0.2 % by its unit: what the rows
    cannot tell stays where it was.

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
    lead = leading_shape(start, weights)
    value, weights = start.expand(*lead, -1).clone(), weights.expand(*lead, -1)
    _check_reach(mechanism, pose, value, weights)
    root = weights.sqrt()[..., None]
    tolerance = torch.tensor([_TOLERANCE.get(p.unit, 1e-3) for p in mechanism.geometry], dtype=torch.float64)

    def by_row(values: Tensor) -> Tensor:
        return values[..., None, :].expand(*values.shape[:-1], len(joints), -1)

    def gap(values: Tensor) -> Tensor:
        """Weighted joint difference, `... x s x n`, 0 where a row has no joints; values: `... x s x k`."""
        found = mechanism.wrap(mechanism.solve_inverse(pose, values, joints) - joints)
        return torch.where(root > 0, found, 0.0) * root

    for _ in range(_ROUNDS):
        noise = (gap(by_row(value)).square().sum(-2) / weights.sum(-1, keepdim=True)).sqrt().clamp_min(1e-12)

        def residual(offset: Tensor, noise: Tensor = noise) -> Tensor:
            rows = gap(by_row(start + offset * tolerance)) / noise[..., None, :]
            return torch.cat([rows.flatten(-2), offset], dim=-1)

        def slope(offset: Tensor, noise: Tensor = noise) -> Tensor:
            rows = jacobian_of(gap, by_row(start + offset * tolerance))[1] / noise[..., None, :, None]
            pull = torch.eye(offset.shape[-1], dtype=offset.dtype).expand(*lead, -1, -1)
            return torch.cat([(rows * tolerance).flatten(-3, -2), pull], dim=-2)

        # In units of the tolerances, since a gain and a length differ by orders of magnitude.
        offset = (value - start) / tolerance
        value = start + levenberg_marquardt(residual, offset, slope, max_iterations=30, damping=1e-6).value * tolerance
    return value


def _check_reach(mechanism: Mechanism, pose: Tensor, values: Tensor, weights: Tensor) -> None:
    """Rows are counted from 1."""
    reached = mechanism.reachable(pose, values[..., None, :])
    lost = torch.nonzero((~reached & (weights > 0)).reshape(-1, len(pose)).any(0)).squeeze(-1)
    if len(lost):
        named = ", ".join(str(int(i) + 1) for i in lost[:10]) + (", …" if len(lost) > 10 else "")
        raise InputError(
            f"geometry: {len(lost)} poses are out of the reach of {mechanism.name} (rows {named}); correct or remove "
            "them"
        )
