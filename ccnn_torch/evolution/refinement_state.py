"""The state of a refinement as plain tensors."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import NamedTuple

from torch import Tensor

from ccnn_torch.evolution.gauss_newton import Network
from ccnn_torch.evolution.waves import Waves
from ccnn_torch.numerics.trees import picked

# Calm iterations after which a network is done.
_CALM = 3


@dataclass(frozen=True)
class RefinementSettings:
    """How to refine.

    Attributes:
        iterations: Levenberg-Marquardt iterations.
        bayesian: estimate the precisions of prior and noise; else `ridge` is the prior's and 1 the noise's.
        ridge: precision of the prior where `bayesian` is off.
        first_prior: prior precision before its first estimate.
        warm_up: iterations before the first estimate of the precisions.
        prior_shape, prior_rate: Gamma distribution that the prior precisions themselves are drawn from; they then are
            (gamma + 2 shape) / (sum w^2 + 2 rate). With a hundred rows and small groups of weights this holds back
            what the estimate of gamma alone would let through; with many rows it makes no difference.
        damping: first damping, relative to the diagonal of H.
        trials: dampings tried in an iteration before it is given up.
        tolerance: a network whose objective falls by less than this share in each of three iterations running is done;
            0 = the objective ends none.
        patience: where `bayesian`, iterations without a rise of the log evidence by 1 nat after which a network is
            done; it ends with the weights and precisions of the highest evidence.
    """

    iterations: int = 50
    bayesian: bool = True
    ridge: float = 1e-6
    first_prior: float = 1e-3
    warm_up: int = 3
    prior_shape: float = 1.0
    prior_rate: float = 0.1
    damping: float = 1e-2
    trials: int = 6
    tolerance: float = 1e-5
    patience: int = 6


@dataclass(frozen=True)
class RefinementProblem:
    """What stays fixed: `b` networks (the leading dimensions in one), their data and the settings.

    Attributes:
        network: masks of the `b` networks and what follows from them.
        inputs: `b x s x i`.
        targets: `b x s x o`.
        rows: row weights, `b x s`.
        metric: `b x s x c x o`, or None.
        groups: prior group of every weight, `k`, int64; the last group is never held back.
        leading: the leading dimensions as given.
        group_count: number of prior groups, that last one included.
        wave_groups: which of them are of periodic nodes, int64.
        settings: as given.
    """

    network: Network
    inputs: Tensor
    targets: Tensor
    rows: Tensor
    metric: Tensor | None
    groups: Tensor
    leading: tuple[int, ...]
    group_count: int
    wave_groups: Tensor
    settings: RefinementSettings


@dataclass(frozen=True)
class RefinementState:
    """What changes from iteration to iteration.

    Attributes:
        weights: `b x k`.
        damping: `b`.
        prior: precision of each prior group, `b x g`.
        noise: precision of each channel's noise, `b x c`.
        effective: weights determined by the data, per prior group, `b x g`.
        calm: iterations running that lowered the objective by less than the tolerance, `b` int64.
        iteration: iterations done, 0-d, int64.
    """

    weights: Tensor
    damping: Tensor
    prior: Tensor
    noise: Tensor
    effective: Tensor
    calm: Tensor
    iteration: Tensor

    @property
    def done(self) -> Tensor:
        """Networks that do not move any more, `b` bool."""
        return self.calm >= _CALM

    def state_dict(self) -> dict[str, Tensor]:
        """All tensors by name."""
        return {f.name: getattr(self, f.name) for f in fields(self)}

    @classmethod
    def from_state_dict(cls, state: dict[str, Tensor]) -> RefinementState:
        """Inverse of `state_dict`."""
        return cls(**{f.name: state[f.name] for f in fields(cls)})


class SecondOrder(NamedTuple):
    """Gradient `b x m` and Gauss-Newton matrix `b x m x m` of the objective in the network's kept weights.

    Inactive ones among them have the gradient 0 and 1 on the diagonal. `root` is the matrix's Cholesky factor, and
    `failed` (`b`) not 0 where it has none.
    """

    gradient: Tensor
    matrix: Tensor
    root: Tensor
    failed: Tensor


class Precisions(NamedTuple):
    """What a refinement has estimated beside the weights; 0 = not known.

    Attributes:
        prior: precision of each prior group, `... x g`.
        noise: precision of each channel's noise, `... x c`.
        damping: `...`.
    """

    prior: Tensor
    noise: Tensor
    damping: Tensor


@dataclass(frozen=True)
class Refined:
    """Refined networks.

    Attributes:
        weights: per layer `... x out x in (+ 1)`; those that take no part are as they were given.
        waves: periodic nodes with their refined frequencies, `... x k`.
        error: weighted mean square of the residual in its channels, on the rows refined on, `...`.
        objective: misfit and penalty under the last precisions, `...`.
        effective_parameters: weights determined by the data, `...`.
        noise: precision of each channel's noise, `... x c`.
        log_evidence: logarithm of the probability of the targets given the masks and precisions, up to a constant of
            the data (MacKay 1992, eq. 2.23); compares networks refined on the same rows. `...`.
        precisions: with which it ended.
        iterations: iterations done.
    """

    weights: list[Tensor]
    waves: Waves
    error: Tensor
    objective: Tensor
    effective_parameters: Tensor
    noise: Tensor
    log_evidence: Tensor
    precisions: Precisions
    iterations: int


def part_of_problem(problem: RefinementProblem, index: Tensor) -> RefinementProblem:
    """The problem of some of the networks, numbered as in the batch; they lead in one dimension."""
    if len(index) == len(problem.rows):
        return problem
    parts = {name: picked(getattr(problem, name), index) for name in ("network", "inputs", "targets", "rows", "metric")}
    return replace(problem, leading=(len(index),), **parts)
