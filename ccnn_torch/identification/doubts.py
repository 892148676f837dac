"""Warnings about an identification, one sentence each."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from scipy.stats import chi2

from ccnn_torch.display import display_unit, number_text

# Residuals that chance makes as rarely as this do not fit the noise given; a ratio this near 1 is nothing to speak of.
_RARE, _NEAR = 1e-3, 1.5
# Held-out errors above so many times the noise, or this share of the error before, say that something else is wrong.
_ABOVE_NOISE, _LITTLE_GAINED = 10.0, 0.5
# An error within so many times the noise has nothing left to gain.
_AT_NOISE = 2.0


def doubts_of(
    test: Mapping[str, Any], ratio: float | None, freedom: float, noise: float | None, noise_given: bool
) -> list[str]:
    """Whether the rows contradict the noise given, and whether too much is left of the held-out error.

    Args:
        test: `position` of before and after, as in `identified.json`.
        ratio: standard deviation of the residual over the noise given [1].
        freedom: equations to spare.
        noise: of a measured position, all coordinates together [m]; None where it is not known.
        noise_given: whether `ratio` compares with a noise that the config names.
    """
    said = []
    if noise_given and ratio is not None and math.isfinite(ratio) and freedom > 0:
        chance = chi2.sf(ratio**2 * freedom, freedom) if ratio > 1 else chi2.cdf(ratio**2 * freedom, freedom)
        if chance < _RARE and ratio > _NEAR:
            said.append(
                f"The noise given does not fit the rows: their residuals are {ratio:.3g} times as large, so that the "
                "noise is larger or more than the geometry is wrong, and the standard deviations are too small."
            )
        elif chance < _RARE and ratio < 1 / _NEAR:
            said.append(
                f"The noise given does not fit the rows: their residuals are {ratio:.2g} times as large, so that the "
                "noise is smaller and the standard deviations are too large."
            )
    position = test["position"]
    before, after = (None, None) if position is None else (position["before"], position["after"])
    if before is None or after is None or (noise is not None and after <= _AT_NOISE * noise):
        return said
    if noise is not None and after > _ABOVE_NOISE * noise:
        said.append(
            f"The held-out position error is still {after / noise:.3g} times the noise ({_length(after)}, "
            f"{_length(noise)}): something else is wrong beside the geometry that was identified."
        )
    if before > 0 and after > _LITTLE_GAINED * before:
        said.append(
            f"The held-out position error is still {100 * after / before:.0f} % of what it was: what was identified "
            "explains little of it."
        )
    return said


def _length(value: float) -> str:
    scale, unit = display_unit("m", value)
    return f"{number_text(value / scale, 3)} {unit}"
