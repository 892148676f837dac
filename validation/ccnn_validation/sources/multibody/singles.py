"""Causes that have a name in the library, each as a change of the MuJoCo model."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ccnn_validation.sources.case import Truth
from ccnn_validation.sources.multibody.arrays import Array
from ccnn_validation.sources.multibody.build import Build
from ccnn_validation.sources.multibody.design import Design
from ccnn_validation.sources.multibody.machine import Machine
from ccnn_validation.sources.multibody.plan import Plan

__all__ = ["SINGLES", "Maker", "named"]

Maker = Callable[[Machine, Design, np.random.Generator], Plan]


def named(*causes: str, also: tuple[tuple[str, ...], ...] = (), outside: bool | None = False) -> Truth:
    """The truth of one cause with a name; `also` lists other names that are as right."""
    sets = tuple(frozenset(names) for names in (causes, *also))
    return Truth("single", causes, sets, outside)


def _spread(machine: Machine, rng: np.random.Generator) -> Array:
    """One factor for each drive, `n`: no two drives are alike."""
    return rng.uniform(0.4, 1.6, machine.drives)


def _signed(machine: Machine, rng: np.random.Generator) -> Array:
    """The same with signs."""
    signs: Array = rng.choice([-1.0, 1.0], machine.drives)
    return signs * _spread(machine, rng)


def _geometry(machine: Machine, design: Design, rng: np.random.Generator) -> Plan:
    """One to four lengths or angles of links that are neither the first nor the last: those are frames as well."""
    n, arm = machine.drives, machine.low is not None
    if arm:
        names = [f"{key}{i}" for i in range(2, n) for key in ("a", "alpha", "d")]
    else:
        # Of base and platform radius of a delta's leg only the difference acts.
        names = [name for name in machine.lengths if not name.startswith("platform")]
    drawn = rng.choice(names, int(rng.integers(1, 5)), replace=False)
    errors = {str(name): float(rng.choice([-1.0, 1.0]) * rng.uniform(0.5, 1.5) * 3e-4) for name in drawn}

    def build(strength: float) -> Build:
        return Build(lengths={name: machine.lengths[name] + strength * error for name, error in errors.items()})

    return Plan(build, named("geometry"))


def _joint_offset(machine: Machine, design: Design, rng: np.random.Generator) -> Plan:
    """Zeros of all servos."""
    zero = 2e-4 * _signed(machine, rng)
    return Plan(lambda strength: Build(zero=strength * zero), named("joint_offset"))


def _joint_gain(machine: Machine, design: Design, rng: np.random.Generator) -> Plan:
    """Gains of all commands: they act from the joint's zero, which an offset may tell from its middle."""
    gain = 2e-4 * _signed(machine, rng)
    also = (("joint_gain", "joint_offset"),)
    return Plan(lambda strength: Build(gain=strength * gain), named("joint_gain", also=also))


def _frame(machine: Machine, design: Design, rng: np.random.Generator) -> Plan:
    """The base shifted and tilted as far as the pose shows it."""
    place = np.concatenate([rng.normal(0, 2e-4, 3), rng.normal(0, 2e-4, 3)])
    if machine.pose == ("x", "y"):
        place[2:5] = 0.0
    return Plan(lambda strength: Build(base=tuple((strength * place).tolist())), named("frame"))


def _tool(machine: Machine, design: Design, rng: np.random.Generator) -> Plan:
    """The measured point shifted and turned on the flange."""
    place = np.concatenate([rng.normal(0, 2e-4, 3), rng.normal(0, 2e-4, 3)])
    return Plan(lambda strength: Build(tool=tuple((strength * place).tolist())), named("tool"))


def _gravity(machine: Machine, design: Design, rng: np.random.Generator) -> Plan:
    """All bodies have weight, and the servos give."""
    servo = machine.stiff / _spread(machine, rng)
    return Plan(lambda strength: Build(servo=servo / strength, gravity=True), named("gravity"), plain=False)


def _payload(machine: Machine, design: Design, rng: np.random.Generator) -> Plan:
    """A mass at the tool that the records do not have; the own weight is fed forward."""
    servo, mass = machine.stiff / _spread(machine, rng), float(rng.uniform(2, 8))
    if machine.name == "stewart":
        mass *= 10
    return Plan(
        lambda strength: Build(servo=servo / strength, gravity=True, carried=1.0, payload=mass),
        named("gravity"),
        plain=False,
    )


def _compliance(machine: Machine, design: Design, rng: np.random.Generator) -> Plan:
    """Forces and moments at the tool that the records have, and servos that give."""
    servo = machine.stiff / _spread(machine, rng)
    return Plan(lambda strength: Build(servo=servo / strength), named("compliance"), frozenset({"load"}), plain=False)


def _flex(machine: Machine, design: Design, rng: np.random.Generator) -> Plan:
    """Links of an arm that tilt across their drives' axes under a load: compliance, not all of it in the joints."""
    flex = np.full(machine.drives, np.inf)
    drawn = rng.choice(np.arange(machine.drives - 1), 2, replace=False)
    flex[drawn] = 2 * machine.stiff[drawn] * rng.uniform(0.5, 1.5, 2)
    return Plan(
        lambda strength: Build(flex=flex / strength),
        named("compliance", outside=None),
        frozenset({"load"}),
        plain=False,
    )


def _friction(machine: Machine, design: Design, rng: np.random.Generator) -> Plan:
    """Dry friction winds up the servos against their last motion; as loads do not vary, it is also play."""
    loss = 1e-4 * machine.stiff * _spread(machine, rng)
    return Plan(
        lambda strength: Build(servo=machine.stiff, friction=strength * loss),
        named("friction", also=(("backlash",),)),
        frozenset({"direction"}),
        plain=False,
    )


def _backlash(machine: Machine, design: Design, rng: np.random.Generator) -> Plan:
    """Play without weight: each link stays behind its motor; friction against the last motion looks the same."""
    play = 2e-4 * _spread(machine, rng)
    return Plan(
        lambda strength: Build(play=strength * play),
        named("backlash", also=(("friction",),)),
        frozenset({"direction"}),
        plain=False,
    )


def _backlash_weight(machine: Machine, design: Design, rng: np.random.Generator) -> Plan:
    """Play with weight, which decides the flank; where it does not push, the last motion does."""
    play = 2e-4 * _spread(machine, rng)
    return Plan(
        lambda strength: Build(play=strength * play, gravity=True),
        named("backlash"),
        frozenset({"direction"}),
        plain=False,
    )


def _thermal(machine: Machine, design: Design, rng: np.random.Generator) -> Plan:
    """All bodies grow with their temperature; the scales of sliding drives in half of the cases as well."""
    return Plan(
        lambda strength: Build(),
        named("thermal"),
        frozenset({"temperature"}),
        growth=1.2e-5,
        screws=bool(rng.random() < 0.5),
        sizes=(5.0, 8.0),
    )


def _latency(machine: Machine, design: Design, rng: np.random.Generator) -> Plan:
    """Viscous damping pulls the servos back on the move: each joint is late by damping over stiffness."""
    late = 2e-4 * _spread(machine, rng)
    return Plan(
        lambda strength: Build(servo=machine.stiff, damping=strength * late * machine.stiff),
        named("latency"),
        frozenset({"speed", "time"}),
        plain=False,
    )


SINGLES: dict[str, Maker] = {
    "geometry": _geometry,
    "joint_offset": _joint_offset,
    "joint_gain": _joint_gain,
    "frame": _frame,
    "tool": _tool,
    "gravity": _gravity,
    "payload": _payload,
    "compliance": _compliance,
    "flex": _flex,
    "friction": _friction,
    "backlash": _backlash,
    "backlash_weight": _backlash_weight,
    "thermal": _thermal,
    "latency": _latency,
}
