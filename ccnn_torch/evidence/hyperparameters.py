"""The model that all evidence rests on, and one step of its scales.

Of a set of groups of columns: y ~ N(X θ, σ² I), θ of group g ~ N(0, α_g² I), log α_g² ~ N(0, s²), and log σ² flat, or
about 0 where the noise was given. α and σ are brought to their most probable values by MacKay's updates (1992) and
integrated there.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

# Spread of log α² about a coefficient's plausible size: a factor of 7 in α, either way.
SPREAD = 4.0
LIMIT = 25.0
FIRST_NOISE = 10.0
"""Updates begin with the mean square over this as variance of the noise."""
# No update changes log α² by more.
_STEP = 3.0
_TINY = 1e-12
# Share of the values that a set leaves free, at least, in an update of the noise.
_FREE = 0.02


class Scales(NamedTuple):
    """What is known beforehand of the scales of `b` sets of `g` groups.

    Attributes:
        values: how many values are explained.
        noise_dof: weight of the prior of σ² about 1, in values; 0 = the noise is not known.
        there: which groups there are, `b x g`, bool.
        spread: standard deviation of log α².
    """

    values: float
    noise_dof: float
    there: Tensor
    spread: float = SPREAD

    def updated(self, psi: Tensor, size: Tensor, gamma: Tensor, rss: Tensor) -> tuple[Tensor, Tensor]:
        """The next log α² `b x g` and σ² `b`.

        MacKay's update, which takes coefficients and γ for fixed, and one of Newton's steps from there for the prior.

        Args:
            psi: log α², `b x g`.
            size: sum of the squares of each group's coefficients in units of α, `b x g`.
            gamma: number of coefficients of each group that the data determine, `b x g`.
            rss: remaining sum of squares, `b`.
        """
        prior = 1 / self.spread**2
        step = torch.log(size.clamp_min(_TINY) / gamma.clamp_min(_TINY)).clamp(-_STEP, _STEP)
        half = 0.5 * size * torch.exp(-step)
        step = step + (half - 0.5 * gamma - (psi + step) * prior) / (half + prior)
        psi = (psi + step.clamp_(-_STEP, _STEP).mul_(self.there)).clamp_(-LIMIT, LIMIT)
        left = (self.values - gamma.sum(-1)).clamp_min(_FREE * self.values + 1)
        return psi, ((rss + self.noise_dof) / (left + self.noise_dof)).clamp_min(1e-12)

    def log_evidence(self, psi: Tensor, gamma: Tensor, noise: Tensor, squares: Tensor, log_det: Tensor) -> Tensor:
        """At log α² `b x g` and σ² `b`, `b`.

        Args:
            psi, gamma: as for `updated`.
            noise: σ², `b`.
            squares: of y in units of its covariance, `b`.
            log_det: of that covariance in units of σ², `b`.
        """
        plain = -0.5 * (self.values * noise.log() + squares + log_det)
        plain = plain - 0.5 * self.noise_dof * (noise.log() + 1 / noise - 1)
        hyper = -0.5 * psi.square() / self.spread**2 - 0.5 * torch.log1p(0.5 * gamma * self.spread**2)
        return plain + (hyper * self.there).sum(-1)
