"""Next measurements: rows that best distinguish the leading explanations, or make the only one sharper."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any, NamedTuple

import torch
from torch import Tensor

from ccnn_torch.coordinates import torque_of
from ccnn_torch.diagnosis.candidates.atom import scaled_signature
from ccnn_torch.diagnosis.residual.rows import frame_columns, in_groups
from ccnn_torch.diagnosis.residual.whitening import device_axes
from ccnn_torch.diagnosis.search.analysis import Analysis
from ccnn_torch.diagnosis.verdict.judgement import Judgement
from ccnn_torch.effects import Situation
from ccnn_torch.effects.covariates import torques_elsewhere
from ccnn_torch.evidence.dictionary import FittedSet, covariance
from ccnn_torch.evidence.sets import scored
from ccnn_torch.mechanisms import Mechanism
from ccnn_torch.numerics.designs import Candidates
from ccnn_torch.records.commanded import SECOND

_CANDIDATES = 400
_WANTED = 8
_RIVALS = 3
# Explanations less probable than this share of the first, and rows that say less [nat], are not worth a measurement.
_RIVAL, _TELLING = 0.01, 0.01
# Candidates are left out where the joints move the platform so many times as far as usual: no first order holds there.
_GAIN = 3.0
# Columns that change together from row to row; all others are one kind more.
_KINDS = ("load", "direction")
# Rows farther apart in time are no motion [s].
_APART = 1.1


class _Question(NamedTuple):
    """What a row may answer.

    Between two explanations the coefficients are those of both, the second's with a minus in the columns.

    Attributes:
        candidates: the rows, for the coefficients, and how far the predictions differ between two explanations.
        weight: how much the answer is wanted.
        names: the names that it distinguishes.
    """

    candidates: Candidates
    weight: float
    names: list[str]

    @property
    def gain(self) -> Tensor:
        """What each candidate says, `s` [nat]."""
        there = self.candidates
        return 0.5 * (there.information() if there.difference is None else there.divergence())


def next_measurements(analysis: Analysis, judgement: Judgement, seed: int) -> list[dict[str, Any]]:
    """The block `next_measurements` of diagnosis.json, the best first.

    Between explanations the gain of a row is the divergence of what they predict for it, in nats: half the square of
    their difference in units of what noise and both posteriors leave open. Where one explanation has no rival, or none
    that a row tells from it, it is the information on its coefficients, half the log determinant (Bayesian
    D-optimality, Chaloner and Verdinelli 1995). Rows are chosen one after the other, each for what it adds to those
    before it; `gain` is that of the row alone.
    """
    rivals = _rivals(analysis, judgement)
    if not any(found.members for _, found in rivals):
        return []
    situation = _candidates(analysis, seed)
    first, x = rivals[0][1], _columns(analysis, rivals[0][1], situation)
    questions, own = [], covariance(analysis.dictionary, first)
    for weight, other in rivals[1:]:
        both = torch.cat([x, -_columns(analysis, other, situation)], -1)
        joint = torch.block_diag(own, covariance(analysis.dictionary, other))  # type: ignore[no-untyped-call]
        names = sorted(_names(analysis, first) ^ _names(analysis, other))
        mean = torch.cat([*first.mean, *other.mean])
        questions.append(_Question(Candidates.of(both, joint, mean), weight / rivals[1][0], names))
    wanted = _chosen(situation, questions) if questions else []
    if wanted or not first.members:
        return wanted
    # No row distinguishes them, so the numbers are made sharper.
    return _chosen(situation, [_Question(Candidates.of(x, own), 1.0, [])])


def _rivals(analysis: Analysis, judgement: Judgement) -> list[tuple[float, FittedSet]]:
    """The most probable sets with other library names, or none, no discrepancy term among them, and their
    probabilities.

    What cannot be distinguished from the verdict is among them, even where the search did not come across it.
    """
    atoms, own = analysis.atoms, judgement.found
    plain = [(e.probability, e.best) for e in judgement.leading if not e.drivers]
    if not plain:
        return []
    like = {
        tuple(sorted(j if m == i else m for m in own.members))
        for i in own.members
        for name in judgement.classes.get(atoms[i].name, ())
        for j, a in enumerate(atoms)
        if a.name == name and name not in {atoms[m].name for m in own.members if m != i}
    }
    known = [_names(analysis, one) for _, one in plain]
    for one in sorted(
        scored(analysis.dictionary, sorted(like), {f.members: f for f in analysis.found}),
        key=lambda f: -f.log_posterior,
    ):
        if _names(analysis, one) not in known:
            known.append(_names(analysis, one))
            plain.append((plain[0][0] * math.exp(min(one.log_posterior - own.log_posterior, 0.0)), one))
    plain.sort(key=lambda pair: -pair[0])
    return [pair for pair in plain[:_RIVALS] if pair[0] >= _RIVAL * plain[0][0]]


def _names(analysis: Analysis, found: FittedSet) -> set[str]:
    return {analysis.atoms[i].name for i in found.members}


def _candidates(analysis: Analysis, seed: int) -> Situation:
    """Poses of the workspace under conditions as they were measured, the machine at rest; of an arm or a simulator
    joints between the lowest and the highest measured.

    Loads, directions, and time with temperature are drawn apart, each as some row had them: what always came together
    so far comes apart.
    """
    here = analysis.situation
    mechanism, generator = here.mechanism, torch.Generator().manual_seed(seed)
    pose: Tensor | None = None
    # Of frames by group those of the first row: the next rows are measured in that group.
    parameters = here.parameters if here.parameters is None or here.parameters.dim() == 1 else here.parameters[0]
    if type(mechanism).sample_joints is not Mechanism.sample_joints:
        # Nothing tells what an arm may touch but where it has been; through its poses its joints would turn many times.
        low, high = here.joints.amin(0), here.joints.amax(0)
        joints = low + (high - low) * torch.rand(_CANDIDATES, len(low), generator=generator, dtype=low.dtype)
    elif parameters is not None:
        # A machine that is framed has its workspace where its frames are.
        pose = mechanism.with_nominal(parameters).sample_workspace(_CANDIDATES, generator)
        joints = mechanism.solve_inverse(pose, parameters)
    else:
        joints = mechanism.sample_joints(_CANDIDATES, generator)
    drawn = {k: torch.randint(len(here.joints), (len(joints),), generator=generator) for k in (*_KINDS, "")}
    covariates = {n: v[drawn[next((k for k in _KINDS if n.startswith(k)), "")]] for n, v in here.covariates.items()}
    if "time" in covariates:
        # In the order of time, and so far apart that no two rows are a motion.
        order = torch.argsort(covariates["time"])
        covariates = {n: v[order] for n, v in covariates.items()}
        covariates["time"] = covariates["time"] + _APART * torch.arange(len(joints))
    if len(here.places) > 1:
        pose = here.pose[drawn[""]]
    there = Situation(mechanism, joints, covariates, here.gravity, parameters, pose)
    # A torque at rest is no choice, but what the joints and the load make it.
    return replace(there, covariates=covariates | torques_elsewhere(here, there))


def _columns(analysis: Analysis, found: FittedSet, there: Situation) -> Tensor:
    """Deviation at the candidates per plausible size of each coefficient of a set, in units of the noise.

    What frames that are fitted to the rows take up in these is taken up at the candidates, too, and shows nothing.
    """
    white, frames = analysis.whitening, frame_columns(there, torch.ones(len(there.joints), dtype=torch.bool))
    columns = _signatures(analysis, found, there)
    if frames.shape[-1]:
        keep = white.keep()
        before = white(_signatures(analysis, found, analysis.situation))[keep].flatten(0, 1)
        taken = torch.linalg.pinv(white(analysis.fitted)[keep].flatten(0, 1)) @ before
        columns = columns - frames @ (in_groups(analysis.situation)[0] @ taken)
    noise = white.sigma * analysis.floor**0.5
    whitened: Tensor = replace(white, axes=device_axes(there)).picked(columns) / noise[:, None]
    return whitened


def _signatures(analysis: Analysis, found: FittedSet, situation: Situation) -> Tensor:
    """Deviation per plausible size of each coefficient of a set, `s x c0 x m` [m, rad]."""
    columns = [situation.jacobian[..., :0]]
    for i in found.members:
        atom = analysis.atoms[i]
        assert atom.effect is not None
        full = scaled_signature(situation, atom.effect, atom.shape)
        columns.append(full if atom.used is None else full[..., list(atom.used)])
    return torch.cat(columns, -1)


def _chosen(situation: Situation, questions: list[_Question]) -> list[dict[str, Any]]:
    """The rows that say most together, by what each says alone."""
    mechanism = situation.mechanism
    possible = _possible(situation)
    weights = torch.tensor([[q.weight] for q in questions], dtype=torch.float64)
    alone: Tensor | None = None
    taken: list[tuple[int, int]] = []
    for _ in range(_WANTED):
        gains = torch.stack([q.gain for q in questions])
        alone = gains if alone is None else alone
        worth = torch.where(possible & (gains >= _TELLING), torch.nan_to_num(gains * weights), 0.0)
        best = int(worth.max(0).values.argmax())
        if not float(worth[:, best].max()) > 0:
            break
        taken.append((best, int(worth[:, best].argmax())))
        possible = possible.clone()
        possible[best] = False
        for question in questions:
            question.candidates.change(best, 1)
    assert alone is not None
    left = {"time", *map(torque_of, mechanism.joints)}
    taken.sort(key=lambda pair: -float(alone[pair[1], pair[0]]))
    return [
        {
            "joints": {
                f"{j.name}{ending}": float(place.joints[k, i])
                for ending, place in zip(("", SECOND), situation.places, strict=False)
                for i, j in enumerate(mechanism.joints)
            },
            "covariates": {n: float(v[k]) for n, v in situation.covariates.items() if n not in left},
            "separates": questions[number].names,
            "gain": float(alone[number, k]),
        }
        for k, number in taken
    ]


def _possible(situation: Situation) -> Tensor:
    """Candidates that the machine reaches and where first order holds, `s`."""
    whole = torch.isfinite(situation.jacobian).flatten(1).all(-1) & torch.isfinite(situation.joints).all(-1)
    reach = torch.linalg.matrix_norm(torch.nan_to_num(situation.jacobian), ord=2)
    possible: Tensor = whole & (reach < _GAIN * reach[whole].median())
    return possible
