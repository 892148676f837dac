"""The compensator's command path as an ONNX graph: the fixed point's step is traced once and written for every step."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import onnx
import torch
from torch import Tensor

from ccnn_torch.compensation.compensator import Compensator
from ccnn_torch.compensation.export.graph import Graph, Value
from ccnn_torch.compensation.export.to_onnx import Traced, rows_apart_from
from ccnn_torch.compensation.machine.machine import ASTRAY, Machine
from ccnn_torch.compensation.model_files.onnx_session import METADATA_KEY
from ccnn_torch.compensation.secant import Step


class _Step:
    """What a step computes at `joints - correction`, of finite joints: the compensator's own formula in fewer
    operations."""

    def __init__(self, compensator: Compensator) -> None:
        self.compensator = compensator
        # Without what is computed at the caged joints themselves, joints may be caged once, with room for a correction:
        # beyond the cage all deviations are the safe one.
        parts = (compensator.geometry, compensator.effects, compensator.machine)
        self.caged_once = all(part is None for part in parts)

    def __call__(
        self, joints: Tensor, covariates: Tensor, strange: Tensor, known: Tensor, *at: Tensor
    ) -> tuple[Tensor, ...]:
        """Returns the next correction `s x n`, excess and weight `s x 1`, the network's features, and doubt `s x 1`.

        Args:
            joints, covariates: finite, `s x n`, `s x m`.
            strange, known: how many inputs were not finite, and 1 where none was, else 0, `s x 1`.
            at: the correction `s x n`, and with a machine its aim.
        """
        own, correction = self.compensator, at[0]
        value, excess, weight, features = self.learned(joints - correction, covariates, strange, known)
        if own.machine is None:
            return value, excess, weight, features, torch.zeros_like(strange)
        moved = joints - correction + value
        wanted = own.machine.next_correction(moved, own._held(covariates), joints, correction, at[1])
        following, doubt = own._settled(joints, wanted, correction, at[1])
        return following, excess, weight, features, doubt

    def learned(self, command: Tensor, covariates: Tensor, strange: Tensor, known: Tensor) -> tuple[Tensor, ...]:
        """What was learned (without a machine δ) at a command, its excess, weight and features."""
        own, domain = self.compensator, self.compensator.domain
        n = len(own.joints)
        inputs = torch.cat([command, covariates], -1)
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

    def back(self, command: Tensor, covariates: Tensor, strange: Tensor, known: Tensor) -> tuple[Tensor, ...]:
        """The machine's aim for the way back, and excess and weight of the command."""
        own = self.compensator
        assert own.machine is not None
        value, excess, weight, _ = self.learned(command, covariates, strange, known)
        return own.machine.aim_back(command + value, own._held(covariates)), excess, weight


def _advanced(compensator: Compensator, joints: Tensor, kept: int) -> Traced:
    """(δ, correction, numbers kept of the steps before) -> the next correction, and these with the new ones."""

    def function(found: Tensor, correction: Tensor, *numbers: Tensor) -> tuple[Tensor, ...]:
        steps = [Step(*pair) for pair in zip(numbers[::2], numbers[1::2], strict=True)]
        correction, steps = compensator.next_correction(found, correction, steps)
        return correction, *(number for step in steps for number in step)

    # A tensor of its own for each: the tracer takes equal tensors for one input.
    return Traced(function, *(joints.clone() for _ in range(2 + kept)))


def _examples(machine: Machine | None, joints: Tensor) -> list[Tensor]:
    """Of what a machine's steps take beside the correction."""
    return [] if machine is None else [machine.aim(joints)]


def _chosen(graph: Graph, known: Any, last: list[Any], first: list[Any], most: Tensor) -> list[Any]:
    """Correction, δ, excess, weight, features and doubt of the last step, or of the first where that went astray."""

    def choose(doubt: Tensor, known: Tensor, *both: Tensor) -> list[Tensor]:
        half = len(both) // 2
        good = _small(both[0], most, doubt) <= ASTRAY
        found = [torch.where(good, a, b) for a, b in zip(both[:half], both[half:], strict=True)]
        return [known * found[0], *found[1:]]

    pairs = [*last[:4], *first[:4]]
    blank = [torch.zeros(graph.rows, 1, dtype=torch.float64) for _ in range(2)]
    examples = [torch.ones(graph.rows, v.shape[1], dtype=torch.float64) for v in pairs]
    correction, excess, weight, features = Traced(choose, *blank, *examples)(graph, last[4], known, *pairs)
    return [correction, correction, excess, weight, last[4], features]


def _small(correction: Tensor, most: Tensor, doubt: Tensor) -> Tensor:
    """Doubt, and more than any where a correction is above its bound, `s x 1`."""
    beyond = torch.relu(correction.abs() - most * (1 + 1e-9)) @ torch.ones_like(most).unsqueeze(-1)
    return doubt + beyond / 1e-12


def _back(graph: Graph, step: _Step, at: Any, more: Any, strange: Any, known: Any) -> list[Any]:
    """The way back of a machine: correction, δ, excess, weight and doubt."""
    own = step.compensator
    assert own.machine is not None
    rows = own.domain.centre.repeat(graph.rows, 1)
    n = len(own.joints)
    joints, covariates = rows[:, :n].contiguous(), rows[:, n:].contiguous()
    blank = torch.zeros(len(rows), 1, dtype=torch.float64)
    traced = Traced(step.back, joints, covariates, blank, blank.clone())
    aim, excess, weight = traced(graph, at, more, strange, known)
    nothing = torch.zeros_like(joints)

    def try_one(command: Tensor, correction: Tensor, aim: Tensor) -> tuple[Tensor, Tensor]:
        return own.step_back(command - correction, correction, aim)

    one = Traced(try_one, joints, nothing, own.machine.aim_back(joints, covariates))
    start, doubt = one(graph, at, nothing, aim)
    correction = found = start
    for _ in range(own.iterations):
        correction = graph.solid(found)
        found, doubt = one(graph, at, correction, aim)

    def choose(doubt: Tensor, known: Tensor, last: Tensor, first: Tensor) -> Tensor:
        return -known * torch.where(_small(last, own.most, doubt) <= ASTRAY, last, first)

    traced = Traced(choose, blank, blank.clone(), joints, nothing.clone())
    deviation = traced(graph, doubt, known, correction, start)[0]
    return [deviation, deviation, excess, weight, doubt]


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
    (known,) = Traced(lambda v: 1 - torch.clamp(v, 0.0, 1.0), blank)(graph, strange)
    machine = compensator.machine
    nothing = torch.zeros_like(joints)
    aim: list[Value] = []
    if machine is not None:
        aim = Traced(machine.aim, joints)(graph, at)
    one = Traced(step, joints, covariates, blank, blank.clone(), nothing, *_examples(machine, joints))
    first = last = one(graph, at, more, strange, known, nothing, *aim)
    correction: Any = nothing
    kept: list[Value] = []
    for _ in range(compensator.iterations):
        if compensator.secant:
            correction, *kept = _advanced(compensator, joints, len(kept))(graph, last[0], correction, *kept)
        else:
            correction = graph.solid(last[0]) if machine is not None else last[0]
        last = one(graph, at, more, strange, known, correction, *aim)
    # Correction, δ, excess, weight and doubt of either way, and the features at the command.
    there = [correction, last[0], last[1], last[2], last[4], last[3]]
    back = [first[0], first[0], first[1], first[2], first[4]]
    if machine is not None:
        there = _chosen(graph, known, [correction, *last[1:]], [first[0], *first[1:]], compensator.most)
        back = _back(graph, step, at, more, strange, known)

    def inside(excess: Tensor) -> Tensor:
        return (excess <= 0).squeeze(-1)

    def status(excess: Tensor, doubt: Tensor, strange: Tensor) -> Tensor:
        found = torch.where(doubt <= 0, torch.where(excess > 0, 1.0, 0.0), 3.0)
        return torch.where(strange > 0, 2.0, found).squeeze(-1)

    found: dict[str, Any] = {"deviation": graph.solid(there[1]), "back_deviation": graph.solid(back[1])}
    found |= {"guard": there[3], "back_guard": back[3]}
    whole = graph.solid(ideal)
    for name, sign, by in (("command", "Sub", there[0]), ("ideal", "Add", back[0])):
        found[name] = graph.node(sign, [whole.name, graph.solid(by).name], whole.shape, whole.shape)
    for name, way in (("", there), ("ideal_", back)):
        if f"{name}inside_domain" in outputs:
            (found[f"{name}inside_domain"],) = Traced(inside, blank)(graph, way[2])
        if f"{name}status" in outputs:
            traced = Traced(status, blank, blank.clone(), blank + 0)
            found[f"{name}status"] = graph.whole(traced(graph, way[2], way[4], strange)[0])
    if "deviation_sd" in outputs:
        features = compensator.scaling.features(points)

        def spread(weight: Tensor, strange: Tensor, features: Tensor) -> Tensor:
            return torch.where(strange <= 0, compensator.sd_of(weight, features), compensator.fallback_sd)

        at_command = there[3], strange, there[5]
        (found["deviation_sd"],) = Traced(spread, blank, blank.clone(), features)(graph, *at_command)
    model = graph.model({name: found[name] for name in outputs}, batch, "compensator")
    model.metadata_props.add(key=METADATA_KEY, value=metadata)
    return model
