"""From a rig and its true poses to a case: columns as in a file, noise, and the answers that are right."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from ccnn_validation.sources.adversarial.effect import Effect, measured, scaled
from ccnn_validation.sources.adversarial.machine import Array, Machine
from ccnn_validation.sources.adversarial.rig import Rig
from ccnn_validation.sources.case import SourceCase, Truth

__all__ = ["NAMES_NOTHING", "Builder", "columns_of", "finish", "none", "plain_case", "pose_columns", "single", "white"]

Builder = Callable[[str, np.random.Generator], SourceCase]

NAMES_NOTHING: frozenset[str] = frozenset()


def none(outside: bool | None = False, drivers: Sequence[str] = ()) -> Truth:
    """Nothing is wrong with the machine."""
    return Truth("none", (), (NAMES_NOTHING,), outside, tuple(drivers))


def single(effect: Effect, strength: float, outside: bool | None = False, drivers: Sequence[str] = ()) -> Truth:
    """One cause by its name. What a form beside the textbook leaves is above the noise where the cause is strong, and
    an answer may say so."""
    beside = not effect.textbook and strength > 5
    return Truth("single", (effect.name,), (frozenset({effect.name}),), None if beside else outside, tuple(drivers))


def white(rig: Rig) -> Array:
    """Independent Gaussian noise, `s x p`."""
    return np.asarray(rig.rng.normal(size=rig.pose.shape) * rig.sigma)


def finish(
    family: str,
    rig: Rig,
    truth: Truth,
    clean: Array,
    noise: Array | None = None,
    kind: str = "white",
    stated: float | None = 1.0,
    always: bool = False,
) -> SourceCase:
    """A case.

    Args:
        family: its name.
        rig: the rig; its generator also draws white noise and whether the noise is given (in two thirds of the cases).
        truth: the right answers.
        clean: true poses, `s x p` [SI].
        noise: what is added to them, `s x p`; white when None.
        kind: what the noise is.
        stated: factor between the noise that the user states and the true one.
        always: give the noise in any case.
    """
    given = bool(rig.rng.random() < 2 / 3) or always
    noise = white(rig) if noise is None else noise
    levels = {unit: float(s) * (stated or 1.0) for unit, s in zip(rig.machine.pose_units, rig.sigma, strict=True)}
    return SourceCase(
        family=family,
        mechanism=rig.machine.text,
        mechanism_keys=rig.machine.keys or None,
        columns=columns_of(rig, rig.machine.moved(clean, noise)),
        noise=levels if given else None,
        truth=truth,
        clean=pose_columns(rig.machine, clean),
        noise_kind=kind,
    )


def plain_case(
    family: str, rig: Rig, effect: Effect, strength: float, truth: Truth | None = None, always: bool = False
) -> SourceCase:
    """A case with one error at a strength and white noise; `truth` is its own name alone when None."""
    clean = measured(rig, scaled(rig, effect, strength))
    return finish(family, rig, truth or single(effect, strength), clean, always=always)


def pose_columns(machine: Machine, pose: Array) -> dict[str, Array]:
    """Poses by header."""
    headers = (f"{c.name}[{c.unit}]" for c in machine.model.pose)
    return {h: np.ascontiguousarray(v) for h, v in zip(headers, pose.T, strict=True)}


def columns_of(rig: Rig, pose: Array) -> dict[str, Array]:
    """The file: joints, measured poses and the covariates that are recorded."""
    machine = rig.machine
    columns = {
        f"{j.name}[{j.unit}]": np.ascontiguousarray(v) for j, v in zip(machine.model.joints, rig.joints.T, strict=True)
    }
    columns |= pose_columns(machine, pose)
    if "time" in rig.shown:
        columns["time[s]"] = rig.time
    if "temperature" in rig.shown:
        columns["temperature[degC]"] = rig.temperature
    if "load" in rig.shown:
        for coordinate, values in zip(machine.model.pose, rig.load.T, strict=True):
            unit = "N" if coordinate.unit == "m" else "N*m"
            columns[f"load_{coordinate.name}[{unit}]"] = np.ascontiguousarray(values)
    if "direction" in rig.shown:
        columns |= {f"direction{i + 1}[1]": np.ascontiguousarray(d) for i, d in enumerate(rig.direction.T)}
    return columns
