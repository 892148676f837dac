"""One case of a source: records as a user would have them, and the answers that are right."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Protocol

from numpy.typing import NDArray

__all__ = ["Source", "SourceCase", "Truth"]


@dataclass(frozen=True)
class Truth:
    """What a right answer says.

    Attributes:
        kind: `none`, `single`, `pair`, `several`, `outside`, or `data` (a mistake in the records).
        causes: the causes by name; words of the source's own where the library has no name.
        accepted: sets of effect names, each a complete right answer; the empty set is "no name".
        outside: True = the answer must say that something is outside the library, False = it must not, None = either.
        drivers: drivers that are right where the answer says outside; () = any.
        mention: where not empty, one of these texts must be in a caution or a note (lower case).
        enough: sets of effect names that are right without "outside the library" where `outside` is True.
    """

    kind: str
    causes: tuple[str, ...]
    accepted: tuple[frozenset[str], ...]
    outside: bool | None = False
    drivers: tuple[str, ...] = ()
    mention: tuple[str, ...] = ()
    enough: tuple[frozenset[str], ...] = ()


@dataclass(frozen=True)
class SourceCase:
    """A case.

    Attributes:
        family: name within the source, by which its figures are counted.
        mechanism: a name of `load_mechanism`, or the text of a geometry file (YAML) or a URDF.
        mechanism_keys: keys of the mechanism's constructor, where it has a name.
        columns: header `name[unit]` -> values, `s` each, as they stand in the CSV.
        noise: standard deviation of a measured position [m] and angle [rad] by unit (`{"m": 1e-5, "rad": 1e-5}`) as the
            diagnosis gets it; None = it is not given.
        truth: the right answers.
        clean: measured columns without noise [m, rad] (only pose columns); None where unknown.
        baseline: columns without the cause, of records whose own errors are unknown: then the names of the verdict
            are compared with those of the verdict on `baseline`, and `accepted` lists the names that are added.
        noise_kind: "white", or what else the noise is.
    """

    family: str
    mechanism: str
    columns: Mapping[str, NDArray[Any]]
    noise: Mapping[str, float] | None
    truth: Truth
    mechanism_keys: Mapping[str, Any] | None = None
    clean: Mapping[str, NDArray[Any]] | None = None
    baseline: Mapping[str, NDArray[Any]] | None = None
    noise_kind: str = "white"


class Source(Protocol):
    """A module of this package."""

    FAMILIES: tuple[str, ...]

    def make(self, family: str, seed: int) -> SourceCase:
        """The case of a family and seed; the same for the same arguments.

        Raises:
            InputError: data that the source reads is not there.
        """
