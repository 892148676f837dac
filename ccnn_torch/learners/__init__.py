"""Learners behind one protocol, one file each."""

from ccnn_torch.doors import door

TYPE_CHECKING = False
if TYPE_CHECKING:
    from ccnn_torch.learners.protocol import Learner as Learner, TrainingData as TrainingData
    from ccnn_torch.learners.registry import LEARNERS as LEARNERS, make_learner as make_learner
else:
    __getattr__, __all__ = door(__name__)
