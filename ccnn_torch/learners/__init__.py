"""Learners behind one protocol, one file each."""

from ccnn_torch.learners.protocol import Learner as Learner
from ccnn_torch.learners.protocol import TrainingData as TrainingData
from ccnn_torch.learners.registry import LEARNERS as LEARNERS
from ccnn_torch.learners.registry import make_learner as make_learner
