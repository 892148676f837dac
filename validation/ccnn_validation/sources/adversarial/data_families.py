"""Families of mistakes in the records, and of causes whose covariate nobody recorded."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from ccnn_validation.sources.adversarial.effect import measured, scaled
from ccnn_validation.sources.adversarial.finish import (
    NAMES_NOTHING,
    Builder,
    finish,
    plain_case,
    single,
)
from ccnn_validation.sources.adversarial.machine import ARM, Array, machine_of
from ccnn_validation.sources.adversarial.ordinary import ordinary
from ccnn_validation.sources.adversarial.rig import ALL, draw_rig
from ccnn_validation.sources.case import SourceCase, Truth

__all__ = ["DATA_FAMILIES"]

_STRONG = (10.0, 30.0)
# No word that a text has without any mistake: every verdict tells of joints, and "late" is a part of "correlated".
_EXCHANGED = ("swap", "exchang", "interchang", "mixed up")
_LATE = ("row late", "another row")
# Advice to look at records and model as a whole.
_WHAT_TO_CHECK = ("this is the machine", "order of the joints", "convention")


def _mistake(cause: str, mention: Sequence[str], *names: str) -> Truth:
    accepted = (NAMES_NOTHING, *(frozenset({n}) for n in names))
    return Truth("data", (cause,), accepted, None, (), tuple(mention))


def _exchanged(columns: dict[str, Array], first: str, second: str) -> dict[str, Array]:
    """Columns with the values of two of them exchanged."""
    return {h: columns[second if h == first else first if h == second else h] for h in columns}


def _late_directions(family: str, rng: np.random.Generator) -> SourceCase:
    """Backlash, and direction columns that are one row late."""
    rig = draw_rig(rng)
    effect = scaled(rig, ordinary(rig, "backlash", textbook=True), float(rng.choice(_STRONG)))
    clean = measured(rig, effect)
    rig.direction = np.concatenate([rng.choice([-1.0, 1.0], size=(1, rig.machine.count)), rig.direction[:-1]])
    truth = _mistake("direction one row late", _LATE, "backlash")
    return finish(family, rig, truth, clean)


def _shifted_half(family: str, rng: np.random.Generator) -> SourceCase:
    """From the middle on each pose stands one row below its joints: a pose was measured twice."""
    rig = draw_rig(rng)
    half = rig.rows // 2
    source = np.where(np.arange(rig.rows) < half, np.arange(rig.rows), np.arange(rig.rows) - 1)
    truth = _mistake("poses one row late", _LATE)
    return finish(family, rig, truth, rig.pose[source])


def _wrong_load(kind: str) -> Builder:
    """Compliance, and two load columns exchanged or one of them (or all) with the wrong sign."""

    def build(family: str, rng: np.random.Generator) -> SourceCase:
        rig = draw_rig(rng)
        effect = scaled(rig, ordinary(rig, "compliance", textbook=True), float(rng.choice(_STRONG)))
        clean = measured(rig, effect)
        forces = [i for i, unit in enumerate(rig.machine.pose_units) if unit == "m"]
        first, second = (int(i) for i in rng.choice(forces, 2, replace=False))
        recorded = np.array(rig.load)
        if kind == "exchanged":
            recorded[:, [first, second]] = recorded[:, [second, first]]
            mention = _EXCHANGED
        else:
            recorded[:, slice(None) if rng.random() < 0.3 else first] *= -1.0
            mention = ("other sign", "wrong sign", "opposite sign", "signs of the columns")
        rig.load = recorded
        return finish(family, rig, _mistake(f"load columns {kind}", mention, "compliance"), clean)

    return build


def _swapped_axes(family: str, rng: np.random.Generator) -> SourceCase:
    """Two of the measured positions are exchanged in the file."""
    rig = draw_rig(rng)
    places = [f"{c.name}[m]" for c in rig.machine.model.pose if c.unit == "m"]
    first, second = (str(n) for n in rng.choice(places, 2, replace=False))
    case = finish(family, rig, _mistake("measured axes exchanged", (*_EXCHANGED, *_WHAT_TO_CHECK)), rig.pose)
    columns, clean = (_exchanged(dict(c or {}), first, second) for c in (case.columns, case.clean))
    return replace(case, columns=columns, clean=clean)


def _mislabelled_joints(family: str, rng: np.random.Generator) -> SourceCase:
    """Two columns of joints are exchanged in the file."""
    rig = draw_rig(rng)
    joints = [f"{j.name}[{j.unit}]" for j in rig.machine.model.joints]
    first, second = (str(n) for n in rng.choice(joints, 2, replace=False))
    case = finish(family, rig, _mistake("joints exchanged", (*_EXCHANGED, *_WHAT_TO_CHECK)), rig.pose)
    return replace(case, columns=_exchanged(dict(case.columns), first, second))


def _turned_base(family: str, rng: np.random.Generator) -> SourceCase:
    """The device's frame is turned by 30, 90 or 180 degrees about the vertical; `frame` is its name as well."""
    rig = draw_rig(rng, tuple(m for m in ALL if m != "tripod"))
    turn = Rotation.from_euler("z", float(rng.choice([30.0, 90.0, 180.0])), degrees=True)
    seen, axes = np.array(rig.pose), min(rig.pose.shape[1], 3)
    place = np.zeros((rig.rows, 3))
    place[:, :axes] = rig.pose[:, :axes]
    seen[:, :axes] = turn.apply(place)[:, :axes]
    if rig.machine.spatial:
        seen[:, 3:] = (turn * Rotation.from_rotvec(rig.pose[:, 3:])).as_rotvec()
    return finish(family, rig, _mistake("base frame turned", ("frame", *_WHAT_TO_CHECK), "frame"), seen)


def _wrong_convention(family: str, rng: np.random.Generator) -> SourceCase:
    """The arm's table is of the standard convention, and its file says modified."""
    rig = draw_rig(rng, (ARM,))
    case = finish(family, rig, _mistake("wrong DH convention", _WHAT_TO_CHECK), rig.pose)
    return replace(case, mechanism=machine_of(ARM, "modified").text)


def _unrecorded_load(family: str, rng: np.random.Generator) -> SourceCase:
    """Compliance without the load columns: no name, and no outliers either.

    Loads that are drawn anew look like more noise; with a given noise an answer must say that something is outside.
    """
    rig = draw_rig(rng)
    effect = ordinary(rig, "compliance")
    rig.shown.discard("load")
    case = plain_case(family, rig, effect, float(rng.choice(_STRONG)))
    truth = Truth("outside", ("compliance",), (NAMES_NOTHING,), None if case.noise is None else True)
    return replace(case, truth=truth)


def _unrecorded_direction(family: str, rng: np.random.Generator) -> SourceCase:
    """Backlash without the direction columns: outside; who infers them from the rows' order is right.

    It looks like more noise: with a given noise an answer must say one of the two.
    """
    rig = draw_rig(rng)
    effect = ordinary(rig, "backlash")
    rig.shown.discard("direction")
    strength = float(rng.choice(_STRONG))
    found = single(effect, strength).accepted
    drivers = ("direction", *rig.machine.joint_names)
    truth = Truth("outside", ("backlash",), (NAMES_NOTHING, *found), True, drivers, enough=found)
    case = plain_case(family, rig, effect, strength, truth)
    return case if case.noise is not None else replace(case, truth=replace(truth, outside=None))


DATA_FAMILIES: dict[str, Builder] = {
    "late_directions": _late_directions,
    "shifted_half": _shifted_half,
    "exchanged_load_columns": _wrong_load("exchanged"),
    "wrong_sign_of_load": _wrong_load("of wrong sign"),
    "swapped_axes": _swapped_axes,
    "mislabelled_joints": _mislabelled_joints,
    "turned_base_frame": _turned_base,
    "wrong_dh_convention": _wrong_convention,
    "unrecorded_load": _unrecorded_load,
    "unrecorded_direction": _unrecorded_direction,
}
