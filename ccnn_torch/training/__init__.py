"""One trainer for every learner: scaling, loop, callbacks, checkpoints."""

from ccnn_torch.training.callbacks import Callback as Callback
from ccnn_torch.training.checkpoint import load_checkpoint as load_checkpoint
from ccnn_torch.training.checkpoint import save_checkpoint as save_checkpoint
from ccnn_torch.training.checkpoint import tensor_digest as tensor_digest
from ccnn_torch.training.scaling import Scaling as Scaling
from ccnn_torch.training.trainer import Training as Training
from ccnn_torch.training.trainer import past_of as past_of
from ccnn_torch.training.trainer import train as train
from ccnn_torch.training.trainer import weighted_mse as weighted_mse
