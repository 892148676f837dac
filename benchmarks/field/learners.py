"""scikit-learn on what SciPy geometry leaves: a Gaussian process, and extra trees."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
from sklearn.ensemble import ExtraTreesRegressor
from sklearn.exceptions import ConvergenceWarning
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import ConstantKernel, Matern, WhiteKernel

from benchmarks.field.geometry import Solved, solve
from benchmarks.field.protocol import Fit, Floats, Rows, errors, matrices, moved, rigid, vectors


def geometry_gp(rows: Rows) -> Fit:
    """A Matérn-3/2 process for each channel's remainder, one length per input shared by the channels."""

    def make(inputs: int) -> Any:
        smooth = ConstantKernel(1.0) * Matern(np.full(inputs, 3.0), (0.1, 100.0), nu=1.5)
        return GaussianProcessRegressor(smooth + WhiteKernel(0.3, (1e-4, 10.0)), normalize_y=True, random_state=0)

    return _on_remainder(rows, make, with_sd=True)


def geometry_trees(rows: Rows) -> Fit:
    """400 extra trees."""
    return _on_remainder(rows, lambda _: ExtraTreesRegressor(400, min_samples_leaf=2, random_state=0), with_sd=False)


def _on_remainder(rows: Rows, make: Callable[[int], Any], with_sd: bool) -> Fit:
    solved = solve(rows)
    reached = solved.in_base(rows.joints)
    wanted = np.empty_like(reached)
    for one in np.unique(rows.frame):
        at = rows.frame == one
        wanted[at] = moved(rows.poses[at], *rigid(rows.poses[at], reached[at]))
    middle, size = rows.covariates.mean(0), rows.covariates.std(0) + 1e-12

    def inputs(joints: Floats, covariates: Floats) -> Floats:
        return np.hstack([np.sin(joints), np.cos(joints), (covariates - middle) / size])

    x = inputs(rows.joints, rows.covariates)
    with warnings.catch_warnings():
        # A length at its bound is an input that does not matter.
        warnings.simplefilter("ignore", ConvergenceWarning)
        model = make(x.shape[1]).fit(x, errors(wanted, reached))

    def predict(joints: Floats, covariates: Floats) -> Floats:
        found = solved.in_base(joints)
        gap = np.asarray(model.predict(inputs(joints, covariates)))
        place = found[:, :3] + gap[:, :3]
        if gap.shape[1] == 6:
            place = np.hstack([place, vectors(matrices(gap[:, 3:]) @ matrices(found[:, 3:]))])
        return moved(place, *solved.base)

    def half_width(joints: Floats, covariates: Floats) -> Floats:
        return _turned(1.96 * np.asarray(model.predict(inputs(joints, covariates), return_std=True)[1]), solved)

    return Fit(predict, half_width if with_sd else None)


def _turned(sd: Floats, solved: Solved) -> Floats:
    """Independent standard deviations in the base as those in the measuring frame, `n x p`."""
    squares = solved.base[0] ** 2
    return np.hstack([np.sqrt(part**2 @ squares.T) for part in np.split(sd, sd.shape[1] // 3, 1)])
