"""Directions of the parameters that the rows do not determine, in words."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import qr
from scipy.sparse.csgraph import connected_components
from torch import Tensor

from ccnn_torch.coordinates import Parameter

# Component of a hidden direction below which a parameter does not take part. Real geometry is never exactly parallel:
# smaller components come from the errors themselves and would tie everything to everything.
TAKES_PART = 1e-2


def combinations_in_words(parameters: Sequence[Parameter], hidden: Tensor, scale: Tensor) -> tuple[str, ...]:
    """A sentence for each group of parameters that hidden directions tie together.

    `A1x and l1 only as 1.00 A1x - 0.72 l1`: of errors of the two, in SI, the rows see this combination and no other.

    Args:
        hidden: directions that the rows do not see, orthonormal or zero, one a row, `… x k`, in units of `scale`.
        scale: `k` [SI].
    """
    rows = hidden.detach().cpu().numpy()
    projector = rows.T @ rows
    part = np.diag(projector) > TAKES_PART**2
    count, group = connected_components((np.abs(projector) > TAKES_PART) & part & part[:, None], directed=False)
    sizes = scale.cpu().numpy()
    sentences = []
    for number in range(count):
        members = np.flatnonzero((group == number) & part).tolist()
        if len(members):
            visible = _visible(projector[np.ix_(members, members)]) / sizes[members]
            sentences.append(_sentence([parameters[i].name for i in members], visible))
    return tuple(sentences)


def _visible(projector: NDArray[np.float64]) -> NDArray[np.float64]:
    """Combinations that the rows see, the complement of a group's hidden directions, each with a parameter of its own:
    reduced echelon form, `visible x members`."""
    values, vectors = np.linalg.eigh(projector)
    basis = vectors[:, values < 0.5].T
    if not len(basis):
        return basis
    own = np.sort(qr(basis, mode="economic", pivoting=True)[2][: len(basis)])
    reduced: NDArray[np.float64] = np.linalg.solve(basis[:, own], basis)
    return np.where(np.abs(reduced) < TAKES_PART, 0.0, reduced)


def _sentence(names: list[str], visible: NDArray[np.float64]) -> str:
    everyone = _listed(names)
    if not len(visible):
        return f"{everyone} not at all"
    return f"{everyone} only as {_listed([_combination(names, row) for row in visible])}"


def _combination(names: list[str], row: NDArray[np.float64]) -> str:
    """With 1.00 before its first parameter."""
    taking = np.flatnonzero(row)
    row = row / row[taking[0]]
    text = f"{_number(row[taking[0]])} {names[taking[0]]}"
    for i in taking[1:]:
        text += f" {'-' if row[i] < 0 else '+'} {_number(abs(row[i]))} {names[i]}"
    return text


def _number(value: float) -> str:
    return f"{value:.2f}" if 0.1 <= value < 1000 else f"{value:.3g}"


def _listed(texts: list[str]) -> str:
    return texts[0] if len(texts) == 1 else f"{', '.join(texts[:-1])} and {texts[-1]}"
