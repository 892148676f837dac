"""Which blind cases there are: kinds, machines, causes and strengths, drawn so that each gets its even share."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ccnn_torch.errors import InputError
from ccnn_validation.blind.body_causes import BODY_CAUSES
from ccnn_validation.blind.joint_causes import JOINT_CAUSES
from ccnn_validation.blind.machines import MACHINES
from ccnn_validation.blind.outside_causes import OUTSIDE_CAUSES

__all__ = ["CAUSES", "KINDS", "SIMULATORS", "STRENGTHS", "CasePlan", "plan_cases"]

KINDS = {"single": 0.45, "pair": 0.25, "none": 0.15, "outside": 0.15}
"""Share of each kind of case, by default."""
STRENGTHS = (3.0, 10.0, 30.0)
"""RMS of the gap over rows and pose coordinates, each in units of its noise."""
SIMULATORS = (*MACHINES, "mujoco_five_bar")
CAUSES = (*BODY_CAUSES, *JOINT_CAUSES, "outlier")
"""Causes of a machine's error, by the names that a verdict may give."""
MUJOCO_CAUSES = ("joint_offset", "compliance", "gravity", "friction", "geometry")
_ROWS, _ROWS_SHARE = (40, 100, 200, 400), (0.15, 0.2, 0.45, 0.2)
_WEAKEST = 0.3
"""Size of a pair's second cause, at least, in units of the first."""
_NOISE = (2e-6, 2e-5)
_UNTOLD = 0.3
_MOVING = 0.25


@dataclass(frozen=True)
class CasePlan:
    """One case before anything is simulated.

    Attributes:
        number: from 0; with the seed it decides everything about the case.
        kind: one of `KINDS`.
        machine: one of `SIMULATORS`.
        causes: names; () for none, and the kind of driver for a cause outside the library.
        shares: size of each cause in units of the first.
        strength: of the gap; 0 for none and for bad rows.
        rows: how many.
        noise: standard deviation of a measured position [m]; of the independent simulator it follows from
            the gap and the strength.
        noise_told: whether the diagnosis gets it.
        moving: whether poses are read in motion.
        disturbance: of the rows: "" or "heavy tails", "bad rows", "uneven noise".
    """

    number: int
    kind: str
    machine: str
    causes: tuple[str, ...]
    shares: tuple[float, ...]
    strength: float
    rows: int
    noise: float
    noise_told: bool
    moving: bool
    disturbance: str


def plan_cases(count: int, seed: int, machines: Sequence[str], kinds: Sequence[str]) -> list[CasePlan]:
    """Draw so many cases; the same for the same arguments.

    Raises:
        InputError: a machine or kind that is not there, no case at all, or none that these machines can have.
    """
    _check(count, machines, kinds)
    # The independent simulator has no causes outside the library.
    able = {kind: [m for m in machines if kind != "outside" or m != "mujoco_five_bar"] for kind in kinds}
    kinds = [kind for kind in kinds if able[kind]]
    if not kinds:
        raise InputError("kinds: mujoco_five_bar has nothing outside the library; name another mechanism beside it")
    g = np.random.default_rng([seed, 0])
    share = np.array([KINDS[kind] for kind in kinds])
    edges = np.round(np.cumsum(share) / share.sum() * count).astype(int)
    order = np.repeat(np.array(list(kinds)), np.diff(edges, prepend=0))
    g.shuffle(order)
    decks = {kind: _Deck(kind, able[kind], g) for kind in kinds}
    plans = []
    for number, kind in enumerate(order.tolist()):
        machine, causes, strength = decks[kind].next()
        bad = causes == ("outlier",)
        # A plain case half the time; a disturbance that is itself a finding only where there is another one.
        moving = "latency" in causes or (bool(g.random() < _MOVING) and machine != "mujoco_five_bar")
        rows = int(g.choice(_ROWS, p=_ROWS_SHARE))
        choice = ["", "heavy tails", "uneven noise"] + (["bad rows"] if kind in ("single", "pair") else [])
        disturbance = str(g.choice(choice)) if g.random() < 0.4 and not bad else ""
        plans.append(
            CasePlan(
                number=number,
                kind=kind,
                machine=machine,
                causes=causes,
                shares=(1.0, float(np.exp(g.uniform(np.log(_WEAKEST), 0.0))))[: len(causes)],
                strength=0.0 if bad or not causes else strength,
                # Speeds beside all else are more columns than 40 rows may have.
                rows=max(rows, 60) if moving else rows,
                noise=float(np.exp(g.uniform(*np.log(_NOISE)))),
                noise_told=bool(g.random() > _UNTOLD) and disturbance != "uneven noise",
                moving=moving,
                disturbance=disturbance if machine != "mujoco_five_bar" else "",
            )
        )
    return plans


def causes_of(machine: str) -> tuple[str, ...]:
    """Causes that this machine can have and that show in what is measured of it."""
    if machine == "mujoco_five_bar":
        return MUJOCO_CAUSES
    # Without orientation a target elsewhere on the platform is the same as a device elsewhere.
    return tuple(c for c in CAUSES if not (c == "tool" and machine in ("five_bar", "delta", "delta_linear")))


class _Deck:
    """Cards for one kind of case: every machine, cause and strength comes up before any comes up again."""

    def __init__(self, kind: str, machines: Sequence[str], generator: np.random.Generator) -> None:
        self._kind, self._g = kind, generator
        # The independent simulator has no causes outside the library.
        self._machines = [m for m in machines if m != "mujoco_five_bar" or kind != "outside"] or list(machines)
        self._left: dict[str, list[str]] = {}

    def next(self) -> tuple[str, tuple[str, ...], float]:
        """Machine, causes and strength of the next case."""
        machine = self._draw("machines", self._machines)
        strength = float(self._draw("strengths", [str(s) for s in STRENGTHS]))
        if self._kind == "none":
            return machine, (), 0.0
        if self._kind == "outside":
            return machine, (self._draw("drivers", list(OUTSIDE_CAUSES)),), strength
        possible = causes_of(machine)
        first = self._draw("causes", list(CAUSES), possible)
        if self._kind == "single":
            return machine, (first,), strength
        others = tuple(c for c in possible if c not in (first, "outlier"))
        if first == "outlier":
            first = self._draw("causes", list(CAUSES), others)
            others = tuple(c for c in others if c != first)
        return machine, (first, str(self._g.choice(others))), strength

    def _draw(self, deck: str, cards: list[str], allowed: Sequence[str] | None = None) -> str:
        left = self._left.setdefault(deck, [])
        if not any(card in (allowed or cards) for card in left):
            left.extend(self._g.permutation(cards).tolist())
        card = next(c for c in left if c in (allowed or cards))
        left.remove(card)
        return card


def _check(count: int, machines: Sequence[str], kinds: Sequence[str]) -> None:
    if count < 1:
        raise InputError(f"--cases: generate at least 1 case, not {count}")
    for option, given, known in (("--mechanism", machines, SIMULATORS), ("--kinds", kinds, tuple(KINDS))):
        strange = [name for name in given if name not in known]
        if strange or not given:
            raise InputError(f"{option}: '{', '.join(strange)}' is not there; known: {', '.join(known)}")
        if len(set(given)) < len(given):
            raise InputError(f"{option}: names are repeated in {', '.join(given)}")
