"""A set of effects of one axis, and what a fit of it gives."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from ccnn_torch.evidence.marginal_likelihood import Grams
from ccnn_torch.motion.library import Library, Variant


class Spec(NamedTuple):
    """A set of effects of one axis, and where its fit begins.

    Attributes:
        theta: all numbers, `k`; those of other effects 0.
        variants: of each effect the one that is fitted, effects ascending.
    """

    theta: Tensor
    variants: tuple[Variant, ...]

    @property
    def members(self) -> tuple[int, ...]:
        """Its effects."""
        return tuple(v.effect for v in self.variants)

    @property
    def log_prior(self) -> float:
        """Of the variants."""
        return sum(v.log_prior for v in self.variants)

    @property
    def moved(self) -> tuple[int, ...]:
        """Places that a fit moves: of numbers, and of shapes, which it refines; what these cost is in the prior."""
        return (*self.flat, *(j for v in self.variants for j in v.free))

    @property
    def flat(self) -> tuple[int, ...]:
        """Places of numbers that are fitted, effect by effect."""
        return tuple(j for v in self.variants for j in v.active)

    @property
    def groups(self) -> list[Tensor]:
        """Columns of each effect among those of `flat`."""
        places = iter(range(len(self.flat)))
        return [torch.tensor([next(places) for _ in v.active]) for v in self.variants]


class Fit(NamedTuple):
    """A fitted set of one axis.

    Attributes:
        spec: the set, with `theta` where the fit ended.
        log_evidence: of the linearised model.
        noise: variance of the whitened residual.
        covariance: of the active numbers in plausible sizes, `m x m`.
        rss: squares of the whitened residual.
        unseen: the same on runs that its numbers were not fitted to, or on parts of runs.
        once: largest share of what a member does in one run, which is large of a limit: then these are parts of runs.
        left: mean square of the residual itself [rad^2 or m^2].
        grams: of the linearised model's whitened columns, in plausible sizes, and of `nuisance` after them.
        settled: whether no step leads further down.
    """

    spec: Spec
    log_evidence: float
    noise: float
    covariance: Tensor
    rss: float
    unseen: float
    once: float
    left: float
    grams: Grams
    settled: bool

    @property
    def members(self) -> tuple[int, ...]:
        return self.spec.members


def nothing(library: Library) -> Spec:
    """The set without any effect."""
    return Spec(torch.zeros(library.size, dtype=torch.float64), ())


def started(spec: Spec, variant: Variant, axis: int) -> Spec:
    """The set with one effect more, which begins as its variant says."""
    theta = spec.theta.clone()
    theta[list(variant.active)] = variant.values[axis]
    if variant.held:
        theta[list(variant.held)] = variant.shapes[axis]
    return Spec(theta, tuple(sorted((*spec.variants, variant), key=lambda v: v.effect)))


def without(spec: Spec, place: int) -> Spec:
    """The set without one of its members."""
    theta, variant = spec.theta.clone(), spec.variants[place]
    theta[[*variant.active, *variant.held]] = 0.0
    return Spec(theta, (*spec.variants[:place], *spec.variants[place + 1 :]))
