"""The estimators: one class a learner, its settings as parameters under their own names.

Where a default is not the run's, that is for speed: cross-validation and searches fit many times, so that an estimator
with its defaults fits a few hundred rows in well under a second. The settings of a run, `CCNNRegressor(**section)`,
give the same model as the run.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from ccnn_torch.learners.ccnn import CCNN, CCNNSettings
from ccnn_torch.sklearn._base import SteppedRegressor

__all__ = ["CCNNRegressor"]


class CCNNRegressor(SteppedRegressor):
    """Cooperative coevolution of a masked network's layers, refined by Levenberg-Marquardt (paper 000, section III).

    A run has by default population=80, generations=30, members=6 and refine_every=10, which takes about ten times as
    long and predicts somewhat better. All settings: `ccnn_torch.learners.ccnn.CCNNSettings`.

    Args:
        hidden: nodes of each hidden layer; a number is one layer.
        population: individuals of each subpopulation, one a layer.
        generations: steps.
        members: independent coevolutions, whose networks are averaged.
        refine_every: generations between refinements; 0 = only after the last.
        refinement_iterations: Levenberg-Marquardt iterations of one refinement; 0 = none, as in the paper.
        crossover, structural_mutation, weight_mutation: probabilities of the operators.
        density: share of connections that exist at the start.
        weight_range: weights start and mutate in -weight_range .. weight_range.
        bias: whether nodes have a bias.
        periodic: inputs that are angles in rad, by index or by name, to be fed as sine and cosine.
        early_stopping: hold rows out, find the step of the lowest error on them, then train on all rows for so long.
        validation_fraction: share of the rows that are then held out.
        n_iter_no_change: steps without improvement after which that search ends; None = go to the end.
        random_state: seed, or a RandomState to draw it from; None = draw it from NumPy's global generator.

    Attributes:
        network_: the trained network, on scaled inputs and outputs.
        scaling_: that scaling.
        n_iter_: steps of the model.
        loss_curve_: mean squared standardised error on the training rows after each of them.
        validation_curve_: with early_stopping, that on the rows held out, after each step of the search.
        converged_: whether the learner's own criterion was met; None where it has none.
        n_features_in_, feature_names_in_: as in scikit-learn.
    """

    _learner = CCNN
    _settings = CCNNSettings

    def __init__(
        self,
        *,
        hidden: int | Sequence[int] = (12, 12),
        population: int = 40,
        generations: int = 10,
        members: int = 2,
        refine_every: int = 0,
        refinement_iterations: int = 20,
        crossover: float = 0.72,
        structural_mutation: float = 0.0015,
        weight_mutation: float = 0.0025,
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
        self.crossover = crossover
        self.structural_mutation = structural_mutation
        self.weight_mutation = weight_mutation
        self.density = density
        self.weight_range = weight_range
        self.bias = bias
        self.periodic = periodic
        self.early_stopping = early_stopping
        self.validation_fraction = validation_fraction
        self.n_iter_no_change = n_iter_no_change
        self.random_state = random_state
