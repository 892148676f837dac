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
        members: effects, ascending.
        theta: all numbers, `k`; those of other effects 0.
        active: places that are fitted, effect by effect.
        log_prior: of the variants.
        free: places of shapes that are refined beside them; what they cost is in the variants' prior.
    """

    members: tuple[int, ...]
    theta: Tensor
    active: tuple[tuple[int, ...], ...]
    log_prior: float
    free: tuple[int, ...] = ()

    @property
    def moved(self) -> tuple[int, ...]:
        return (*self.flat, *self.free)

    @property
    def flat(self) -> tuple[int, ...]:
        return tuple(j for group in self.active for j in group)

    @property
    def groups(self) -> list[Tensor]:
        """Columns of each effect among those of `flat`."""
        places = iter(range(len(self.flat)))
        return [torch.tensor([next(places) for _ in group]) for group in self.active]


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
    return Spec((), torch.zeros(library.size, dtype=torch.float64), (), 0.0)


def started(library: Library, spec: Spec, variant: Variant, axis: int) -> Spec:
    """The set with one effect more, which begins as its variant says."""
    theta = spec.theta.clone()
    theta[list(variant.active)] = variant.values[axis]
    if variant.held:
        theta[list(variant.held)] = variant.shapes[axis]
    both = sorted([*zip(spec.members, spec.active, strict=True), (variant.effect, variant.active)])
    return Spec(
        tuple(m for m, _ in both),
        theta,
        tuple(a for _, a in both),
        spec.log_prior + variant.log_prior,
        (*spec.free, *variant.free(library.held)),
    )


def without(library: Library, spec: Spec, place: int) -> Spec:
    """The set without one of its members."""
    theta, effect = spec.theta.clone(), spec.members[place]
    rest = [k for k in range(len(spec.members)) if k != place]
    held = {p for v in library.variants[effect] for p in v.held}
    theta[[*spec.active[place], *held]] = 0.0
    return Spec(
        tuple(spec.members[k] for k in rest),
        theta,
        tuple(spec.active[k] for k in rest),
        spec.log_prior,
        tuple(p for p in spec.free if p not in held),
    )


def renamed(library: Library, spec: Spec, effect: int, other: int) -> Spec:
    """The set with another effect, of the same numbers, in the place of one."""
    to = dict(zip(library.places[effect], library.places[other], strict=True))
    theta = spec.theta.clone()
    theta[[*to]] = 0.0
    theta[[*to.values()]] = spec.theta[[*to]]
    return spec._replace(
        members=tuple(other if m == effect else m for m in spec.members),
        theta=theta,
        active=tuple(tuple(to.get(j, j) for j in group) for group in spec.active),
    )
