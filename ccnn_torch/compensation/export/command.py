"""The compensator's command path as an ONNX graph: the fixed point's step is traced once and written for every step."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import onnx
import torch
from torch import Tensor

from ccnn_torch.compensation.compensator import Compensator
from ccnn_torch.compensation.export.graph import Graph, Value
from ccnn_torch.compensation.export.to_onnx import Traced, rows_apart_from
from ccnn_torch.compensation.model_files.onnx_session import METADATA_KEY
from ccnn_torch.compensation.secant import Step


class _Step:
    """δ at `joints - value`, of finite joints: the compensator's own formula in fewer operations."""

    def __init__(self, compensator: Compensator) -> None:
        self.compensator = compensator
        # Without what is computed at the caged joints themselves, joints may be caged once, with room for a correction:
        # beyond the cage all deviations are the safe one.
        self.caged_once = compensator.geometry is None and compensator.effects is None

    def __call__(self, joints: Tensor, covariates: Tensor, strange: Tensor, value: Tensor) -> tuple[Tensor, ...]:
        """Returns δ `s x n`, excess and weight `s x 1`, and the network's features."""
        own, domain = self.compensator, self.compensator.domain
        n = len(own.joints)
        inputs = torch.cat([joints - value, covariates], -1)
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
        value = faded[..., :n] * own.limit - faded[..., n:] * own.safe + own.safe
        if own.effects is not None:
            moved = own.effects(caged[..., :n] + value, caged[..., n:])
            value = own._limited(value + weight * moved)
        if own.geometry is not None:
            moved = own.geometry(caged[..., :n] + value)
            value = own._limited(value + (moved if own.geometry.extrapolates else weight * moved))
        return value, excess, weight, features


def _advanced(compensator: Compensator, joints: Tensor, kept: int) -> Traced:
    """(δ, correction, numbers kept of the steps before) -> the next correction, and these with the new ones."""

    def function(found: Tensor, correction: Tensor, *numbers: Tensor) -> tuple[Tensor, ...]:
        steps = [Step(*pair) for pair in zip(numbers[::2], numbers[1::2], strict=True)]
        correction, steps = compensator.next_correction(found, correction, steps)
        return correction, *(number for step in steps for number in step)

    # A tensor of its own for each: the tracer takes equal tensors for one input.
    return Traced(function, *(joints.clone() for _ in range(2 + kept)))


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
    n, m, domain = len(compensator.joints), len(compensator.covariates), compensator.domain
    rows = rows_apart_from(compensator)
    points = domain.centre.repeat(rows, 1)
    joints, covariates = points[:, :n].contiguous(), points[:, n:].contiguous()
    blank = torch.zeros(rows, 1, dtype=torch.float64)
    step = _Step(compensator)
    clean = Traced(lambda given: tuple(domain.clean(given)), points)
    one = Traced(step, joints, covariates, blank, torch.zeros_like(joints))

    batch: str | int = 1 if dtype == "float32" else "batch"
    graph = Graph(rows, opset, dtype)
    given = graph.input("joints", n, batch)
    if m:
        # No linear form: an infinite number times 0 would be none.
        names = [given.name, graph.input("covariates", m, batch).name]
        given = graph.node("Concat", names, (rows, n + m), (rows, n + m), axis=1)
    inputs, strange = clean(graph, given)
    inputs = graph.solid(inputs)

    def parts(whole: Tensor) -> tuple[Tensor, Tensor]:
        return whole[:, :n], whole[:, n:]

    ideal, more = Traced(parts, points)(graph, inputs)
    start = inputs
    if step.caged_once:
        room = torch.cat([compensator.limit, torch.zeros(m, dtype=torch.float64)])
        low, high = domain._cage_low - room, domain._cage_high + room
        (start,) = Traced(lambda v: torch.minimum(torch.maximum(v, low), high), points)(graph, inputs)
    at, more = Traced(parts, points)(graph, start)
    correction: Any = torch.zeros_like(joints)
    first = last = one(graph, at, more, strange, correction)
    kept: list[Value] = []
    for _ in range(compensator.iterations):
        if compensator.secant:
            correction, *kept = _advanced(compensator, joints, len(kept))(graph, last[0], correction, *kept)
        else:
            correction = last[0]
        last = one(graph, at, more, strange, correction)

    def inside(excess: Tensor) -> Tensor:
        return (excess <= 0).squeeze(-1)

    found: Mapping[str, Value] = {}
    found = {"deviation": graph.solid(last[0]), "back_deviation": graph.solid(first[0])}
    found |= {"guard": last[2], "back_guard": first[2]}
    whole = graph.solid(ideal)
    for name, sign, by in (("command", "Sub", correction), ("ideal", "Add", first[0])):
        found[name] = graph.node(sign, [whole.name, graph.solid(by).name], whole.shape, whole.shape)
    if "inside_domain" in outputs:
        (found["inside_domain"],) = Traced(inside, blank)(graph, last[1])
        (found["ideal_inside_domain"],) = Traced(inside, blank)(graph, first[1])
        features = compensator.scaling.features(points)
        sd = Traced(compensator.sd_of, blank, features)
        (found["deviation_sd"],) = sd(graph, last[2], last[3])
    model = graph.model({name: found[name] for name in outputs}, batch, "compensator")
    model.metadata_props.add(key=METADATA_KEY, value=metadata)
    return model
