"""How well the numbers of a set are known: its coefficients together with their periods, lags and the like."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from ccnn_torch.diagnosis.candidates.atom import Atom, scales
from ccnn_torch.diagnosis.residual.linearisation import signature_at
from ccnn_torch.diagnosis.search.analysis import Analysis
from ccnn_torch.effects import Situation, moved
from ccnn_torch.evidence.dictionary import FittedSet, covariance

# Step of a derivative by a shape, as a share of its grid's narrowest step.
_STEP = 1e-3


class Spread(NamedTuple):
    """Attributes:
    coefficients: covariance, atom by atom, in units of their plausible sizes, `m x m`.
    shapes: standard deviation of each shape that was searched between the values of its grid [SI], by the atom's place
        in the set and the shape's number.
    """

    coefficients: Tensor
    shapes: dict[tuple[int, int], float]


def spread_of(analysis: Analysis, found: FittedSet) -> Spread:
    """Covariance of the coefficients of a set, what is not known of its shapes included.

    The model is linear in the coefficients for given shapes; about the shapes that were found it is taken as linear in
    these, too (Laplace's approximation; MacKay 1992), with a normal prior as wide as their grids.
    """
    given = covariance(analysis.dictionary, found)
    there = moved(analysis.situation, analysis.acting(found))
    keys, columns, priors = [], [], []
    for place, (i, mean) in enumerate(zip(found.members, found.mean, strict=True)):
        atom = analysis.atoms[i]
        for h, step in _free_shapes(analysis.situation, atom).items():
            keys.append((place, h))
            columns.append(_derivative(analysis.situation, there, atom, mean, h, step))
            assert atom.effect is not None
            grid = atom.effect.shapes(analysis.situation)[h].grid
            priors.append(12 / (grid[-1] - grid[0]) ** 2)
    if not keys:
        return Spread(given, {})
    (by_shape,) = analysis.whitened([torch.stack(columns, -1)])
    index = torch.cat([analysis.dictionary.groups[i] for i in found.members])
    own, by_shape = analysis.dictionary.columns[..., index].flatten(0, 1), by_shape.flatten(0, 1)
    across = given @ (own.mT @ by_shape) / found.noise
    precision = by_shape.mT @ by_shape / found.noise + torch.diag(by_shape.new_tensor(priors))
    shapes = torch.linalg.inv(precision - (own.mT @ by_shape).mT @ across / found.noise)
    deviations = shapes.diagonal().clamp_min(0).sqrt().tolist()
    return Spread(given + across @ shapes @ across.mT, dict(zip(keys, deviations, strict=True)))


def _free_shapes(situation: Situation, atom: Atom) -> dict[int, float]:
    """Numbers of an atom's shapes of which values between those of the grid are possible, with a small step of each."""
    if atom.effect is None:
        return {}
    used = None if atom.used is None else set(atom.used)
    return {
        h: _STEP * min(high - low for low, high in zip(shape.grid, shape.grid[1:], strict=False))
        for h, shape in enumerate(atom.effect.shapes(situation))
        if shape.refined and len(shape.grid) > 1 and (used is None or shape.columns is None or used & {*shape.columns})
    }


def _derivative(situation: Situation, there: Situation, atom: Atom, mean: Tensor, h: int, step: float) -> Tensor:
    """Of what an atom does by one of its shapes, `s x c` [m or rad per SI unit of the shape]; within the grid."""
    assert atom.effect is not None
    grid = atom.effect.shapes(situation)[h].grid
    size = scales(atom.effect.coefficients(situation), mean)
    ends = []
    for end in (max(float(atom.shape[h]) - step, grid[0]), min(float(atom.shape[h]) + step, grid[-1])):
        shape = atom.shape.clone()
        shape[h] = end
        done = signature_at(situation, there, atom.effect, shape) @ (atom.spread(situation, mean) / size)
        ends.append((end, torch.nan_to_num(done)))
    (low, before), (high, after) = ends
    change: Tensor = (after - before) / (high - low)
    return change
