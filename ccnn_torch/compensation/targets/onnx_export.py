"""The compensator as ONNX: printed node by node, and verified against the eager model when it is made.

In double, ONNX Runtime has kernels for Gemm, Sigmoid, Tanh, Exp, Sin, Cos, Min, Max, Where, comparisons and arithmetic,
and none for Tan, Asin, Acos, Atan, Softplus, Elu, Gelu and Erf: a network made of those cannot be exported.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Sequence
from itertools import count
from typing import Any, ClassVar

import numpy as np
import onnx
import torch
from onnxruntime.capi.onnxruntime_pybind11_state import NotImplemented as NoKernel
from torch import Tensor
from torch.fx.experimental.proxy_tensor import make_fx

from ccnn_torch.compensation.compensator import Compensator, status_of
from ccnn_torch.compensation.contraction import Steepness, iterations_needed
from ccnn_torch.compensation.machine import ASTRAY
from ccnn_torch.compensation.model_files.onnx_session import METADATA_KEY, OUTPUTS, check_graph, open_onnx, run_onnx
from ccnn_torch.compensation.routines import Copy, Functions, Statement, routines_of
from ccnn_torch.compensation.targets.golden import Vectors, probe_points
from ccnn_torch.compensation.targets.onnx_graph import Graph, Value
from ccnn_torch.compensation.targets.onnx_operations import ByTensors
from ccnn_torch.errors import MethodFailedError

# Rows of an example, or a few more.
_LEAST = 61


def rows_apart_from(module: torch.nn.Module) -> int:
    """How many rows an example has, so that a length is a multiple of them only where it grows with the batch."""
    tensors = [*module.state_dict().values(), *module.buffers()]
    lengths = {n for tensor in tensors for n in tensor.shape if n}
    primes = (p for p in count(_LEAST) if all(p % d for d in range(2, math.isqrt(p) + 1)))
    return next(p for p in primes if all(n % p for n in lengths))


class Traced:
    """A function of tensors whose first axis is the batch."""

    def __init__(self, function: Callable[..., Any], *example: Tensor) -> None:
        with torch.no_grad():
            self._module = make_fx(lambda *given: function(*given), tracing_mode="real", pre_dispatch=True)(*example)

    def __call__(self, graph: Graph, *inputs: Any) -> list[Any]:
        """Write it into a graph; inputs and outputs are values or constants.

        Raises:
            MethodFailedError: there is an operation that no file has.
        """
        return ByTensors(graph).run(self._module, inputs)


# What a machine falls back to where its last step went astray.
_KEPT = (Copy("near_weight", "weight"), Copy("near_features", "features"))
# In the graph their numbers are there, so that command + deviation is the joints to the last digit.
_SOLID = frozenset({"ideal", "correction", "found"})


class GraphFunctions(Functions):
    """The compensator's own formulas in fewer operations, of which every one costs a graph as much as a matrix product.

    Further variables: `inputs` as given, `ideal` the finite joints themselves, `known` 1 where every input is finite,
    else 0; guard's `weight` and network's `features`, of the first step `near_weight` and `near_features`.
    """

    outputs: ClassVar[dict[str, str]] = {
        **Functions.outputs,
        "clean": "ideal q x strange known",
        "step": "found excess weight features doubt",
        "aim_back": "aim excess weight",
        **dict.fromkeys(("finish", "choose"), "command deviation inside_domain guard status deviation_sd"),
        **dict.fromkeys(
            ("finish_back", "choose_back"), "ideal back_deviation ideal_inside_domain back_guard ideal_status"
        ),
    }

    def __init__(self, own: Compensator, rows: int) -> None:
        super().__init__(own, rows)
        blank, q = self.examples["strange"], self.examples["q"]
        features = own.scaling.features(self.examples["inputs"])
        self.examples |= dict.fromkeys(("known", "weight", "near_weight"), blank)
        self.examples |= {"ideal": q, "features": features, "near_features": features}
        # Without what is computed at the caged joints themselves, joints may be caged once, with room for a correction:
        # beyond the cage all deviations are the safe one.
        self.caged_once = all(part is None for part in (own.geometry, own.effects, own.machine))

    def clean(self, inputs: Tensor) -> Sequence[Tensor]:
        n, domain = self.joints, self.own.domain
        finite, strange = domain.clean(inputs)
        at = finite
        if self.caged_once:
            room = torch.cat([self.own.limit, self.own.limit.new_zeros(len(self.own.covariates))])
            at = torch.minimum(torch.maximum(finite, domain._cage_low - room), domain._cage_high + room)
        return finite[:, :n], at[:, :n], at[:, n:], strange, 1 - torch.clamp(strange, 0.0, 1.0)

    def step(
        self, q: Tensor, x: Tensor, strange: Tensor, known: Tensor, correction: Tensor, aim: Tensor
    ) -> Sequence[Tensor]:
        own = self.own
        value, excess, weight, features = self._learned(q - correction, x, strange, known)
        if own.machine is None:
            return value, excess, weight, features, torch.zeros_like(strange)
        wanted = own.machine.next_correction(q - correction + value, own._held(x), q, correction, aim)
        following, doubt = own._settled(q, wanted, correction, aim)
        return following, excess, weight, features, doubt

    def aim_back(self, q: Tensor, x: Tensor, strange: Tensor, known: Tensor) -> Sequence[Tensor]:
        assert self.own.machine is not None
        value, excess, weight, _ = self._learned(q, x, strange, known)
        return self.own.machine.aim_back(q + value, self.own._held(x)), excess, weight

    def finish(
        self,
        ideal: Tensor,
        strange: Tensor,
        correction: Tensor,
        found: Tensor,
        excess: Tensor,
        weight: Tensor,
        features: Tensor,
        doubt: Tensor,
    ) -> Sequence[Tensor]:
        sd = torch.where(strange <= 0, self.own.sd_of(weight, features), self.own.fallback_sd)
        return ideal - correction, found, *self._flags(strange, excess, weight, doubt), sd

    def choose(
        self,
        ideal: Tensor,
        strange: Tensor,
        known: Tensor,
        first: Tensor,
        near: Tensor,
        near_weight: Tensor,
        near_features: Tensor,
        correction: Tensor,
        excess: Tensor,
        weight: Tensor,
        features: Tensor,
        doubt: Tensor,
    ) -> Sequence[Tensor]:
        good = self.own.is_allowed(correction) & (doubt <= ASTRAY)
        both = zip((correction, excess, weight, features), (first, near, near_weight, near_features), strict=True)
        taken, excess, weight, features = (torch.where(good, *pair) for pair in both)
        return self.finish(ideal, strange, known * taken, known * taken, excess, weight, features, doubt)

    def finish_back(
        self, ideal: Tensor, strange: Tensor, found: Tensor, excess: Tensor, weight: Tensor, doubt: Tensor
    ) -> Sequence[Tensor]:
        return ideal + found, found, *self._flags(strange, excess, weight, doubt)

    def choose_back(
        self,
        ideal: Tensor,
        strange: Tensor,
        known: Tensor,
        first: Tensor,
        correction: Tensor,
        excess: Tensor,
        weight: Tensor,
        doubt: Tensor,
    ) -> Sequence[Tensor]:
        good = self.own.is_allowed(correction) & (doubt <= ASTRAY)
        deviation = -known * torch.where(good, correction, first)
        return self.finish_back(ideal, strange, deviation, excess, weight, doubt)

    def _flags(self, strange: Tensor, excess: Tensor, weight: Tensor, doubt: Tensor) -> Sequence[Tensor]:
        """Whether inside the domain, the guard's weight, and the status."""
        inside = excess <= 0
        return inside.squeeze(-1), weight, status_of(strange, inside, doubt).squeeze(-1)

    def _learned(self, command: Tensor, x: Tensor, strange: Tensor, known: Tensor) -> tuple[Tensor, ...]:
        """What was learned (without a machine δ) at a command, its excess, weight and features."""
        own, domain = self.own, self.own.domain
        n = self.joints
        inputs = torch.cat([command, x], -1)
        caged = inputs if self.caged_once else domain.cage(inputs)
        features = own.scaling.features(caged)
        raw = own.scaling.restore(own.network(features))
        # In units of the limit, with a column of ones that becomes the weight: δ is a linear form of one array then.
        unit = torch.where(own.limit > 0, own.limit, torch.ones_like(own.limit))
        limited = torch.clamp(torch.cat([raw / unit, torch.ones_like(strange)], -1), -1.0, 1.0)
        away = (caged - domain.centre) @ domain._axes - domain.middle
        # Both sides at once: an absolute value would be one more operation between two products.
        beyond = torch.relu(torch.cat([away - domain.radius, -away - domain.radius], -1) / domain.width.repeat(2))
        excess = (beyond * beyond) @ domain._ones.repeat(2, 1) + strange
        fade = torch.relu(1 - excess)
        weight = fade * fade
        faded = weight * limited
        value = faded[..., :n] * own.limit - faded[..., n:] * own.safe + known * own.safe
        if own.effects is not None:
            value = own._limited(value + weight * own.effects(caged[..., :n] + value, caged[..., n:]))
        if own.geometry is not None:
            value = own._limited(value + weight * own.geometry(caged[..., :n] + value))
        return value, excess, weight, features


def command_graph(
    compensator: Compensator, opset: int, metadata: str, outputs: Sequence[str], dtype: str = "float64"
) -> onnx.ModelProto:
    """Both directions as one graph.

    Args:
        outputs: which ones, in order: those of `Solution`, or `deviation`, `guard`, `back_deviation`, `back_guard`.
        dtype: in which the graph computes; single precision is for one row.

    Raises:
        MethodFailedError: the model has an operation that no file has.
    """
    n, m = len(compensator.joints), len(compensator.covariates)
    functions = GraphFunctions(compensator, rows_apart_from(compensator))
    rows = len(functions.examples["q"])
    batch: str | int = 1 if dtype == "float32" else "batch"
    graph = Graph(rows, opset, dtype)
    given = graph.input("joints", n, batch)
    if m:
        # No linear form: an infinite number times 0 would be none.
        names = [given.name, graph.input("covariates", m, batch).name]
        given = graph.node("Concat", names, (rows, n + m), (rows, n + m), axis=1)
    traced: dict[tuple[str, int], Traced] = {}

    def call(name: str, values: dict[str, Any]) -> None:
        inputs = {i: values[i] if i in values else functions.examples[i] for i in functions.inputs_of(name)}
        if name.startswith("finish"):
            inputs |= {i: graph.solid(v) for i, v in inputs.items() if i in _SOLID and isinstance(v, Value)}
        # Steps of Broyden's method become more.
        key = name, values["steps"].shape[-1] if name == "following" else 0
        if key not in traced:
            examples = functions.examples | {"steps": torch.zeros(rows, key[1], dtype=torch.float64)}
            # A tensor of its own for each: the tracer takes equal tensors for one input.
            traced[key] = Traced(getattr(functions, name), *(examples[i].clone() for i in inputs))
        values |= dict(zip(functions.outputs[name].split(), traced[key](graph, *inputs.values()), strict=True))

    def run(statements: Sequence[Statement], values: dict[str, Any]) -> dict[str, Any]:
        for statement in statements:
            if isinstance(statement, str):
                call(statement, values)
            elif isinstance(statement, Copy):
                blank = torch.zeros(rows, 0 if statement.target == "steps" else n, dtype=torch.float64)
                values[statement.target] = values[statement.source] if statement.source else blank
            else:
                for _ in range(statement.times):
                    run(statement.statements, values)
        return values

    found: dict[str, Any] = {}
    for routine in routines_of(compensator, _KEPT):
        found |= run(routine.statements, {"inputs": given})
    model = graph.model({name: found[name] for name in outputs}, batch, "compensator")
    model.metadata_props.add(key=METADATA_KEY, value=metadata)
    return model


_OPSET = 20
_OPSET_FLOAT32 = 17
# Of the correction limit: what a network may ask for, and what single precision gives.
_LOOSEST = 1e-9
_TOLERANCE_FLOAT32 = 1e-5
_OUTPUTS_FLOAT32 = ("deviation", "guard", "back_deviation", "back_guard")


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
    # What is read back must not be refused.
    check_graph(model)
    content: bytes = model.SerializeToString(deterministic=True)
    try:
        session = open_onnx(content)
    except NoKernel as reason:
        raise MethodFailedError(
            f"an operator of this model has no kernel in ONNX Runtime in double ({str(reason).rpartition(' : ')[2]}); "
            "leave out the learner or the effect (instrument on a machine that turns) that brings it"
        ) from None
    verify(compensator, lambda joints, covariates: run_onnx(session, joints, covariates), "ONNX", outputs)
    return content


def export_float32(compensator: Compensator, metadata: str) -> bytes:
    """Single precision, one row, opset 17, for engines with a narrow operator list: a verified ONNX file.

    Gemm, Sigmoid and elementwise operators only (Concat with covariates; sine and cosine with periodic inputs). A
    joint of 1 m has a step of 1e-7 m in single precision, about the size of the corrections, so the file gives
    deviations and the controller does the sums in its own precision: command = joints - `deviation`; the way back is
    ideal = joints + `back_deviation`. `guard` and `back_guard` are 1 inside the domain and fall to 0 outside.

    Raises:
        MethodFailedError: the file is not right to 1e-5 of the limit, or the model holds physical effects or identified
            kinematics, which are computed in double: a length of 1 m is rounded by as much as a deviation.
    """
    if compensator.effects is not None or compensator.machine is not None:
        what = "identified kinematics" if compensator.effects is None else "physical effects"
        raise MethodFailedError(f"the {what} need double precision; use the float64 file")
    twin = copy.copy(compensator)
    if not twin.secant:
        twin.iterations = iterations_needed(Steepness(compensator.lipschitz, 1.0), _TOLERANCE_FLOAT32 / 10)
    joints, covariates = probe_points(compensator)
    given = [v.float() for v in (joints, covariates) if v is not None]
    model = command_graph(twin, _OPSET_FLOAT32, metadata, _OUTPUTS_FLOAT32, "float32")
    content: bytes = model.SerializeToString(deterministic=True)
    session = open_onnx(content)
    with torch.no_grad():
        expected = compensator.guarded(*(v.double() for v in given))
    tolerance = _TOLERANCE_FLOAT32 * compensator.limit.numpy()
    for row in range(len(joints)):
        one = [v[row : row + 1].numpy() for v in given]
        found = run_onnx(session, one[0], one[1] if len(one) > 1 else None)
        for name, wanted in zip(_OUTPUTS_FLOAT32, expected, strict=True):
            allowed = 10 * _TOLERANCE_FLOAT32 if "guard" in name else tolerance
            if not bool((np.abs(found[name].astype(np.float64) - wanted[row].numpy()) <= allowed).all()):
                raise MethodFailedError(
                    f"single precision does not hold this model: its output '{name}' is off by more than 1e-5 of the "
                    "limit; use the float64 file"
                )
    return content


def verify(compensator: Compensator, run: Any, form: str, outputs: Sequence[str] = OUTPUTS) -> None:
    """Compare an exported form with the eager model, at random and at extreme points, one by one and in a batch.

    Args:
        run: (joints `s x n`, covariates `s x m` or None) -> outputs by name.
        form: what the file is called in the error.
        outputs: that there are.

    Raises:
        MethodFailedError: it differs by more than 1e-12 of the limit (commands: and the rounding of a joint; standard
            deviations: and 1e-12 of themselves). A network may ask for more than 1e-12, up to 1e-9, by its attribute
            `export_tolerance`; so may geometry, effects and machine.
    """
    joints, covariates = probe_points(compensator)
    with torch.no_grad():
        expected = compensator.solve(joints, covariates)._asdict()
    given = joints.numpy(), None if covariates is None else covariates.numpy()
    share = min(compensator.export_tolerance, _LOOSEST)
    wanted = {name: value.numpy() for name, value in expected.items()}
    vectors = Vectors(given[0], joints.numpy()[:, :0], wanted, share * compensator.most.numpy(), share)
    for rows in (len(joints), 1):
        found = run(*(None if v is None else v[:rows] for v in given))
        wrong = [name for name, error in vectors.errors(found, outputs).items() if not error <= 1]
        if wrong:
            raise MethodFailedError(
                f"the {form} export's output '{wrong[0]}' is not the model's to {share:.0e} of the limit; export with "
                "other versions of torch or onnxruntime (tested ones: see the model card)"
            )
