"""Identification of simulated machines beside SciPy's least squares on the same residual.

All parameters are free, decorrelated by the pose noise. SciPy's `least_squares` has its default tolerances and

* `trf, jacobian_of`: its default method, the Jacobian of the residual by this package's `jacobian_of`;
* `trf, quick`: the same method, the Jacobian by the routine that `solve_lm` itself uses;
* `lm, quick`: MINPACK's Levenberg-Marquardt with that Jacobian;
* `trf, 2-point`: the default method with its own finite differences, as it does without being told.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import least_squares

from benchmarks.measure import Row, compare
from ccnn_torch.coordinates import plausible_error
from ccnn_torch.identification import Problem, inverse_problem, solve_lm, what_is_known
from ccnn_torch.mechanisms import load_mechanism
from ccnn_torch.numerics.least_squares import jacobian_of

Array = NDArray[np.float64]
NOISE, POSES = 1e-4, 36
KINDS: dict[str, dict[str, str]] = {
    "SciPy trf, jacobian_of": {"method": "trf", "jacobian": "plain"},
    "SciPy trf, quick": {"method": "trf", "jacobian": "quick"},
    "SciPy lm, quick": {"method": "lm", "jacobian": "quick"},
    "SciPy trf, 2-point": {"method": "trf", "jacobian": "2-point"},
}


def run(quick: bool, model: Path | None = None) -> Iterator[Row]:
    """One machine, and 10 to 1,000 at once; SciPy works on one after the other, a sample of them."""
    for name in ("five_bar",) if quick else ("five_bar", "stewart"):
        for machines in (1, 30, 1000):
            sample = 1 if machines == 1 else 3
            everyone, alone = problems(name, machines, POSES, sample)
            solvers = [SciPy(p) for p in alone]
            found, exact = solve_lm(everyone), [s.solve("trf", "quick", xtol=1e-15, ftol=1e-15) for s in solvers]
            sd = [what_is_known(p, torch.from_numpy(x)[None]).sd[0].numpy() for p, x in zip(alone, exact, strict=True)]
            off = max(np.abs((v.numpy() - x) / d).max() for v, x, d in zip(found.values, exact, sd, strict=False))
            yield from compare(
                f"identify a {name}, {POSES} poses",
                machines,
                "machines",
                partial(solve_lm, everyone),
                {label: (partial(_solve_all, solvers, keys), sample / machines) for label, keys in KINDS.items()},
                rounds=3,
                note=f"off SciPy's minimum by {off:.0e} standard errors",
            )


def _solve_all(solvers: list[Any], keys: dict[str, Any]) -> list[Any]:
    return [one.solve(**keys) for one in solvers]


def problems(name: str, machines: int, poses: int, sample: int) -> tuple[Problem, list[Problem]]:
    """All machines as one problem, and some of them alone."""
    mechanism = load_mechanism(name)
    generator = torch.Generator().manual_seed(0)
    scale = torch.tensor([plausible_error(p) for p in mechanism.geometry], dtype=torch.float64)
    drawn = torch.randn(machines, len(scale), generator=generator, dtype=torch.float64)
    truth = mechanism.nominal + scale * drawn
    middle = (mechanism.low + mechanism.high) / 2
    ideal = middle + 0.6 * (mechanism.sample_workspace(machines * poses, generator) - middle)
    joints = mechanism.solve_inverse(ideal).reshape(machines, poses, -1)
    pose = mechanism.forward_kinematics(joints, truth[:, None])
    pose = pose + NOISE * torch.randn(pose.shape, generator=generator, dtype=torch.float64)
    alone = [inverse_problem(mechanism, q, x, pose_noise=NOISE) for q, x in zip(joints[:sample], pose, strict=False)]
    return inverse_problem(mechanism, joints, pose, pose_noise=NOISE), alone


class SciPy:
    """`least_squares` on the residual of a problem of one machine."""

    def __init__(self, problem: Problem) -> None:
        self.problem = problem
        self.rows = problem.weights.shape[1]

    def solve(self, method: str, jacobian: str, **keys: Any) -> Array:
        slope = {"plain": self.plain, "quick": self.quick}.get(jacobian, jacobian)
        found = least_squares(self.residual, self.problem.start[0].numpy(), jac=slope, method=method, **keys)
        values: Array = found.x
        return values

    def point(self, x: Array) -> torch.Tensor:
        return torch.from_numpy(x).expand(1, self.rows, -1)

    def residual(self, x: Array) -> Array:
        values: Array = self.problem.residual(self.point(x), *self.problem.data).flatten().numpy()
        return values

    def plain(self, x: Array) -> Array:
        slope = jacobian_of(lambda v: self.problem.residual(v, *self.problem.data), self.point(x))[1]
        values: Array = slope.reshape(-1, len(x)).numpy()
        return values

    def quick(self, x: Array) -> Array:
        slope = self.problem.residual.jacobian(self.point(x), self.problem.data)[1]  # type: ignore[attr-defined]
        values: Array = slope.reshape(-1, len(x)).numpy()
        return values
