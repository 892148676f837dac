"""The scikit-learn estimators: scikit-learn's own checks, and what a user of pipelines and searches relies on."""

from __future__ import annotations

import inspect
import pickle
import re
import runpy
from dataclasses import fields
from pathlib import Path
from typing import Any

import joblib
import numpy as np
import pandas as pd
import pytest
import scipy.sparse
import torch
from sklearn.base import clone
from sklearn.model_selection import GridSearchCV, cross_val_score
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler
from sklearn.utils.estimator_checks import parametrize_with_checks

from ccnn_torch.learners import TrainingData
from ccnn_torch.sklearn import BPLMRegressor, CCNNRegressor, ENNRegressor, GRNNRegressor, SteppedRegressor
from ccnn_torch.training import Scaling, train

ROOT = Path(__file__).parent.parent
ESTIMATORS = [CCNNRegressor, BPLMRegressor, GRNNRegressor, ENNRegressor]
STEPPED = [kind for kind in ESTIMATORS if issubclass(kind, SteppedRegressor)]
# Settings for the tests that need no good model.
SMALL: dict[type[Any], dict[str, Any]] = {
    CCNNRegressor: {"generations": 4, "population": 12, "hidden": 6, "refinement_iterations": 10},
    BPLMRegressor: {"iterations": 6, "restarts": 2, "hidden": 4},
    GRNNRegressor: {"iterations": 4},
    ENNRegressor: {"generations": 30, "population": 20, "density": 0.7},
}
# And for those that fit again and again.
TINY: dict[type[Any], dict[str, Any]] = {
    CCNNRegressor: {"generations": 2, "population": 6, "members": 1, "refinement_iterations": 3},
    ENNRegressor: {"generations": 4, "population": 8},
}
GRIDS: dict[type[Any], dict[str, Any]] = {
    CCNNRegressor: {"hidden": [(4,), (6, 6)]},
    BPLMRegressor: {"hidden": [(3,), (3, 3)]},
    GRNNRegressor: {"candidates": [8, 32]},
    ENNRegressor: {"hidden": [4, (6, 6)]},
}
# Parameters whose default may be another than the run's, as the docstring says.
OTHER_DEFAULTS: dict[type[Any], set[str]] = {
    CCNNRegressor: {"hidden", "rival_hidden", "population", "generations", "members", "refinement_iterations"},
    BPLMRegressor: {"hidden", "restarts"},
    GRNNRegressor: set(),
    ENNRegressor: {"hidden", "population", "generations"},
}

every = pytest.mark.parametrize("kind", ESTIMATORS)
stepped = pytest.mark.parametrize("kind", STEPPED)


def small(kind: type[Any], **more: Any) -> Any:
    return kind(**(SMALL[kind] | more))


def tiny(kind: type[Any], **more: Any) -> Any:
    return small(kind, **(TINY.get(kind, {}) | more))


def smooth(rows: int, seed: int = 0, noise: float = 0.05) -> tuple[Any, Any]:
    """Two outputs of three inputs of very different sizes, as joint deviations in metres would be."""
    rng = np.random.default_rng(seed)
    u = rng.uniform(-1, 1, (rows, 3))
    clean = np.stack([np.sin(2 * u[:, 0]) + u[:, 1] * u[:, 2], u[:, 0] ** 2 - 0.5 * u[:, 1]], axis=1)
    return u * [0.1, 1.0, 100.0] + [5.0, 0.0, 0.0], 1e-5 * (3 + clean + noise * rng.standard_normal(clean.shape))


@pytest.fixture(autouse=True)
def _array_api(monkeypatch: pytest.MonkeyPatch) -> None:
    """scikit-learn leaves one of its checks out where this is not set."""
    monkeypatch.setenv("SCIPY_ARRAY_API", "1")


@parametrize_with_checks([tiny(kind) for kind in ESTIMATORS])
def test_checks_of_scikit_learn(estimator: Any, check: Any) -> None:
    # The one check that asks for a score, which a small ENN does not reach.
    scored = check.func.__name__ == "check_regressors_train" and isinstance(estimator, ENNRegressor)
    check(ENNRegressor() if scored else estimator)


@every
def test_parameters_are_settings_of_the_learner_with_the_defaults_that_the_docstring_says(kind: Any) -> None:
    settings = {field.name: field.default for field in fields(kind._settings)}
    bookkeeping = {"periodic", "random_state"}
    if kind in STEPPED:
        bookkeeping |= {"early_stopping", "validation_fraction", "n_iter_no_change"}
    own = {name: value for name, value in kind().get_params().items() if name not in bookkeeping}
    assert {name for name, value in own.items() if value != settings[name]} <= OTHER_DEFAULTS[kind]
    summary, _, described = (inspect.getdoc(kind) or "").partition("Args:")
    assert all(re.search(rf"\b{name}\b", described) for name in own)
    assert all(re.search(rf"\b{name}\b", summary) for name in OTHER_DEFAULTS[kind])


@every
def test_the_model_is_that_of_the_learner_trained_directly(kind: Any) -> None:
    X, y = smooth(30)
    regressor = tiny(kind, random_state=np.random.RandomState(5)).fit(X, y)
    seed = int(np.random.RandomState(5).randint(np.iinfo(np.int32).max))
    order = np.lexsort(np.concatenate([X, y], axis=1).T[::-1])
    inputs, targets = torch.as_tensor(X[order])[None], torch.as_tensor(y[order])[None]
    weights = torch.ones(1, 30, dtype=torch.float64)
    scaling = Scaling.fit(inputs, targets, weights, torch.zeros(3, dtype=torch.bool))
    learner = kind._learner(regressor._make_settings())
    data = TrainingData(scaling.features(inputs), scaling.standardise(targets), weights, torch.tensor([seed]))
    training = train(learner, data)
    fresh = torch.as_tensor(smooth(20, seed=1)[0])[None]
    expected = scaling.restore(learner.predict(scaling.features(fresh)))[0].numpy()
    np.testing.assert_allclose(regressor.predict(fresh[0].numpy()), expected, rtol=1e-9)
    variance = learner.variance(scaling.features(fresh))[0]
    expected = (variance.sqrt() * scaling.deviation[0]).numpy()
    np.testing.assert_allclose(regressor.predict(fresh[0].numpy(), return_std=True)[1], expected, rtol=1e-9)
    assert regressor.n_iter_ == training.step == len(regressor.loss_curve_)


@every
def test_held_out_rows_are_predicted_far_better_than_by_their_mean(kind: Any) -> None:
    X, y = smooth(150)
    fresh, truth = smooth(400, seed=1)
    regressor = kind().fit(X, y)
    assert regressor.score(fresh, truth) > (0.5 if kind is ENNRegressor else 0.85)
    mean, deviation = regressor.predict(fresh, return_std=True)
    assert mean.shape == deviation.shape == truth.shape and (deviation > 0).all()
    covered = (np.abs(mean - truth) < 1.96 * deviation).mean()
    assert 0.85 < covered <= 1
    alone = small(kind).fit(X, y[:, 0])
    mean, deviation = alone.predict(fresh, return_std=True)
    assert mean.shape == deviation.shape == (400,) and (deviation > 0).all()


@every
def test_a_weight_is_a_number_of_rows_and_order_does_not_matter(kind: Any) -> None:
    X, y = smooth(24)
    rng = np.random.default_rng(2)
    weight = rng.integers(0, 4, 24)
    again = rng.permutation(np.repeat(np.arange(24), weight))
    for more in ({}, {"early_stopping": True}) if kind in STEPPED else ({},):
        weighted = tiny(kind, **more).fit(X, y, sample_weight=weight)
        repeated = tiny(kind, **more).fit(X[again], y[again])
        np.testing.assert_array_equal(weighted.predict(X), repeated.predict(X))
        assert np.abs(weighted.predict(X) - tiny(kind, **more).fit(X, y).predict(X)).max() > 0


@every
def test_a_fit_depends_on_the_seed_alone_and_leaves_global_generators_alone(kind: Any) -> None:
    X, y = smooth(30)
    np.random.seed(3)  # noqa: NPY002 - what scikit-learn takes for random_state=None
    before = np.random.get_state()[1].tolist(), torch.random.get_rng_state().tolist()  # noqa: NPY002
    one, two, other = (tiny(kind, random_state=seed).fit(X, y) for seed in (1, 1, 2))
    assert before == (np.random.get_state()[1].tolist(), torch.random.get_rng_state().tolist())  # noqa: NPY002
    np.testing.assert_array_equal(one.predict(X), two.predict(X))
    if kind in STEPPED:
        assert np.abs(one.predict(X) - other.predict(X)).max() > 0
    drawn = tiny(kind, random_state=None).fit(X, y)
    np.random.seed(3)  # noqa: NPY002
    np.testing.assert_array_equal(drawn.predict(X), tiny(kind, random_state=None).fit(X, y).predict(X))


@every
def test_pickled_and_dumped_estimators_predict_the_same(kind: Any, tmp_path: Path) -> None:
    X, y = smooth(30)
    regressor = tiny(kind).fit(X, y)
    joblib.dump(regressor, tmp_path / "regressor.joblib")
    for copy in (pickle.loads(pickle.dumps(regressor)), joblib.load(tmp_path / "regressor.joblib")):
        for one, two in zip(regressor.predict(X, return_std=True), copy.predict(X, return_std=True), strict=True):
            np.testing.assert_array_equal(one, two)
    # The model alone is kept, not the learner with its populations and training rows.
    assert len(pickle.dumps(regressor)) < 60_000
    assert not hasattr(clone(regressor), "network_")


@every
def test_pipelines_and_searches(kind: Any) -> None:
    X, y = smooth(60)
    frame = pd.DataFrame(X, columns=["q1", "q2", "q3"])
    pipeline = make_pipeline(StandardScaler(), small(kind)).set_output(transform="pandas")
    pipeline.fit(frame, y)
    assert list(pipeline[-1].feature_names_in_) == ["q1", "q2", "q3"]
    assert pipeline.score(frame, y) > 0
    with pytest.raises(ValueError, match="feature names"):
        pipeline[-1].predict(frame.rename(columns={"q1": "x"}))
    pipeline = make_pipeline(StandardScaler(), tiny(kind)).set_output(transform="pandas")
    scores = cross_val_score(pipeline, frame, y, cv=2)
    assert scores.shape == (2,) and np.isfinite(scores).all()
    name, values = next(iter(GRIDS[kind].items()))
    search = GridSearchCV(pipeline, {f"{kind.__name__.lower()}__{name}": values}, cv=2).fit(frame, y)
    assert np.isfinite(search.cv_results_["mean_test_score"]).all()
    assert search.best_params_[f"{kind.__name__.lower()}__{name}"] in values


@every
def test_periodic_inputs_have_no_seam(kind: Any) -> None:
    rng = np.random.default_rng(0)
    X = rng.uniform(-np.pi, np.pi, (80, 2))
    y = np.sin(X[:, 0]) + 0.3 * X[:, 1]
    turned = X + np.array([2 * np.pi, 0])
    # A wave may have any period.
    more = {"waves": 0} if kind is CCNNRegressor else {}
    regressor = small(kind, periodic=[0], **more).fit(X, y)
    np.testing.assert_allclose(regressor.predict(X), regressor.predict(turned), atol=1e-9)
    assert np.abs(small(kind).fit(X, y).predict(X) - small(kind).fit(X, y).predict(turned)).max() > 1e-3
    named = small(kind, periodic=["a"], **more).fit(pd.DataFrame(X, columns=["a", "b"]), y)
    np.testing.assert_array_equal(named.predict(pd.DataFrame(X, columns=["a", "b"])), regressor.predict(X))
    for wrong in ("a", 2, -1, 0.5):
        with pytest.raises(ValueError, match=r"periodic: there is no column .*; write indices from 0 to 1"):
            small(kind, periodic=[wrong]).fit(X, y)


@stepped
def test_early_stopping_takes_the_step_of_lowest_error_on_the_rows_held_out(kind: Any) -> None:
    X, y = smooth(40)
    regressor = small(kind, early_stopping=True, validation_fraction=0.3).fit(X, y)
    assert regressor.n_iter_ == 1 + int(np.argmin(regressor.validation_curve_)) == len(regressor.loss_curve_)
    short = small(kind, early_stopping=True, validation_fraction=0.3, n_iter_no_change=1).fit(X, y)
    best = int(np.argmin(short.validation_curve_))
    assert short.n_iter_ == 1 + best
    assert (np.diff(short.validation_curve_[: best + 1]) < 0).all()
    for wrong in ({"validation_fraction": 1.0}, {"n_iter_no_change": 0}):
        with pytest.raises(ValueError, match=next(iter(wrong))):
            small(kind, early_stopping=True, **wrong).fit(X, y)
    with pytest.raises(ValueError, match="of 2 different rows, 1 would be held out"):
        small(kind, early_stopping=True).fit(X[:2], y[:2])


@stepped
def test_intervals_are_as_wide_as_the_errors_on_rows_held_out(kind: Any) -> None:
    X, y = smooth(60)
    fresh, truth = smooth(400, seed=1)
    regressor = small(kind, early_stopping=True, validation_fraction=0.4).fit(X, y)
    mean, deviation = regressor.predict(fresh, return_std=True)
    covered, narrow = ((np.abs(mean - truth) < 1.96 * share * deviation).mean() for share in (1, 0.4))
    assert covered > 0.85 and narrow < 0.85
    scale = regressor.sd_scale_.copy()
    assert scale.shape == (2,)
    regressor.sd_scale_ = np.array([1.0, 3.0])
    np.testing.assert_allclose(regressor.predict(fresh, return_std=True)[1], deviation / scale * [1.0, 3.0])


@every
def test_what_cannot_be_used_is_named(kind: Any) -> None:
    X, y = smooth(20)
    with pytest.raises(ValueError, match="at least two weights must be above zero"):
        tiny(kind).fit(X, y, sample_weight=np.eye(20)[0])
    with pytest.raises(ValueError, match=r"[Nn]egative"):
        tiny(kind).fit(X, y, sample_weight=-np.ones(20))
    with pytest.raises((ValueError, TypeError), match=r"[Ss]parse"):
        tiny(kind).fit(X, scipy.sparse.csr_array(y))
    with pytest.raises(ValueError, match="dim 3"):
        tiny(kind).fit(X, y[:, :, None])
    name = next(iter(SMALL[kind]))
    for wrong in ("many", 0):
        with pytest.raises(ValueError, match=f"{kind.__name__}: {name}"):
            tiny(kind, **{name: wrong}).fit(X, y)


@every
def test_odd_rows_give_finite_predictions(kind: Any) -> None:
    X, y = smooth(12)
    cases = (
        (X[:2], y[:2]),
        (np.repeat(X[:1], 5, axis=0), y[:5]),
        (np.repeat(X[:1], 5, axis=0), np.repeat(y[:1], 5, axis=0)),
        (X, np.ones((12, 2))),
        (np.concatenate([X, X * 0], axis=1), y * 1e12),
    )
    for inputs, targets in cases:
        regressor = tiny(kind).fit(inputs, targets)
        far = 1e6 * np.ones((1, inputs.shape[1]))
        for rows in (inputs, far):
            mean, deviation = regressor.predict(rows, return_std=True)
            assert np.isfinite(mean).all() and np.isfinite(deviation).all() and (deviation > 0).all()
    with pytest.raises(ValueError, match="1 sample"):
        tiny(kind).fit(X[:1], y[:1])


def test_the_page_shows_the_example_and_it_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    example = ROOT / "experiments" / "scikit_learn.py"
    code = example.read_text().partition('"""\n\n')[2]
    assert f"```python\n{code}```" in (ROOT / "docs" / "how_to" / "scikit_learn.md").read_text()
    monkeypatch.chdir(tmp_path)
    (tmp_path / "example.py").write_text(example.read_text().replace("KFold(3", "KFold(2"))
    runpy.run_path("example.py")
    told = capsys.readouterr().out
    errors = {name: float(error) for name, error in re.findall(r"(\w+Regressor): ([\d.]+) µm held out", told)}
    assert errors.keys() == {"DummyRegressor", *(kind.__name__ for kind in ESTIMATORS)}
    assert max(errors, key=lambda name: errors[name]) == "DummyRegressor"
    assert "best {" in told and [path.name for path in tmp_path.iterdir()] == ["example.py"]


def test_the_rest_of_the_package_does_without_scikit_learn() -> None:
    needs = re.compile(r"^\s*(from|import) (sklearn|ccnn_torch\.sklearn)", re.MULTILINE)
    files = sorted((ROOT / "ccnn_torch").rglob("*.py"))
    assert {path.parent.name for path in files if needs.search(path.read_text())} == {"sklearn"}
