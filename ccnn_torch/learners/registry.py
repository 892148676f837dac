"""Learners by the names that configs use."""

from __future__ import annotations

from collections.abc import Callable
from typing import cast

from ccnn_torch.errors import InputError
from ccnn_torch.learners.bp_lm import BPLM
from ccnn_torch.learners.ccnn import CCNN
from ccnn_torch.learners.constant import Constant
from ccnn_torch.learners.enn import ENN
from ccnn_torch.learners.gp import GaussianProcess
from ccnn_torch.learners.grnn import GRNN
from ccnn_torch.learners.protocol import Learner, missing_verbs
from ccnn_torch.plugins import is_plugin, load_plugin
from ccnn_torch.spelling import hint

LEARNERS: dict[str, Callable[..., Learner]] = {
    "ccnn": CCNN,
    "bp_lm": BPLM,
    "grnn": GRNN,
    "enn": ENN,
    "constant": Constant,
    "gp": GaussianProcess,
}
"""Name -> class, called without arguments or with its settings."""


def make_learner(name: str, settings: object = None) -> Learner:
    """A fresh learner, by name or from a user's `path/to/file.py:Name` (a class that is called without arguments).

    Args:
        settings: the section of a run's config that has the learner's name; None = its defaults.

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
        near = hint(name, [*LEARNERS], "it has")
        raise InputError(f"methods: '{name}' is no learner of this version; {near}")
    return LEARNERS[name]() if settings is None else LEARNERS[name](settings)
