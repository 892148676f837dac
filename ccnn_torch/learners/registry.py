"""Learners by the names that configs use."""

from __future__ import annotations

import difflib
from collections.abc import Callable
from typing import Any, cast

from ccnn_torch.errors import InputError
from ccnn_torch.evolution.settings import CCNNSettings, ENNSettings
from ccnn_torch.learners.bp_lm import BPLM, BPLMSettings
from ccnn_torch.learners.ccnn import CCNN
from ccnn_torch.learners.constant import Constant
from ccnn_torch.learners.enn import ENN
from ccnn_torch.learners.gp import GaussianProcess, GPSettings
from ccnn_torch.learners.grnn import GRNN, GRNNSettings
from ccnn_torch.learners.protocol import Learner, missing_verbs
from ccnn_torch.plugins import is_plugin, load_plugin

LEARNERS: dict[str, Callable[[dict[str, Any]], Learner]] = {
    "ccnn": lambda settings: CCNN(CCNNSettings(**settings)),
    "bp_lm": lambda settings: BPLM(BPLMSettings(**settings)),
    "grnn": lambda settings: GRNN(GRNNSettings(**settings)),
    "enn": lambda settings: ENN(ENNSettings(**settings)),
    "constant": lambda settings: Constant(),
    "gp": lambda settings: GaussianProcess(GPSettings(**settings)),
}
"""Name -> maker from the settings of the config's section of that name."""


def make_learner(name: str, settings: dict[str, Any] | None = None) -> Learner:
    """A fresh learner, by name or from a user's `path/to/file.py:Name` (a class that is called without arguments).

    Raises:
        InputError: no learner has this name, or what the file has is no learner.
    """
    if is_plugin(name):
        learner = load_plugin(name)()
        missing = missing_verbs(learner)
        if missing:
            raise InputError(
                f"methods: {name} is no learner, it lacks {', '.join(missing)} "
                "(ccnn_torch.testing.check_learner checks the whole protocol of a learner)"
            )
        return cast(Learner, learner)
    if name not in LEARNERS:
        near = difflib.get_close_matches(name, LEARNERS, 1)
        hint = f"; did you mean {near[0]!r}?" if near else ""
        raise InputError(f"methods: {name!r} is no learner of this version, which has {', '.join(LEARNERS)}{hint}")
    return LEARNERS[name](settings or {})
