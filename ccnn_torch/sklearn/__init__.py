"""The learners as scikit-learn regressors."""

from ccnn_torch.sklearn._regressors import BPLMRegressor as BPLMRegressor
from ccnn_torch.sklearn._regressors import CCNNRegressor as CCNNRegressor
from ccnn_torch.sklearn._regressors import ENNRegressor as ENNRegressor
from ccnn_torch.sklearn._regressors import GRNNRegressor as GRNNRegressor
