"""Priors of geometric parameters in a config. Apart from `sizes`, which need nothing of the identification."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from ccnn_torch.config.sizes import Size, size
from ccnn_torch.coordinates import Parameter
from ccnn_torch.identification.problems.parameters import match_parameters


def prior_sizes(given: Mapping[str, Size], geometry: Sequence[Parameter], key: str) -> dict[str, float]:
    """Standard deviation of each prior [SI] by its name or pattern; a text has the unit of what it fits.

    Raises:
        InputError: a pattern that fits nothing, an entry that is no size, or a unit of another kind than that of a
            parameter that it fits.
    """
    units = {p.name: p.unit for p in geometry}
    found = {}
    for pattern, value in given.items():
        fits = match_parameters(geometry, [pattern], key.partition(".")[2])
        kinds = list(dict.fromkeys(units[p.name] for p in geometry if p.name in fits))
        # Converted for every unit that the pattern matches, so that no mismatch is missed.
        found[pattern] = max(size(value, unit, f"{key}.{pattern}") for unit in kinds)
    return found
