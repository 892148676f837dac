"""Families of errors that come with time: a machine that is another one after a row, a loose bolt, a walking zero."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from ccnn_validation.sources.adversarial.effect import Effect, absorbed
from ccnn_validation.sources.adversarial.finish import NAMES_NOTHING, Builder, plain_case
from ccnn_validation.sources.adversarial.machine import ARM, Array
from ccnn_validation.sources.adversarial.ordinary import geometry, pick
from ccnn_validation.sources.adversarial.outside import SEEN
from ccnn_validation.sources.adversarial.rig import ALL, Rig, draw_rig
from ccnn_validation.sources.case import SourceCase, Truth

__all__ = ["JUMP_FAMILIES"]

_STRENGTHS = (5.0, 10.0, 30.0)
_ORIENTED = ("stewart", ARM)
# RMS share of an error that the parameters of a machine leave where they do the same to first order.
_THE_SAME = 0.01
# Terms of the library's random walk.
_WALK = 4


def _frame(rig: Rig) -> Effect:
    """The machine shifts and turns as a whole against the measuring device, `s x p`; a tripod only shifts."""
    names, twist = rig.machine.pose_names, np.zeros_like(rig.pose)
    axes = [n for n in names if n in ("x", "y", "z")]
    place = np.zeros((rig.rows, 3))
    for column, name in enumerate(axes):
        place[:, "xyz".index(name)] = rig.pose[:, column]
    turn = rig.rng.normal(size=3)
    if rig.machine.name == "tripod":
        turn[:] = 0.0
    elif len(axes) == 2:
        turn[:2] = 0.0
    # Lever arms count from the middle of the workspace.
    moved = rig.rng.normal(size=3) * 0.3 + np.cross(turn, place - place.mean(0))
    for column, name in enumerate(axes):
        twist[:, column] = moved[:, "xyz".index(name)]
    if rig.machine.spatial:
        twist[:, 3:] = turn
    return Effect("frame", twist=twist)


def _tool(rig: Rig) -> Effect:
    """The target shifts and turns on the platform."""
    rotation = Rotation.from_rotvec(rig.pose[:, 3:])
    shift, turn = rig.rng.normal(size=3), 2.0 * rig.rng.normal(size=3)
    return Effect("tool", twist=np.concatenate([rotation.apply(shift), rotation.apply(turn)], axis=1))


def _joint(rig: Rig) -> Effect:
    """A belt skips a tooth: one joint has another zero."""
    change = np.zeros_like(rig.joints)
    change[:, pick(rig, 1)[0]] = rig.rng.choice([-1.0, 1.0])
    return Effect("joint_offset", joints=change)


def _geometry(rig: Rig) -> Effect:
    effect = geometry(rig, True, ())
    assert effect.parameters is not None
    return Effect("geometry", parameters=np.broadcast_to(effect.parameters, (rig.rows, len(effect.parameters))))


def _gated(rig: Rig, effect: Effect, state: Array) -> Effect:
    """The error in the rows where the state is 1."""
    return effect.changed(lambda part: np.asarray(part * state[:, None]))


def _jump_truth(rig: Rig, cause: str, effect: Effect) -> Truth:
    """Outside by the time; what jumps may be named beside it (it is there in half of the rows).

    A constant error of frame or tool is also one of the geometry of some parallel machines. One of several jumps of the
    frame has its own name.
    """
    names = [effect.name, *(["geometry"] if absorbed(rig, effect, ("geometry",)) < _THE_SAME else [])]
    names += ["frame_drift"] if effect.name == "frame" else []
    accepted = (NAMES_NOTHING, *(frozenset({n}) for n in dict.fromkeys(names)))
    return Truth("outside", (cause,), accepted, True, ("time",))


def _named_jump(rig: Rig, effect: Effect) -> Truth | None:
    """A jump that the library has a name for; None where it has none."""
    if effect.name == "frame":
        return Truth("single", ("frame_drift",), (frozenset({"frame_drift"}),))
    if effect.name != "joint_offset" or effect.joints is None:
        return None
    accepted = [frozenset({"homing"})]
    if rig.machine.name == ARM and effect.joints[:, 0].any():
        # A turn of the whole arm about a fixed axis: the very same.
        accepted.append(frozenset({"frame_drift"}))
    return Truth("single", ("homing",), tuple(accepted))


def _jump(make: Callable[[Rig], Effect], machines: Sequence[str] = ALL) -> Builder:
    """From a row in the middle third on the machine is another one."""

    def build(family: str, rng: np.random.Generator) -> SourceCase:
        rig = draw_rig(rng, machines)
        rig.show("time")
        start = int(rng.integers(rig.rows // 3, 2 * rig.rows // 3))
        effect = make(rig)
        after = _gated(rig, effect, (np.arange(rig.rows) >= start).astype(np.float64))
        truth = _named_jump(rig, effect) or _jump_truth(rig, family, effect)
        return plain_case(family, rig, after, float(rng.choice(_STRENGTHS)), truth)

    return build


def _loose_bolt(family: str, rng: np.random.Generator) -> SourceCase:
    """The machine's foot lies in one of two ways, and changes between them three to six times."""
    rig = draw_rig(rng)
    rig.show("time")
    changes = rng.choice(np.arange(10, rig.rows - 10), size=int(rng.integers(3, 7)), replace=False)
    state = (np.searchsorted(np.sort(changes), np.arange(rig.rows), side="right") % 2).astype(np.float64)
    effect = _frame(rig)
    after = _gated(rig, effect, state)
    return plain_case(family, rig, after, float(rng.choice(_STRENGTHS)), _jump_truth(rig, family, effect))


def _walking_zero(family: str, rng: np.random.Generator) -> SourceCase:
    """The zero of a joint walks at random: outside by the time.

    `drift` beside that is no error, since a walk is one. It is enough alone where its form (a straight and a
    logarithmic trend, and the first terms of a random walk) leaves less than twice the noise.
    """
    rig = draw_rig(rng, rows=(100, 400))
    rig.show("time")
    steps = rng.normal(size=rig.rows) * np.sqrt(np.diff(rig.time, prepend=rig.time[0]))
    walk = np.cumsum(steps)
    share = (rig.time - rig.time[0]) / np.ptp(rig.time)
    waves = [np.sin((k + 0.5) * np.pi * share) for k in range(_WALK)]
    trend = np.stack([share, np.log1p((rig.time - rig.time[0]) / 1800.0), *waves], -1)
    rest = walk - trend @ np.linalg.lstsq(trend, walk, rcond=None)[0]
    left = float(np.linalg.norm(rest) / np.linalg.norm(walk))
    change = np.zeros_like(rig.joints)
    change[:, pick(rig, 1)[0]] = walk
    named, strength = frozenset({"drift"}), float(rng.choice(_STRENGTHS))
    enough = (named,) if left * strength < SEEN else ()
    truth = Truth("outside", (family,), (NAMES_NOTHING, named), True, ("time",), enough=enough)
    return plain_case(family, rig, Effect(family, change), strength, truth)


JUMP_FAMILIES: dict[str, Builder] = {
    "jump_of_frame": _jump(_frame),
    "jump_of_tool": _jump(_tool, _ORIENTED),
    "jump_of_one_joint": _jump(_joint),
    "jump_of_geometry": _jump(_geometry, tuple(m for m in ALL if m != "tripod")),
    "loose_bolt": _loose_bolt,
    "random_walk_of_a_joint": _walking_zero,
}
