"""The cooperative coevolutionary network of the paper (section III) as a learner."""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor

from ccnn_torch.evolution.coevolution import REPRESENTATIVES, density, diversity, make_task
from ccnn_torch.evolution.masked_network import MaskedNetwork, Spread, readout_spread, spread_variance
from ccnn_torch.evolution.network import forward
from ccnn_torch.evolution.random import member_seeds
from ccnn_torch.evolution.settings import CCNNSettings
from ccnn_torch.evolution.waves import Harmonics, Waves, fit_harmonics, harmonic_count
from ccnn_torch.learners.protocol import TrainingData, weighted_mse
from ccnn_torch.learners.rows import thinned
from ccnn_torch.learners.structure import MemberRows, Structure
from ccnn_torch.numerics.trees import below, mapped

# A training with rows held out, which chooses the number of steps, has one in so many of a refinement's iterations; the
# one on all rows goes on from its networks with the others.
_CHOOSING = 3
# Rows enough to choose, evolve and search for periodic nodes by; the training that goes on sees them all. With 1,000 of
# 2,100 rows a tripod had 7 % more error.
_ENOUGH = 3000


class CCNN:
    """Cooperative coevolution of structure and weights, then refinement and a search for periodic nodes.

    A step is one generation of every subpopulation; after the last generation it is one refinement, or one search for
    periodic nodes, of one structure. Without refinement the model is the best joined network by training fitness
    (eq. 11). With it, the members of highest evidence are averaged, and of two structures (`hidden` and
    `rival_hidden`) each repeat takes the one whose members have the higher evidence: Bayesian regularisation gives up
    training error for held-out error, so that training fitness could not choose. Refinement judges errors in the
    channels of `data.metric`, evolution (eq. 11) always in the outputs.

    Where the data show which output is the deviation of a turning joint itself, the harmonics of its gear are fitted
    first (with refinement only), and everything else learns what they leave.

    Metrics of a step: `fitness_best`, `fitness_mean` (over all individuals), `error_train` (mean square of the model,
    standardised), `evaluations` (joined networks so far, and of each iteration of a refinement as many as there are
    outputs for its Jacobian and one for the steps tried), each `r`; `density` and `diversity`, `r x layers` of the
    first structure.
    """

    name = "ccnn"
    reads_angles = True

    def __init__(self, settings: CCNNSettings | None = None) -> None:
        self.settings = settings or CCNNSettings()

    def start(self, data: TrainingData) -> None:
        """Take the data and judge the random first generation."""
        settings = self.settings
        members = settings.members
        if data.validation is not None:
            data = thinned(data, _ENOUGH)
        self._gears = _gears(data, settings)
        if self._gears is not None:
            there = (data.weights > 0).unsqueeze(-1)
            left = data.targets - self._gears(data.inputs)
            data = replace(data, targets=torch.where(there, left, data.targets))
        rows = (data.inputs, data.targets, data.weights, data.metric)
        inputs, targets, weights, metric = mapped(lambda part: part.repeat_interleave(members, dim=0), rows)
        features = data.inputs.shape[-1]
        # Sigmoids read an angle by its sine and cosine; periodic nodes read the angle.
        self._features, read = features, features - data.angles
        readable = torch.ones(features, dtype=torch.bool, device=data.inputs.device)
        readable[read - 2 * data.angles : read] = False
        task = make_task(inputs[..., :read], targets, weights)
        of_members = MemberRows(inputs, targets, weights, metric, task, member_seeds(data.seeds, members).flatten())
        self._data, self._phase = data, 0
        self._layers = settings.structures(targets.shape[-1])
        iterations = settings.refinement_iterations
        if data.validation is not None:
            iterations = math.ceil(iterations / _CHOOSING)
        self._structures = [Structure(hidden, settings, of_members, readable, iterations) for hidden in self._layers]

    def step(self) -> dict[str, Tensor]:
        """One generation, or one refinement or search after the last of them."""
        if not self._evolved:
            for structure in self._structures:
                structure.evolve()
        else:
            structure = self._structures[self._phase // self._phases_each]
            if self._phase % self._phases_each == 0:
                structure.refine()
            else:
                structure.search_waves()
            self._phase += 1
        return self._metrics()

    @property
    def finished(self) -> bool:
        """True after the last generation and refinement."""
        return self._evolved and self._phase >= self._phases

    @property
    def steps(self) -> int:
        """Generations, refinements and searches."""
        return self.settings.generations + self._phases

    def predict(self, inputs: Tensor) -> Tensor:
        """Output of the model of each repeat. inputs: `r x s x i` [1]; returns `r x s x o` [1]."""
        output = self._remainder(inputs)
        return output if self._gears is None else output + self._gears(inputs)

    def _remainder(self, inputs: Tensor) -> Tensor:
        """What the networks say, without the harmonics."""

        def one(structure: Structure) -> Tensor:
            model = structure.model()
            return forward(model.masks, model.weights, inputs, model.waves)

        return self._chosen([one(structure) for structure in self._structures])

    def variance(self, inputs: Tensor) -> Tensor:
        """Predictive variance of newly measured outputs. inputs: `r x s x i` [1]; returns `r x s x o` [1]."""

        def one(structure: Structure) -> Tensor:
            model = structure.model()
            return spread_variance(model.masks, model.weights, self._spread(structure), inputs, model.waves)

        variance = self._chosen([one(structure) for structure in self._structures])
        return variance if self._gears is None else variance + self._gears.variance(inputs)

    def network(self, repeat: int) -> MaskedNetwork:
        """The model of one repeat, pruned of its dead nodes."""
        structure = self._structure(repeat)
        model, spread = structure.model(), self._spread(structure)
        return MaskedNetwork(
            [mask[repeat] for mask in model.masks],
            [weight[repeat] for weight in model.weights],
            spread.factors[repeat],
            spread.noise[repeat],
            Waves(*(part[repeat] for part in model.waves)),
            self._features,
            None if self._gears is None else self._gears.repeat(repeat),
        )

    def state_dict(self) -> dict[str, Tensor]:
        """Subpopulations with their fitness, best joined networks, refined ones: `r x members x ...`."""
        tensors = {
            f"structure_{number}_{name}": tensor
            for number, structure in enumerate(self._structures)
            for name, tensor in structure.tensors().items()
        }
        counters = {"generation": self._structures[0].state.generation, "phase": self._phase}
        return tensors | {name: torch.tensor(value, dtype=torch.int64) for name, value in counters.items()}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Take back a state; call `start` with the same data first."""
        for number, structure in enumerate(self._structures):
            structure.load(below(state, f"structure_{number}_"), int(state["generation"]))
        self._phase = int(state["phase"])

    @property
    def refits(self) -> bool:
        """Whether `begin_from` shortens a training: not without refinement."""
        return self.settings.refinement_iterations > 0

    def begin_from(self, state: dict[str, Tensor]) -> None:
        """Refine the networks of this state, found on fewer of the same rows in the same scaling; after `start`."""
        most, kept = self.settings.refinement_iterations, self.settings.kept
        parts = [below(state, f"structure_{number}_") for number in range(len(self._structures))]
        evidence = [part["evidence"].sort(1, descending=True).values[:, :kept].mean(1) for part in parts]
        # Only the structure that each repeat took: a few rows more do not turn the evidence.
        taken = torch.stack(evidence).argmax(0)
        for number, (structure, part) in enumerate(zip(self._structures, parts, strict=True)):
            structure.begin_from(part, taken == number, most)

    @property
    def _evolved(self) -> bool:
        return self._structures[0].state.generation >= self.settings.generations

    @property
    def _phases_each(self) -> int:
        """Refinements and searches of one structure."""
        settings = self.settings
        if not settings.refinement_iterations:
            return 0
        return 1 + (settings.wave_searches if settings.waves else 0)

    @property
    def _phases(self) -> int:
        return self._phases_each * len(self._layers)

    def _scores(self) -> Tensor:
        """Evidence of each structure, `structures x r`."""
        return torch.stack([structure.score() for structure in self._structures])

    def _chosen(self, values: list[Tensor]) -> Tensor:
        """What the structure of higher evidence gives, repeat by repeat; the first one's before any refinement."""
        if len(values) == 1:
            return values[0]
        first = self._scores()[0] >= self._scores()[1]
        return torch.where(first[:, None, None], values[0], values[1])

    def _structure(self, repeat: int) -> Structure:
        return self._structures[int(self._scores()[:, repeat].argmax())]

    def _spread(self, structure: Structure) -> Spread:
        data, members = self._data, structure.members()
        return readout_spread(members.masks, members.weights, data.inputs, data.targets, data.weights, members.waves)

    def _metrics(self) -> dict[str, Tensor]:
        settings, first = self.settings, self._structures[0]
        judged = torch.zeros(len(self._data.seeds), dtype=torch.float64, device=self._data.inputs.device)
        for structure in self._structures:
            layers = len(structure.state.populations)
            joined = (structure.state.generation + 1) * layers * settings.population * (REPRESENTATIVES + 1)
            judged = judged + joined * settings.members + structure.by_repeat(structure.passes).sum(1)
        fitness = torch.stack([scores.mean(-1) for scores in first.state.fitness], -1)
        return {
            "fitness_best": first.by_repeat(first.state.best_fitness).amax(1),
            "fitness_mean": first.by_repeat(fitness).mean((1, 2)),
            "error_train": self._error(),
            "density": first.by_repeat(density(first.state.populations)).mean(1),
            "diversity": first.by_repeat(diversity(first.state.populations, settings.weight_range)).mean(1),
            "evaluations": judged,
        }

    def _error(self) -> Tensor:
        """Weighted mean squared error of the model on the training rows, `r`."""
        data = self._data
        there = (data.weights > 0).unsqueeze(-1)
        found = self._remainder(data.inputs.masked_fill(~there, 0)).masked_fill(~there, 0)
        return weighted_mse(found, data.targets.masked_fill(~there, 0), data.weights)


def _gears(data: TrainingData, settings: CCNNSettings) -> Harmonics | None:
    """Harmonics of the turning joints, where there are such joints, and rows enough."""
    rows = int((data.weights > 0).sum(-1).min())
    count = harmonic_count(settings.harmonics, rows, len(data.angle_outputs))
    if data.angle_step is None or not data.angle_outputs or not settings.refinement_iterations or count == 0:
        return None
    first = data.inputs.shape[-1] - data.angles
    return fit_harmonics(
        data.inputs[..., first:], data.angle_step, data.targets, data.weights, data.angle_outputs, data.metric, count
    )
