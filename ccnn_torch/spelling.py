"""The name that a misspelt one most likely means, and the names that a pattern fits."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Sequence
from fnmatch import fnmatchcase


def nearest(name: str, candidates: Sequence[str], cutoff: float = 0.6) -> str | None:
    """The candidate most similar to a misspelt name, without regard to case; None if none is similar enough.

    Args:
        name: as it was written.
        candidates: the names that exist.
        cutoff: least similarity, 0 to 1, of `difflib.get_close_matches`.
    """
    folded = {candidate.lower(): candidate for candidate in reversed(candidates)}
    near = difflib.get_close_matches(name.lower(), folded, 1, cutoff)
    return folded[near[0]] if near else None


def matching(names: Iterable[str], patterns: Sequence[str]) -> list[str]:
    """The names that one of the patterns (`load_*`) fits, in their order."""
    return [name for name in names if any(fnmatchcase(name, pattern) for pattern in patterns)]


def hint(name: str, candidates: Sequence[str], otherwise: str = "there are", more: str = "") -> str:
    """What to write instead of a name that is none of the candidates: the nearest, or all of them after `otherwise`."""
    near = nearest(name, candidates)
    return f"did you mean '{near}'?" if near else f"{otherwise} {', '.join(candidates) or 'none'}{more}"


def nearest_hint(name: str, candidates: Sequence[str]) -> str:
    """The candidate that is meant, to follow a sentence; empty where none is similar enough."""
    near = nearest(name, candidates)
    return f"; '{near}' is the nearest" if near else ""
