"""Families of causes with names in another amount, number or form than the textbook's."""

from __future__ import annotations

import numpy as np

from ccnn_validation.sources.adversarial.effect import Effect, combined, measured, scaled
from ccnn_validation.sources.adversarial.finish import Builder, finish, plain_case
from ccnn_validation.sources.adversarial.machine import ARM
from ccnn_validation.sources.adversarial.ordinary import (
    ORDINARY,
    geometry,
    lagged,
    ordinary,
    pick,
    torque,
    weight_torque,
)
from ccnn_validation.sources.adversarial.rig import ALL, Rig, draw_rig
from ccnn_validation.sources.case import SourceCase, Truth

__all__ = ["MIXED_FAMILIES"]

_LENGTHS = tuple(m for m in ALL if m != "tripod")
_MANY_JOINTS = tuple(m for m in ALL if m != "five_bar")


def _several(count: int) -> Builder:
    """Different causes at once, each of 10 or 30 times the noise."""

    def build(family: str, rng: np.random.Generator) -> SourceCase:
        rig = draw_rig(rng, _LENGTHS, (200, 400))
        names = [str(n) for n in rng.choice([*ORDINARY, "geometry"], size=count, replace=False)]
        parts = [scaled(rig, ordinary(rig, n), float(rng.choice([10.0, 30.0]))) for n in names]
        together = combined("several", parts)
        outside = False if together.textbook else None
        truth = Truth("several", tuple(names), (frozenset(names),), outside)
        return finish(family, rig, truth, measured(rig, together))

    return build


def _weak_beside_strong(strong: float, weak: float) -> Builder:
    """Two causes of textbook form. The strong one is in the joints or lengths, where no second order is left of it."""

    def build(family: str, rng: np.random.Generator) -> SourceCase:
        rig = draw_rig(rng, _LENGTHS, (200, 400))
        rig.sigma = rig.sigma * (2e-6 if rig.machine.name != ARM else 8e-6) / rig.sigma.min()
        first = str(rng.choice(["backlash", "transmission", "geometry"]))
        second = str(rng.choice([n for n in ORDINARY if n != first]))
        sizes = ((first, strong), (second, weak))
        parts = [scaled(rig, ordinary(rig, n, textbook=True), size) for n, size in sizes]
        truth = Truth("pair", (first, second), (frozenset({first, second}),), False)
        return finish(family, rig, truth, measured(rig, combined("pair", parts)))

    return build


def _one_joint(family: str, rng: np.random.Generator) -> SourceCase:
    """One joint of several has it."""
    rig = draw_rig(rng, _MANY_JOINTS)
    name = str(rng.choice(["backlash", "compliance", "transmission"]))
    return plain_case(family, rig, ordinary(rig, name, joints=1), float(rng.choice([5.0, 10.0, 30.0])))


def _large_geometry(family: str, rng: np.random.Generator) -> SourceCase:
    """Lengths that are up to 20 mm off: a thousand times the noise, and far from first order."""
    rig = draw_rig(rng, _LENGTHS, (100, 400))
    effect = geometry(rig, True, pick(rig))
    assert effect.parameters is not None
    size = 0.02 / np.abs(effect.parameters).max()
    clean = measured(rig, effect.times(size))
    while not np.isfinite(clean).all():
        size *= 0.7
        clean = measured(rig, effect.times(size))
    return finish(family, rig, Truth("single", ("geometry",), (frozenset({"geometry"}),), False), clean)


def _some(rig: Rig) -> np.ndarray:
    sizes = np.zeros(rig.machine.count)
    which = pick(rig)
    sizes[which] = rig.rng.uniform(0.5, 1.5, len(which))
    return sizes


def _friction_with_constant(family: str, rng: np.random.Generator) -> SourceCase:
    """Coulomb friction that winds up the drive: 70 % grows with the load, 30 % is constant (seals): friction alone.

    The constant part alone would be backlash; one friction has both.
    """
    rig = draw_rig(rng)
    rig.show("load", "direction")
    pull = np.abs(torque(rig, rig.load))
    wound = _some(rig) * (0.7 * pull + 0.3 * pull.mean(0))
    return plain_case(family, rig, Effect("friction", -rig.direction * wound), float(rng.choice([5.0, 10.0, 30.0])))


def _thermal_two_lags(family: str, rng: np.random.Generator) -> SourceCase:
    """A thin part follows the hall in 10 minutes, a cast one in three hours; both let all lengths grow.

    Thermal growth alone, whose form has a second lag.
    """
    rig = draw_rig(rng)
    rig.show("time", "temperature")
    share = float(rng.uniform(0.3, 0.7))
    warm = share * lagged(rig, 600.0) + (1 - share) * lagged(rig, 10800.0) - 20.0
    lengths = np.zeros_like(rig.machine.nominal)
    sized = rig.machine.parameters_like()
    lengths[sized] = rig.machine.nominal[sized]
    effect = Effect("thermal", parameters=warm[:, None] * lengths)
    return plain_case(family, rig, effect, float(rng.choice([5.0, 10.0, 30.0])))


def _curved_coupling(family: str, rng: np.random.Generator) -> SourceCase:
    """One joint moves another in a wrist's gears, by a line that bends by 15 %: coupling alone."""
    rig = draw_rig(rng, (ARM,))
    low, high = rig.machine.span
    way = 2 * (rig.joints - rig.machine.middle) / (high - low)
    mover, moved = (int(i) for i in rng.choice(rig.machine.count, 2, replace=False))
    change = np.zeros_like(rig.joints)
    change[:, moved] = way[:, mover] + 0.15 * (way[:, mover] ** 2 - 1 / 3)
    effect = Effect("coupling", change, textbook=False)
    return plain_case(family, rig, effect, float(rng.choice([5.0, 10.0, 30.0])))


def _wrong_payload(family: str, rng: np.random.Generator) -> SourceCase:
    """A payload that nobody wrote down, the same in all rows; or one that the load column has 20 % too small.

    The first is weight, gravity; no compliance, which goes by the recorded load. The second is compliance of the
    drives, by another factor.
    """
    rig = draw_rig(rng)
    strength = float(rng.choice([10.0, 30.0]))
    # All drives: a vertical axis alone would feel no weight.
    turn = weight_torque(rig) * rng.uniform(0.5, 1.5, rig.machine.count)
    if rng.random() < 0.5:
        # An arm's own weight is spread over its links; a payload pulls at the tool, for which gravity has coefficients.
        return plain_case(family, rig, Effect("gravity", turn), strength)
    kilograms = rng.choice([0.0, 2.0, 5.0, 10.0], rig.rows)
    down = "z" if "z" in rig.machine.pose_names else "y"
    rig.load = np.zeros_like(rig.load)
    rig.load[:, rig.machine.pose_names.index(down)] = -9.81 * 0.8 * kilograms
    rig.show("load")
    return plain_case(family, rig, Effect("compliance", turn * kilograms[:, None]), strength)


MIXED_FAMILIES: dict[str, Builder] = {
    "three_at_once": _several(3),
    "four_at_once": _several(4),
    "weak_beside_strong_300_3": _weak_beside_strong(300.0, 3.0),
    "weak_beside_strong_100_5": _weak_beside_strong(100.0, 5.0),
    "one_joint_only": _one_joint,
    "large_geometry": _large_geometry,
    "friction_with_constant": _friction_with_constant,
    "thermal_two_lags": _thermal_two_lags,
    "curved_coupling": _curved_coupling,
    "wrong_payload": _wrong_payload,
}
