"""One trainer for every learner: scaling, loop, callbacks, checkpoints."""

from ccnn_torch.learners.protocol import weighted_mse as weighted_mse
from ccnn_torch.training.scaling import Scaling as Scaling
from ccnn_torch.training.trainer import (
    Callback as Callback,
    Training as Training,
    load_checkpoint as load_checkpoint,
    save_checkpoint as save_checkpoint,
    tensor_digest as tensor_digest,
    train as train,
)
