"""Conformance checks for plug-ins: each raises AssertionError with a sentence that names the mistake."""

from ccnn_torch.testing.effect import check_effect as check_effect, check_motion_effect as check_motion_effect
from ccnn_torch.testing.learner import check_learner as check_learner
from ccnn_torch.testing.mechanism import check_mechanism as check_mechanism
