"""The compensator as ONNX: printed node by node, and verified against the eager model when it is made.

In double, ONNX Runtime has kernels for Gemm, Sigmoid, Tanh, Exp, Sin, Cos, Min, Max, Where, comparisons and arithmetic,
and none for Tan, Asin, Acos, Atan, Softplus, Elu, Gelu and Erf: a network made of those cannot be exported.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence
from itertools import count
from typing import Any

import numpy as np
import onnx
import torch
from onnx import compose, helper
from onnxruntime.capi.onnxruntime_pybind11_state import NotImplemented as NoKernel
from torch import Tensor
from torch.fx import GraphModule

from ccnn_torch.compensation.compensator import Compensator
from ccnn_torch.compensation.fit import SINGLE_TOLERANCE, single_steps
from ccnn_torch.compensation.model_files.metadata import METADATA_KEY, check_graph, open_onnx, run_onnx
from ccnn_torch.compensation.outputs import OUTPUTS
from ccnn_torch.compensation.routines import (
    KEPT,
    Functions,
    Variables,
    execute,
    routines_of,
)
from ccnn_torch.compensation.targets.golden import Golden, probe_points
from ccnn_torch.compensation.targets.lowering import recorded
from ccnn_torch.compensation.targets.onnx_graph import Graph, Value
from ccnn_torch.compensation.targets.onnx_operations import ByTensors
from ccnn_torch.errors import MethodFailedError

# Rows of an example, or a few more.
_LEAST = 61
_OPSET = 20
_OPSET_FLOAT32 = 17
# Of the correction limit: what a network may ask for.
_LOOSEST = 1e-9
# Points that are also compared one by one: what a batch hides is in the shapes, not in the values.
_ALONE = 48
_OUTPUTS_FLOAT32 = ("deviation", "guard", "back_deviation", "back_guard")


def rows_apart_from(module: torch.nn.Module) -> int:
    """How many rows an example has, so that a length is a multiple of them only where it grows with the batch."""
    tensors = [*module.state_dict().values(), *module.buffers()]
    lengths = {n for tensor in tensors for n in tensor.shape if n}
    primes = (p for p in count(_LEAST) if all(p % d for d in range(2, math.isqrt(p) + 1)))
    return next(p for p in primes if all(n % p for n in lengths))


# Those of a command alone, which have a short way where the guard is 1.
_OF_COMMAND = frozenset({"command", "deviation", "inside_domain", "status"})
# Of the limit: how far a correction moves joints, and what is rounded on the way.
_REACH = 1.01
# In the graph their numbers are there, so that command + deviation is the joints to the last digit.
_SOLID = frozenset({"ideal", "correction", "found"})


class GraphFunctions(Functions):
    """Those of a graph, in which every operation costs as much as a matrix product: fewer of them."""

    def __init__(self, own: Compensator) -> None:
        super().__init__(own)
        reach = float(own.limit.max())
        self.ends = float(own.domain._cage_low.min()) - reach, float(own.domain._cage_high.max()) + reach

    def in_reach(self, inputs: Tensor) -> Tensor:
        # Farther out they are finite, too, and one operation has one limit for all.
        return torch.clamp(inputs, *self.ends)

    def excess(self, caged: Tensor) -> Tensor:
        domain = self.own.domain
        away = (caged - domain.centre) @ domain._axes - domain.middle
        # Both sides at once: an absolute value would be one more operation between two products.
        beyond = torch.relu(torch.cat([away - domain.radius, -away - domain.radius], -1) / domain.width.repeat(2))
        return (beyond * beyond) @ domain._ones.repeat(2, 1)

    def faded(self, raw: Tensor, weight: Tensor) -> Tensor:
        limit, safe = self.own.limit, self.own.safe
        # In units of the limit, with a column of ones that becomes the weight: δ is a linear form of one array then.
        unit = torch.where(limit > 0, limit, torch.ones_like(limit))
        both = weight * torch.clamp(torch.cat([raw / unit, torch.ones_like(weight)], -1), -1.0, 1.0)
        return both[..., : self.joints] * limit - both[..., self.joints :] * safe + safe

    def surely_inside(self, inputs: Tensor) -> Tensor:
        """Whether every correction leaves all rows of `inputs` `s x (n + m)` [SI] inside the domain, 0-dim."""
        domain = self.own.domain
        reach = _REACH * self.own.limit @ domain._axes[: self.joints].abs()
        away = (inputs - domain.centre) @ domain._axes - domain.middle
        # What is no number is not inside.
        return (torch.cat([away, -away], -1) <= (domain.radius - reach).repeat(2)).all()


class InsideFunctions(GraphFunctions):
    """Those of rows that are `surely_inside`: the guard's weight is 1, and all inputs are finite."""

    def clean(self, inputs: Tensor) -> Variables:
        n, none = self.joints, torch.zeros_like(inputs[..., :1])
        found = {"ideal": inputs[..., :n], "q": inputs[..., :n], "x": inputs[..., n:]}
        return found | {"strange": none, "start": self.own.safe.expand_as(found["q"])}

    def excess(self, caged: Tensor) -> Tensor:
        return torch.zeros_like(caged[..., :1])


def command_graph(
    compensator: Compensator, opset: int, metadata: str, outputs: Sequence[str], dtype: str = "float64"
) -> onnx.ModelProto:
    """Both directions as one graph; the command alone has a branch for rows that are all `surely_inside`.

    Args:
        outputs: which ones, in order: those of `Solution`, or `deviation`, `guard`, `back_deviation`, `back_guard`.
        dtype: in which the graph computes; single precision is for one row.

    Raises:
        MethodFailedError: the model has an operation that no file has.
    """
    functions = GraphFunctions(compensator)
    model = _graph(functions, opset, outputs, dtype)
    if functions.caged_once and {*outputs} <= _OF_COMMAND:
        inside = _graph(InsideFunctions(compensator), opset, outputs, dtype)
        model = _branched(functions, inside.graph, model)
    model.metadata_props.add(key=METADATA_KEY, value=metadata)
    return model


def _branched(functions: GraphFunctions, inside: onnx.GraphProto, model: onnx.ModelProto) -> onnx.ModelProto:
    """One graph of two with the same outputs: `inside` where all rows are `surely_inside`, else that of the model."""
    graph, given = _begun(functions, model.opset_import[0].version, "float64")
    example = torch.zeros(given.shape, dtype=torch.float64)
    (sure,) = ByTensors(graph).run(recorded(functions.surely_inside, [example]), [given])
    found = graph.model({"surely_inside": sure}, "batch", "compensator")
    branches = {
        f"{name}_branch": compose.add_prefix_graph(own, f"{name}_", rename_inputs=False)
        for name, own in (("then", inside), ("else", model.graph))
    }
    for branch in branches.values():
        del branch.input[:]
    del found.graph.output[:]
    found.graph.output.extend(model.graph.output)
    found.graph.node.append(helper.make_node("If", ["surely_inside"], [o.name for o in model.graph.output], **branches))
    return found


def _begun(functions: GraphFunctions, opset: int, dtype: str) -> tuple[Graph, Value]:
    """A graph with its inputs, and these side by side, `s x (n + m)`."""
    compensator = functions.own
    n, m = len(compensator.joints), len(compensator.covariates)
    graph, batch = Graph(rows_apart_from(compensator), opset, dtype), 1 if dtype == "float32" else "batch"
    given = graph.input("joints", n, batch)
    if m:
        # No linear form: an infinite number times 0 would be none.
        names, shape = [given.name, graph.input("covariates", m, batch).name], (graph.rows, n + m)
        given = graph.node("Concat", names, shape, shape, axis=1)
    return graph, given


def _graph(functions: GraphFunctions, opset: int, outputs: Sequence[str], dtype: str) -> onnx.ModelProto:
    """As `command_graph`, without branches and metadata."""
    compensator = functions.own
    graph, given = _begun(functions, opset, dtype)
    n, rows = len(compensator.joints), graph.rows
    examples = functions.start(compensator.domain.centre.repeat(rows, 1))
    sd = "deviation_sd" in outputs
    routines = routines_of(compensator, KEPT, sd, ("sure",) if sd else ())
    with torch.no_grad():
        for routine in routines:
            functions.run(routine.statements, examples)
    nothing = examples["aim"][:, :0]
    lowering = ByTensors(graph)
    known: dict[tuple[str, int], tuple[GraphModule, list[str]]] = {}

    def call(name: str, values: dict[str, Any]) -> dict[str, Any]:
        inputs = {i: values[i] for i in functions.inputs_of(name)}
        if name.startswith("finish"):
            inputs |= {i: graph.solid(v) for i, v in inputs.items() if i in _SOLID and isinstance(v, Value)}
        # Steps of Broyden's method become more.
        key = name, values["steps"].shape[-1] if name == "following" else 0
        if key not in known:
            steps = {"steps": torch.zeros(rows, key[1], dtype=torch.float64)}
            # A tensor of its own for each: the tracer takes equal tensors for one input.
            own = [(examples | steps)[i].clone() for i in inputs]
            with torch.no_grad():
                given = [*getattr(functions, name)(*own)]
            known[key] = recorded(lambda *v: [*getattr(functions, name)(*v).values()], own), given
        module, given = known[key]
        return dict(zip(given, lowering.run(module, [*inputs.values()]), strict=True))

    def zeros(name: str) -> Tensor:
        return nothing if name == "steps" else torch.zeros(rows, n, dtype=torch.float64)

    found: dict[str, Any] = {"inputs": given, "aim": nothing}
    for routine in routines:
        execute(routine.statements, found, call, zeros)
    return graph.model({name: found[name] for name in outputs}, 1 if dtype == "float32" else "batch", "compensator")


def export_onnx(compensator: Compensator, metadata: str, outputs: Sequence[str] = OUTPUTS) -> bytes:
    """The compensator in float64 as a verified ONNX file without external data, for any number of rows.

    Inputs `joints` (`s x n`, ideal, SI) and, where there are any, `covariates` (`s x m`, SI). Outputs `command`,
    `deviation`, `inside_domain`, for the way back `ideal` and `ideal_inside_domain`: the ideal joints, were the input a
    command; and `deviation_sd`.

    Args:
        outputs: those that are wanted; each costs its own operations in every call.

    Raises:
        MethodFailedError: the file does not give the eager model's numbers, see `verify`, or cannot be run.
    """
    model = command_graph(compensator, _OPSET, metadata, outputs)
    if {*outputs} >= {*OUTPUTS}:
        # What is read back must not be refused; a controller's file is not, and has branches.
        check_graph(model)
    content: bytes = model.SerializeToString(deterministic=True)
    try:
        session = open_onnx(content)
    except NoKernel as reason:
        raise MethodFailedError(
            f"an operator of this model has no kernel in ONNX Runtime in double ({str(reason).rpartition(' : ')[2]}); "
            "leave out the learner or the effect (instrument on a machine that turns) that brings it"
        ) from None
    verify(compensator, lambda joints, covariates: run_onnx(session, joints, covariates), outputs)
    return content


def export_float32(compensator: Compensator, metadata: str) -> bytes:
    """Single precision, one row, opset 17, for engines with a narrow operator list: a verified ONNX file.

    Gemm, Sigmoid and elementwise operators only (Concat with covariates; sine and cosine with periodic inputs). A
    joint of 1 m has a step of 1e-7 m in single precision, about the size of the corrections, so the file gives
    deviations and the controller does the sums in its own precision: command = joints - `deviation`; the way back is
    ideal = joints + `back_deviation`. `guard` and `back_guard` are 1 inside the domain and fall to 0 outside.

    Raises:
        MethodFailedError: the file is not right to 1e-5 of the limit, or the model holds an identified machine,
            which is computed in double: a length of 1 m is rounded by as much as a deviation.
    """
    if compensator.machine is not None:
        raise MethodFailedError("the identified kinematics need double precision; use the float64 file")
    twin = copy.copy(compensator)
    if not twin.secant:
        twin.iterations = single_steps(compensator)
    joints, covariates = probe_points(compensator)
    given = [v.float() for v in (joints, covariates) if v is not None]
    model = command_graph(twin, _OPSET_FLOAT32, metadata, _OUTPUTS_FLOAT32, "float32")
    content: bytes = model.SerializeToString(deterministic=True)
    session = open_onnx(content)
    with torch.no_grad():
        found = compensator.run(given[0].double(), None if covariates is None else given[1].double())
        expected = [found[name] for name in _OUTPUTS_FLOAT32]
    tolerance = SINGLE_TOLERANCE * compensator.limit.numpy()
    for row in range(len(joints)):
        one = [v[row : row + 1].numpy() for v in given]
        said = run_onnx(session, one[0], one[1] if len(one) > 1 else None)
        for name, wanted in zip(_OUTPUTS_FLOAT32, expected, strict=True):
            allowed = 10 * SINGLE_TOLERANCE if "guard" in name else tolerance
            if not bool((np.abs(said[name].astype(np.float64) - wanted[row].numpy()) <= allowed).all()):
                raise MethodFailedError(
                    f"single precision does not hold this model: its output '{name}' is off by more than 1e-5 of the "
                    "limit; use the float64 file"
                )
    return content


def verify(compensator: Compensator, run: Any, outputs: Sequence[str] = OUTPUTS) -> None:
    """Compare an exported graph with the eager model, at random and at extreme points, in a batch and some one by one.

    Args:
        run: (joints `s x n`, covariates `s x m` or None) -> outputs by name.
        outputs: that there are.

    Raises:
        MethodFailedError: it differs by more than 1e-12 of the limit (commands: and the rounding of a joint; standard
            deviations: and 1e-12 of themselves). A network may ask for more than 1e-12, up to 1e-9, by its attribute
            `export_tolerance`; so may a machine.
    """
    joints, covariates = probe_points(compensator)
    with torch.no_grad():
        expected = compensator.solve(joints, covariates)._asdict()
    given = joints.numpy(), None if covariates is None else covariates.numpy()
    share = min(compensator.export_tolerance, _LOOSEST)
    wanted = {name: value.numpy() for name, value in expected.items()}
    vectors = Golden(given[0], joints.numpy()[:, :0], wanted, share * compensator.most.numpy(), share)
    together = run(*given)
    alone = {name: value.copy() for name, value in together.items()}
    for k in range(0, len(joints), max(1, len(joints) // _ALONE)):
        for name, value in run(*(None if v is None else v[k : k + 1] for v in given)).items():
            alone[name][k : k + 1] = value
    for found in (together, alone):
        wrong = [name for name, error in vectors.errors(found, outputs).items() if not error <= 1]
        if wrong:
            raise MethodFailedError(
                f"the ONNX export's output '{wrong[0]}' is not the model's to {share:.0e} of the limit; of a class of "
                "your own return NaN where the machine has no pose, else export with other versions of torch or "
                "onnxruntime"
            )
