"""Time of an identification, beside SciPy's least squares on the same residual, measured in the same run.

    python benchmarks/identification.py
    python benchmarks/identification.py --mechanisms five_bar stewart --machines 1000 --poses 36

Inverse calibration of simulated machines with all parameters free, decorrelated by the pose noise. `solve_lm` works on
one machine, and on all at once. SciPy's `least_squares` works on one machine after another (a sample of them, for the
time of all), with its default tolerances and

* `trf, jacobian_of`: its default method, the Jacobian of the residual by this package's `jacobian_of`;
* `trf, quick`: the same method, the Jacobian by the routine that `solve_lm` itself uses;
* `lm, quick`: MINPACK's Levenberg-Marquardt with that Jacobian;
* `trf, 2-point`: the default method with its own finite differences, as it does without being told.

In each the residual is the same torch function, without gradient. Times are the least of several, in process time on
one thread, so that a busy machine disturbs little. `off` is the largest difference from SciPy's minimum (at tolerances
of 1e-15) in standard errors.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import least_squares

from ccnn_torch.coordinates import plausible_error
from ccnn_torch.identification import Problem, inverse_problem, solve_lm, what_is_known
from ccnn_torch.mechanisms import load_mechanism
from ccnn_torch.numerics.least_squares import jacobian_of

Array = NDArray[np.float64]
NOISE = 1e-4
KINDS: dict[str, dict[str, str]] = {
    "trf, jacobian_of": {"method": "trf", "jacobian": "plain"},
    "trf, quick": {"method": "trf", "jacobian": "quick"},
    "lm, quick": {"method": "lm", "jacobian": "quick"},
    "trf, 2-point": {"method": "trf", "jacobian": "2-point"},
}


def main() -> None:
    """Print one table a mechanism."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--mechanisms", nargs="+", default=["five_bar", "stewart"])
    parser.add_argument("--machines", type=int, default=1000)
    parser.add_argument("--poses", type=int, default=36)
    parser.add_argument("--sample", type=int, default=10, help="machines that SciPy works on")
    given = parser.parse_args()
    torch.set_num_threads(1)
    for name in given.mechanisms:
        compare(name, given.machines, given.poses, given.sample)


def compare(name: str, machines: int, poses: int, sample: int) -> None:
    """One table."""
    everyone, alone = problems(name, machines, poses, sample)
    n, k = len(everyone.channels), len(everyone.parameters)
    print(f"{name}: {poses} poses, {n} joints, {k} parameters; {sample} machines one by one, {machines} at once")
    together, all_ms = least_time(lambda: solve_lm(everyone), 3)
    assert bool(together.converged.all()), together.message
    one = [least_time(lambda p=p: solve_lm(p), 30) for p in alone]
    ours = float(np.mean([ms for _, ms in one]))
    exact = [SciPy(p).solve("trf", "quick", xtol=1e-15, ftol=1e-15, gtol=1e-15) for p in alone]
    sd = [what_is_known(p, torch.from_numpy(x)[None]).sd[0].numpy() for p, x in zip(alone, exact, strict=True)]

    def off(values: list[Array]) -> float:
        return max(float(np.abs((v - x) / s).max()) for v, x, s in zip(values, exact, sd, strict=True))

    print(f"{'':>18} {'ms a machine':>13} {'off':>8} {'solve_lm alone':>15} {'solve_lm at once':>17}")
    print(f"{'solve_lm, alone':>18} {ours:>13.2f} {off([fit.values[0].numpy() for fit, _ in one]):>8.0e}")
    each = all_ms / machines
    print(f"{'solve_lm, at once':>18} {each:>13.3f} {off([v.numpy() for v in together.values[:sample]]):>8.0e}")
    for label, keys in KINDS.items():
        solvers = [SciPy(p) for p in alone]
        runs = [least_time(lambda s=s, q=keys: s.solve(**q), 10) for s in solvers]
        ms = float(np.mean([t for _, t in runs]))
        print(f"{label:>18} {ms:>13.2f} {off([x for x, _ in runs]):>8.0e} {ms / ours:>14.1f}x {ms / each:>16.1f}x")


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


def least_time(call: Callable[[], Any], times: int) -> tuple[Any, float]:
    """What it returns, and its least process time [ms]."""
    answer, least = call(), float("inf")
    for _ in range(times):
        began = time.process_time()
        answer = call()
        least = min(least, time.process_time() - began)
    return answer, 1000 * least


if __name__ == "__main__":
    main()
