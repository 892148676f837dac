"""Gross outliers for simulated records."""

from __future__ import annotations

import torch
from torch import Tensor

from ccnn_torch.errors import InputError
from ccnn_torch.simulation.acting import Wanted

_KEYS = {"share": (0.03, "share of the rows"), "size": (1e-3, "standard deviation, in m and rad")}


def bad_rows(
    wanted: Wanted, rows: int, channels: int, generator: torch.Generator
) -> tuple[Tensor, Tensor, dict[str, tuple[float, str]]]:
    """Gross errors of a share of the rows.

    Returns:
        Numbers of the rows, ascending; the displacements of their frames, `rows x c` [m, rad]; and the parameters.

    Raises:
        InputError: a parameter that does not exist or is out of range.
    """
    values = {}
    for name, text in wanted.values.items():
        try:
            values[name] = float(text)
        except ValueError:
            raise InputError(f"--effect outlier: {name}={text} is no number") from None
    wrong = sorted(set(values) - set(_KEYS))
    if wrong:
        known = ", ".join(f"{key} ({meaning})" for key, (_, meaning) in _KEYS.items())
        raise InputError(f"--effect outlier: it has no parameter '{wrong[0]}'; it has {known}")
    share, size = (values.get(key, default) for key, (default, _) in _KEYS.items())
    if not (0 < share <= 0.5 and size > 0):
        raise InputError("--effect outlier: share must be above 0 and at most 0.5, size above 0")
    count = max(round(share * rows), 1)
    chosen = torch.randperm(rows, generator=generator)[:count].sort().values
    added = torch.zeros(rows, channels, dtype=torch.float64)
    added[chosen] = size * torch.randn(count, channels, generator=generator, dtype=torch.float64)
    return chosen, added, {"share": (share, "1"), "size": (size, "m, rad")}
