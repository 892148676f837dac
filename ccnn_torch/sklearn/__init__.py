"""The learners as scikit-learn regressors."""

from ccnn_torch.sklearn.regressors import (
    BPLMRegressor as BPLMRegressor,
    CCNNRegressor as CCNNRegressor,
    ENNRegressor as ENNRegressor,
    GRNNRegressor as GRNNRegressor,
)
