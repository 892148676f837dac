"""The estimators: one class a learner, its most useful settings as parameters under their own names.

Where a default is not that of the settings, it is for speed: cross-validation and searches fit many times, so that an
estimator with its defaults fits a few hundred rows in well under a second.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from ccnn_torch.evolution.settings import CCNNSettings, ENNSettings
from ccnn_torch.learners.bp_lm import BPLM, BPLMSettings
from ccnn_torch.learners.ccnn import CCNN
from ccnn_torch.learners.enn import ENN
from ccnn_torch.learners.grnn import GRNN, GRNNSettings
from ccnn_torch.sklearn.base import LearnerRegressor, SteppedRegressor


@dataclass(kw_only=True, eq=False, repr=False)
class CCNNRegressor(SteppedRegressor):
    """Cooperative coevolution of a masked network's layers, refined by Levenberg-Marquardt (paper 000, section III).

    By default hidden, rival_hidden, population, generations, members and refinement_iterations stay below what a run
    has, which takes about ten times as long and predicts somewhat better. All settings:
    `ccnn_torch.learners.ccnn.CCNNSettings`.

    Args:
        hidden: nodes of each hidden layer; a number is one layer.
        rival_hidden: hidden layers of a second structure; the one of higher evidence is taken. () = none.
        population: individuals of each subpopulation, one a layer.
        generations: steps.
        members: independent coevolutions, whose networks are averaged.
        refine_every: generations between refinements; 0 = only after the last.
        refinement_iterations: Levenberg-Marquardt iterations of one refinement; 0 = none, as in the paper.
        waves: slots for periodic nodes, found in what a refined network leaves; 0 = none, as in the paper.
        wave_searches: how often to look for them.
        crossover, structural_mutation, weight_mutation: probabilities of the operators.
        density: share of connections that exist at the start.
        weight_range: weights start and mutate in -weight_range .. weight_range.
        bias: whether nodes have a bias.
        periodic: inputs that are angles in rad, by index or by name, to be fed as sine and cosine; waves read the angle
            itself, and their period need not be a part of a turn.
        early_stopping: hold rows out, find the step of the lowest error on them and how wide intervals must be to cover
            them, then train on all rows for so long.
        validation_fraction: share of the rows that are then held out.
        n_iter_no_change: steps without improvement after which that search ends; None = go to the end.
        random_state: seed, or a RandomState to draw it from; None = draw it from NumPy's global generator.

    Attributes:
        network_: the trained network, on scaled inputs and outputs.
        scaling_: that scaling.
        sd_scale_: factor on the learner's own standard deviation, per output; 1 where no rows were held out.
        n_iter_: steps of the model.
        loss_curve_: mean squared standardised error on the training rows after each of them.
        validation_curve_: with early_stopping, that on the rows held out, after each step of the search.
        converged_: whether the learner's own criterion was met; None where it has none.
        n_features_in_, feature_names_in_: as in scikit-learn.
    """

    _learner = CCNN
    _settings = CCNNSettings

    hidden: int | Sequence[int] = (12, 12)
    rival_hidden: Sequence[int] = ()
    population: int = 40
    generations: int = 10
    members: int = 2
    refine_every: int = 0
    refinement_iterations: int = 20
    waves: int = CCNNSettings.waves
    wave_searches: int = CCNNSettings.wave_searches
    crossover: float = CCNNSettings.crossover
    structural_mutation: float = CCNNSettings.structural_mutation
    weight_mutation: float = CCNNSettings.weight_mutation
    density: float = CCNNSettings.density
    weight_range: float = CCNNSettings.weight_range
    bias: bool = CCNNSettings.bias


@dataclass(kw_only=True, eq=False, repr=False)
class BPLMRegressor(SteppedRegressor):
    """Fully connected sigmoid networks from many starts, trained by Levenberg-Marquardt with Bayesian regularisation.

    The model is the network of highest evidence. By default hidden and restarts are less than in a run. All settings:
    `ccnn_torch.learners.bp_lm.BPLMSettings`.

    Args:
        hidden: nodes of each hidden layer; a number is one layer.
        restarts: networks from independent starts, trained side by side.
        iterations: Levenberg-Marquardt iterations at most; training ends earlier once every network is at rest.
        tolerance: a network is at rest once its log evidence changed by at most this per measured value in each of
            `patience` iterations.
        patience: see `tolerance`.
        periodic: inputs that are angles in rad, by index or by name, to be fed as sine and cosine.
        early_stopping: hold rows out, find the step of the lowest error on them and how wide intervals must be to cover
            them, then train on all rows for so long; for the error the regularisation suffices.
        validation_fraction: share of the rows that are then held out.
        n_iter_no_change: steps without improvement after which that search ends; None = go to the end.
        random_state: seed, or a RandomState to draw it from; None = draw it from NumPy's global generator.

    Attributes:
        network_: the trained network, on scaled inputs and outputs.
        scaling_: that scaling.
        sd_scale_: factor on the learner's own standard deviation, per output; 1 where no rows were held out.
        n_iter_: iterations of the model.
        loss_curve_: mean squared standardised error on the training rows after each of them.
        validation_curve_: with early_stopping, that on the rows held out, after each iteration of the search.
        converged_: whether the model is at rest.
        n_features_in_, feature_names_in_: as in scikit-learn.
    """

    _learner = BPLM
    _settings = BPLMSettings

    hidden: int | Sequence[int] = (10,)
    restarts: int = 3
    iterations: int = BPLMSettings.iterations
    tolerance: float = BPLMSettings.tolerance
    patience: int = BPLMSettings.patience


@dataclass(kw_only=True, eq=False, repr=False)
class ENNRegressor(SteppedRegressor):
    """One evolved population of whole networks, without cooperation and without refinement: the paper's comparison.

    By default hidden is one layer, and population and generations stay far below what a run has, so that the network
    is coarse. All settings: `ccnn_torch.learners.enn.ENNSettings`.

    Args:
        hidden: nodes of each hidden layer; a number is one layer.
        population: networks.
        generations: steps.
        crossover, structural_mutation, weight_mutation: probabilities of the operators.
        density: share of connections that exist at the start.
        weight_range: weights start and mutate in -weight_range .. weight_range.
        bias: whether nodes have a bias.
        periodic: inputs that are angles in rad, by index or by name, to be fed as sine and cosine.
        early_stopping: hold rows out, find the step of the lowest error on them and how wide intervals must be to cover
            them, then train on all rows for so long; there is no other regularisation.
        validation_fraction: share of the rows that are then held out.
        n_iter_no_change: steps without improvement after which that search ends; None = go to the end.
        random_state: seed, or a RandomState to draw it from; None = draw it from NumPy's global generator.

    Attributes:
        network_: the trained network, on scaled inputs and outputs.
        scaling_: that scaling.
        sd_scale_: factor on the learner's own standard deviation, per output; 1 where no rows were held out.
        n_iter_: steps of the model.
        loss_curve_: mean squared standardised error on the training rows after each of them.
        validation_curve_: with early_stopping, that on the rows held out, after each step of the search.
        converged_: whether the learner's own criterion was met; None where it has none.
        n_features_in_, feature_names_in_: as in scikit-learn.
    """

    _learner = ENN
    _settings = ENNSettings

    hidden: int | Sequence[int] = (8,)
    population: int = 50
    generations: int = 70
    crossover: float = ENNSettings.crossover
    structural_mutation: float = ENNSettings.structural_mutation
    weight_mutation: float = ENNSettings.weight_mutation
    density: float = ENNSettings.density
    weight_range: float = ENNSettings.weight_range
    bias: bool = ENNSettings.bias


@dataclass(kw_only=True, eq=False, repr=False)
class GRNNRegressor(LearnerRegressor):
    """Kernel regression (Specht's general regression neural network), one bandwidth per input found by leave-one-out.

    All settings: `ccnn_torch.learners.grnn.GRNNSettings`; defaults are theirs.

    Args:
        iterations: steps of the search at most; it ends earlier once its moves are small.
        candidates: bandwidth vectors judged in one step.
        narrowest, widest: range of bandwidths that the first step searches; inputs are scaled to -1 .. 1.
        queries: rows that leave-one-out judges, drawn where there are more.
        references: rows that they are predicted from, drawn where there are more.
        periodic: inputs that are angles in rad, by index or by name, to be fed as sine and cosine.
        random_state: seed, or a RandomState to draw it from; None = draw it from NumPy's global generator.

    Attributes:
        network_: the trained network with its rows, on scaled inputs and outputs.
        scaling_: that scaling.
        sd_scale_: 1 for every output.
        n_iter_: steps of the search.
        loss_curve_: mean squared standardised error on the training rows after each of them.
        converged_: whether the search met its own criterion.
        n_features_in_, feature_names_in_: as in scikit-learn.
    """

    _learner = GRNN
    _settings = GRNNSettings

    iterations: int = GRNNSettings.iterations
    candidates: int = GRNNSettings.candidates
    narrowest: float = GRNNSettings.narrowest
    widest: float = GRNNSettings.widest
    queries: int = GRNNSettings.queries
    references: int = GRNNSettings.references
