"""Learners: what the trainer drives. Protocol in `_protocol.py`, one file a learner."""

from ccnn_torch.learners._protocol import Learner as Learner
from ccnn_torch.learners._protocol import TrainingData as TrainingData
from ccnn_torch.learners._registry import LEARNERS as LEARNERS
from ccnn_torch.learners._registry import make_learner as make_learner
