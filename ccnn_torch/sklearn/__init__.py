"""The learners as scikit-learn regressors: one class a learner, its most useful settings as parameters of their names.

Where a default is not that of the settings, it is for speed: cross-validation and searches fit many times, so that an
estimator with its defaults fits a few hundred rows in well under a second.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from typing import Any, ClassVar, NamedTuple

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from pydantic import TypeAdapter, ValidationError
from sklearn.base import BaseEstimator, RegressorMixin
from sklearn.utils import check_array, check_random_state
from sklearn.utils.validation import _check_sample_weight, check_is_fitted, validate_data
from torch import Tensor, nn

from ccnn_torch.calibration.statistics import sd_scale
from ccnn_torch.evolution.settings import CCNNSettings, ENNSettings
from ccnn_torch.learners import Learner, TrainingData
from ccnn_torch.learners.bp_lm import BPLM, BPLMSettings
from ccnn_torch.learners.ccnn import CCNN
from ccnn_torch.learners.enn import ENN
from ccnn_torch.learners.grnn import GRNN, GRNNSettings
from ccnn_torch.training import Scaling, Training, train

__all__ = ["BPLMRegressor", "CCNNRegressor", "ENNRegressor", "GRNNRegressor"]

_Floats = NDArray[np.float64]


class _Choice(NamedTuple):
    """Results on rows held out of a first training.

    Attributes:
        steps: of lowest error on them, `1` int64.
        inputs: of these rows, `h x i`.
        residuals: that the first training left there, `h x o`.
    """

    steps: Tensor
    inputs: _Floats
    residuals: Tensor


@dataclass(kw_only=True, eq=False, repr=False)
class LearnerRegressor(RegressorMixin, BaseEstimator):  # type: ignore[misc]
    """A learner as a scikit-learn regressor; a subclass names the learner and has its settings as parameters.

    Rows that are alike in X and y are one row of their summed weights, and rows are sorted before training. So a
    weight of 2 is exactly the same as a repeated row, the order of rows changes nothing, and no copy of a
    training row is ever held out for validation.
    """

    _learner: ClassVar[Callable[[Any], Learner]]
    _settings: ClassVar[type[Any]]

    periodic: Sequence[int | str] | None = None
    random_state: Any = 0

    def fit(self, X: ArrayLike, y: ArrayLike, sample_weight: ArrayLike | None = None) -> LearnerRegressor:
        """Train on all rows.

        Args:
            X: inputs, `s x i`; any units, since each is scaled to [-1, 1] by the training rows.
            y: outputs, `s` or `s x o`; standardised by the training rows.
            sample_weight: `s`; a weight of 2 counts as two rows, of 0 as none, so that the sum of the weights is the
                number of rows that the data are trusted as. None = 1 for every row.

        Raises:
            ValueError: the data or a parameter cannot be used.
            MethodFailedError: the learner could not be trained on these rows.
        """
        inputs, targets, weights = self._check(X, y, sample_weight)
        generator = check_random_state(self.random_state)
        seed = int(generator.randint(np.iinfo(np.int32).max))
        choice = self._choose(inputs, targets, weights, seed, generator)
        learner, scaling, training = self._train(inputs, targets, weights, seed, stop_at=choice and choice.steps)
        self.network_: nn.Module = learner.network(0).requires_grad_(False)
        self.scaling_: Scaling = scaling.repeat(0)
        self.n_iter_ = int(training.best_step[0])
        self.loss_curve_ = training.history["error_train"][: self.n_iter_, 0].tolist()
        converged = getattr(learner, "converged", None)
        self.converged_ = None if converged is None else bool(converged[0])
        self.sd_scale_ = np.ones(targets.shape[1]) if choice is None else self._sd_scale(choice)
        return self

    def predict(self, X: ArrayLike, return_std: bool = False) -> Any:
        """Outputs, and with `return_std` the standard deviation of a newly measured output beside them.

        Args:
            X: `s x i`.

        Returns:
            `s` or `s x o`, as the y of the training was; with `return_std` a pair of such arrays.
        """
        check_is_fitted(self)
        rows: _Floats = validate_data(self, X, reset=False, dtype=np.float64)
        features = self.scaling_.features(_tensor(rows))
        with torch.no_grad():
            mean = self._shaped(self.scaling_.restore(self.network_(features)))
        return (mean, self._shaped(self._sd(features) * _tensor(self.sd_scale_))) if return_std else mean

    def __sklearn_tags__(self) -> Any:
        tags = super().__sklearn_tags__()
        tags.target_tags.multi_output = True
        return tags

    def _check(self, X: ArrayLike, y: ArrayLike, sample_weight: ArrayLike | None) -> tuple[_Floats, _Floats, _Floats]:
        """Checked rows, alike ones merged, sorted: `s x i`, `s x o`, `s`."""
        inputs: _Floats
        targets: _Floats
        inputs, found = validate_data(
            self, X, y, dtype=np.float64, multi_output=True, y_numeric=True, ensure_min_samples=2
        )
        targets = check_array(found, dtype=np.float64, ensure_2d=False, input_name="y")
        self._flat = targets.ndim == 1
        weights: _Floats = _check_sample_weight(sample_weight, inputs, dtype=np.float64, ensure_non_negative=True)
        used = weights > 0
        if used.sum() < 2:
            raise ValueError("sample_weight: at least two weights must be above zero; the others' rows are left out")
        table = np.concatenate([inputs, targets.reshape(len(targets), -1)], axis=1)[used]
        rows, index = np.unique(table, axis=0, return_inverse=True)
        merged = np.bincount(index.reshape(-1), weights=weights[used], minlength=len(rows)).astype(np.float64)
        width = inputs.shape[1]
        return rows[:, :width], rows[:, width:], merged

    def _choose(
        self, inputs: _Floats, targets: _Floats, weights: _Floats, seed: int, generator: np.random.RandomState
    ) -> _Choice | None:
        """Hold rows out of a first training; None without early stopping."""
        return None

    def _sd(self, features: Tensor) -> Tensor:
        """The learner's own standard deviation. features: `s x i` [1]; returns `s x o`."""
        with torch.no_grad():
            variance: Tensor = self.network_.variance(features)  # type: ignore[operator]
        return variance.sqrt() * self.scaling_.deviation

    def _sd_scale(self, choice: _Choice) -> _Floats:
        """Factor that makes intervals of the model as wide as held-out residuals.

        The residuals are divided by the standard deviation of the final model, not of the first one: the standard
        deviations of the two can differ by half, while their errors hardly differ.
        """
        sd = self._sd(self.scaling_.features(_tensor(choice.inputs)))
        return sd_scale(choice.residuals[None], sd[None], torch.ones(1, len(sd), dtype=sd.dtype))[0].numpy()

    def _train(
        self,
        inputs: _Floats,
        targets: _Floats,
        weights: _Floats,
        seed: int,
        *,
        held: NDArray[np.bool_] | None = None,
        patience: int | None = None,
        stop_at: Tensor | None = None,
    ) -> tuple[Learner, Scaling, Training]:
        """Train one repeat. held: rows to watch instead of training on them, `s`."""
        every = [_tensor(part).unsqueeze(0) for part in (inputs, targets, weights)]
        rows = every if held is None else [part[:, _tensor(~held)] for part in every]
        learner = type(self)._learner(self._make_settings())
        angles = getattr(learner, "reads_angles", False)
        scaling = Scaling.fit(rows[0], rows[1], rows[2], _tensor(self._periodic()), angles)
        seeds = torch.tensor([seed])

        def scaled(parts: list[Tensor], validation: TrainingData | None = None) -> TrainingData:
            features, targets = scaling.features(parts[0]), scaling.standardise(parts[1])
            return TrainingData(features, targets, parts[2], seeds, validation, angles=scaling.angle_count)

        validation = None if held is None else scaled([part[:, _tensor(held)] for part in every])
        training = train(learner, scaled(rows, validation), patience=patience, stop_at=stop_at)
        return learner, scaling, training

    def _make_settings(self) -> Any:
        """The learner's settings from the parameters of the same names, checked as those of a config are."""
        given = self.get_params(deep=False)
        values = {field.name: _plain(given[field.name]) for field in fields(self._settings) if field.name in given}
        if isinstance(values.get("hidden"), int):
            values["hidden"] = [values["hidden"]]
        try:
            return TypeAdapter(self._settings).validate_python(values)
        except ValidationError as error:
            wrong = [
                f"{'.'.join(map(str, item['loc']))}: {item['msg']}".removeprefix(": ").replace("Value error, ", "")
                for item in error.errors()
            ]
            raise ValueError(f"{type(self).__name__}: {'; '.join(wrong)}") from None

    def _periodic(self) -> NDArray[np.bool_]:
        """Which inputs are angles, `i`."""
        names = list(getattr(self, "feature_names_in_", []))
        chosen = np.zeros(self.n_features_in_, dtype=bool)
        for column in self.periodic or ():
            if isinstance(column, str) and column in names:
                chosen[names.index(column)] = True
            elif isinstance(column, int | np.integer) and 0 <= column < len(chosen):
                chosen[column] = True
            else:
                raise ValueError(
                    f"periodic: there is no column {column!r}; write indices from 0 to {len(chosen) - 1}"
                    + (f", or names out of {', '.join(names)}" if names else "")
                )
        return chosen

    def _shaped(self, outputs: Tensor) -> _Floats:
        return (outputs.squeeze(-1) if self._flat else outputs).numpy()


@dataclass(kw_only=True, eq=False, repr=False)
class SteppedRegressor(LearnerRegressor):
    """One whose learner improves step by step, so that rows held out can say when it is best."""

    early_stopping: bool = False
    validation_fraction: float = 0.2
    n_iter_no_change: int | None = None

    def _choose(
        self, inputs: _Floats, targets: _Floats, weights: _Floats, seed: int, generator: np.random.RandomState
    ) -> _Choice | None:
        if not self.early_stopping:
            return None
        if not 0 < self.validation_fraction < 1:
            raise ValueError(f"validation_fraction={self.validation_fraction} must lie between 0 and 1")
        if self.n_iter_no_change is not None and self.n_iter_no_change < 1:
            raise ValueError(f"n_iter_no_change={self.n_iter_no_change} must be at least 1, or None")
        count = max(1, round(self.validation_fraction * len(weights)))
        if len(weights) - count < 2:
            raise ValueError(
                f"early_stopping: of {len(weights)} different rows, {count} would be held out; at least 2 must be left "
                "to train on"
            )
        held = np.zeros(len(weights), dtype=bool)
        held[generator.permutation(len(weights))[:count]] = True
        learner, scaling, training = self._train(
            inputs, targets, weights, seed, held=held, patience=self.n_iter_no_change
        )
        self.validation_curve_ = training.history["error_validation"][:, 0].tolist()
        with torch.no_grad():
            found = learner.network(0)(scaling.features(_tensor(inputs[held]).unsqueeze(0)))
            residuals = _tensor(targets[held]) - scaling.restore(found)[0]
        return _Choice(training.best_step, inputs[held], residuals)


def _tensor(values: NDArray[Any]) -> Tensor:
    """A copy: arrays may be read-only memory maps."""
    return torch.from_numpy(np.array(values))


def _plain(value: Any) -> Any:
    """NumPy's numbers and arrays, as a search over parameters gives them, as Python's own."""
    if isinstance(value, np.generic | np.ndarray):
        return value.tolist()
    return [_plain(part) for part in value] if isinstance(value, list | tuple) else value


@dataclass(kw_only=True, eq=False, repr=False)
class CCNNRegressor(SteppedRegressor):
    """Cooperative coevolution of a masked network's layers, refined by Levenberg-Marquardt (Zhang and Gao 2012).

    By default hidden, rival_hidden, population, generations, members and refinement_iterations stay below what a run
    has, which takes about ten times as long and predicts somewhat better. All settings:
    `ccnn_torch.learners.ccnn.CCNNSettings`.

    Args:
        hidden: nodes of each hidden layer; a number is one layer.
        rival_hidden: hidden layers of a second structure; the one of higher evidence is taken. () = none.
        population: individuals of each subpopulation, one a layer.
        generations: steps.
        members: independent coevolutions, whose networks are averaged.
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
    queries: int = GRNNSettings.queries
    references: int = GRNNSettings.references
