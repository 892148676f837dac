"""How well the values of a nominal model and the time stamps of its logs are known."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from ccnn_torch.errors import InputError
from ccnn_torch.spelling import nearest_hint
from ccnn_torch.units import amount

TIME, _WEIGHT = "time", ("gravity_sin", "gravity_cos")
_SAME = (
    *("gain", "integral", "derivative", "forward", "inertia", "viscous", "coulomb", "load_friction", "stribeck"),
    "delay",
)
OF: dict[str, tuple[str, ...]] = {name: (name,) for name in _SAME} | {"mass": _WEIGHT, "torque_limit": ("weakness",)}
"""What of a model may be off, by its key, and the parameters of an axis that it is; of the load's mass its weight."""
VALUE = 0.03
"""Share to which a value is known (standard deviation) unless that is told."""
# The same of time stamps, as a share of a sampling step.
_STAMP = 0.1


def share_of(known: Mapping[str, float], key: str) -> float:
    """Share to which a value is known; of time stamps a share of the sampling step."""
    return known.get(key, _STAMP if key == TIME else VALUE)


def shares_of(exact: Sequence[str] = (), known: Mapping[str, float | str] | None = None) -> dict[str, float]:
    """Shares by key.

    Args:
        exact: keys of what is exact.
        known: shares of others, as numbers or texts such as `2 %`.

    Raises:
        InputError: there is no such key, it is given twice, or its share is none.
    """
    names = [*OF, TIME]
    for place, key in [*(("exact", key) for key in exact), *(("known", key) for key in known or {})]:
        if key not in names:
            raise InputError(
                f"{place}: there is no value '{key}'{nearest_hint(key, names)}; there are {', '.join(names)}"
            )
    found = dict.fromkeys(exact, 0.0)
    for key, value in (known or {}).items():
        if key in found:
            raise InputError(f"known.{key}: it stands in exact as well; write it in one of the two")
        found[key] = amount(value, "1", f"known.{key}") if isinstance(value, str) else float(value)
        if not 0 <= found[key] < 1:
            raise InputError(f"known.{key}: must be a share from 0 up to below 1, such as 2 %, not {value}")
    return found


def allowed_text(shares: Mapping[str, float]) -> str:
    """Up to what values and time stamps are taken to be known, `gain 3 %, time 10 % of a step`."""
    step = {TIME: " of a step"}
    return ", ".join(f"{n} {100 * share:.3g} %{step.get(n, '')}" for n, share in shares.items() if share)
