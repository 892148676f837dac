"""Base class of the estimators: checks of the data, scaling, training, prediction."""

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

from ccnn_torch.calibration.learning.uncertainty import sd_scale
from ccnn_torch.learners import Learner, TrainingData
from ccnn_torch.training import Scaling, Training, train

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
