"""
The learners in scikit-learn
============================

The learners are scikit-learn estimators: cross-validation, pipelines and searches work as usual.
"""

import matplotlib.pyplot as plt
from sklearn.dummy import DummyRegressor
from sklearn.model_selection import KFold, cross_val_score

from ccnn_torch.simulation.case_study import build_case
from ccnn_torch.sklearn import BPLMRegressor, GRNNRegressor

case = build_case("tripod")
X = case.joints.numpy()  # q1, q2, q3 [m]
y = (case.learnable + case.noise([0])[0]).numpy()  # deviation of each joint [m]

folds = KFold(5, shuffle=True, random_state=0)
regressors = [DummyRegressor(), BPLMRegressor(), GRNNRegressor()]
scores = [-cross_val_score(r, X, y, cv=folds, scoring="neg_root_mean_squared_error") for r in regressors]

# %%
# Root mean squared error on the held-out folds. The noise of the case is 10 µm.
figure, axes = plt.subplots(figsize=(5, 3), layout="constrained")
axes.boxplot([1e6 * s for s in scores], tick_labels=[type(r).__name__ for r in regressors])
axes.axhline(10, color="grey", linestyle="--", label="noise")
axes.set(ylabel="error [µm]", ylim=(0, None))
axes.legend()
plt.show()
