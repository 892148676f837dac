"""Checks that make an identification impossible, before it is tried."""

from __future__ import annotations

import torch

from ccnn_torch.errors import InputError
from ccnn_torch.identification.problems.problem import Problem


def check_equations(problem: Problem) -> None:
    """Refuse a problem with fewer equations than parameters; a prior counts as one equation."""
    rows = int((problem.weights > 0).sum(-1).min())
    channels, k = len(problem.channels), len(problem.parameters)
    held = int(torch.isfinite(problem.prior_sd).sum())
    if rows * channels + held < k:
        needed = -(-(k - held) // channels)
        raise InputError(
            f"{rows} rows of {channels} equations{f' and {held} priors' if held else ''} cannot determine {k} free "
            f"parameters; measure at least {needed} poses, or fix parameters"
        )
