"""The simulator with what a diagnosis found written into it: a servo's keys, a simulator's parameters, or an MJCF.

What a model cannot hold (a delay, a play, ...) stands beside it, as parameters of the axes that follow it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import torch

from ccnn_torch.errors import InputError
from ccnn_torch.motion.effects.bodies import CARRIED
from ccnn_torch.motion.effects.registry import OWN
from ccnn_torch.motion.engine import MotionDiagnosis
from ccnn_torch.motion.linearised import own_values
from ccnn_torch.motion.nominal import Nominal
from ccnn_torch.motion.servo import TORQUES, axis_keys
from ccnn_torch.motion.setting import nominal_of
from ccnn_torch.motion.stage import ABSENT
from ccnn_torch.plugins import code_refused
from ccnn_torch.report.json_files import write_json
from ccnn_torch.report.results.base import Number, Result

IDENTIFIED, _MODEL = "identified_motion.json", "identified.xml"
# What an MJCF can hold of an axis.
_IN_MJCF = ("gain", "inertia", "load", "viscous", "drive_damping", "coulomb", "weakness")

# No number is surer.
_ROUNDING = 1e-12

Axis = Mapping[str, float]


class _File(Result):
    """identified_motion.json, as ccnn diagnose --motion writes it"""

    mechanism: str
    mechanism_keys: dict[str, Any]
    units: list[str]
    effects: list[str]
    left: list[float]
    errors: list[float]
    axes: list[dict[str, float]]
    supply: Number = None
    temperature: Number = None


class Identified(NamedTuple):
    """A model as identified.

    Attributes:
        nominal: the model with the new values.
        axes: parameters of its axes, with what the model itself does not hold.
        left: RMS that it left on runs that were not fitted, of each joint [rad or m].
        effects: names of what it holds: of each axis the set that leaves least of runs that no fit saw.
        units: of the joints.
        errors: largest differences of command and position in the logs, of each joint [rad or m].
        temperature: that at which the model's friction holds [K]; None where none was recorded.
    """

    nominal: Nominal
    axes: tuple[Axis, ...]
    left: tuple[float, ...]
    effects: tuple[str, ...]
    units: tuple[str, ...]
    errors: tuple[float, ...] = ()
    temperature: float | None = None


def write_identified(folder: Path, found: MotionDiagnosis, nominal: Nominal, keys: Mapping[str, Any]) -> list[str]:
    """Write `identified_motion.json`, and for a MuJoCo model `identified.xml`; names of the files.

    Args:
        folder: where to.
        found: whose verdict names effects; with none, the model as it is.
        nominal: the model that was diagnosed.
        keys: of the mechanism, as given.
    """
    library, data = found.problem.library, found.problem.data
    values = library.parameters(torch.stack([spec.theta for spec in found.followed]), found.problem.axes)
    values = {name: v for name, v in values.items() if name != CARRIED and not name.startswith(OWN)}
    count = len(found.followed)
    axes = [{name: float(v[i]) for name, v in values.items() if float(v[i]) != ABSENT[name]} for i in range(count)]
    content = _File(
        mechanism=nominal.name,
        mechanism_keys=dict(keys),
        units=list(data.units),
        effects=list(dict.fromkeys(library.names[m] for spec in found.followed for m in spec.members)),
        left=[float(own[data.judged].square().mean().sqrt()) for own in found.left],
        errors=[float(own[data.judged].abs().max()) for own in data.command - data.position],
        axes=axes,
    )
    if "supply" in data.beside:
        content.supply = float((data.beside["supply"] / (1 + found.problem.driven.supply)).nanmedian())
        nominal = replace(nominal, supply=content.supply)
    if "temperature" in data.beside:
        content.temperature = float((data.beside["temperature"] - found.problem.driven.warm).median())
    files = [IDENTIFIED]
    if nominal.name == "servo":
        content.mechanism_keys = axis_keys(nominal, axes, _mass(found))
    elif nominal.simulator is not None:
        parameters = dict(nominal.simulator.parameters)
        for name, value in own_values(found.problem, found.followed).items():
            parameters[name] += value
        content.mechanism_keys = parameters
    elif nominal.loaded is not None:
        from ccnn_torch.motion.mujoco_motion import write_mjcf

        written = [{name: axis.get(name, ABSENT[name]) for name in _IN_MJCF} for axis in axes]
        write_mjcf(nominal.name, folder / _MODEL, written, nominal.gains, _at_tool(found))
        content.mechanism = _MODEL
        content.axes = [_beside(axis) for axis in axes]
        files.append(_MODEL)
    write_json(folder / IDENTIFIED, content)
    return files


def load_identified(path: Path, allow_code: bool = False) -> Identified:
    """The model of a file that `ccnn diagnose --motion` has written.

    Args:
        path: the file.
        allow_code: whether the Python file that it may name as its simulator runs.

    Raises:
        InputError: it is not there, is no such file, or names a model that is not there or may not run.
    """
    content = _File.read(path)
    mechanism, units, axes = content.mechanism, content.units, content.axes
    unknown = next((n for axis in axes for n, v in axis.items() if n not in ABSENT or not math.isfinite(v)), None)
    if (
        unknown is not None
        or not len(axes) == len(units) == len(content.left) == len(content.errors)
        or not {*units} <= {"rad", "m"}
    ):
        what = f"an axis has no number '{unknown}'"
        what = what if unknown else f"{len(axes)} axes for {len(units)} joints in rad or m"
        raise InputError(f"{path}: {what}; write it anew with ccnn diagnose --motion")
    name = str(path.parent / mechanism) if mechanism == _MODEL else mechanism
    with code_refused(f"{path}: its simulator", allow_code):
        nominal = nominal_of(name, content.mechanism_keys, units)
    if nominal.name == "servo":
        own = nominal.axes
    else:
        own = tuple({**axis, **of_model} for axis, of_model in zip(axes, nominal.axes, strict=True))
    nominal = replace(nominal, supply=content.supply or nominal.supply)
    left, effects, errors = tuple(content.left), tuple(content.effects), tuple(content.errors)
    return Identified(nominal, own, left, effects, tuple(units), errors, content.temperature or None)


def _beside(axis: Axis) -> dict[str, float]:
    """What an axis has beside its MJCF, over the gain in that."""
    found = {name: value for name, value in axis.items() if name not in _IN_MJCF}
    return found | {name: found[name] / axis.get("gain", 1.0) for name in TORQUES if name in found}


def _at_tool(found: MotionDiagnosis) -> float:
    """Mass at the tool [kg]: the mean of what the joints say, weighted by how sure they are."""
    payload = next((e for e in found.content["effects"] if e["name"] == "payload"), None)
    if payload is None or payload["name"] not in found.content["verdict"]["effects"]:
        return 0.0
    numbers = [(n["value"], 1 / max(n["sd"], _ROUNDING) ** 2) for n in payload["parameters"].values()]
    return float(sum(value * weight for value, weight in numbers) / sum(weight for _, weight in numbers))


def _mass(found: MotionDiagnosis) -> list[float]:
    """What a payload adds to each axis [kg]."""
    library = found.problem.library
    if "payload" not in library.names:
        return [0.0] * len(found.followed)
    places = library.places[library.names.index("payload")]
    return [
        sum(float(spec.theta[j]) * library.numbers[i][j].scale for j in places) for i, spec in enumerate(found.followed)
    ]
