"""One trainer for every learner: scaling, loop, callbacks, checkpoints, metrics."""

from ccnn_torch.training._scaling import Scaling as Scaling
