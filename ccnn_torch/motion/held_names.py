"""Sets that are tried on runs that no fit saw: each effect alone, and the names of the verdict one after the other."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from ccnn_torch.motion.fit import Spec
from ccnn_torch.motion.judge import AxisVerdict
from ccnn_torch.motion.library import Library
from ccnn_torch.motion.problem import Problem
from ccnn_torch.motion.search import Search, without

__all__ = ["in_order", "none_of", "only", "singles"]


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
