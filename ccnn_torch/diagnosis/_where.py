"""Where the gap lies: shares of its energy, less the noise's, by output, joint, leg, region and covariate."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from ccnn_torch.diagnosis._analysis import Analysis

__all__ = ["where"]

_AXES = ("x", "y", "z", "rx", "ry", "rz")


def where(analysis: Analysis, residual: Tensor) -> dict[str, Any]:
    """The block `where` of diagnosis.json; residual: nominal, `s x c0` [m, rad]. Every list of shares sums to 1."""
    white, situation = analysis.whitening, analysis.situation
    keep = white.keep()
    y = (residual[:, white.channels] / white.sigma)[keep]
    energy = (y.square() - analysis.floor).sum(-1)
    outputs = dict(zip((_AXES[int(c)] for c in white.channels), (y.square() - analysis.floor).sum(0), strict=True))
    joints = _joints(analysis, y, keep)
    names = [j.name for j in situation.mechanism.joints]
    legs = {str(g.leg) for g in situation.mechanism.geometry if g.leg is not None}
    return {
        "outputs": _shares(outputs),
        "joints": _shares(dict(zip(names, joints, strict=True))),
        "legs": _shares({f"leg {i + 1}": e for i, e in enumerate(joints)}) if legs else {},
        "regions": _regions(analysis, energy, keep),
        "covariates": {
            name: _bins(value[keep], energy)
            for name, value in situation.covariates.items()
            if float(value.max() - value.min()) > 0
        },
    }


def _joints(analysis: Analysis, y: Tensor, keep: Tensor) -> Tensor:
    """Energy of the joint deviations that make the residual, each by what it alone moves, `n`."""
    white = analysis.whitening
    jacobian = (analysis.situation.jacobian[:, white.channels] / white.sigma[:, None])[keep]
    inverse = torch.linalg.pinv(jacobian)
    deviation = (inverse @ y[..., None])[..., 0]
    noise = analysis.floor * inverse.square().sum(-1)
    return ((deviation.square() - noise) * jacobian.square().sum(-2)).sum(0)


def _shares(parts: dict[str, Tensor]) -> dict[str, float]:
    values = {k: max(float(v), 0.0) for k, v in parts.items()}
    total = sum(values.values())
    return {k: v / total if total > 0 else 1 / len(values) for k, v in values.items()}


def _regions(analysis: Analysis, energy: Tensor, keep: Tensor) -> list[dict[str, Any]]:
    """Boxes of the workspace: the two position coordinates that vary most, each cut at its median."""
    coordinates = analysis.situation.mechanism.pose
    lengths = [i for i, c in enumerate(coordinates) if c.unit == "m"] or list(range(len(coordinates)))
    pose = analysis.situation.pose[keep]
    varying = sorted(lengths, key=lambda i: -float(pose[:, i].std()))[:2]
    cell = sum((pose[:, i] > pose[:, i].median()).long() * 2**k for k, i in enumerate(varying))
    found, total = [], 0.0
    for k in range(2 ** len(varying)):
        inside = cell == k
        if not bool(torch.as_tensor(inside).any()):
            continue
        low, high = pose[inside].amin(0), pose[inside].amax(0)
        share = max(float(energy[inside].sum()), 0.0)
        total += share
        found.append(
            {
                "center": {coordinates[i].name: float((low + high)[i] / 2) for i in lengths},
                "half_width": {coordinates[i].name: float((high - low)[i] / 2) for i in lengths},
                "share": share,
                "rows": int(torch.as_tensor(inside).sum()),
            }
        )
    for region in found:
        region["share"] = region["share"] / total if total > 0 else 1 / len(found)
    return found


def _bins(value: Tensor, energy: Tensor) -> list[dict[str, float]]:
    """Thirds of a covariate, or its values where it has no more than three."""
    levels = torch.unique(value)
    if len(levels) <= 3:
        edges = [(float(v), float(v)) for v in levels]
    else:
        cuts = torch.quantile(value, torch.tensor([0, 1 / 3, 2 / 3, 1], dtype=value.dtype)).tolist()
        edges = list(zip(cuts[:-1], cuts[1:], strict=True))
    sums = []
    for k, (low, high) in enumerate(edges):
        inside = (value >= low) & ((value <= high) if k == len(edges) - 1 or low == high else (value < high))
        sums.append(max(float(energy[inside].sum()), 0.0))
    total = sum(sums)
    return [
        {"from": low, "to": high, "share": s / total if total > 0 else 1 / len(edges)}
        for (low, high), s in zip(edges, sums, strict=True)
    ]
