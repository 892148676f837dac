"""Compare the learners by cross-validation, search a setting, and predict with error bars, all in scikit-learn."""

from sklearn.dummy import DummyRegressor
from sklearn.model_selection import GridSearchCV, KFold, cross_val_score

from ccnn_torch.simulation.case_study import build_case
from ccnn_torch.sklearn import BPLMRegressor, CCNNRegressor, ENNRegressor, GRNNRegressor

case = build_case("tripod")
X = case.joints.numpy()  # q1, q2, q3 [m]
y = (case.learnable + case.noise([0])[0]).numpy()  # deviation of each joint [m]

folds = KFold(3, shuffle=True, random_state=0)
for regressor in (DummyRegressor(), CCNNRegressor(), BPLMRegressor(), GRNNRegressor(), ENNRegressor()):
    error = -cross_val_score(regressor, X, y, cv=folds, scoring="neg_root_mean_squared_error").mean()
    print(f"{type(regressor).__name__}: {1e6 * error:.1f} µm held out")

search = GridSearchCV(BPLMRegressor(), {"hidden": [(3,), (10,)]}, cv=folds).fit(X, y)
deviation, sd = search.best_estimator_.predict(X[:1], return_std=True)
print(f"best {search.best_params_}; first pose {(1e6 * deviation[0]).round(1)} µm, sd {(1e6 * sd[0]).round(1)} µm")
