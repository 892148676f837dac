"""Covariate columns that would explain the rows if they were late, of the other sign, or exchanged."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import combinations

import torch
from torch import Tensor

from ccnn_torch.diagnosis.candidates.atom import Atom
from ccnn_torch.diagnosis.residual.linearisation import signature_at
from ccnn_torch.diagnosis.residual.rows import frame_columns
from ccnn_torch.diagnosis.residual.whitening import without_fitted
from ccnn_torch.diagnosis.search.analysis import Analysis
from ccnn_torch.effects import Situation
from ccnn_torch.evidence.marginal_likelihood import fit_sets, grams_of

# Log odds that an effect must gain by a correction, over all that was found without it: mistakes are rare.
_GAIN = 10.0
# Effects that need columns, by how these begin.
_USED_BY = {"load_": ("compliance", "friction"), "direction": ("backlash", "friction"), "temperature": ("thermal",)}


def column_mistake(analysis: Analysis) -> str:
    """The correction of a column with which one effect explains more than all that was found; empty where none does."""
    atoms = analysis.atoms
    best = analysis.found[0].log_posterior
    likely: dict[str, Atom] = {}
    for found in analysis.found:
        for atom in (atoms[i] for i in found.members if len(found.members) == 1):
            if atom.effect is not None:
                likely.setdefault(atom.name, atom)
    words, most = "", best + _GAIN
    for kind, names in _USED_BY.items():
        columns = [n for n in analysis.situation.covariates if n.startswith(kind)]
        mine = [likely[n] for n in names if n in likely]
        for said, covariates in _corrections(analysis.situation, columns) if mine else ():
            other = replace(analysis.situation, covariates=covariates)
            for atom in mine:
                odds = _evidence(analysis, other, atom) + atom.log_prior
                if odds > most:
                    most = odds
                    words = f"{said}: {atom.name} would then explain more than all that was found; check the columns"
    return words


def _corrections(situation: Situation, columns: list[str]) -> Iterator[tuple[str, dict[str, Tensor]]]:
    """What is wrong, in words, and the covariates as they would be without it."""
    given = dict(situation.covariates)
    every = " and ".join(columns) if len(columns) < 3 else f"{columns[0]} to {columns[-1]}"
    for step, word in ((-1, "late"), (1, "early")):
        # The row that comes round is one of many.
        yield f"{every} seem to be shifted, one row {word}", given | {n: given[n].roll(step) for n in columns}
    if columns and columns[0] == "temperature":
        return
    yield f"{every} seem to have the other sign", given | {n: -given[n] for n in columns}
    for name in columns:
        yield f"{name} seems to have the other sign", given | {name: -given[name]}
    for one, other in combinations(columns, 2):
        yield f"{one} and {other} seem to be swapped", given | {one: given[other], other: given[one]}


def _evidence(analysis: Analysis, situation: Situation, atom: Atom) -> float:
    """Log evidence of an effect alone with these covariates."""
    assert atom.effect is not None
    white, keep = analysis.whitening, analysis.whitening.keep()
    columns = torch.nan_to_num(signature_at(situation, situation, atom.effect, atom.shape))
    columns = columns if atom.used is None else columns[..., list(atom.used)]
    fitted = frame_columns(situation, white.weight > 0)
    every = [white(v)[keep] for v in (fitted, analysis.residual[..., None], columns)]
    frames, target, own = (analysis.correlation(v) for v in every)
    y, x = without_fitted(frames, [target, own])
    fit = fit_sets(grams_of(x, y[..., 0]), [[torch.arange(x.shape[-1])]], analysis.dictionary.noise_dof)
    return float(fit.log_evidence[0])
