"""From a name, a geometry file or a user's class to a mechanism, and from its description back."""

from __future__ import annotations

import difflib
import functools
import inspect
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from ccnn_torch.errors import InputError
from ccnn_torch.mechanisms.files.dh_file import read_dh_file
from ccnn_torch.mechanisms.files.mechanism_file import MechanismFile, read_mechanism_file
from ccnn_torch.mechanisms.files.urdf import read_urdf
from ccnn_torch.mechanisms.frames.framed import Framed
from ccnn_torch.mechanisms.machines.delta import Delta, DeltaLinear
from ccnn_torch.mechanisms.machines.five_bar import FiveBar
from ccnn_torch.mechanisms.machines.machine_tool import MachineTool
from ccnn_torch.mechanisms.machines.overconstrained import Overconstrained2Dof
from ccnn_torch.mechanisms.machines.serial import SerialArm
from ccnn_torch.mechanisms.machines.stewart import Stewart
from ccnn_torch.mechanisms.machines.tripod import Tripod
from ccnn_torch.mechanisms.mechanism import Mechanism
from ccnn_torch.mechanisms.protocol import checked_plugin
from ccnn_torch.mechanisms.simulators.simulator import Simulator
from ccnn_torch.plugins import class_hint, code_refused, file_that_names, is_plugin, load_plugin


def _framed(
    mechanism: str | Mapping[str, Any],
    base: bool = True,
    tool: bool = False,
    rotation_weight: float = 0.04,
    keys: Mapping[str, Any] | None = None,
) -> Framed:
    """A mechanism by name or file with its keys, or by description, seen from a measuring frame."""
    for name, value in (("base", base), ("tool", tool)):
        if not isinstance(value, bool):
            raise InputError(
                f"mechanism 'framed': {name} is true or false, whether that frame is fitted, not {value!r}; keys of "
                "the mechanism inside go under keys: {mechanism: delta, keys: {base: 0.2}}"
            )
    # The reader of the file that contains this decides whether code may run.
    if isinstance(mechanism, str):
        inner = load_mechanism(mechanism, **(keys or {}))
    else:
        inner = mechanism_from_description(mechanism, allow_code=True)
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
_MODELS = (".safetensors", ".onnx", ".json")

_FORMS = "a serial arm's geometry file (.yaml, .urdf), or your own class or simulator as path/to/file.py:Name"


def load_mechanism(spec: str, *, allow_code: bool = False, **keys: Any) -> Mechanism:
    """A mechanism by name, by geometry file, or from a user's Python file.

    Only a Python file that `spec` itself names is run, not one that a file named by `spec` names.

    Args:
        spec: a name in the registry (`tripod`, `five_bar`, `stewart`, …), a DH file (.yaml), a URDF (.urdf), an
            identified machine's mechanism file (.yaml, as `ccnn identify` writes it), the machine of a model file
            (.safetensors, .onnx) or of a diagnosis.json, or `path/to/file.py:Name`: a class, a `Simulator`, or a
            function that makes one.
        allow_code: run the Python file that an identified machine's mechanism file names.
        keys: keys of its constructor (tripod: L, r, per_leg; DH file: orientation; URDF: base, tip, orientation;
            framed: mechanism, its keys, base, tool; …).

    Raises:
        InputError: unknown name (with the nearest), missing or faulty file, a key that the mechanism does not take, a
            user's class that breaks the protocol of mechanisms, or code that was not allowed.
    """
    if file_that_names() is not None and spec not in REGISTRY and not is_plugin(spec):
        raise InputError(f"{file_that_names()}: mechanism: must be one of {', '.join(REGISTRY)}, not {spec!r}")
    if Path(spec).suffix.lower() in _YAML:
        file = read_mechanism_file(spec)
        if file is not None:
            return mechanism_of_file(file, "value", allow_code, keys)
    if Path(spec).suffix.lower() in _MODELS and spec not in REGISTRY:
        if keys:
            raise InputError(f"mechanism_keys: {spec} has the keys of its own machine; leave out {', '.join(keys)}")
        # Model files hold more than a machine: what reads them comes after this package.
        from ccnn_torch.compensation.model_files.identified import load_machine

        return load_machine(spec, allow_code=allow_code)
    maker = _maker(spec)
    if is_plugin(spec):
        mechanism = checked_plugin(spec, functools.partial(_call, spec, maker, keys))
    else:
        mechanism = _call(spec, maker, keys)
    if (spec in REGISTRY or is_plugin(spec)) and not isinstance(mechanism, Framed):
        mechanism.recipe = {"spec": spec, "keys": keys}
    return mechanism


def mechanism_from_description(description: Mapping[str, Any], allow_code: bool = False) -> Mechanism:
    """The mechanism that `Mechanism.describe` described, parameters equal bit by bit.

    Args:
        description: out of a model file, say.
        allow_code: run the Python file that the description of a user's own class names.

    Raises:
        InputError: the description lacks something, is of no mechanism, names a file that is not there, or code that
            was not allowed.
    """
    try:
        spec, keys, parameters = description["spec"], description["keys"], description["parameters"]
    except KeyError as missing:
        raise InputError(f"the mechanism's description lacks {missing}; write it with describe()") from None
    with code_refused("the mechanism's description", allow_code):
        return _made(spec, keys, lambda _: parameters, "the mechanism's description")


def mechanism_of_file(
    file: MechanismFile, what: str, allow_code: bool = False, keys: Mapping[str, Any] | None = None
) -> Mechanism:
    """The mechanism of a mechanism file, with its parameters of one kind.

    Args:
        file: read.
        what: "value" or "nominal".
        allow_code: run the Python file that it names.
        keys: of the constructor, beside the file's own.

    Raises:
        InputError: the file does not describe a mechanism, or names code that was not allowed.
    """
    if file.spec not in REGISTRY and not is_plugin(file.spec):
        raise InputError(f"{file.path}: mechanism: must be one of {', '.join(REGISTRY)}, not {file.spec!r}")
    with code_refused(f"{file.path}: its key 'mechanism'", allow_code):
        return _made(file.spec, {**file.keys, **(keys or {})}, lambda m: file.parameters_of(m, what), file.path)


def _made(spec: str, keys: Any, parameters: Callable[[Mechanism], Any], source: str) -> Mechanism:
    """The mechanism that a file describes, whatever else the file contains."""
    try:
        mechanism = load_mechanism(spec, **keys)
        mechanism.set_parameters(parameters(mechanism))
    except (TypeError, ValueError, KeyError, IndexError, AttributeError, ArithmeticError, RuntimeError) as reason:
        raise InputError(
            f"{source} does not describe a mechanism ({reason}); take it from where it was written"
        ) from None
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
