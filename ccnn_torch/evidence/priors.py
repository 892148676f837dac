"""Prior odds of sets of causes, before any data."""

from __future__ import annotations

import math

EFFECT = math.log(0.1)
"""Log prior odds of one library effect: one machine in ten has a given one."""
OUTSIDE = math.log(1e-3)
"""Log prior odds of a discrepancy term: a hundred times rarer than a library effect."""
WIDE = 10.0
"""Plausible sizes that what is not judged may have (standard deviation): it takes what it can explain."""
_CROWD = math.log(0.1)


def crowd(count: int) -> float:
    """Log prior odds of so many causes at once beside those of each: every one beyond the second is rarer still."""
    return _CROWD * max(count - 2, 0)
