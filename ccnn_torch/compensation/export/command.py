"""The compensator's routines as an ONNX graph: each function is traced once, and written as often as it is called."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar

import onnx
import torch
from torch import Tensor

from ccnn_torch.compensation.compensator import Compensator, status_of
from ccnn_torch.compensation.export.graph import Graph, Value
from ccnn_torch.compensation.export.traced import Traced, rows_apart_from
from ccnn_torch.compensation.machine.machine import ASTRAY
from ccnn_torch.compensation.model_files.onnx_session import METADATA_KEY
from ccnn_torch.compensation.routines import Copy, Functions, Statement, routines_of

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
