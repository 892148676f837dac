"""BP-LM as a learner: fully connected sigmoid networks from many starts, trained by Levenberg-Marquardt."""

from __future__ import annotations

from itertools import pairwise
from typing import Annotated

import torch
from pydantic import Field
from pydantic.dataclasses import dataclass
from torch import Tensor

from ccnn_torch.evolution.random import uniform
from ccnn_torch.evolution.refinement import (
    RefinementState,
    log_evidence,
    part_of_problem,
    pose_refinement,
    second_order,
    start_refinement,
    step_refinement,
)
from ccnn_torch.evolution.settings import STRICT, Above, Count, Widths
from ccnn_torch.learners.protocol import TrainingData, weighted_mse
from ccnn_torch.learners.rows import OneNetwork, usable_rows
from ccnn_torch.numerics.trees import mapped, picked, put

_STARTS = 0


@dataclass(frozen=True, config=STRICT)
class BPLMSettings:
    """Settings of BP-LM; the paper gives none of its own.

    Attributes:
        hidden: nodes of each hidden layer. Bayesian regularisation switches off what the rows do not ask for, so that
            more nodes cost time rather than accuracy.
        restarts: networks from independent starts, trained side by side.
        iterations: Levenberg-Marquardt iterations at most; training ends earlier once every network is at rest.
        tolerance: a network is at rest, and is left there, once its log evidence changed by at most this per measured
            value in each of `patience` iterations.
        patience: see `tolerance`.

    Raises:
        ValueError: a value out of its range, in one sentence with the key.
    """

    hidden: Annotated[Widths, Field(min_length=1)] = (20,)
    restarts: Count = 6
    iterations: Count = 60
    tolerance: Above = 1e-3
    patience: Count = 3


class BPLM(OneNetwork):
    """Levenberg-Marquardt with Bayesian regularisation (`evolution.refinement`); a step is an iteration of all starts.

    The Jacobian is in closed form (`evolution._gauss_newton`), which is faster than `torch.func` and compared with it
    by a test. Starts are those of Nguyen and Widrow (IJCNN 1990), put to the logistic sigmoid: directions and places of
    the nodes drawn from the seed, slopes such that the nodes share out the range of the inputs; output weights are
    small.

    The model is the network of highest evidence so far, of whichever start and iteration. On case one (seeds 1000 to
    1009) the average of ten networks was as good (0.648 and 0.646 of the constant's error), and it would have ten times
    the nodes. Errors are judged in the channels of `data.metric` where there is one.

    Metrics of a step: `error_train`, `evidence_best` (logarithm, per measured value; highest now),
    `evaluations` (a Jacobian counts as many as there are outputs, the steps
    tried in an iteration count one), each `r`.
    """

    name = "bp_lm"

    def __init__(self, settings: BPLMSettings | None = None) -> None:
        self.settings = settings or BPLMSettings()

    def start(self, data: TrainingData) -> None:
        """Take the data and draw the starts; until the first step the model is the mean.

        Raises:
            MethodFailedError: training rows are not finite.
        """
        self._data = data = usable_rows(data)
        sizes = (data.inputs.shape[-1], *self.settings.hidden, data.targets.shape[-1])
        restarts = self.settings.restarts
        self._leading = (len(data.seeds), restarts)
        weights = _nguyen_widrow(sizes, data.seeds, restarts)
        self._masks = [
            data.seeds.new_ones(len(layer), o, i, dtype=torch.bool)
            for layer, (i, o) in zip(weights, pairwise(sizes), strict=True)
        ]
        rows = (data.inputs, data.targets, data.weights, data.metric)
        rows = mapped(lambda part: part.repeat_interleave(restarts, 0), rows)
        self._problem = pose_refinement(self._masks, weights, *rows)
        self._state = start_refinement(self._problem, weights)
        # Of each network, `r * restarts`.
        self._evidence = torch.full_like(self._state.damping, -torch.inf)
        self._rest = torch.zeros_like(self._state.calm)
        self._iterations = torch.zeros_like(self._evidence)
        # Zeros: the mean, until some evidence is known.
        self._best = torch.zeros_like(self._apart(self._state.weights)[:, 0])
        self._best_evidence = torch.full_like(data.weights[:, 0], -torch.inf)
        self._known = second_order(self._problem, self._state)

    def step(self) -> dict[str, Tensor]:
        """One iteration of every network."""
        data = self._data
        going = torch.nonzero(self._rest < self.settings.patience).flatten()
        problem = part_of_problem(self._problem, going)
        everything = (self._state, self._known, self._evidence, self._rest, self._iterations)
        state, known, before, rest, made = picked(everything, going)
        moved = step_refinement(problem, state, known)
        known = second_order(problem, moved)
        evidence = log_evidence(problem, moved, known) / (problem.rows.sum(-1) * moved.noise.shape[-1])
        calm = (evidence - before).abs() <= self.settings.tolerance
        renewed = (moved, known, evidence, torch.where(calm, rest + 1, 0), made + 1)
        self._state, self._known, self._evidence, self._rest, self._iterations = put(everything, going, renewed)
        highest, which = self._apart(self._evidence).max(-1)
        repeats = torch.arange(len(which), device=which.device)
        candidate = self._apart(self._state.weights)[repeats, which]
        better = highest > self._best_evidence
        self._best = torch.where(better.unsqueeze(-1), candidate, self._best)
        self._best_evidence = torch.where(better, highest, self._best_evidence)
        return {
            "error_train": weighted_mse(self.predict(data.inputs), data.targets, data.weights),
            "evidence_best": highest,
            "evaluations": self._apart(self._iterations).sum(-1) * (data.targets.shape[-1] + 1),
        }

    @property
    def finished(self) -> bool:
        """True once every network is at rest, or after the last iteration."""
        at_rest = bool((self._rest >= self.settings.patience).all())
        return at_rest or int(self._state.iteration) >= self.settings.iterations

    @property
    def converged(self) -> Tensor:
        """Whether the network of highest evidence is at rest, `r`, bool."""
        best = self._apart(self._evidence).argmax(-1, keepdim=True)
        at_rest: Tensor = self._apart(self._rest).gather(-1, best).squeeze(-1) >= self.settings.patience
        return at_rest

    @property
    def steps(self) -> int:
        """Iterations at most."""
        return self.settings.iterations

    def state_dict(self) -> dict[str, Tensor]:
        """The networks with their precisions, `r x restarts x ...`, and what is known of each."""
        known = {"log_evidence": self._evidence, "rest": self._rest, "iterations_made": self._iterations}
        tensors = {
            name: self._apart(value) if value.dim() else value
            for name, value in (self._state._asdict() | known).items()
        }
        return tensors | {"best": self._best, "best_evidence": self._best_evidence}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Take back a state; call `start` with the same data first."""
        self._best, self._best_evidence = state["best"], state["best_evidence"]
        flat = {name: value.flatten(0, 1) if value.dim() > 1 else value for name, value in state.items()}
        self._state = RefinementState(*(flat[name] for name in RefinementState._fields))
        self._evidence, self._rest, self._iterations = (flat[k] for k in ("log_evidence", "rest", "iterations_made"))
        self._known = second_order(self._problem, self._state)

    def _apart(self, value: Tensor) -> Tensor:
        """By repeat and restart, `r x restarts x ...`."""
        return value.reshape(*self._leading, *value.shape[1:])

    def _model(self) -> tuple[list[Tensor], list[Tensor]]:
        """Masks and weights of the model, `r x 1 x ...`."""
        masks = [mask[: len(self._best), None] for mask in self._masks]
        return masks, [layer.unsqueeze(1) for layer in self._problem.network.split(self._best)]


def _nguyen_widrow(sizes: tuple[int, ...], seeds: Tensor, restarts: int) -> list[Tensor]:
    """First weights, one a layer, `(r restarts) x out x (in + 1)` with the biases last."""
    shapes = [(out, into + 1) for into, out in pairwise(sizes)]
    draws = 2 * uniform(seeds, _STARTS, 0, (restarts, sum(out * width for out, width in shapes))) - 1
    parts = torch.split(draws, [out * width for out, width in shapes], dim=-1)
    layers = []
    for number, (part, (out, width)) in enumerate(zip(parts, shapes, strict=True)):
        drawn = part.reshape(-1, out, width)
        if number == len(shapes) - 1:
            layers.append(drawn / 2)
            continue
        direction = drawn[..., :-1] / torch.linalg.vector_norm(drawn[..., :-1], dim=-1, keepdim=True)
        # Twice the slope for tanh: the logistic sigmoid is (1 + tanh(x / 2)) / 2.
        slope = 2 * 0.7 * out ** (1 / (width - 1))
        layers.append(slope * torch.cat([direction, drawn[..., -1:]], -1))
    return layers
