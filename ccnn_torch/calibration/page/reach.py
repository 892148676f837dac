"""Effort of each method to reach the same held-out error."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ccnn_torch.report.results.run import Reach, Reached

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
