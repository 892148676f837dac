"""From a name, a geometry file or a user's class to a mechanism, and from its description back."""

from __future__ import annotations

import difflib
import functools
import inspect
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from ccnn_torch.errors import InputError
from ccnn_torch.mechanisms._mechanism import Mechanism
from ccnn_torch.mechanisms._protocol import checked_plugin
from ccnn_torch.mechanisms.delta import Delta, DeltaLinear
from ccnn_torch.mechanisms.dh_file import read_dh_file
from ccnn_torch.mechanisms.five_bar import FiveBar
from ccnn_torch.mechanisms.framed import Framed
from ccnn_torch.mechanisms.machine_tool import MachineTool
from ccnn_torch.mechanisms.mechanism_file import MechanismFile, read_mechanism_file
from ccnn_torch.mechanisms.overconstrained import Overconstrained2Dof
from ccnn_torch.mechanisms.serial import SerialArm
from ccnn_torch.mechanisms.simulator import Simulator
from ccnn_torch.mechanisms.stewart import Stewart
from ccnn_torch.mechanisms.tripod import Tripod
from ccnn_torch.mechanisms.urdf import read_urdf
from ccnn_torch.plugins import class_hint, is_plugin, load_plugin

__all__ = ["REGISTRY", "load_mechanism", "mechanism_from_description"]


def _framed(
    mechanism: str | Mapping[str, Any], base: bool = True, tool: bool = False, rotation_weight: float = 0.04
) -> Framed:
    """A mechanism by name, file or description, seen from a measuring frame."""
    inner = load_mechanism(mechanism) if isinstance(mechanism, str) else mechanism_from_description(mechanism)
    return Framed(inner, base, tool, rotation_weight)


REGISTRY: dict[str, Callable[..., Mechanism]] = {
    "tripod": Tripod,
    "machine_tool": MachineTool,
    "five_bar": FiveBar,
    "overconstrained_2dof": Overconstrained2Dof,
    "stewart": Stewart,
    "delta": Delta,
    "delta_linear": DeltaLinear,
    "serial": SerialArm,
    "framed": _framed,
}

_READERS: dict[str, Callable[..., Mechanism]] = {".yaml": read_dh_file, ".yml": read_dh_file, ".urdf": read_urdf}
_YAML = (".yaml", ".yml")

_FORMS = "a serial arm's geometry file (.yaml, .urdf), or your own class or simulator as path/to/file.py:Name"


def load_mechanism(spec: str, **keys: Any) -> Mechanism:
    """A mechanism by name, by geometry file, or from a user's Python file.

    Args:
        spec: a name in the registry (`tripod`, `five_bar`, `stewart`, …), a DH file (.yaml), a URDF (.urdf), an
            identified machine's mechanism file (.yaml, as `ccnn identify` writes it), or `path/to/file.py:Name`: a
            class, a `Simulator`, or a function that makes one.
        keys: keys of its constructor (tripod: L, r, per_leg; DH file: orientation; URDF: base, tip, orientation;
            framed: mechanism, base, tool; …).

    Raises:
        InputError: unknown name (with the nearest), missing or faulty file, a key that the mechanism does not take, or
            a user's class that breaks the protocol of mechanisms.
    """
    if Path(spec).suffix.lower() in _YAML:
        file = read_mechanism_file(spec)
        if file is not None:
            return _from_file(file, keys)
    maker = _maker(spec)
    if is_plugin(spec):
        mechanism = checked_plugin(spec, functools.partial(_call, spec, maker, keys))
    else:
        mechanism = _call(spec, maker, keys)
    if (spec in REGISTRY or is_plugin(spec)) and not isinstance(mechanism, Framed):
        mechanism.recipe = {"spec": spec, "keys": keys}
    return mechanism


def mechanism_from_description(description: Mapping[str, Any]) -> Mechanism:
    """The mechanism that `Mechanism.describe` described, parameters equal bit by bit.

    Raises:
        InputError: the description lacks something, or names a file that is not there.
    """
    try:
        spec, keys, parameters = description["spec"], description["keys"], description["parameters"]
    except KeyError as missing:
        raise InputError(f"the mechanism's description lacks {missing}; write it with describe()") from None
    mechanism = load_mechanism(spec, **keys)
    mechanism.set_parameters(parameters)
    return mechanism


def _from_file(file: MechanismFile, keys: Mapping[str, Any]) -> Mechanism:
    mechanism = load_mechanism(file.spec, **{**file.keys, **keys})
    mechanism.set_parameters(file.parameters_of(mechanism, "value"))
    return mechanism


def _maker(spec: str) -> Callable[..., Any]:
    if spec in REGISTRY:
        return REGISTRY[spec]
    if is_plugin(spec):
        found = load_plugin(spec, (Simulator,))
        return (lambda: found) if isinstance(found, Simulator) else found
    reader = _READERS.get(Path(spec).suffix.lower())
    if reader is not None:
        return functools.partial(reader, spec)
    if Path(spec).suffix == ".py":
        raise InputError(class_hint(spec))
    near = difflib.get_close_matches(spec, REGISTRY, 1)
    hint = f"did you mean '{near[0]}'?" if near else f"known: {', '.join(REGISTRY)}."
    raise InputError(f"unknown mechanism '{spec}'; {hint} Otherwise give {_FORMS}")


def _call(spec: str, maker: Callable[..., Any], keys: Mapping[str, Any]) -> Any:
    """Call with the keys; a key too many or missing becomes a sentence."""
    signature = inspect.signature(maker)
    try:
        signature.bind(**keys)
    except TypeError as error:
        takes = ", ".join(signature.parameters) or "no keys"
        raise InputError(f"mechanism '{spec}': {error}; it takes {takes}") from None
    return maker(**keys)
