"""Figures of `results.json`: error measures per joint, noise floor, pose error, each with its spread over repeats.

Every number is in SI (m, rad and their squares). A value that is not finite is written as null and left out of the
median and the quantiles of its spread, so that a reader sees which repeat failed.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from ccnn_torch.calibration.dataset import Dataset
from ccnn_torch.compensation import Domain
from ccnn_torch.coordinates import Coordinate
from ccnn_torch.errors import InputError
from ccnn_torch.report.results.base import Length, Spread
from ccnn_torch.report.results.run import Before, Energy, Errors, Floor, Mse, Pose, PoseFigures, Reach, Reached, RmsMax

Error = tuple[ArrayLike, ArrayLike | None]


def spread(values: ArrayLike) -> Spread:
    """Median, 5 % and 95 % quantile over repeats, and the values themselves.

    Args:
        values: `r`, one value a repeat; not finite means that the repeat has no such value.
    """
    array = _array(values).reshape(-1)
    finite = array[np.isfinite(array)]
    low, median, high = (
        (float(q) for q in np.quantile(finite, [0.05, 0.5, 0.95])) if finite.size else (None, None, None)
    )
    return Spread(median=median, low=low, high=high, values=[float(v) if np.isfinite(v) else None for v in array])


def share_unit(joints: Sequence[Coordinate]) -> bool:
    """Whether all joints share a unit, so that an error over all of them means something."""
    return len({joint.unit for joint in joints}) == 1


def joint_errors(
    predicted: ArrayLike, measured: ArrayLike, weights: ArrayLike | None, joints: Sequence[Coordinate]
) -> dict[str, Errors]:
    """Mean squared, mean absolute and summed squared error, as in Tables II and IV of the paper.

    A joint's mse and mae are means over the rows and its sse the sum. `all` holds the mean over rows and joints (mse,
    mae) and the sum over both (sse): the paper's columns "All joints" are exactly that. `all` is left out when the
    joints have different units.

    Args:
        predicted: deviations by the model, `r x s x n` [the joint's SI unit].
        measured: deviations by measurement, the same shape; what has no leading `r` serves all repeats.
        weights: row weights, `r x s` [1]; rows of weight 0 are ignored (padding). None = every row counts once.

    Returns:
        By joint, and `all`.
    """
    error, weight = _rows(_array(predicted) - _array(measured), weights, joints)
    total = weight.sum(1)
    square = (np.square(error) * weight[..., None]).sum(1)
    absolute = (np.abs(error) * weight[..., None]).sum(1)

    def measures(squares: NDArray[np.float64], absolutes: NDArray[np.float64], count: NDArray[np.float64]) -> Errors:
        return Errors(mse=spread(squares / count), mae=spread(absolutes / count), sse=spread(squares))

    errors = {"all": measures(square.sum(1), absolute.sum(1), total * len(joints))} if share_unit(joints) else {}
    return errors | {joint.name: measures(square[:, i], absolute[:, i], total) for i, joint in enumerate(joints)}


def constant_errors(
    train: ArrayLike,
    test: ArrayLike,
    train_weights: ArrayLike | None,
    test_weights: ArrayLike | None,
    joints: Sequence[Coordinate],
) -> dict[str, Errors]:
    """Errors on the test rows of the constant predictor: the mean deviation of each joint over the training rows.

    Args:
        train, test: measured deviations, `r x s x n` and `r x s' x n` [the joint's SI unit].
        train_weights, test_weights: `r x s`, `r x s'` [1], or None.
    """
    values, weight = _rows(_array(train), train_weights, joints)
    mean = (values * weight[..., None]).sum(1, keepdims=True) / weight.sum(1)[:, None, None]
    return joint_errors(mean, test, test_weights, joints)


def before_block(deviations: ArrayLike, weights: ArrayLike | None, joints: Sequence[Coordinate]) -> dict[str, Before]:
    """Mean and maximum of each joint's error before calibration (Tables I and III of the paper).

    Both are of the *signed* error: the paper's ρ3 has mean -9.36e-5 and maximum -6.68e-5, which only the algebraically
    largest error can be. `max_abs` is the largest by absolute value, which is what a user fears.

    Args:
        deviations: pseudoerrors, `r x s x n` [the joint's SI unit].
        weights: `r x s` [1] or None.
    """
    values, weight = _rows(_array(deviations), weights, joints)
    there = weight[..., None] > 0
    found = {
        "mean": (values * weight[..., None]).sum(1) / weight.sum(1)[:, None],
        "max": np.where(there, values, -np.inf).max(1),
        "max_abs": np.where(there, np.abs(values), -np.inf).max(1),
    }
    spreads = {joint.name: {name: spread(v[:, i]) for name, v in found.items()} for i, joint in enumerate(joints)}
    return {
        joint: Before(**{name: s.median for name, s in each.items()}, spread=each) for joint, each in spreads.items()
    }


def floor_block(
    noise: ArrayLike,
    weights: ArrayLike | None,
    joints: Sequence[Coordinate],
    variance: ArrayLike,
    unlearnable: ArrayLike | None = None,
) -> Floor:
    """The error that no model can go below: the noise actually drawn in the test rows, and what is expected of it.

    Args:
        noise: noise in the test rows, `r x s x n` [the joint's SI unit].
        weights: `r x s` [1] or None.
        variance: variance of the noise, `n` [the square of it].
        unlearnable: the part of the signal that the inputs do not determine, like `noise` (the chirp of eq. 19), or
            None. It counts as signal in `realised` and as noise in `with_unlearnable`.
    """
    drawn = _array(noise)
    repeats = drawn.shape[0] if drawn.ndim == 3 else 1
    expected = np.broadcast_to(np.sqrt(_array(variance)), (repeats, 1, len(joints)))

    def only_mse(error: NDArray[np.float64], weight: ArrayLike | None) -> dict[str, Mse]:
        errors = joint_errors(error, np.zeros_like(error), weight, joints)
        return {name: Mse(mse=measures.mse) for name, measures in errors.items()}

    return Floor(
        realised=only_mse(drawn, weights),
        expected=only_mse(expected, None),
        with_unlearnable=None if unlearnable is None else only_mse(drawn + _array(unlearnable), weights),
    )


def ratio(above: Spread, below: Spread) -> Spread:
    """Ratio of two figures, repeat by repeat."""
    top, bottom = (np.array(s.values, dtype=float) for s in (above, below))
    return spread(np.divide(top, bottom, out=np.full_like(top, np.nan), where=bottom > 0))


def ratio_to_floor(errors: Mapping[str, Mse], floor: Floor | None) -> Spread | None:
    """Ratio of the `all` mse to the realised floor, repeat by repeat.

    Returns:
        A spread; None where one of the two is unknown or has no `all`.
    """
    if floor is None or "all" not in errors or "all" not in floor.realised:
        return None
    return ratio(errors["all"].mse, floor.realised["all"].mse)


def pose_block(
    before: Error,
    after: Error,
    weights: ArrayLike | None = None,
    rotation_weight: float | None = None,
    **beside: Error | None,
) -> Pose:
    """Root mean square and maximum of the pose error over the held-out rows, before and after.

    Args:
        before, after: Euclidean position errors, `r x s` [m] (eq. 6), and geodesic angles, `r x s` [rad], or None where
            there is no orientation.
        weights: `r x s` [1], or None.
        rotation_weight: η of eq. 5 [m/rad]; adds `energy`, E = position error + η · rotation error, row by row [m].
        beside: what else is reported with `before` and `after`, under its name; None is left out.
    """
    errors = {"before": before, "after": after} | {name: error for name, error in beside.items() if error is not None}

    def figures(unit: Length, values: Mapping[str, ArrayLike | None]) -> dict[str, Any]:
        return {"unit": unit} | {k: _rms_and_max(_array(v), weights) for k, v in values.items() if v is not None}

    position = PoseFigures(**figures("m", {name: error[0] for name, error in errors.items()}))
    if before[1] is None or after[1] is None:
        return Pose(position=position, rotation=None)
    rotation = PoseFigures(**figures("rad", {name: error[1] for name, error in errors.items()}))
    if rotation_weight is None:
        return Pose(position=position, rotation=rotation)
    first, last = (_array(p) + rotation_weight * _array(r) for p, r in ((before[0], before[1]), (after[0], after[1])))
    if bool(np.isnan(first).all(1).any()):
        # No row shows lengths and angles alike.
        return Pose(position=position, rotation=rotation)
    energy = Energy(**figures("m", {"before": first, "after": last}), rotation_weight=rotation_weight)
    return Pose(position=position, rotation=rotation, energy=energy)


def _rms_and_max(errors: NDArray[np.float64], weights: ArrayLike | None) -> RmsMax:
    # Rows of which nothing of the kind was measured do not count.
    known = ~np.isnan(errors)
    weights = known * (1.0 if weights is None else _array(weights))
    values, weight = _rows(np.nan_to_num(errors)[..., None], weights, (Coordinate("error", "1"),))
    values = values[..., 0]
    rms = np.sqrt((np.square(values) * weight).sum(1) / weight.sum(1))
    return RmsMax(rms=spread(rms), max=spread(np.where(weight > 0, values, -np.inf).max(1)))


def _rows(
    values: NDArray[np.float64], weights: ArrayLike | None, joints: Sequence[Coordinate]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Values `r x s x n` and weights `r x s`, checked; values of rows of weight 0 become 0."""
    if values.ndim == 2:
        values = values[None]
    if values.ndim != 3 or values.shape[-1] != len(joints):
        raise InputError(f"Errors must be repeats x rows x {len(joints)} joints, not of shape {values.shape}.")
    weight = np.ones(values.shape[:2]) if weights is None else _array(weights)
    if weight.shape[-1:] != values.shape[1:2]:
        raise InputError(f"{weight.shape[-1]} row weights do not fit {values.shape[1]} rows.")
    weight = np.broadcast_to(weight, values.shape[:2])
    if not (weight.sum(1) > 0).all():
        raise InputError("A repeat has no row to measure the error on; give it at least one test row.")
    return np.where(weight[..., None] > 0, values, 0.0), weight


def _array(values: ArrayLike) -> NDArray[np.float64]:
    """A float64 array from a list, an array or a tensor on any device."""
    if isinstance(values, torch.Tensor):
        values = values.detach().cpu().numpy()
    return np.asarray(values, dtype=np.float64)


CURVE = "heldout_mse_all"
"""The metric that methods are compared by: held-out mean squared error over all joints [SI²]."""
_BASELINE = "constant"


def reach_block(histories: Mapping[str, Mapping[str, ArrayLike]]) -> Reach | None:
    """Seconds and evaluations until the median curve is at or below the level that every trained method reaches.

    The level is the lowest point of the median curve (over the repeats) of the method whose lowest point is highest,
    the constant left aside, as it is not trained. It compares effort, and chooses nothing.

    Args:
        histories: training curves by method: `heldout_mse_all` `t x r` [SI²], `seconds` `t x r`, and `evaluations`
            `t x r` where the learner counts.

    Returns:
        None where fewer than two methods have such a curve, or none but the constant.
    """
    curves = {name: _median(found[CURVE]) for name, found in histories.items() if CURVE in found}
    trained = {name: float(np.nanmin(curve)) for name, curve in curves.items() if name != _BASELINE}
    if len(curves) < 2 or not trained:
        return None
    worst = max(trained, key=lambda name: trained[name])
    level = trained[worst]
    methods: dict[str, Reached | None] = {}
    for name, curve in curves.items():
        there = np.flatnonzero(curve <= level)
        if len(there) == 0:
            methods[name] = None
            continue
        first = int(there[0])
        counted = histories[name].get("evaluations")
        methods[name] = Reached(
            step=first + 1,
            seconds=float(_median(histories[name]["seconds"])[first]),
            evaluations=None if counted is None else float(_median(counted)[first]),
        )
    return Reach(level=level, set_by=worst, methods=methods)


def _median(values: ArrayLike) -> NDArray[np.float64]:
    """Median over the repeats of `t x r`, `t`."""
    found: NDArray[np.float64] = np.nanmedian(np.asarray(values, dtype=np.float64), axis=1)
    return found


NORMAL = 1.959963984540054
"""An interval of 95 % reaches so many predictive standard deviations to either side."""
_TRUSTED = 100.0
"""Held-out figures (rows times joints) from which the shape of their tails counts more than a normal one."""


def sd_scale(residuals: Tensor, sd: Tensor, weights: Tensor) -> Tensor:
    """What to multiply the predictive sd by, so that ±1.96 of it cover 95 % of new rows.

    The size is each joint's own: the root mean square of its standardised residuals z. From size to interval there are
    two ways, and their geometric mean is taken, the second with weight N / (N + 100) where N figures were held out:

    * if z is normal, an interval of 95 % from `s` rows reaches Student's t of `s` degrees of freedom (the size itself
      is uncertain: with 20 rows 2.09, not 1.96, times the root mean square);
    * else the quantile of the absolute z over the size, each over the size of the *other* rows, as a new row would be;
      over all joints together, since 20 rows alone do not have a 95 % quantile. Its rank is that of conformal
      prediction, 0.95 (N + 1).

    Simulated with 3 joints, the mean coverage is between 0.93 and 0.96 from 12 rows on for normal, Laplace and
    Student's t (3) residuals, normal ones with 5 % outliers, and normal ones of varying spread; residuals without
    tails (uniform) are covered by more until the rows are many.

    Args:
        residuals: measured minus predicted on held-out rows, `r x s x n` [any unit].
        sd: predicted for them, above 0, `r x s x n` [the same unit].
        weights: `r x s`; rows of weight 0 are ignored.

    Returns:
        `r x n` [1]; 1 where nothing was held out or no residual differs from 0.
    """
    if residuals.shape[1] == 0:
        return residuals.new_ones(len(residuals), residuals.shape[-1])
    # Only a training with rows held out waits for it; scipy.stats would take half a second.
    from scipy.special import stdtrit

    there = (weights > 0).unsqueeze(-1)
    square = torch.where(there, residuals / sd, 0.0).square()
    rows = there.sum(1)
    size = (square.sum(1) / rows.clamp_min(1)).sqrt()
    student = torch.from_numpy(stdtrit(rows.clamp_min(1).numpy(), 0.975))
    others = ((square.sum(1, keepdim=True) - square) / (rows - 1).clamp_min(1).unsqueeze(1)).sqrt()
    ratio = torch.where(there & (others > 0), square.sqrt() / others, 0.0)
    tails = _quantile(ratio.flatten(1), there.expand_as(ratio).flatten(1))
    count = rows.to(size) * size.shape[-1]
    trust = count / (count + _TRUSTED)
    # A single row has no others; its tails say nothing.
    usable = (tails > 0).unsqueeze(-1) & (rows > 1)
    reach = torch.where(usable, student ** (1 - trust) * tails.clamp_min(1e-300).unsqueeze(-1) ** trust, student)
    return torch.where(size > 0, size * reach / NORMAL, 1.0)


def _quantile(values: Tensor, there: Tensor) -> Tensor:
    """The 95 % quantile as conformal prediction takes it, between two ranks in a straight line. Both `r x k`."""
    count = there.sum(1, keepdim=True)
    ordered = values.masked_fill(~there, torch.inf).sort(1).values
    rank = torch.minimum(0.95 * (count + 1.0) - 1, count - 1.0).clamp_min(0)
    low = rank.floor().long()
    high = torch.minimum(low + 1, (count - 1).clamp_min(0))
    below, above = ordered.gather(1, low), ordered.gather(1, high)
    found = below + (rank - low) * (above - below)
    return torch.where(count > 0, found, 0.0).squeeze(1)


def inside_domain(dataset: Dataset, margin: float) -> Tensor:
    """Which rows lie in the domain of the compensator that the training rows of a repeat give, `r x s` bool."""
    rows = dataset.usable_rows("fit")
    inside = []
    for inputs, index, weights in zip(dataset.inputs, rows.index, rows.weights, strict=True):
        trained = inputs[index[weights > 0]]
        domain = Domain.fit(trained, torch.zeros_like(trained[0]), margin)
        inside.append(domain.excess(domain.cage(inputs)).squeeze(-1) == 0)
    return torch.stack(inside)


def coverage(residuals: Tensor, sd: Tensor, weights: Tensor) -> Tensor:
    """Share of the figures, over rows and joints, within 1.96 sd.

    Args:
        residuals, sd: `r x s x n` [any unit].
        weights: `r x s`; rows of weight 0 are ignored.

    Returns:
        `r` [1]; NaN where no row is left.
    """
    within = ((residuals.abs() <= NORMAL * sd).to(torch.float64).mean(-1) * weights).sum(-1)
    return within / weights.sum(-1)
