"""Which names of the verdicts hold on runs that no fit saw."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from ccnn_torch.motion.fit import Fit, Spec
from ccnn_torch.motion.judge import AxisVerdict
from ccnn_torch.motion.library import Library
from ccnn_torch.motion.problem import Problem
from ccnn_torch.motion.search import Search, without

__all__ = ["how_many_hold", "in_order", "none_of", "only", "reduced", "singles"]

# Names are added as long as they take the held-out gap to less than this share of itself; a verdict that loses one is
# no surer than the second number.
_NEARLY_LEAST, _DOUBTED = 1.02, 0.9


def none_of(library: Library) -> Spec:
    return Spec((), torch.zeros(library.size, dtype=torch.float64), (), 0.0)


def only(library: Library, spec: Spec, members: Sequence[int]) -> Spec:
    """The set with these members alone."""
    while extra := [k for k, m in enumerate(spec.members) if m not in members]:
        spec = without(library, spec, extra[0])
    return spec


def singles(found: Search) -> dict[str, list[Spec]]:
    """Of each effect alone its fit on every axis; an axis that cannot show it has none."""
    library = found.problem.library
    alone = [{f.members[0]: f.spec for f in fits if len(f.members) == 1} for fits in found.found]
    return {
        name: [own.get(e, none_of(library)) for own in alone]
        for e, name in enumerate(library.names)
        if any(e in own for own in alone)
    }


def in_order(problem: Problem, verdicts: Sequence[AxisVerdict]) -> list[str]:
    """Names of the verdict, the one without which most is left first."""
    names = problem.library.names
    there = list(dict.fromkeys(m for v in verdicts for m in v.best.members))
    if not there:
        return []
    specs = [[only(problem.library, v.best.spec, [m for m in there if m != e]) for v in verdicts] for e in there]
    left = problem.residual(torch.stack([torch.stack([s.theta for s in row]) for row in specs]))
    size = (left.square() * problem.data.judged).sum((1, 2, 3))
    return [names[there[k]] for k in torch.argsort(size, descending=True).tolist()]


def how_many_hold(squares: Sequence[Tensor]) -> int:
    """How many of the names, added one after the other, still take something away where nothing was fitted."""
    left = [float(s.sum()) for s in squares]
    return next(k for k, value in enumerate(left) if value <= _NEARLY_LEAST**2 * min(left))


def reduced(library: Library, fits: Sequence[Fit], verdict: AxisVerdict, names: Sequence[str]) -> AxisVerdict:
    """The verdict with these names alone, as probable as what is left of it."""
    members = tuple(m for m in verdict.best.members if library.names[m] in names)
    best = next((f for f in fits if f.members == members), None)
    if best is None:
        old, spec = verdict.best, only(library, verdict.best.spec, members)
        place = [old.spec.flat.index(j) for j in spec.flat]
        best = old._replace(spec=spec, mean=old.mean[place], covariance=old.covariance[place][:, place])
    like = {m: verdict.classes[m] for m in members}
    each = [verdict.marginal.get(m, 1.0) for m in members] or [1 - max(verdict.marginal.values(), default=0.0)]
    # Of a cause outside the library it is the probability of that.
    doubted = verdict.probability if verdict.driver else min([verdict.probability, _DOUBTED, *each])
    return AxisVerdict(best, doubted, verdict.marginal, like, verdict.driver)
