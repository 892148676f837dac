"""The estimators: one class a learner, its settings as parameters."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from ccnn_torch.learners.ccnn import CCNN, CCNNSettings
from ccnn_torch.sklearn._base import SteppedRegressor

__all__ = ["CCNNRegressor"]


class CCNNRegressor(SteppedRegressor):
    _learner = CCNN
    _settings = CCNNSettings

    def __init__(
        self,
        *,
        hidden: int | Sequence[int] = (12, 12),
        population: int = 40,
        generations: int = 10,
        members: int = 3,
        refine_every: int = 0,
        refinement_iterations: int = 20,
        density: float = 0.5,
        weight_range: float = 2.0,
        bias: bool = True,
        periodic: Sequence[int | str] | None = None,
        early_stopping: bool = False,
        validation_fraction: float = 0.2,
        n_iter_no_change: int | None = None,
        random_state: Any = 0,
    ) -> None:
        self.hidden = hidden
        self.population = population
        self.generations = generations
        self.members = members
        self.refine_every = refine_every
        self.refinement_iterations = refinement_iterations
        self.density = density
        self.weight_range = weight_range
        self.bias = bias
        self.periodic = periodic
        self.early_stopping = early_stopping
        self.validation_fraction = validation_fraction
        self.n_iter_no_change = n_iter_no_change
        self.random_state = random_state
