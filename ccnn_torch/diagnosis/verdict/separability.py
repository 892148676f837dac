"""Why rows do not distinguish two effects: the angle between what the two do in these rows."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from ccnn_torch.diagnosis.search.analysis import Analysis
from ccnn_torch.diagnosis.verdict.judgement import Judgement

_RANK = 1e-9


def signature_angles(analysis: Analysis, judgement: Judgement) -> dict[str, dict[str, dict[str, float]]]:
    """Of each of the verdict's effects how far its signature is from those that may replace it.

    A signature is the fitted part of an effect in units of the noise, the verdict's other effects projected out. The
    angle is the principal one between it and all that the other effect can do (Björck and Golub 1973): 0 where the
    other can do the very same. What no fit of the other can copy is the sine of the angle times the size of the
    signature, the root of a sum of squares over all rows: below about 3 noise hides it, at any angle.

    Returns:
        `{effect: {other: {"angle" [rad], "separation" [1, times the noise]}}}`.
    """
    atoms = analysis.atoms
    found = judgement.found
    flat = analysis.dictionary.columns.flatten(0, 1)

    def columns(members: Sequence[int]) -> Tensor:
        return torch.cat([flat[:, :0], *(flat[:, analysis.dictionary.groups[i]] for i in members)], -1)

    block: dict[str, dict[str, dict[str, float]]] = {}
    for i, mean in zip(found.members, found.mean, strict=True):
        like = judgement.classes.get(atoms[i].name, ())
        if not like:
            continue
        beside = _span(columns([j for j in found.members if j != i]))
        own = _without(beside, columns([i]) @ mean[:, None])[:, 0]
        size = float(torch.linalg.vector_norm(own))
        block[atoms[i].name] = {}
        for name in like:
            # Where a name has several atoms (shapes), the closest one.
            angles = [_angle(own, _span(_without(beside, columns([j])))) for j, a in enumerate(atoms) if a.name == name]
            angle = min(angles)
            block[atoms[i].name][name] = {"angle": angle, "separation": size * math.sin(angle)}
    return block


def _span(x: Tensor) -> Tensor:
    """Orthonormal columns of what the columns of x span, `N x r`."""
    if not x.shape[-1]:
        return x
    u, s, _ = torch.linalg.svd(x, full_matrices=False)
    span: Tensor = u[:, s > _RANK * s.max().clamp_min(1e-300)]
    return span


def _without(span: Tensor, x: Tensor) -> Tensor:
    return x - span @ (span.mT @ x)


def _angle(line: Tensor, span: Tensor) -> float:
    """Between a vector and a subspace, by its sine: the arc cosine is blind to small angles."""
    outside = torch.linalg.vector_norm(_without(span, line[:, None]))
    inside = torch.linalg.vector_norm(span.mT @ line)
    return float(torch.atan2(outside, inside))
