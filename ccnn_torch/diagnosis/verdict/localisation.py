"""Where the gap is: shares of its energy, less the noise's, by output, joint, leg, region and covariate."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Any, NamedTuple

import torch
from torch import Tensor

from ccnn_torch.diagnosis.search.analysis import Analysis
from ccnn_torch.effects import Situation
from ccnn_torch.evidence.shrink import INTERVAL, draws
from ccnn_torch.mechanisms import SerialArm

# Rows from which on each of two coordinates is cut in three and not in two.
_MANY = 300


class _Parts(NamedTuple):
    """Squares of every row in each part, and those that noise of variance 1 makes there on average, `s x k` each."""

    squares: Tensor
    noise: Tensor


class _Shares(NamedTuple):
    """Share of each part, `k`, and its 95 % interval, `k x 2`; shares sum to 1."""

    plain: list[float]
    interval: list[list[float]]


class _Drawn:
    """Rows drawn with replacement, and the noise within what is known of it."""

    def __init__(self, analysis: Analysis, seed: int) -> None:
        drawn = draws(len(analysis.whitening.keep()), seed)
        self.counts = drawn.counts
        values, effective = analysis.dictionary.grams.values, analysis.found[0].effective
        exact = analysis.whitening.known > 0 or analysis.instrument is not None
        spread = 0.0 if exact else math.sqrt(2 / max(values - effective, 1.0))
        self.floor = analysis.floor
        self.floors = (analysis.floor * (1 + spread * drawn.normal[:, None])).clamp_min(0.0)

    def shares(self, parts: _Parts) -> _Shares:
        """Of the energy above the noise."""
        plain = _normalised(parts.squares.sum(0) - self.floor * parts.noise.sum(0))
        drawn = _normalised(self.counts @ parts.squares - self.floors * (self.counts @ parts.noise))
        low, high = torch.quantile(drawn, torch.tensor(INTERVAL, dtype=drawn.dtype), 0)
        return _Shares(plain.tolist(), torch.stack([low.minimum(plain), high.maximum(plain)], -1).tolist())


def localise(analysis: Analysis, residual: Tensor, seed: int = 0) -> tuple[dict[str, Any], dict[str, Any]]:
    """The blocks `where` and `where_ci95` of diagnosis.json: shares, each list of which sums to 1, and intervals.

    Args:
        analysis: of the rows.
        residual: nominal, `s x c0` [m, rad].
        seed: of the draws.
    """
    white, situation = analysis.whitening, analysis.situation
    keep = white.keep()
    y = (white.picked(residual) / white.sigma)[keep]
    rows = _Parts(y.square().sum(-1, keepdim=True), torch.full_like(y[:, :1], y.shape[-1]))
    drawn = _Drawn(analysis, seed)
    outputs = drawn.shares(_Parts(y.square(), torch.ones_like(y)))
    joints = drawn.shares(_joints(analysis, y, keep))
    axes, names = white.names, [j.name for j in situation.mechanism.joints]
    legged = any(g.leg is not None for g in situation.mechanism.geometry)
    legs = [f"leg {i + 1}" for i in range(len(names))] if legged else []
    places, inside = _regions(analysis, keep)
    regions = drawn.shares(_split(rows, inside))
    edges = {
        name: _bins(value[keep]) for name, value in situation.covariates.items() if float(value.max() - value.min()) > 0
    }
    covariates = {name: drawn.shares(_split(rows, member)) for name, (_, member) in edges.items()}
    parts = {"outputs": (axes, outputs), "joints": (names, joints), "legs": (legs, joints)}
    # A machine without legs has no names for them.
    block: dict[str, Any] = {g: dict(zip(n, own.plain, strict=False)) for g, (n, own) in parts.items()}
    intervals: dict[str, Any] = {g: dict(zip(n, own.interval, strict=False)) for g, (n, own) in parts.items()}
    block["regions"] = [
        {**place, "share": share, "rows": int(n)}
        for place, share, n in zip(places, regions.plain, inside.sum(0), strict=True)
    ]
    block["covariates"] = {
        name: [
            {"from": low, "to": high, "share": share, "rows": int(n)}
            for (low, high), share, n in zip(edges[name][0], own.plain, edges[name][1].sum(0), strict=True)
        ]
        for name, own in covariates.items()
    }
    intervals |= {"regions": regions.interval, "covariates": {n: own.interval for n, own in covariates.items()}}
    return block, intervals


def _normalised(energy: Tensor) -> Tensor:
    """`... x k` to shares; alike where there is no energy."""
    energy = energy.clamp_min(0.0)
    total = energy.sum(-1, keepdim=True)
    return torch.where(total > 0, energy / total.clamp_min(1e-300), 1 / energy.shape[-1])


def _joints(analysis: Analysis, y: Tensor, keep: Tensor) -> _Parts:
    """Squares of the joint deviations that make the residual, each by what it alone moves, `s x n`."""
    white = analysis.whitening
    jacobian = (white.picked(analysis.situation.jacobian) / white.sigma[:, None])[keep]
    inverse = torch.linalg.pinv(jacobian)
    reach = jacobian.square().sum(-2)
    return _Parts((inverse @ y[..., None])[..., 0].square() * reach, inverse.square().sum(-1) * reach)


def _split(rows: _Parts, member: Tensor) -> _Parts:
    """The rows' squares by the part that each is in; member: `s x k`, bool."""
    return _Parts(rows.squares * member, rows.noise * member)


def _regions(analysis: Analysis, keep: Tensor) -> tuple[list[dict[str, Any]], Tensor]:
    """Boxes of the workspace and which rows are in them, `s x k`: the two lengths that vary most, cut at quantiles.

    In the robot's frame: that of an arm's base, wherever the measuring device stands.
    """
    situation = analysis.situation
    coordinates = situation.mechanism.pose
    lengths = [i for i, c in enumerate(coordinates) if c.unit == "m"] or list(range(len(coordinates)))
    pose = own_pose(situation)[keep]
    varying = sorted(lengths, key=lambda i: -float(pose[:, i].std()))[:2]
    cuts = 3 if len(keep) >= _MANY and len(varying) == 2 else 2
    cell = torch.zeros(len(keep), dtype=torch.int64)
    for k, i in enumerate(varying):
        edges = torch.quantile(pose[:, i], torch.arange(1, cuts, dtype=pose.dtype) / cuts)
        cell += cuts**k * torch.bucketize(pose[:, i].contiguous(), edges)
    inside = cell[:, None] == torch.unique(cell)
    alone = inside[..., None]
    low = torch.where(alone, pose[:, None], math.inf).amin(0)[:, lengths]
    high = torch.where(alone, pose[:, None], -math.inf).amax(0)[:, lengths]
    names = [coordinates[i].name for i in lengths]
    places = [
        {"center": dict(zip(names, centre, strict=True)), "half_width": dict(zip(names, half, strict=True))}
        for centre, half in zip(((low + high) / 2).tolist(), ((high - low) / 2).tolist(), strict=True)
    ]
    return places, inside


def _bins(value: Tensor) -> tuple[list[tuple[float, float]], Tensor]:
    """Thirds of a covariate, or its values where it has no more than three, and which rows are in them, `s x k`."""
    levels = torch.unique(value)
    if len(levels) <= 3:
        return [(float(v), float(v)) for v in levels], value[:, None] == levels
    cuts = torch.quantile(value, torch.tensor([0, 1 / 3, 2 / 3, 1], dtype=value.dtype))
    part = torch.bucketize(value.contiguous(), cuts[1:-1].contiguous(), right=True)
    edges = list(pairwise(cuts.tolist()))
    return edges, part[:, None] == torch.arange(len(edges))


def own_pose(situation: Situation) -> Tensor:
    """Poses in the robot's frame: of an arm the position in its own base, `s x 3` [m], else as measured, `s x p`."""
    pose, arm = situation.pose, situation.mechanism
    if not isinstance(arm, SerialArm):
        return pose
    return arm.in_own_base(pose[:, :3], pose[:, None, :3], situation.parameters)[0]
