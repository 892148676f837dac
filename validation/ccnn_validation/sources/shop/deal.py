"""The 104 cases of a seed: which machine has which causes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np

from ccnn_validation.sources.shop.library import LIBRARY
from ccnn_validation.sources.shop.outside import OUTSIDE

__all__ = ["FAMILIES", "Dealt", "dealt"]

_MACHINES = ("painter6", "scara", "arm7", "planar3r", "gantry", "five_bar", "delta", "stewart", "delta_linear")
_MEANINGLESS = {
    "planar3r": {"gravity", "tool", "friction"},
    "scara": {"gravity"},
    "gantry": {"geometry", "coupling", "tool", "gravity", "frame", "joint_offset"},
    "five_bar": {"coupling", "tool"},
    "delta": {"coupling", "tool"},
    "delta_linear": {"coupling", "tool"},
    "stewart": {"coupling"},
}
"""Causes that a machine cannot have, or cannot but as another by design."""
_ROUNDS = 4
_PAIRS = (
    *(("geometry", "compliance"), ("backlash", "thermal"), ("transmission", "joint_offset"), ("gravity", "tool")),
    *(("coupling", "friction"), ("geometry", "backlash"), ("joint_gain", "transmission"), ("compliance", "backlash")),
)
_ALL_PAIRS = 20
_NOISES = (*("white", "t3", "ar1", "tempdrift") * 2, "ar1", "white")
_OUTSIDE = (*OUTSIDE, *list(OUTSIDE)[:6])


@dataclass(frozen=True)
class Dealt:
    """A case before it is built.

    Attributes:
        name: of which its random numbers come.
        machine: by name.
        causes: of the library or outside it; without a cause the kind of the noise.
        kind: single, pair, none or outside.
    """

    name: str
    machine: str
    causes: tuple[str, ...]
    kind: str


def _numbered(names: Sequence[str]) -> dict[str, str]:
    """Family -> name, numbered where a name comes again."""
    return {f"{name}_{names[: i + 1].count(name)}": name for i, name in enumerate(names)}


_OF_NOISE = {f"noise_{family}": kind for family, kind in _numbered(_NOISES).items()}
_OF_OUTSIDE = _numbered(_OUTSIDE)
FAMILIES: tuple[str, ...] = (
    *(f"{cause}_{turn + 1}" for cause in LIBRARY for turn in range(_ROUNDS)),
    *(f"pair_{i + 1}" for i in range(_ALL_PAIRS)),
    *_OF_NOISE,
    *_OF_OUTSIDE,
)
"""Each has one case for a seed: a cause of the library four times, twenty pairs, ten without, fourteen outside."""


@cache
def dealt(seed: int) -> dict[str, Dealt]:
    """The cases of a seed by family: machines are dealt evenly among those on which the causes mean something."""
    rng = np.random.default_rng(seed)
    stack: list[str] = []
    found: dict[str, Dealt] = {}

    def add(family: str, tag: str, causes: tuple[str, ...], kind: str) -> None:
        nonlocal stack
        wanted = causes if kind in ("single", "pair") else ()
        stack = stack or list(rng.permutation(_MACHINES)) * 2
        machine = next((m for m in stack if _can(m, wanted)), None)
        if machine is None:
            stack += list(rng.permutation(_MACHINES))
            machine = next(m for m in stack if _can(m, wanted))
        stack.remove(machine)
        found[family] = Dealt(f"{tag}_{machine}_{'+'.join(causes)}", str(machine), causes, kind)

    for turn in range(_ROUNDS):
        for cause in rng.permutation(list(LIBRARY)):
            add(f"{cause}_{turn + 1}", f"s{len(found):02d}", (str(cause),), "single")
    for i in range(_ALL_PAIRS):
        add(f"pair_{i + 1}", f"p{i:02d}", _PAIRS[i] if i < len(_PAIRS) else _pair(rng), "pair")
    for i, (family, kind) in enumerate(_OF_NOISE.items()):
        add(family, f"n{i}", (kind,), "none")
    for i, (family, cause) in enumerate(_OF_OUTSIDE.items()):
        add(family, f"o{i:02d}", (cause,), "outside")
    return found


def _can(machine: str, causes: tuple[str, ...]) -> bool:
    return not _MEANINGLESS.get(machine, set()) & set(causes)


def _pair(rng: np.random.Generator) -> tuple[str, ...]:
    """Two causes that more than two machines can have, and that are not one the other."""
    while True:
        pair = tuple(str(cause) for cause in rng.choice(list(LIBRARY), 2, False))
        one = set(pair) == {"frame", "instrument"} or (
            "joint_offset" in pair and {"joint_gain", "coupling"} & set(pair)
        )
        if "latency" not in pair and not one and sum(_can(m, pair) for m in _MACHINES) > 2:
            return pair
