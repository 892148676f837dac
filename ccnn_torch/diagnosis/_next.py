"""What to measure next: rows that would best tell the leading explanations apart."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from ccnn_torch.diagnosis._analysis import Analysis
from ccnn_torch.diagnosis._atoms import scales
from ccnn_torch.diagnosis._search import Found
from ccnn_torch.diagnosis._verdict import Judgement
from ccnn_torch.effects import Situation, signature

__all__ = ["next_measurements"]

_CANDIDATES = 400
_WANTED = 8
_RIVALS = 3


def next_measurements(analysis: Analysis, judgement: Judgement, seed: int) -> list[dict[str, Any]]:
    """The block `next_measurements` of diagnosis.json, the best first.

    The gain of a row is the divergence of what the two most probable library explanations predict for it, in nats:
    half the square of their difference in units of its standard deviation (noise and both posteriors).
    """
    rivals = _rivals(analysis, judgement)
    if len(rivals) < 2:
        return []
    situation = _candidates(analysis, seed)
    first = _predicted(analysis, rivals[0], situation)
    best: Tensor | None = None
    names: list[list[str]] = []
    sigma2 = analysis.whitening.sigma.square()
    for other in rivals[1:]:
        second = _predicted(analysis, other, situation)
        gain = 0.5 * ((first[0] - second[0]).square() / (sigma2 + first[1] + second[1])).sum(-1)
        gain = torch.nan_to_num(gain, 0.0)
        names.append(sorted(_names(analysis, rivals[0]) ^ _names(analysis, other)))
        best = gain[None] if best is None else torch.cat([best, gain[None]])
    assert best is not None
    return _chosen(analysis, situation, best, names)


def _rivals(analysis: Analysis, judgement: Judgement) -> list[Found]:
    """The most probable sets with other library names, no catch-all among them."""
    atoms = analysis.library.atoms
    found: list[Found] = []
    for _, driver, _, one in judgement.leading:
        plain = driver is None and not any(atoms[i].catch_all for i in one.members)
        if plain and one.members and len(found) < _RIVALS:
            found.append(one)
    return found


def _names(analysis: Analysis, found: Found) -> set[str]:
    return {analysis.library.atoms[i].name for i in found.members}


def _candidates(analysis: Analysis, seed: int) -> Situation:
    """Poses of the workspace under conditions as they were measured, one drawn row's conditions for each pose."""
    here = analysis.situation
    generator = torch.Generator().manual_seed(seed)
    pose: Tensor | None = None
    if _common(here):
        pose = here.mechanism.sample_workspace(_CANDIDATES, generator)
        joints = here.mechanism.solve_inverse(pose, here.parameters)
    else:
        joints = here.mechanism.sample_joints(_CANDIDATES, generator)
    row = torch.randint(len(here.joints), (_CANDIDATES,), generator=generator)
    covariates = {n: v[row] for n, v in here.covariates.items()}
    if "time" in covariates:
        order = torch.argsort(covariates["time"])
        covariates = {n: v[order] for n, v in covariates.items()}
    parameters = here.parameters if _common(here) else None
    return Situation(here.mechanism, joints, covariates, here.gravity, parameters, pose)


def _common(situation: Situation) -> bool:
    return situation.parameters is not None and situation.parameters.dim() == 1


def _predicted(analysis: Analysis, found: Found, there: Situation) -> tuple[Tensor, Tensor]:
    """Mean and variance of the deviation at the candidates, `s x c` each."""
    columns = []
    for i in found.members:
        atom = analysis.library.atoms[i]
        assert atom.effect is not None
        full = signature(there, atom.effect, atom.shape) * scales(atom.effect.coefficients(there), there.joints)
        columns.append(full if atom.used is None else full[..., list(atom.used)])
    x = torch.cat(columns, -1)[:, analysis.whitening.channels]
    return x @ torch.cat(found.mean), ((x @ found.covariance) * x).sum(-1)


def _chosen(analysis: Analysis, situation: Situation, gain: Tensor, names: list[list[str]]) -> list[dict[str, Any]]:
    """The rows of most gain, each some way from those before; gain: `rivals x rows`."""
    mechanism = situation.mechanism
    where = situation.pose / (mechanism.high - mechanism.low)
    worth, rival = gain.max(0)
    found: list[dict[str, Any]] = []
    left = worth.clone()
    for _ in range(_WANTED):
        k = int(left.argmax())
        if not float(left[k]) > 0:
            break
        found.append(
            {
                "joints": {j.name: float(situation.joints[k, i]) for i, j in enumerate(mechanism.joints)},
                "covariates": {n: float(v[k]) for n, v in situation.covariates.items() if n != "time"},
                "separates": names[int(rival[k])],
                "gain": float(worth[k]),
            }
        )
        left = torch.where((where - where[k]).square().sum(-1).sqrt() < 0.15, 0.0, left)
        left[k] = 0.0
    return found
