"""Check of every output of a model against the limits of its card."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ccnn_torch.compensation.machine import FARTHEST
from ccnn_torch.coordinates import Coordinate
from ccnn_torch.errors import InputError

Array = NDArray[Any]

# From here an input counts as infinite; as in a `Domain`, but for the joints of a machine.
_HUGE = 1e300
# Of the limit: how far command + deviation may be from the joints, and of the half range: from the domain's edge.
# Exports agree with their master to 1e-9 of the limit.
_SLACK = 1e-6
_EDGE = 1e-9


@dataclass(frozen=True)
class Promise:
    """What holds for every row of a model with n joints and d inputs, the joints first.

    Attributes:
        limit: of |deviation|, `n` [SI]: the card's `most_deviation`.
        sd: standard deviation where the deviation is taken as 0, `n` [SI].
        huge: magnitude from which an input counts as infinite, `d` [SI].
        centre, low, high: replacements of an input that is no number, and for an infinite one, `d` [SI].
        half_range: unit of the rows of `directions`, `d` [SI].
        directions: `k x d` [1], with `least` and `most`, `k` [1]: inside the domain, directions · (x - centre) /
            half_range is between the two.
    """

    limit: Array
    sd: Array
    huge: Array
    centre: Array
    low: Array
    high: Array
    half_range: Array
    directions: Array
    least: Array
    most: Array

    @classmethod
    def of_card(cls, facts: Mapping[str, Any]) -> Promise:
        """Out of facts of the right form (`read_facts`, `description_of`)."""
        domain, principal = facts["domain"], facts["domain"]["principal"]
        # By name: JSON has its keys in another order.
        edges = [domain["inputs"][c["name"]] for c in facts["joints"] + facts["covariates"]]
        limits = [facts["limits"][c["name"]] for c in facts["joints"]]
        low, high = (np.array([edge[k] for edge in edges], dtype=float) for k in ("low", "high"))
        # As floats at once: of an integer of more than 64 bits numpy makes an object, which has no `hypot`.
        centre, half_range, least, most = (
            np.array(principal[k], dtype=float) for k in ("centre", "half_range", "low", "high")
        )
        limit, safe, sd = (
            np.array([entry[k] for entry in limits], dtype=float)
            for k in ("most_deviation", "safe_correction", "safe_sd")
        )
        huge = np.full(len(centre), _HUGE)
        if "machine" in facts:
            huge[: len(limits)] = FARTHEST
        return cls(
            limit,
            np.hypot(safe, sd),
            huge,
            centre,
            low,
            high,
            half_range,
            np.concatenate([np.eye(len(centre)), np.array(principal["directions"], dtype=float)]),
            np.concatenate([(low - centre) / half_range, least]),
            np.concatenate([(high - centre) / half_range, most]),
        )

    def cleaned(self, inputs: Array) -> tuple[Array, Array]:
        """Finite inputs `s x d` [SI], as a `Domain` makes them, and which were not, `s x d`, bool."""
        strange = ~(np.abs(inputs) < self.huge)
        edge = np.where(np.isnan(inputs), self.centre, np.where(inputs > 0, self.high, self.low))
        return np.where(strange, edge, inputs), strange

    def inside(self, inputs: Array) -> Array:
        """Whether inputs `s x d` [SI] are in the domain, `s`, bool."""
        y = ((inputs - self.centre) / self.half_range) @ self.directions.T
        return np.asarray(((y >= self.least - _EDGE) & (y <= self.most + _EDGE)).all(-1))


def as_matrix(values: ArrayLike, wanted: tuple[Coordinate, ...], what: str) -> Array:
    """Rows of what a caller gives, `... x len(wanted)` [SI]."""
    names = ", ".join(c.header for c in wanted)
    try:
        array = np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError):
        raise InputError(f"the model takes numbers, the {what} {names} as last dimension") from None
    if array.ndim == 0 or array.shape[-1] != len(wanted):
        raise InputError(f"the model takes the {what} {names} as last dimension; got the shape {array.shape}")
    return array


def as_rows(
    joints: ArrayLike,
    covariates: ArrayLike | None,
    coordinates: tuple[tuple[Coordinate, ...], tuple[Coordinate, ...]],
) -> tuple[Array, Array | None, tuple[int, ...]]:
    """Rows of joints `s x n`, of covariates `s x m` (None where the model has none), and the leading dimensions.

    Args:
        coordinates: joints and covariates of the model, in order.

    Raises:
        InputError: covariates are missing, or a last dimension is wrong.
    """
    given = as_matrix(joints, coordinates[0], "joints")
    lead, flat = given.shape[:-1], None
    if coordinates[1]:
        if covariates is None:
            names = ", ".join(c.header for c in coordinates[1])
            raise InputError(f"the model needs the covariates {names}; give covariates=… in this order")
        extra = as_matrix(covariates, coordinates[1], "covariates")
        if extra.shape[:-1] not in (lead, ()):
            raise InputError(f"covariates for {lead} rows of joints must have as many rows, got {extra.shape[:-1]}")
        flat = np.broadcast_to(extra, (*lead, extra.shape[-1])).reshape(-1, extra.shape[-1])
    return given.reshape(-1, given.shape[-1]), flat, lead


@np.errstate(invalid="ignore", over="ignore")
def kept(found: Mapping[str, Any], joints: Array, covariates: Array | None, promise: Promise) -> dict[str, Array]:
    """The outputs, with what breaks the promise replaced by the safe fallback.

    A row falls back where an output is missing, of another shape or kind, or not finite, where |deviation| or
    |ideal - joints| is above the limit, or where command + deviation is not the joints. It then has command = ideal =
    joints and deviation 0, outside the domain. A row is inside only where it is also inside the card's domain. Joints
    that are no number count as the middle of the domain, infinite ones as its edge.

    Args:
        joints: `s x n` [SI], anything.
        covariates: `s x m` [SI], anything; None without any.

    Returns:
        `command`, `deviation`, `ideal` and `deviation_sd`, `s x n` [SI], all finite;
        `inside_domain`, `ideal_inside_domain` and `fallback`, `s`, bool; `status` and `ideal_status`, `s`, int64: 0
        exact, 1 outside what was measured or fallen back, 2 an input is not finite, 3 damped.
    """
    rows, n = joints.shape
    inputs = joints if covariates is None else np.concatenate([joints, covariates], -1)
    inputs, strange = promise.cleaned(inputs)
    given = inputs[:, :n]

    floats, bools = ["command", "deviation", "ideal", "deviation_sd"], ["inside_domain", "ideal_inside_domain"]
    safe = {"command": given, "deviation": np.zeros_like(given), "ideal": given}
    safe["deviation_sd"] = np.broadcast_to(promise.sd, given.shape)
    # Where an output is no such numbers there are none.
    there = {name: _of_kind(found.get(name), (rows, n), np.float64) for name in floats}
    flags = {name: _of_kind(found.get(name), (rows,), np.bool_) for name in bools}
    states = {name: _of_kind(found.get(name), (rows,), np.int64) for name in ("status", "ideal_status")}
    whole = all(value is not None for value in (*there.values(), *flags.values(), *states.values()))
    numbers = {name: safe[name] if value is None else value for name, value in there.items()}

    command, deviation, ideal = (numbers[name] for name in floats[:3])
    rounding = _SLACK * promise.limit + 8 * np.spacing(np.abs(given) + np.abs(deviation))
    # Written so that a NaN is not good.
    good = np.isfinite(command) & np.isfinite(ideal) & (np.abs(deviation) <= promise.limit * (1 + _EDGE))
    good &= (np.abs(command + deviation - given) <= rounding) & (np.abs(ideal - given) <= promise.limit + rounding)
    good &= (numbers["deviation_sd"] >= 0) & (numbers["deviation_sd"] < np.inf)
    kept_rows: Array = np.logical_and(good.all(-1), whole)

    checked = {name: np.where(kept_rows[:, None], numbers[name], safe[name]) for name in floats}
    known = kept_rows & ~strange.any(-1)
    inside_of = {"inside_domain": ("status", checked["command"]), "ideal_inside_domain": ("ideal_status", given)}
    for name, (state, at) in inside_of.items():
        flag = flags[name]
        if flag is None:
            flag = np.zeros(rows, dtype=bool)
        checked[name] = known & flag & promise.inside(np.concatenate([at, inputs[:, n:]], -1))
        damped = known & (states[state] == 3) if states[state] is not None else np.zeros(rows, dtype=bool)
        of_row = np.where(damped, 3, np.where(checked[name], 0, 1))
        lost = strange.any(-1) | (states[state] == 2 if states[state] is not None else False)
        checked[state] = np.where(lost, 2, of_row)
    return checked | {"fallback": ~kept_rows}


def _of_kind(value: Any, shape: tuple[int, ...], kind: type) -> Array | None:
    """The output, None where it is no array of this shape and kind."""
    right = isinstance(value, np.ndarray) and value.shape == shape and value.dtype == kind
    return value if right else None
