"""What a model file says of itself, the same in the master and every export, and exports that run without its code."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Mapping
from functools import cache
from pathlib import Path
from typing import Annotated, Any

import onnx
import onnxruntime
from google.protobuf.message import DecodeError  # type: ignore[import-untyped]
from numpy.typing import NDArray
from onnx.utils import Extractor
from onnxruntime.capi import onnxruntime_pybind11_state as runtime
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from ccnn_torch.compensation.outputs import OUTPUTS
from ccnn_torch.coordinates import Coordinate
from ccnn_torch.errors import InputError, ModelFileError, raise_if_out_of_memory

Array = NDArray[Any]

# How sentences about a touched file end.
TAKE_AGAIN = "; take it again from where it was written"

METADATA_KEY = "ccnn_torch"

# What a graph or a module of another kind than ours may raise. ONNX Runtime's errors have no common class.
RUN_ERRORS: tuple[type[Exception], ...] = (
    *(RuntimeError, ValueError, TypeError, KeyError, IndexError, AttributeError, ArithmeticError, MemoryError),
    *(v for v in vars(runtime).values() if isinstance(v, type) and issubclass(v, Exception)),
)
_FORMATS = "ccnn_torch compensator "
# No model that can be solved for needs as many; a forged one may not compute for ever.
_MOST_ITERATIONS = 10_000
_MOST_TERMS = 100
# Nor has an effect of the library as many numbers on any machine.
_MOST_NUMBERS = 10_000


def said(reason: Exception) -> str:
    """Message of such an error, short enough for a sentence: it contains names from the file."""
    return " ".join("".join(c if c.isprintable() else " " for c in str(reason)).split())[:200] or type(reason).__name__


def check_graph(model: onnx.ModelProto) -> None:
    """Refuse what our exports do not have: other files, operators of other libraries, loops and branches.

    Raises:
        ModelFileError: names what it is.
    """
    if model.functions:
        raise ModelFileError(f"its graph has a function of its own ({model.functions[0].name})" + TAKE_AGAIN)
    for node in model.graph.node:
        if node.domain not in ("", "ai.onnx"):
            raise ModelFileError(f"its graph has an operator of another library ({node.domain})" + TAKE_AGAIN)
        if any(a.HasField("g") or a.graphs for a in node.attribute):
            raise ModelFileError(f"its graph has a loop or a branch ({node.op_type})" + TAKE_AGAIN)
    for tensor in _tensors(model.graph):
        if tensor.data_location == onnx.TensorProto.EXTERNAL or tensor.external_data:
            raise ModelFileError(f"its graph reads another file ('{tensor.name}' is stored outside)" + TAKE_AGAIN)


def _tensors(graph: onnx.GraphProto) -> Iterator[onnx.TensorProto]:
    yield from graph.initializer
    sparse = [*graph.sparse_initializer]
    for attribute in (a for node in graph.node for a in node.attribute):
        yield from (attribute.t, *attribute.tensors)
        sparse += [attribute.sparse_tensor, *attribute.sparse_tensors]
    for tensor in sparse:
        yield from (tensor.values, tensor.indices)


def open_onnx(content: bytes) -> onnxruntime.InferenceSession:
    """A session on one thread: for one command, more only add jitter."""
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    options.inter_op_num_threads = 1
    options.log_severity_level = 4
    # Not by what the bytes look like.
    options.add_session_config_entry("session.load_model_format", "ONNX")
    # Else it prints what is wrong with a file, and tries the same again.
    return onnxruntime.InferenceSession(content, options, providers=["CPUExecutionProvider"], enable_fallback=0)


def run_onnx(session: onnxruntime.InferenceSession, joints: Array, covariates: Array | None) -> dict[str, Array]:
    """joints: `s x n`; covariates: `s x m` or None; returns the outputs by name."""
    feeds = {"joints": joints} if covariates is None else {"joints": joints, "covariates": covariates}
    names = [output.name for output in session.get_outputs()]
    return dict(zip(names, session.run(names, feeds), strict=True))


FORMAT = f"{_FORMATS}8"


_Number = Annotated[float, Field(allow_inf_nan=False)]
_Size = Annotated[float, Field(allow_inf_nan=False, ge=0)]
_Scale = Annotated[float, Field(allow_inf_nan=False, gt=0)]


class _Form(BaseModel):
    # Other keys are for others.
    model_config = ConfigDict(strict=True, extra="ignore")


class Axis(_Form):
    name: str
    unit: str


class MadeFor(_Form):
    name: str = ""
    joints: list[str] = []
    pose: list[str] = []
    parameters: dict[str, _Number] = {}


class Limit(_Form):
    limit: _Size
    most_deviation: _Size
    safe_correction: _Number
    safe_sd: _Size
    sd_scale: _Size


class Edge(_Form):
    low: _Number
    high: _Number


class Principal(_Form):
    centre: list[_Number]
    half_range: list[_Scale]
    directions: list[list[_Number]]
    low: list[_Number]
    high: list[_Number]


class Inside(_Form):
    inputs: dict[str, Edge]
    principal: Principal


class Acting(_Form):
    # Name, number of shapes, number of coefficients of each.
    acting: list[list[str | Annotated[int, Field(ge=0, le=_MOST_NUMBERS)]]] = []


class Closed(_Form):
    degree: Annotated[int, Field(ge=0, le=_MOST_TERMS)] = 0
    newton: Annotated[int, Field(ge=0, le=_MOST_TERMS)] = 0
    joints: Annotated[int, Field(ge=0, le=_MOST_TERMS)] = 0
    degrees: list[Annotated[int, Field(ge=0, le=_MOST_TERMS)]] = []
    ends: dict[str, Annotated[list[_Number], Field(min_length=2, max_length=2)]] = {}
    effects: Acting | None = None


class Facts(_Form):
    mechanism: MadeFor
    joints: Annotated[list[Axis], Field(min_length=1)]
    covariates: list[Axis]
    pose: list[Axis]
    network: dict[str, Any]
    machine: Closed = Closed()
    domain: Inside
    limits: dict[str, Limit]
    lipschitz: _Size
    iterations: Annotated[int, Field(ge=0, le=_MOST_ITERATIONS)]
    secant: bool = False


class PromisedErrors(_Form):
    rows: int
    configurations: int
    position: dict[str, Any]
    rotation: dict[str, Any] | None


class Metrics(_Form):
    promise: PromisedErrors | None = None
    """what the held-out rows promise for new ones: ccnn verify holds a model to it"""


class Card(Facts):
    """card.json, the model card beside an exported compensator."""

    format: str
    files: Annotated[dict[str, Annotated[str, Field(pattern="^[0-9a-f]{64}$")]], Field(min_length=1)]
    """file name -> SHA-256 of the whole file, hexadecimal"""
    data_sha256: str | None
    metrics: Metrics | None
    seed: int | None
    versions: dict[str, str]
    sha256: dict[str, str]
    columns: dict[str, str] | None = {}
    """header in the records -> name[unit] or ignore"""
    joint_map: dict[str, str] | None = {}
    """joint -> sum of columns, where its controller counts otherwise"""
    date: str
    notes: list[str]


def read_facts(text: Any) -> dict[str, Any]:
    """The facts in a file's metadata, when they are ours, unchanged, and of the form that is used later.

    Raises:
        ModelFileError: they are not; with the key that is missing, no finite number, or does not fit the rest.
    """
    try:
        facts = from_json(text or "null")
    except ValueError:
        raise ModelFileError("its metadata is not JSON" + TAKE_AGAIN) from None
    written = str(facts.get("format")) if isinstance(facts, dict) else ""
    if written != FORMAT and written.startswith(_FORMATS):
        raise ModelFileError(
            f"it has the form '{written}' of another version of this package, which reads {FORMAT!r}; write it again "
            "with this version (ccnn run …, or save_model)"
        )
    if not isinstance(facts, dict) or written != FORMAT:
        raise ModelFileError(
            f"its metadata does not have the form '{FORMAT}', so this package did not write it" + TAKE_AGAIN
        )
    stated = facts.get("sha256")
    if not isinstance(stated, dict) or stated.get("keys") != digest_of(facts):
        raise ModelFileError("its metadata was edited after it was written" + TAKE_AGAIN)
    # Two texts can mean one number (long decimals do), so the text itself must be the one we would write.
    if to_json(facts) != text:
        raise ModelFileError("its metadata was edited after it was written")
    try:
        form = Facts.model_validate(facts)
    except ValidationError as problem:
        first = problem.errors()[0]
        key = ".".join(map(str, first["loc"]))
        raise ModelFileError(f"its card or text has '{key}' wrong ({first['msg']})" + TAKE_AGAIN) from None
    joints = [c.name for c in form.joints]
    inputs = [*joints, *(c.name for c in form.covariates)]
    principal, d = form.domain.principal, len(inputs)
    right = {
        "joints": len({*inputs}) == d,
        # In another order in JSON, where keys are sorted.
        "limits": {*form.limits} == {*joints},
        "domain.inputs": {*form.domain.inputs} == {*inputs},
        "domain.principal": all(len(v) == d for v in (principal.centre, principal.half_range, *principal.directions))
        and len(principal.directions) == len(principal.low) == len(principal.high),
    }
    for key, good in right.items():
        if not good:
            raise ModelFileError(f"its card or text has '{key}' wrong (it does not fit the joints)" + TAKE_AGAIN)
    return facts


def coordinates(entries: list[dict[str, str]]) -> tuple[Coordinate, ...]:
    """Inverse of how coordinates are written in the metadata."""
    return tuple(Coordinate(entry["name"], entry["unit"]) for entry in entries)


def to_json(value: Mapping[str, Any], indent: int | None = None) -> str:
    """Sorted JSON without NaN, which UTF-8 can hold."""
    try:
        text = json.dumps(value, sort_keys=True, allow_nan=False, ensure_ascii=False, indent=indent)
        text.encode()
    except (TypeError, ValueError) as problem:
        raise InputError(f"a model's fields must be JSON: {problem}") from None
    return text


def from_json(text: str | bytes) -> Any:
    """JSON of a file from outside.

    Raises:
        ValueError: it is none, holds NaN or infinity, or is nested without end.
    """

    def no_number(word: str) -> None:
        raise ValueError(f"{word} is no number")

    try:
        return json.loads(text, parse_constant=no_number)
    except RecursionError:
        raise ValueError("is nested too deeply") from None


def digest_of(facts: Mapping[str, Any]) -> str:
    """SHA-256 of everything but itself; that of the tensors is among it."""
    others = {key: value for key, value in facts["sha256"].items() if key != "keys"}
    return hashlib.sha256(to_json({**facts, "sha256": others}).encode()).hexdigest()


def open_export(content: bytes) -> tuple[dict[str, Any], Any]:
    try:
        model = onnx.load_from_string(content)
    except DecodeError:
        raise ModelFileError("it is damaged, or no ONNX file" + TAKE_AGAIN) from None
    facts = read_facts({entry.key: entry.value for entry in model.metadata_props}.get(METADATA_KEY))
    if any(i.type.tensor_type.elem_type == onnx.TensorProto.FLOAT for i in model.graph.input):
        raise ModelFileError(
            "this is the single precision variant for controllers, which gives one row's deviation; use the .onnx "
            "file without 'float32' in its name"
        )
    check_graph(model)
    inputs = ["joints", "covariates"] if facts["covariates"] else ["joints"]
    if [i.name for i in model.graph.input] != inputs or not {*OUTPUTS} <= {o.name for o in model.graph.output}:
        raise ModelFileError(f"its graph does not take {', '.join(inputs)} and give {', '.join(OUTPUTS)}" + TAKE_AGAIN)
    try:
        whole = open_onnx(content)
    except RUN_ERRORS as reason:
        raise_if_out_of_memory(reason)
        raise ModelFileError(f"ONNX Runtime does not take its graph ({said(reason)})" + TAKE_AGAIN) from None

    @cache
    def session_of(outputs: frozenset[str]) -> onnxruntime.InferenceSession:
        # ONNX Runtime evaluates all of a graph, whatever is asked for.
        if len(outputs) == len(OUTPUTS):
            return whole
        return open_onnx(Extractor(model).extract_model(inputs, sorted(outputs)).SerializeToString())

    return facts, session_of


def card_of(path: Path, content: bytes) -> tuple[dict[str, Any], bytes]:
    """The card in the file's folder that lists the SHA-256 of these bytes, under any name; and the card's bytes.

    Raises:
        ModelFileError: there is none, or a card is damaged.
    """
    digest = hashlib.sha256(content).hexdigest()
    names = sorted({path.parent / "card.json", *path.parent.glob("*.card.json")})
    present = [name for name in names if name.is_file()]
    if not present:
        raise ModelFileError(
            f"{path}: there is no card.json beside it to vouch for it; copy the card from the folder it was written "
            "to, or name a model file"
        )
    for name in present:
        try:
            text = name.read_bytes()
            card = from_json(text)
        except OSError as reason:
            raise ModelFileError(f"{name}: cannot be read: {reason.strerror}") from None
        except ValueError:
            raise ModelFileError(f"{name}: this card is damaged; take it again from where it was written") from None
        files = card.get("files") if isinstance(card, dict) else None
        if isinstance(files, dict) and digest in files.values():
            found: dict[str, Any] = card
            for key in ("columns", "joint_map"):
                told = found.get(key) or {}
                if not isinstance(told, dict) or not all(isinstance(value, str) for value in told.values()):
                    raise ModelFileError(
                        f"{name}: {key} is no table of names and texts; take the card again from where it was written"
                    )
            return found, text
    raise ModelFileError(
        f"{path}: its SHA-256 is in none of the cards beside it ({', '.join(name.name for name in present)}): the file "
        "is damaged, altered or foreign; take it again from where it was written, with its card"
    )
