"""The learners as scikit-learn regressors."""

from ccnn_torch.sklearn.regressors import BPLMRegressor as BPLMRegressor
from ccnn_torch.sklearn.regressors import CCNNRegressor as CCNNRegressor
from ccnn_torch.sklearn.regressors import ENNRegressor as ENNRegressor
from ccnn_torch.sklearn.regressors import GRNNRegressor as GRNNRegressor
