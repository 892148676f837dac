"""Families of causes that the library has no name for, or only a nearby one."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from ccnn_validation.sources.adversarial import odd
from ccnn_validation.sources.adversarial.effect import Effect, measured, strength_of
from ccnn_validation.sources.adversarial.finish import NAMES_NOTHING, Builder, finish, none, plain_case
from ccnn_validation.sources.adversarial.machine import ARM, Array
from ccnn_validation.sources.adversarial.ordinary import pick, torque
from ccnn_validation.sources.adversarial.outside import load_names, outside_smooth
from ccnn_validation.sources.adversarial.rig import ALL, Rig, draw_rig
from ccnn_validation.sources.case import SourceCase, Truth

__all__ = ["ODD_FAMILIES"]

_STRONG = (10.0, 30.0)


def _names(rig: Rig, *joints: int) -> tuple[str, ...]:
    return tuple(rig.machine.joint_names[j] for j in joints)


def _of_one_joint(
    shape: Callable[[Rig, int], Array], rows: tuple[int, int] = (150, 400), machines: Sequence[str] = ALL
) -> Builder:
    """A function of one joint: outside, driven by that joint."""

    def build(family: str, rng: np.random.Generator) -> SourceCase:
        rig = draw_rig(rng, machines, rows)
        joint = pick(rig, 1)[0]
        effect, strength = Effect(family, shape(rig, joint)), float(rng.choice(_STRONG))
        return plain_case(family, rig, effect, strength, outside_smooth(rig, effect, strength, _names(rig, joint)))

    return build


def _cable_drag(family: str, rng: np.random.Generator) -> SourceCase:
    """The pull follows joint 1: outside; what of it is a straight line may be called a gain.

    The drive yields to the pull, but that is none of the recorded load: no compliance.
    """
    rig = draw_rig(rng, rows=(150, 400))
    effect, strength = Effect(family, odd.cable(rig)), float(rng.choice(_STRONG))
    return plain_case(family, rig, effect, strength, outside_smooth(rig, effect, strength, _names(rig, 0)))


def _eccentricity(family: str, rng: np.random.Generator) -> SourceCase:
    """Periods of a turn and of half a turn: a transmission with its second harmonic. The travel is half a turn."""
    rig = draw_rig(rng, (ARM,), (150, 400))
    joint = int(rng.choice([0, 3, 5]))
    effect = Effect("transmission", odd.eccentricity(rig, joint))
    return plain_case(family, rig, effect, float(rng.choice(_STRONG)))


def _hysteresis(family: str, rng: np.random.Generator) -> SourceCase:
    """Outside; backlash beside that is no error: after moves that close all loops it is one, and few moves do.

    Backlash leaves more than half of it (RMS).
    """
    rig = draw_rig(rng, rows=(150, 400))
    rig.show("direction")
    joint = pick(rig, 1)[0]
    drivers = ("direction", f"direction{joint + 1}", *_names(rig, joint))
    truth = Truth("outside", (family,), (NAMES_NOTHING, frozenset({"backlash"})), True, drivers)
    return plain_case(family, rig, Effect(family, odd.hysteresis(rig, joint)), float(rng.choice(_STRONG)), truth)


def _stribeck(family: str, rng: np.random.Generator) -> SourceCase:
    """Backlash by its sign; how it falls with the speed, which nobody recorded, is outside.

    What the library calls friction grows with the load, and this does not. What backlash leaves, a third (RMS), looks
    like more noise: with a given noise an answer must say outside.
    """
    rig = draw_rig(rng, rows=(150, 400))
    rig.show("direction")
    joint = pick(rig, 1)[0]
    drivers = ("direction", f"direction{joint + 1}", *_names(rig, joint))
    named = frozenset({"backlash"})
    truth = Truth("outside", (family,), (NAMES_NOTHING, named), True, drivers)
    case = plain_case(family, rig, Effect(family, odd.stribeck(rig, joint)), float(rng.choice(_STRONG)), truth)
    return case if case.noise is not None else replace(case, truth=replace(truth, enough=(named,)))


def _warm_stiffness(family: str, rng: np.random.Generator) -> SourceCase:
    """A belt of 10 % less stiffness for each kelvin: compliance at 20 °C, and its change with the temperature."""
    rig = draw_rig(rng, rows=(150, 400))
    rig.show("load", "temperature", "time")
    some = np.zeros(rig.machine.count)
    some[pick(rig)] = 1.0
    softer = 1 + 0.1 * (rig.temperature - 20.0)
    effect = Effect(family, some * torque(rig, rig.load) * softer[:, None])
    causes = ("compliance", "thermal_compliance")
    truth = Truth("pair", causes, (frozenset(causes),))
    return plain_case(family, rig, effect, float(rng.choice(_STRONG)), truth)


def _load_by_place(family: str, rng: np.random.Generator) -> SourceCase:
    """A drive that is ten times as soft at one end of its travel as at the other (a long screw)."""
    rig = draw_rig(rng, rows=(150, 400))
    rig.show("load")
    joint = pick(rig, 1)[0]
    change = np.zeros_like(rig.joints)
    change[:, joint] = (torque(rig, rig.load) * (0.1 + 0.9 * odd.of_travel(rig)))[:, joint]
    drivers = (*load_names(rig), *_names(rig, joint), "position")
    truth = Truth("outside", (family,), (frozenset({"compliance"}), NAMES_NOTHING), True, drivers)
    return plain_case(family, rig, Effect(family, change), float(rng.choice(_STRONG)), truth)


def _product(family: str, rng: np.random.Generator) -> SourceCase:
    """The product of two joints moves one of the joints: outside by one of the two, or by the place."""
    rig = draw_rig(rng, rows=(150, 400))
    first, second = pick(rig, 2)
    way = odd.of_travel(rig) - 0.5
    change = np.zeros_like(rig.joints)
    change[:, pick(rig, 1)[0]] = way[:, first] * way[:, second]
    effect, strength = Effect(family, change), float(rng.choice(_STRONG))
    drivers = (*_names(rig, first, second), "position")
    return plain_case(family, rig, effect, strength, outside_smooth(rig, effect, strength, drivers))


def _quantised_commands(family: str, rng: np.random.Generator) -> SourceCase:
    """A controller that rounds its commands, which the file has unrounded.

    Rounding to hundreds of steps over the travel cannot be told from more noise: with a given noise an answer must say
    that something is outside, without one it may not. Far below the noise (0.15 times) nothing is wrong.
    """
    rig = draw_rig(rng)
    strength = float(rng.choice([0.15, 5.0, 10.0]))
    step = 1e-5
    for _ in range(5):
        change = np.round(rig.joints / step) * step - rig.joints
        clean = measured(rig, Effect(family, change))
        step *= strength / strength_of(rig, clean)
    if strength < 1:
        return finish(family, rig, none(), clean)
    given = bool(rng.random() < 2 / 3)
    truth = Truth("outside", (family,), (NAMES_NOTHING,), True if given else None)
    case = finish(family, rig, truth, clean, always=True)
    return case if given else replace(case, noise=None)


ODD_FAMILIES: dict[str, Builder] = {
    "local_bump": _of_one_joint(odd.bump, (250, 400)),
    "old_table_wrong_sign": _of_one_joint(odd.table, (200, 400)),
    "cable_drag": _cable_drag,
    "second_order_eccentricity": _eccentricity,
    "hysteresis_with_memory": _hysteresis,
    "stribeck": _stribeck,
    "temperature_dependent_stiffness": _warm_stiffness,
    "load_by_place": _load_by_place,
    "product_of_two_joints": _product,
    "quantised_commands": _quantised_commands,
}
