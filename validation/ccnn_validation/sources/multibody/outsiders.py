"""Causes that the library has no name for, each as a change of the MuJoCo model."""

from __future__ import annotations

import numpy as np

from ccnn_validation.sources.case import Truth
from ccnn_validation.sources.multibody.build import Build
from ccnn_validation.sources.multibody.design import Design
from ccnn_validation.sources.multibody.machine import Machine
from ccnn_validation.sources.multibody.plan import Plan
from ccnn_validation.sources.multibody.singles import Maker

__all__ = ["OUTSIDERS"]

_NOTHING: frozenset[str] = frozenset()


def _softening(machine: Machine, design: Design, rng: np.random.Generator) -> Plan:
    """Drives that soften with the temperature: a load moves a warm machine farther.

    Compliance acts as well, and is right to name; that it changes with the temperature has no name. Either factor of
    the product is a driver.
    """
    servo = machine.stiff / rng.uniform(0.6, 1.4, machine.drives)
    loads = tuple(f"load_{c}" for c in machine.pose)
    truth = Truth(
        "outside",
        ("compliance", "stiffness that falls with temperature"),
        (frozenset({"compliance"}), _NOTHING),
        True,
        (*loads, "temperature"),
    )
    return Plan(
        lambda strength: Build(servo=servo / strength),
        truth,
        frozenset({"load", "temperature"}),
        softening=0.03,
        sizes=(20.0, 40.0),
        plain=False,
    )


def _soft_stop(machine: Machine, design: Design, rng: np.random.Generator) -> Plan:
    """A rubber stop in the last fifth of a joint's travel pushes back against a servo that gives."""
    joint, side = int(rng.integers(machine.drives)), float(rng.choice([-1.0, 1.0]))
    begin = float(np.quantile(design.joints[:, joint], 0.5 + side * rng.uniform(0.25, 0.35)))
    truth = Truth("outside", ("soft stop",), (_NOTHING,), True, (f"q{joint + 1}", "position"))
    return Plan(
        lambda strength: Build(
            servo=machine.stiff, stop=(joint, begin, side, 2e-3 * strength * float(machine.stiff[joint]))
        ),
        truth,
        sizes=(6.0, 25.0),
        plain=False,
    )


def _cable(machine: Machine, design: Design, rng: np.random.Generator) -> Plan:
    """A hose pulls the tool towards a hook as a spring, and the servos give.

    The pull changes its direction and size with the tool's place. It is no recorded load, so compliance cannot show it,
    and no weight; near a constant pull along the vertical a share of it is gravity's, which is right to name beside.
    """
    middle = np.zeros(3)
    at = design.pose[:, : 2 if machine.pose == ("x", "y") else 3].mean(0)
    middle[: len(at)] = at
    way = rng.normal(size=3)
    if machine.pose == ("x", "y"):
        way[2] = 0.0
    hook = middle + 1.2 * machine.reach * way / np.linalg.norm(way)
    joints = tuple(f"q{i + 1}" for i in range(machine.drives))
    truth = Truth("outside", ("cable drag",), (_NOTHING, frozenset({"gravity"})), True, (*joints, "position"))
    place = (float(hook[0]), float(hook[1]), float(hook[2]))
    slack = 0.4 * machine.reach
    return Plan(
        lambda strength: Build(servo=machine.stiff, cable=(place, 100.0 * strength, slack)),
        truth,
        sizes=(10.0, 40.0),
        plain=False,
    )


def _loose_bolt(machine: Machine, design: Design, rng: np.random.Generator) -> Plan:
    """From a row on a link stands otherwise by play in a bolted joint: a step in time of the geometry.

    The library's drift is smooth in time or a random walk: neither is a step. Both that and the geometry of the later
    rows may be named beside, since each takes a share of it.
    """
    n, arm = machine.drives, machine.low is not None
    names = [f"{key}{i}" for i in range(2, n) for key in ("a", "d")] if arm else list(machine.lengths)
    names = [name for name in names if not name.startswith(("platform", "angle"))]
    name = str(rng.choice(names))
    truth = Truth(
        "outside",
        ("loose bolt",),
        (_NOTHING, frozenset({"geometry"}), frozenset({"drift"}), frozenset({"geometry", "drift"})),
        True,
        ("time", "position"),
    )
    return Plan(
        lambda strength: Build(lengths={name: machine.lengths[name] + 3e-4 * strength}),
        truth,
        frozenset({"time"}),
        after=int(len(design.joints) * rng.uniform(0.3, 0.7)),
    )


OUTSIDERS: dict[str, Maker] = {
    "softening": _softening,
    "soft_stop": _soft_stop,
    "cable": _cable,
    "loose_bolt": _loose_bolt,
}
