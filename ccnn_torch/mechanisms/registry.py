"""From a name, a geometry file or a user's class to a mechanism, and from its description back."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch

from ccnn_torch.errors import InputError
from ccnn_torch.mechanisms.dh_file import read_dh_file, read_urdf
from ccnn_torch.mechanisms.frames.framed import Framed
from ccnn_torch.mechanisms.frames.instrument import Instrument, instrument
from ccnn_torch.mechanisms.frames.partial import Partial, Seen
from ccnn_torch.mechanisms.gears import read_gears, read_motors
from ccnn_torch.mechanisms.kinds.machine_file import build_machine, read_machine_file, template
from ccnn_torch.mechanisms.machines.delta import Delta, DeltaLinear
from ccnn_torch.mechanisms.machines.five_bar import FiveBar
from ccnn_torch.mechanisms.machines.overconstrained import Overconstrained2Dof
from ccnn_torch.mechanisms.machines.pair import Pair
from ccnn_torch.mechanisms.machines.serial import SerialArm
from ccnn_torch.mechanisms.machines.sliders import MachineTool, Tripod
from ccnn_torch.mechanisms.machines.stewart import Stewart
from ccnn_torch.mechanisms.mechanism import Mechanism
from ccnn_torch.mechanisms.mechanism_file import MechanismFile, read_mechanism_file
from ccnn_torch.mechanisms.simulators.black_box import BlackBox
from ccnn_torch.mechanisms.simulators.simulator import Simulator
from ccnn_torch.plugins import class_hint, code_refused, file_that_names, is_plugin, load_plugin, users_code
from ccnn_torch.spelling import hint
from ccnn_torch.units import amount

_POSES, _STEPS = 256, 8
# A walk whose joints change by more than this in a step, or that differs by less from the direct answer, is not
# conclusive.
_LARGEST_STEP, _APART = 1.0, 0.1


def is_numeric(mechanism: Mechanism) -> bool:
    """Whether the mechanism's inverse kinematics are the numeric default, which needs a branch to start from."""
    return type(mechanism).solve_inverse is Mechanism.solve_inverse


def settle_home(mechanism: Mechanism) -> None:
    """Put `home_joints` exactly where `home_pose` is, by Newton from where they are; changed in place.

    From a guess that is only near, a search for another pose first has to return to the branch, and may miss it.
    Where there is no solution near, they stay.
    """
    if is_numeric(mechanism):
        exact = mechanism.solve_inverse(mechanism.home_pose)
        if exact.shape == mechanism.home_joints.shape and bool(torch.isfinite(exact).all()):
            mechanism.home_joints.copy_(exact)


def jump_sentence(mechanism: Mechanism, seed: int = 0) -> str:
    """What is wrong where numeric inverse kinematics straight from home end elsewhere than on a walk; empty if nothing.

    The walk goes along a straight line of pose coordinates, each step from the joints of the last. A line that leaves
    the workspace or comes near a singularity proves nothing and is left out.
    """
    if not is_numeric(mechanism):
        return ""
    poses = mechanism.sample_workspace(_POSES, torch.Generator().manual_seed(seed))
    direct = mechanism.solve_inverse(poses)
    walked = mechanism.home_joints.expand_as(direct)
    smooth = torch.ones(len(poses), dtype=torch.bool)
    for step in range(1, _STEPS + 1):
        here = torch.lerp(mechanism.home_pose.expand_as(poses), poses, step / _STEPS)
        there = mechanism.solve_inverse(here, guess=torch.where(smooth[:, None], walked, mechanism.home_joints))
        smooth &= mechanism.wrap(there - walked).abs().amax(-1) <= _LARGEST_STEP  # false for NaN, too
        walked = there
    gap = torch.where(smooth, mechanism.wrap(direct - walked).abs().amax(-1), 0.0)
    worst = int(gap.argmax())
    if float(gap[worst]) <= _APART:
        return ""
    where = ", ".join(
        f"{c.name} = {v:.4g} {c.unit}" for c, v in zip(mechanism.pose, poses[worst].tolist(), strict=True)
    )
    straight, stepped = (", ".join(f"{v:.4g}" for v in joints[worst].tolist()) for joints in (direct, walked))
    return (
        f"its numeric inverse kinematics leave the branch of home_joints: at {where} they give the joints {straight}, "
        f"and {stepped} when they go there in small steps; make low and high narrower, put home_pose in their middle "
        "with its exact home_joints, or write solve_inverse"
    )


# A root is settled to about 1e-12; a user's own closed form may close a little worse [m, rad].
_CLOSES = 1e-6
_ADVICE = "ccnn_torch.testing.check_mechanism reports more"


def checked_plugin(spec: str, make: Callable[[], Any]) -> Mechanism:
    """Make a user's mechanism and try it at its home configuration, alone and with two sets of parameters.

    Home joints that are only near those of the home pose are settled first; numeric inverse kinematics are then held
    against a walk through the sampling box, which must not end on another branch.
    """
    with users_code(spec):
        mechanism = make()
        if isinstance(mechanism, Simulator):
            mechanism = BlackBox(mechanism)
        if not isinstance(mechanism, Mechanism):
            raise InputError(
                f"{spec}: is no mechanism; derive the class from ccnn_torch.mechanisms.Mechanism, or make a Simulator"
            )
        wrong = wrong_names(mechanism) or _wrong_shape_of_closure(mechanism)
        if not wrong:
            settle_home(mechanism)
            wrong = _wrong_kinematics(mechanism) or jump_sentence(mechanism)
    if wrong:
        raise InputError(f"{spec}: {wrong}; {_ADVICE}")
    return mechanism


def wrong_names(m: Mechanism) -> str:
    """What is wrong with names, units, legs and the sampling box; empty where nothing is."""
    n, wanted = len(m.joints), [f"q{i + 1}" for i in range(len(m.joints))]
    if n == 0 or [j.name for j in m.joints] != wanted:
        return f"its joints must be named {', '.join(wanted) or 'q1, q2, …'}, not {[j.name for j in m.joints]}"
    for kind, names in (("pose", [c.name for c in m.pose]), ("geometry", [g.name for g in m.geometry])):
        twice = sorted({name for name in names if names.count(name) > 1})
        if twice:
            return f"its {kind} has the name '{twice[0]}' twice"
    strange = [c.header for c in (*m.joints, *m.pose) if c.unit not in ("m", "rad")]
    if strange:
        return f"joints and pose are in m or rad, not {strange[0]}"
    legless = [g for g in m.geometry if g.leg is not None and g.leg not in range(1, n + 1)]
    if legless:
        return f"parameter '{legless[0].name}' belongs to leg {legless[0].leg}; legs are numbered from 1 to {n}"
    if m.low.shape != (len(m.pose),) or m.high.shape != (len(m.pose),) or not bool((m.low < m.high).all()):
        return f"low and high need {len(m.pose)} numbers each, low below high"
    return ""


def _wrong_shape_of_closure(m: Mechanism) -> str:
    """Of a closure of its own, before anything solves it: 2 poses, as many joints, in two sets of parameters."""
    if type(m).closure is Mechanism.closure:
        return ""
    n, p, lead = len(m.joints), len(m.pose), (2, 3)
    gap = m.closure(m.home_pose.expand(*lead, p), m.home_joints.expand(*lead, n), m.nominal.expand(2, 1, -1))
    if isinstance(gap, torch.Tensor) and gap.shape[:-1] == lead:
        return ""
    got = f"shape {tuple(gap.shape)}" if isinstance(gap, torch.Tensor) else f"a {type(gap).__name__}"
    return (
        f"closure returned {got} for 2 x 3 configurations, expected (2, 3, N) with one number for each of N equations: "
        "stack them along the last dim, torch.stack([…], -1)"
    )


def _wrong_kinematics(m: Mechanism) -> str:
    n, p, sets = len(m.joints), len(m.pose), m.nominal.expand(2, 1, -1)
    pose = m.home_pose.expand(3, -1)
    joints = m.solve_inverse(pose, sets, m.home_joints)
    if joints.shape != (2, 3, n):
        got = tuple(joints.shape)
        return f"solve_inverse gives shape {got} for 3 poses and 2 sets of parameters, expected (2, 3, {n})"
    if joints.dtype != torch.float64:
        return f"solve_inverse gives {joints.dtype}, expected torch.float64"
    if not bool(torch.isfinite(joints).all()):
        return "its home pose has no joints; give home_pose (and home_joints near a solution)"
    gap = m.closure(pose, joints, sets)
    if not float(gap.abs().max()) <= _CLOSES:
        return f"closure is {float(gap.abs().max()):.2g} at the joints that solve_inverse gives, expected 0"
    there = m.forward_kinematics(joints, sets, m.home_pose)
    if there.shape != (2, 3, p):
        return f"forward_kinematics gives shape {tuple(there.shape)} for 2 x 3 configurations, expected (2, 3, {p})"
    error = m.pose_error(there, pose)
    off = max(float(e.max()) for e in error if e is not None)
    if not off <= _CLOSES:
        return f"forward_kinematics of the home pose's joints misses it by {off:.2g}"
    return ""


def _framed(
    mechanism: str | Mapping[str, Any],
    base: bool = True,
    tool: bool = False,
    rotation_weight: float = 0.04,
    keys: Mapping[str, Any] | None = None,
    frame_per: Sequence[str] = (),
    tool_per: Sequence[str] = (),
) -> Framed:
    """A mechanism by name or file with its keys, or by description, seen from a measuring frame."""
    for name, value in (("base", base), ("tool", tool)):
        if not isinstance(value, bool):
            raise InputError(
                f"mechanism 'framed': {name} is true or false, whether that frame is fitted, not {value!r}; keys of "
                "the mechanism inside go under keys: {mechanism: delta, keys: {base: 0.2}}"
            )
    return Framed(_inside(mechanism, keys), base, tool, rotation_weight, frame_per, tool_per)


def _inside(mechanism: str | Mapping[str, Any], keys: Mapping[str, Any] | None) -> Mechanism:
    # The reader of the file that contains this decides whether code may run.
    if isinstance(mechanism, str):
        return load_mechanism(mechanism, **(keys or {}))
    return mechanism_from_description(mechanism, allow_code=True)


def _partial(mechanism: str | Mapping[str, Any], pose: Sequence[str], keys: Mapping[str, Any] | None = None) -> Partial:
    """A mechanism by name or file with its keys, or by description, of which some pose coordinates are measured."""
    return Partial(_inside(mechanism, keys), pose)


def _instrument(
    mechanism: str | Mapping[str, Any],
    kind: str | None = None,
    instruments: Sequence[Mapping[str, Any]] | None = None,
    keys: Mapping[str, Any] | None = None,
    **of_instrument: Any,
) -> Instrument:
    """A mechanism by name or file with its keys, or by description, seen through one or several instruments."""
    if (kind is None) == (instruments is None) or (instruments is not None and of_instrument):
        raise InputError(
            "mechanism 'instrument': write kind and its keys, or instruments: a list of these, "
            "e.g. [{kind: wire, anchors: 2}, {kind: level}, {kind: pose}]"
        )
    return instrument(_inside(mechanism, keys), instruments or [{"kind": kind, **of_instrument}])


def _pair(first: str | Mapping[str, Any], second: str | Mapping[str, Any]) -> Pair:
    """Two arms by their files, or by description."""
    arms = [_inside(arm, None) for arm in (first, second)]
    return Pair(*arms)  # type: ignore[arg-type]


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
    "partial": _partial,
    "instrument": _instrument,
    "pair": _pair,
}


def _machine(machine: str, **content: Any) -> Mechanism:
    """A machine of a kind in the numbers that people know, as its machine file has them."""
    return build_machine({"machine": machine, **content}, "mechanism_keys", REGISTRY)


REGISTRY["machine"] = _machine

_READERS: dict[str, Callable[..., Mechanism]] = {".yaml": read_dh_file, ".yml": read_dh_file, ".urdf": read_urdf}
_YAML = (".yaml", ".yml")
_MODELS = (".safetensors", ".onnx", ".json")

_FORMS = "a serial arm's geometry file (.yaml, .urdf), or your own class or simulator as path/to/file.py:Name"


def load_mechanism(spec: str, *, allow_code: bool = False, **keys: Any) -> Mechanism:
    """A mechanism by name, by geometry file, or from a user's Python file.

    Only a Python file that `spec` itself names is run, not one that a file named by `spec` names.

    Args:
        spec: a name in the registry (`tripod`, `five_bar`, `stewart`, …), a DH file (.yaml), a URDF (.urdf), an
            identified machine's mechanism file (.yaml, as `ccnn identify` writes it), a machine file (.yaml, as
            `ccnn new --mechanism KIND` writes it), the machine of a model file
            (.safetensors, .onnx) or of a diagnosis.json, or `path/to/file.py:Name`: a class, a `Simulator`, or a
            function that makes one.
        allow_code: run the Python file that an identified machine's mechanism file names.
        keys: keys of its constructor (tripod: L, r, per_leg; DH file: orientation; URDF: base, tip, orientation;
            framed: mechanism, its keys, base, tool, frame_per, tool_per; partial: mechanism, its keys, pose;
            instrument: mechanism, its keys, kind, link, and those of the kind, or instruments; …); of any machine
            `gears` and `motors`, see `read_gears`, `read_motors`.

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
        machine = read_machine_file(spec)
        if machine is not None:
            return build_machine({**machine, **keys}, spec, REGISTRY)
    if Path(spec).suffix.lower() in _MODELS and spec not in REGISTRY:
        if keys:
            raise InputError(f"mechanism_keys: {spec} has the keys of its own machine; leave out {', '.join(keys)}")
        # Model files hold more than a machine: what reads them comes after this package.
        from ccnn_torch.compensation.model_files.identified import load_machine

        return load_machine(spec, allow_code=allow_code)
    maker = _maker(spec)
    taken = inspect.signature(maker).parameters
    of_drives = [key for key in ("gears", "motors") if spec not in _EXAMPLES and key not in taken]
    apart = {key: keys.pop(key) for key in of_drives if key in keys}
    if is_plugin(spec):
        mechanism = checked_plugin(spec, functools.partial(_call, spec, maker, keys))
    else:
        mechanism = _call(spec, maker, keys)
    plain = spec != "machine" and (spec in REGISTRY or is_plugin(spec))
    if plain and not isinstance(mechanism, Framed | Seen | Pair):
        mechanism.recipe = {"spec": spec, "keys": keys}
    if "gears" in apart:
        where = f"mechanism '{spec}': gears"
        told = read_gears(apart["gears"], mechanism.joints, where, lambda v, unit: amount(str(v), unit, where))
        mechanism.gears, apart["gears"] = tuple(told), told
    if "motors" in apart:
        mechanism.motors = read_motors(apart["motors"], mechanism.joints, f"mechanism '{spec}': motors")
    if apart:
        mechanism.recipe["keys"].update(apart)
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
    near = hint(spec, [*REGISTRY], "known:", ".")
    raise InputError(f"unknown mechanism '{spec}'; {near} Otherwise give {_FORMS}")


# Keys of what is made of another mechanism, as examples.
_EXAMPLES = {
    "framed": "mechanism: five_bar, keys: {l: 220 mm, L: 280 mm, a: 80 mm}",
    "partial": "mechanism: my_arm.yaml, pose: [x, y, z]",
    "instrument": "mechanism: my_arm.yaml, kind: wire, anchors: 2",
    "pair": "first: left.yaml, second: right.yaml",
    "machine": "machine: gantry",
}


def dimensions(name: str) -> str:
    """Names and values of the dimensions that a built-in machine is taken to have; empty for others."""
    takes = inspect.signature(REGISTRY[name]).parameters.values() if name in REGISTRY else ()
    sizes = [p for p in takes if isinstance(p.default, float) and _UNITS.get(p.name, "m")]
    return ", ".join(f"{p.name}: {p.default:g}" for p in sizes)


def machine_text(kind: str) -> str:
    """Text of a machine file of a kind, to be filled in.

    Raises:
        InputError: there is no such kind; of a mechanism that is built in it says what to write.
    """
    keys = _EXAMPLES.get(kind) or dimensions(kind)
    if keys:
        raise InputError(
            f"--mechanism {kind}: is built in and needs no file; write mechanism: {kind} and "
            f"mechanism_keys: {{{keys}}} into the config, with the numbers of your machine in m and rad, or with "
            "units, e.g. 220 mm"
        )
    return template(kind)


# Of keys of built-in mechanisms that are no lengths; None = any.
_UNITS = {**dict.fromkeys(("gamma", "lean", "base_spread", "platform_spread"), "rad"), "rotation_weight": None}


def _call(spec: str, maker: Callable[..., Any], keys: Mapping[str, Any]) -> Any:
    """Call with the keys, those of a built-in one with numbers in SI; a key too many or missing becomes a sentence."""
    signature = inspect.signature(maker)
    try:
        signature.bind(**keys)
    except TypeError as error:
        takes = ", ".join(signature.parameters) or "no keys"
        lacking = [
            p.name
            for p in signature.parameters.values()
            if p.default is p.empty and p.kind is p.POSITIONAL_OR_KEYWORD and p.name not in keys
        ]
        example = _EXAMPLES.get(spec) or ", ".join(f"{name}: …" for name in lacking)
        advice = f"needs {' and '.join(lacking)}; write e.g. mechanism_keys: {{{example}}} into the config"
        raise InputError(f"mechanism '{spec}': {advice if lacking else error}; it takes {takes}") from None
    numbers = {name: p.default for name, p in signature.parameters.items()} if spec in REGISTRY else {}
    return maker(
        **{
            name: amount(str(value), _UNITS.get(name, "m"), f"mechanism '{spec}': {name}")
            if isinstance(numbers.get(name), float) and not isinstance(value, int | float)
            else value
            for name, value in keys.items()
        }
    )
