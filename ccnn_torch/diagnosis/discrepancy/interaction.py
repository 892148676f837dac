"""Discrepancy terms that two drivers make together: neither alone moves a joint so, their product does."""

from __future__ import annotations

import math
from itertools import combinations

import torch
from torch import Tensor

from ccnn_torch.diagnosis.candidates.atom import Atom
from ccnn_torch.diagnosis.candidates.nuisance import NuisanceFit, SharedColumns, TrialColumns, search_charge
from ccnn_torch.diagnosis.discrepancy.smooth import driver_of, unit_range
from ccnn_torch.effects import Situation
from ccnn_torch.evidence.priors import OUTSIDE

CROSS = " × "
"""Between the two drivers in the name of such a term."""


def interaction_discrepancies(
    situation: Situation, moved: Tensor, whitened: Tensor, few: Tensor, plain: NuisanceFit, loose: float
) -> list[Atom]:
    """The pair of drivers whose product explains most in one joint, beside both of them alone; its search charged.

    One term is of that joint alone, one of all joints.

    Args:
        situation: `s` rows.
        moved: what each joint's plausible deviation does to the pose, `s x c0 x n` [m, rad].
        whitened: the same, `s x c x n`.
        few: rows evaluated, `t`.
        plain: what is to be explained there.
        loose: size of what else is there, in plausible sizes.
    """
    scores, pairs = [], list[tuple[str, str]]()
    for k in range(moved.shape[-1]):
        drivers = _drivers(situation, k)
        pairs = list(combinations(drivers, 2))
        if not pairs:
            return []
        lead = whitened[few][..., k : k + 1]
        alone = torch.stack([torch.ones(len(few), dtype=lead.dtype), *(v[few] for v in drivers.values())], -1)
        left = plain.beside(loose * lead * alone[:, None])
        both = torch.stack([drivers[a][few] * drivers[b][few] for a, b in pairs])
        scores.append(left.gain(TrialColumns(both[..., None, None], SharedColumns(lead))))
    score = torch.stack(scores)
    k, pair = divmod(int(score.argmax()), len(pairs))
    drivers = _drivers(situation, k)
    first, second = (drivers[name] for name in pairs[pair])
    charge = search_charge(len(moved) / len(few) * score.flatten())
    features = torch.stack([first * second, first, second], -1)
    name = CROSS.join(pairs[pair])
    own = moved[..., k : k + 1] * features[:, None]
    every = (moved[..., None] * features[:, None, None]).flatten(-2)
    log_prior = OUTSIDE - charge
    joint = situation.mechanism.joints[k].name
    return [
        Atom(name, None, score.new_zeros(0), own, log_prior, note=f"their product moves joint {joint}"),
        Atom(name, None, score.new_zeros(0), every, log_prior + math.log(moved.shape[-1])),
    ]


def _drivers(situation: Situation, joint: int) -> dict[str, Tensor]:
    """What may drive a joint together with something else, `s` each in [-1, 1]; loads by their torque on it."""
    tracks = unit_range(situation.joints)
    found = {f"joint {j.name}": tracks[:, i] for i, j in enumerate(situation.mechanism.joints)}
    for name, value in situation.covariates.items():
        driver = driver_of(name)
        if driver is not None and not driver.startswith(("load", "speed")) and bool((value != value[0]).any()):
            found[driver] = unit_range(value[:, None])[:, 0]
    for name in (name for name in situation.covariates if name.startswith("load_")):
        # 0 where the load does not act on this joint: every joint has the same drivers.
        torque = situation.with_covariates({name: situation.covariates[name]}).load_torque[:, joint]
        found[driver_of(name) or name] = torque / torque.abs().amax().clamp_min(1e-300)
    return found
