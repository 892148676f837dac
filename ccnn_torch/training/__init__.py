"""One trainer for every learner: scaling, loop, callbacks, checkpoints."""

from ccnn_torch.training.callbacks import Callback as Callback
from ccnn_torch.training.checkpoint import (
    load_checkpoint as load_checkpoint,
    save_checkpoint as save_checkpoint,
    tensor_digest as tensor_digest,
)
from ccnn_torch.training.scaling import Scaling as Scaling
from ccnn_torch.training.trainer import (
    Training as Training,
    past_of as past_of,
    train as train,
    weighted_mse as weighted_mse,
)
