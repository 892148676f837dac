"""Conformance checks for plug-ins, to be called from their tests; each raises AssertionError with one sentence."""

from ccnn_torch.testing._mechanism import check_mechanism as check_mechanism
