"""Linear and quadratic discrepancy terms of the drives, the base and the platform.

The groups of `smooth` bend wherever they may, and the evidence charges them for all of it: where two effects of the
library come near a plain cause that it lacks, they are the cheaper ones. These here are as plain as effects are.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from ccnn_torch.diagnosis.candidates.atom import Atom
from ccnn_torch.diagnosis.discrepancy.smooth import (
    ANY,
    joint_moves,
    platform_moves,
    products,
    reduced,
    unit_range,
)
from ccnn_torch.effects import Situation
from ccnn_torch.evidence.priors import OUTSIDE

# What bends against what is straight.
_BEND = 0.5
_MOST = 60
# Of one form with an effect that is a candidate, it has to be better than that by as much again.
_TWIN = 2 * OUTSIDE


def linear_discrepancies(situation: Situation, beside: Sequence[str]) -> list[Atom]:
    """What acts through the drives, what is between base and measurement, and what the platform carries.

    Through the drives: each by its own track, or all by the place of all. Most are nearly of one form with an effect of
    the library; where that is a candidate it takes much to call the same something else.

    Args:
        situation: `s` rows.
        beside: names of the library effects that are candidates.
    """
    from_middle = situation.from_middle
    own = from_middle / from_middle.abs().amax(0).clamp_min(1e-300)
    place = unit_range(situation.joints)
    planes = torch.cat([torch.ones_like(place[:, :1]), place], -1)
    curves = torch.cat([planes, _BEND * products(place)], -1)
    still = torch.eye(3, dtype=place.dtype).expand(len(place), 3, 3)
    found = {
        "joint_gain": _driven(situation, f"joint {ANY}", torch.stack([own, _BEND * own.square()], -1)),
        "coupling": _driven(situation, "workspace", _by_all(planes, own)),
        "geometry": _driven(situation, "workspace", _by_all(curves, own)),
        "instrument": _carried(situation, still),
    }
    turned = situation.platform[1]
    if turned is not None and float((turned - turned[:1]).abs().max()) > 1e-6:
        found["tool"] = _carried(situation, turned)
    found = {twin: atom for twin, atom in found.items() if atom.columns.shape[-1]}
    return [replace(atom, log_prior=_TWIN) if twin in beside else atom for twin, atom in found.items()]


def _by_all(features: Tensor, joints: Tensor) -> Tensor:
    """The same features for every joint, `s x n x f`."""
    return features[:, None].expand(-1, joints.shape[-1], -1)


def _driven(situation: Situation, driver: str, features: Tensor) -> Atom:
    """Joints that are off by features of their own, `s x n x f`."""
    columns = reduced(joint_moves(situation, situation.jacobian), features, _MOST)
    return Atom(driver, None, features.new_zeros(0), columns, OUTSIDE, plain=True)


def _carried(situation: Situation, axes: Tensor) -> Atom:
    """Shifts along axes, `s x 3 x 3`, by a plane over the workspace, and turns about them."""
    lengths = [k for k, c in enumerate(situation.mechanism.pose) if c.unit == "m"]
    place = unit_range(situation.pose[:, lengths])
    features = torch.cat([torch.ones_like(place[:, :1]), place], -1)
    moves = platform_moves(situation)
    shifts = ((moves[..., :3] @ axes)[..., None] * features[:, None, None]).flatten(-2)
    turns = moves[..., 3:] @ axes if moves.shape[-1] == 6 else moves[..., :0]
    columns = torch.cat([shifts, turns], -1)
    shown = columns.abs().amax((0, 1)) > 1e-9 * columns.abs().max().clamp_min(1e-300)
    return Atom("workspace", None, place.new_zeros(0), columns[..., shown], OUTSIDE, plain=True)
