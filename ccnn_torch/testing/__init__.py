"""Conformance checks for plug-ins, to be called from their tests; each raises AssertionError with one sentence."""

from ccnn_torch.testing._learner import check_learner as check_learner
