"""The promise of a model for new rows, from the rows held out when it was made."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ccnn_torch.compensation import LoadedModel
from ccnn_torch.coordinates import Coordinate
from ccnn_torch.mechanisms import PoseError
from ccnn_torch.numerics.outliers import inlying
from ccnn_torch.report.json_files import read_json
from ccnn_torch.report.results.verify import Middle, Promised, Repeated

# Rows whose commanded joints round to the same cell are one configuration, measured several times [SI].
_CELL = {"m": 1e-4, "rad": 1e-3}
# Squared length of independent normal errors in three directions: variance over squared mean.
_LEAST_SPREAD = 2 / 3
_SHARE = 0.95
# Readings of a target from which its spread is told.
_CYCLES = 3


def repeated(place: Tensor, before: Tensor, after: Tensor, groups: Tensor) -> Repeated | None:
    """Pose accuracy AP and repeatability RP of the position (ISO 9283:1998, 7.2.1 and 7.2.2).

    Args:
        place: measured positions, `s x 3` [m].
        before, after: from where a position should be to where it is, `s x 3` [m].
        groups: number of each row's target, `s`.

    Returns:
        Figures over the targets that were reached three times or more; None where none was.
    """
    known = ~(place.isnan() | before.isnan() | after.isnan()).any(-1)
    place, before, after, groups = place[known], before[known], after[known], groups[known]
    chosen = [groups == k for k in torch.nonzero(torch.bincount(groups) >= _CYCLES).squeeze(-1).tolist()]
    if not chosen:
        return None
    away = [(place[mine] - place[mine].mean(0)).norm(dim=-1) for mine in chosen]
    spread = [float(a.mean() + 3 * a.std()) for a in away]
    accuracy, left = ([float(gap[mine].mean(0).norm()) for mine in chosen] for gap in (before, after))
    ap, ap_after, rp = (Middle(median=float(np.median(v)), max=max(v)) for v in (accuracy, left, spread))
    cycles = min(len(a) for a in away)
    return Repeated(targets=len(chosen), cycles=cycles, accuracy=ap, accuracy_after=ap_after, repeatability=rp)


def configurations(joints: Tensor, coordinates: Sequence[Coordinate]) -> Tensor:
    """Number of each row's configuration, `s`, from 0: rows at the same commanded joints `s x n` [SI] are one."""
    cells = torch.tensor([_CELL[c.unit] for c in coordinates], dtype=joints.dtype)
    found = np.unique(torch.round(joints / cells).numpy(), axis=0, return_inverse=True)[1]
    return torch.from_numpy(found.reshape(-1))


def promise_block(before: PoseError, after: PoseError, groups: Tensor) -> dict[str, Any] | None:
    """The entry `metrics`, `promise` of a model's card; None with fewer than two configurations.

    Rows that are far off among the others with the model and without it are mistyped or mismeasured: they are no part.

    Args:
        before, after: pose error of the held-out rows, `s`; NaN where it was not measured.
        groups: configuration of each row, `s`, numbered from 0 without a gap.

    Returns:
        `rows`, `configurations`, and `position` and `rotation` (None without), each `unit`, `before`, `rms` and
        `spread`: variance over squared mean of the squared error [1] of a configuration.
    """
    lengths = torch.stack([before.position, after.position])
    known = torch.isfinite(lengths)
    near = (inlying(lengths.nan_to_num(), known, 3, 0) | ~known).any(0)
    before, after = (
        PoseError(e.position[near], None if e.rotation is None else e.rotation[near]) for e in (before, after)
    )
    groups = torch.unique(groups[near], return_inverse=True)[1]
    count = int(groups.max()) + 1 if len(groups) else 0
    if count < 2:
        return None

    def part(unit: str, first: Tensor | None, last: Tensor | None) -> dict[str, Any] | None:
        if first is None or last is None:
            return None
        square, there = last[~last.isnan()].square(), groups[~last.isnan()]
        if len(torch.unique(there)) < 2:
            return None
        return {
            "unit": unit,
            "before": float(first.square().nanmean().sqrt()),
            "rms": float(square.mean().sqrt()),
            "spread": max(_spread(square, torch.unique(there, return_inverse=True)[1]), _LEAST_SPREAD),
        }

    return {
        "rows": len(groups),
        "configurations": count,
        "position": part("m", before.position, after.position),
        "rotation": part("rad", before.rotation, after.rotation),
    }


def of_whole(error: PoseError, pose: Tensor, coordinates: Sequence[Coordinate]) -> PoseError:
    """Pose errors `s` that can be promised: NaN in rows that lack a length or an angle of theirs (NaN in `s x p`)."""
    lacking = (
        pose[:, [k for k, c in enumerate(coordinates) if c.unit == unit]].isnan().any(-1) for unit in ("m", "rad")
    )
    first, last = (None if e is None else torch.where(gap, torch.nan, e) for e, gap in zip(error, lacking, strict=True))
    assert first is not None
    return PoseError(first, last)


def promised(promise: Mapping[str, Any], kind: str, count: int) -> Promised | None:
    """RMS that new rows should have, and the limits that it passes once in twenty on either side; None = no promise.

    The mean of squared errors over C configurations is taken as a scaled chi-square with 2 C / spread degrees of
    freedom (Satterthwaite 1946), that of the held-out rows as well, so that their ratio is an F variate. It holds for
    rows that are drawn as the held-out ones were. Rows at one configuration count once; errors of neighbouring
    configurations are alike, too, which is not counted: with rows in one small part of the workspace the limits are
    too narrow.

    Args:
        promise: as `promise_block` gives it.
        kind: `position` or `rotation`.
        count: configurations among the new rows.
    """
    block = promise.get(kind)
    if block is None:
        return None
    # Imported here: few commands need it.
    from scipy.stats import f

    freedom = [2 * n / block["spread"] for n in (count, promise["configurations"])]
    low, high = (block["rms"] * math.sqrt(float(f.ppf(share, *freedom))) for share in (1 - _SHARE, _SHARE))
    return Promised(rms=block["rms"], low=low, high=high)


def paired_gain(before: Tensor, after: Tensor, groups: Tensor) -> bool:
    """Whether squared errors fell: a paired t test over configurations, one-sided at 95 %; `s` each."""
    from scipy.stats import t

    known = ~after.isnan()
    before, after, groups = before[known], after[known], torch.unique(groups[known], return_inverse=True)[1]
    gain = before.square() - after.square()
    count = int(groups.max()) + 1
    mean = float(gain.mean())
    if count < 2 or mean <= 0:
        return False
    return mean > float(t.ppf(_SHARE, count - 1)) * mean * math.sqrt(_spread(gain, groups) / count)


def _spread(values: Tensor, groups: Tensor) -> float:
    """Variance of the mean of `s` rows in groups, over its square, times the number of groups [1]."""
    count, mean = int(groups.max()) + 1, values.mean()
    if mean == 0:
        return 0.0
    sums = torch.zeros(count, dtype=values.dtype).index_add_(0, groups, values - mean)
    variance = sums.square().sum() / len(values) ** 2 * count / (count - 1)
    return float(count * variance / mean**2)


def promise_of(model: LoadedModel) -> dict[str, Any] | None:
    """The card's promise, that of a diagnosis.json, or that of the identified.json beside an identified.yaml, which no
    signature covers."""
    if model.machine is None:
        metrics = model.card.get("metrics")
        found = metrics.get("promise") if isinstance(metrics, dict) else None
        return found if isinstance(found, dict) else None
    path = Path(model.path)
    if len(model.machine.joints):
        found = read_json(path).get("promise")
        return found if isinstance(found, dict) else None
    path = path.with_name("identified.json")
    if model.signed or not path.is_file():
        return None
    results = read_json(path)
    promise, parameters = results.get("promise"), results.get("parameters")
    if not isinstance(promise, dict) or not isinstance(parameters, dict):
        return None
    own = model.machine.identified.describe()["parameters"]
    same = all(math.isclose(own.get(name, math.nan), block["value"]) for name, block in parameters.items())
    return promise if same else None
