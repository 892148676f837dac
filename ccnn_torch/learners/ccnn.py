"""The cooperative coevolutionary network of paper 000 (section III) as a learner."""

from __future__ import annotations

import torch
from torch import Tensor

from ccnn_torch.evolution.coevolution import Coevolution, advance, density, diversity, keep_refined, start
from ccnn_torch.evolution.evaluation import fitness, joined_errors, make_task
from ccnn_torch.evolution.genome import Genome
from ccnn_torch.evolution.network import MaskedNetwork, average, forward
from ccnn_torch.evolution.random import member_seeds
from ccnn_torch.evolution.refinement import RefinementSettings, refine
from ccnn_torch.evolution.settings import CCNNSettings
from ccnn_torch.evolution.spread import Spread, readout_spread, spread_variance
from ccnn_torch.learners._protocol import TrainingData

__all__ = ["CCNN", "CCNNSettings"]


class CCNN:
    """Cooperative coevolution of structure and weights; one step is one generation of every subpopulation.

    The model is the best joined network so far by training fitness (eq. 11). Where refinement is on, it is the refined
    network of highest evidence, from the first refinement on: Bayesian regularisation gives up training error for
    held-out error, so that training fitness could not choose between the two. Refinement judges errors in the
    channels of `data.metric`, evolution (eq. 11) always in the outputs. With several members, each repeat runs as many
    coevolutions, and its model is the mean of their networks.

    Metrics of a step: `fitness_best`, `fitness_mean` (over all individuals), `error_train` (mean square of the model,
    standardised), `evaluations` (joined networks so far), each `r`; `density` and `diversity`, `r x layers`.
    """

    name = "ccnn"

    def __init__(self, settings: CCNNSettings | None = None) -> None:
        self.settings = settings or CCNNSettings()

    def start(self, data: TrainingData) -> None:
        """Take the data and judge the random first generation."""
        members = self.settings.members
        self._repeats = len(data.seeds)
        self._inputs, self._targets, self._rows = (
            part.repeat_interleave(members, dim=0) for part in (data.inputs, data.targets, data.weights)
        )
        self._metric = None if data.metric is None else data.metric.repeat_interleave(members, dim=0)
        self._task = make_task(self._inputs, self._targets, self._rows)
        self._seeds = member_seeds(data.seeds, members).flatten()
        sizes = (data.inputs.shape[-1], *self.settings.hidden, data.targets.shape[-1])
        self._state = start(sizes, self._task, self.settings, self._seeds)
        self._evidence = torch.full_like(self._state.best_fitness, -torch.inf)
        self._refined = tuple(Genome(part.mask.clone(), part.weight.clone()) for part in self._state.best)

    def step(self) -> dict[str, Tensor]:
        """One generation, and a refinement where one is due."""
        settings = self.settings
        self._state = advance(self._state, self._task, settings, self._seeds)
        every = settings.refine_every
        if settings.refinement_iterations and (self.finished or (every and self._state.generation % every == 0)):
            self._refine()
        state = self._state
        best = self._by_repeat(state.best_fitness)
        judged = (state.generation + 1) * len(state.populations) * settings.population * (settings.representatives + 1)
        return {
            "fitness_best": best.amax(1),
            "fitness_mean": self._by_repeat(torch.stack([scores.mean(-1) for scores in state.fitness], -1)).mean(
                (1, 2)
            ),
            "error_train": self._error(),
            "density": self._by_repeat(density(state.populations)).mean(1),
            "diversity": self._by_repeat(diversity(state.populations, settings.weight_range)).mean(1),
            "evaluations": torch.full_like(best[:, 0], judged * settings.members),
        }

    @property
    def finished(self) -> bool:
        """True after the last generation, or once every coevolution has reached the target error."""
        settings, state = self.settings, self._state
        error = 1 / state.best_fitness - settings.epsilon
        reached = settings.target_error > 0 and bool((error <= settings.target_error).all())
        return reached or state.generation >= settings.generations

    @property
    def steps(self) -> int:
        """Generations."""
        return self.settings.generations

    def predict(self, inputs: Tensor) -> Tensor:
        """Output of the model of each repeat. inputs: `r x s x i` [1]; returns `r x s x o` [1]."""
        masks, weights = self._member_networks()
        return forward(masks, weights, inputs.unsqueeze(1)).mean(1)

    def variance(self, inputs: Tensor) -> Tensor:
        """Predictive variance of newly measured outputs. inputs: `r x s x i` [1]; returns `r x s x o` [1]."""
        return spread_variance(*average(*self._member_networks()), self._spread(), inputs)

    def masks(self) -> list[Tensor]:
        """Connections of the model, one layer each, `r x out x in`, bool."""
        return average(*self._member_networks())[0]

    def weights(self) -> list[Tensor]:
        """Weights of the model, one layer each, `r x out x in`, or `r x out x (in + 1)` with the biases last."""
        return average(*self._member_networks())[1]

    def genome(self, repeat: int) -> tuple[list[Tensor], list[Tensor]]:
        """Masks and weights of one repeat's model, dead nodes included: `out x in` and `out x (in or in + 1)`."""
        masks, weights = average(*self._member_networks())
        return [mask[repeat] for mask in masks], [weight[repeat] for weight in weights]

    def network(self, repeat: int) -> MaskedNetwork:
        """The model of one repeat, pruned of its dead nodes."""
        spread = self._spread()
        return MaskedNetwork(*self.genome(repeat), spread.factors[repeat], spread.noise[repeat])

    def state_dict(self) -> dict[str, Tensor]:
        """Subpopulations with their fitness, the best joined network, the refined one: `r x members x ...`."""
        state = self._state
        tensors = {"best_fitness": state.best_fitness, "refined_evidence": self._evidence}
        for name, parts in (("population", state.populations), ("best", state.best), ("refined", self._refined)):
            for layer, part in enumerate(parts):
                tensors[f"{name}_mask_{layer}"] = part.mask
                tensors[f"{name}_weight_{layer}"] = part.weight
        tensors |= {f"fitness_{layer}": scores for layer, scores in enumerate(state.fitness)}
        generation = torch.tensor(state.generation, dtype=torch.int64)
        return {name: self._by_repeat(tensor) for name, tensor in tensors.items()} | {"generation": generation}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Take back a state; call `start` with the same data first."""
        layers = range(len(self._state.populations))
        flat = {name: tensor.flatten(0, 1) for name, tensor in state.items() if tensor.dim() > 0}

        def parts(name: str) -> tuple[Genome, ...]:
            return tuple(Genome(flat[f"{name}_mask_{n}"], flat[f"{name}_weight_{n}"]) for n in layers)

        self._state = Coevolution(
            populations=parts("population"),
            fitness=tuple(flat[f"fitness_{n}"] for n in layers),
            best=parts("best"),
            best_fitness=flat["best_fitness"],
            generation=int(state["generation"]),
        )
        self._refined = parts("refined")
        self._evidence = flat["refined_evidence"]

    def _by_repeat(self, tensor: Tensor) -> Tensor:
        """`(r members) x ...` to `r x members x ...`."""
        return tensor.reshape(self._repeats, self.settings.members, *tensor.shape[1:])

    def _member_networks(self) -> tuple[list[Tensor], list[Tensor]]:
        """Model of each member: masks and weights, one a layer, `r x members x out x ...`."""
        model = _choose(self._evidence > -torch.inf, self._refined, self._state.best)
        masks = [self._by_repeat(part.mask[:, 0]) for part in model]
        return masks, [self._by_repeat(part.weight[:, 0]) for part in model]

    def _spread(self) -> Spread:
        first = slice(None, None, self.settings.members)
        return readout_spread(*self._member_networks(), self._inputs[first], self._targets[first], self._rows[first])

    def _error(self) -> Tensor:
        """Weighted mean squared error of the model on the training rows, `r`."""
        first = slice(None, None, self.settings.members)
        inputs, targets, shares = (part[first] for part in self._task)
        error = self.predict(inputs.transpose(1, 2)) - targets.transpose(1, 2)
        return (error.square().mean(-1) * shares).sum(-1)

    def _refine(self) -> None:
        """Refine the best joined networks, keep them by evidence, and write them back into the elite where fitter."""
        settings, best = self.settings, self._state.best
        refined = refine(
            [part.mask[:, 0] for part in best],
            [part.weight[:, 0] for part in best],
            self._inputs,
            self._targets,
            self._rows,
            RefinementSettings(iterations=settings.refinement_iterations),
            self._metric,
        )
        candidate = tuple(
            Genome(part.mask, weight.unsqueeze(1)) for part, weight in zip(best, refined.weights, strict=True)
        )
        self._refined = _choose(refined.log_evidence > self._evidence, candidate, self._refined)
        self._evidence = torch.maximum(self._evidence, refined.log_evidence)
        scores = fitness(joined_errors(0, candidate[0], candidate, self._task)[:, 0, 0], settings.epsilon)
        self._state = keep_refined(self._state, candidate, scores)


def _choose(first: Tensor, one: tuple[Genome, ...], other: tuple[Genome, ...]) -> tuple[Genome, ...]:
    """Repeat by repeat. first: `r`, bool."""
    take = first[:, None, None, None]
    return tuple(
        Genome(torch.where(take, a.mask, b.mask), torch.where(take, a.weight, b.weight))
        for a, b in zip(one, other, strict=True)
    )
