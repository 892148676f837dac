"""The cooperative coevolutionary network of paper 000 (section III) as a learner."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn

from ccnn_torch.evolution.coevolution import Coevolution, advance, density, diversity, keep_refined, start
from ccnn_torch.evolution.evaluation import fitness, joined_errors, make_task
from ccnn_torch.evolution.genome import Genome
from ccnn_torch.evolution.masked_network import MaskedNetwork
from ccnn_torch.evolution.network import average, average_waves, forward
from ccnn_torch.evolution.random import member_seeds
from ccnn_torch.evolution.refinement import RefinementSettings, refine
from ccnn_torch.evolution.settings import CCNNSettings
from ccnn_torch.evolution.spread import Spread, readout_spread, spread_variance
from ccnn_torch.evolution.waves import Waves, find_waves, no_waves
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
    standardised), `evaluations` (joined networks so far, and of each iteration of a refinement as many as there are
    outputs for its Jacobian and one for the steps tried), each `r`; `density` and `diversity`, `r x layers`.
    """

    name = "ccnn"
    reads_angles = True

    def __init__(self, settings: CCNNSettings | None = None) -> None:
        self.settings = settings or CCNNSettings()

    def start(self, data: TrainingData) -> None:
        """Take the data and judge the random first generation."""
        members = self.settings.members
        self._slots = self.settings.waves if self.settings.refinement_iterations else 0
        self._repeats = len(data.seeds)
        self._inputs, self._targets, self._rows = (
            part.repeat_interleave(members, dim=0) for part in (data.inputs, data.targets, data.weights)
        )
        self._metric = None if data.metric is None else data.metric.repeat_interleave(members, dim=0)
        features = data.inputs.shape[-1]
        # Sigmoids read an angle by its sine and cosine; periodic nodes read the angle.
        self._features, self._read = features, features - data.angles
        self._readable = torch.ones(features, dtype=torch.bool, device=data.inputs.device)
        self._readable[self._read - 2 * data.angles : self._read] = False
        self._task = make_task(self._inputs[..., : self._read], self._targets, self._rows)
        self._seeds = member_seeds(data.seeds, members).flatten()
        sizes = (self._read, *self.settings.hidden, data.targets.shape[-1])
        self._state = start(sizes, self._task, self.settings, self._seeds)
        self._evidence = torch.full_like(self._state.best_fitness, -torch.inf)
        self._passes = torch.zeros_like(self._evidence)
        self._refined = self._evolved()

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
            "evaluations": judged * settings.members + self._by_repeat(self._passes).sum(1),
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
        model = self._members()
        return forward(model.masks, model.weights, inputs.unsqueeze(1), model.waves).mean(1)

    def variance(self, inputs: Tensor) -> Tensor:
        """Predictive variance of newly measured outputs. inputs: `r x s x i` [1]; returns `r x s x o` [1]."""
        model = self._average()
        return spread_variance(model.masks, model.weights, self._spread(), inputs, model.waves)

    def masks(self) -> list[Tensor]:
        """Connections of the model, one layer each, `r x out x in`, bool; periodic nodes left out."""
        return self._sigmoids()[0]

    def weights(self) -> list[Tensor]:
        """Weights of the model, one layer each, `r x out x in`, or `r x out x (in + 1)` with the biases last."""
        return self._sigmoids()[1]

    def genome(self, repeat: int) -> tuple[list[Tensor], list[Tensor]]:
        """Masks and weights of one repeat's model, dead nodes included: `out x in` and `out x (in or in + 1)`."""
        masks, weights = self._sigmoids()
        return [mask[repeat] for mask in masks], [weight[repeat] for weight in weights]

    def network(self, repeat: int) -> MaskedNetwork:
        """The model of one repeat, pruned of its dead nodes."""
        model, spread = self._average(), self._spread()
        return MaskedNetwork(
            [mask[repeat] for mask in model.masks],
            [weight[repeat] for weight in model.weights],
            spread.factors[repeat],
            spread.noise[repeat],
            Waves(*(part[repeat] for part in model.waves)),
            self._features,
        )

    def state_dict(self) -> dict[str, Tensor]:
        """Subpopulations with their fitness, the best joined network, the refined one: `r x members x ...`."""
        state = self._state
        tensors = {"best_fitness": state.best_fitness, "refined_evidence": self._evidence, "passes": self._passes}
        for name, parts in (("population", state.populations), ("best", state.best)):
            for layer, part in enumerate(parts):
                tensors[f"{name}_mask_{layer}"] = part.mask
                tensors[f"{name}_weight_{layer}"] = part.weight
        for layer, (mask, weight) in enumerate(zip(self._refined.masks, self._refined.weights, strict=True)):
            tensors[f"refined_mask_{layer}"] = mask
            tensors[f"refined_weight_{layer}"] = weight
        tensors |= {"refined_source": self._refined.waves.source, "refined_frequency": self._refined.waves.frequency}
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
        self._refined = _Model(
            [flat[f"refined_mask_{n}"] for n in layers],
            [flat[f"refined_weight_{n}"] for n in layers],
            Waves(flat["refined_source"], flat["refined_frequency"]),
        )
        self._evidence, self._passes = flat["refined_evidence"], flat["passes"]

    def _by_repeat(self, tensor: Tensor) -> Tensor:
        """`(r members) x ...` to `r x members x ...`."""
        return tensor.reshape(self._repeats, self.settings.members, *tensor.shape[1:])

    def _evolved(self) -> _Model:
        """Best joined network of every coevolution, its slots for periodic nodes free: `(r members) x ...`."""
        parts = [Genome(part.mask[:, 0].clone(), part.weight[:, 0].clone()) for part in self._state.best]
        slots, output = self._slots, parts[-1]
        width = output.mask.shape[-1]
        none = output.weight.new_zeros(*output.mask.shape[:-1], 2 * slots)
        weight = torch.cat([output.weight[..., :width], none, output.weight[..., width:]], -1)
        return _Model(
            [*(part.mask for part in parts[:-1]), torch.cat([output.mask, none > 0], -1)],
            [*(part.weight for part in parts[:-1]), weight],
            no_waves(tuple(weight.shape[:1]), slots, weight),
        )

    def _members(self) -> _Model:
        """Model of each member: `r x members x ...`."""
        model = _choose(self._evidence > -torch.inf, self._refined, self._evolved())
        return _Model(
            [self._by_repeat(mask) for mask in model.masks],
            [self._by_repeat(weight) for weight in model.weights],
            Waves(*(self._by_repeat(part) for part in model.waves)),
        )

    def _average(self) -> _Model:
        """Model of each repeat: `r x ...`."""
        model = self._members()
        masks, weights = average(model.masks, model.weights, self._slots)
        return _Model(masks, weights, average_waves(model.waves))

    def _sigmoids(self) -> tuple[list[Tensor], list[Tensor]]:
        """The averaged model without its periodic nodes."""
        masks, weights, _ = self._average()
        width = masks[-1].shape[-1] - 2 * self.settings.members * self._slots
        end = masks[-1].shape[-1]
        last = torch.cat([weights[-1][..., :width], weights[-1][..., end:]], -1)
        return [*masks[:-1], masks[-1][..., :width]], [*weights[:-1], last]

    def _spread(self) -> Spread:
        first, model = slice(None, None, self.settings.members), self._members()
        rows = self._inputs[first], self._targets[first], self._rows[first]
        return readout_spread(model.masks, model.weights, *rows, model.waves)

    def _error(self) -> Tensor:
        """Weighted mean squared error of the model on the training rows, `r`."""
        first = slice(None, None, self.settings.members)
        rows = self._rows[first]
        there = (rows > 0).unsqueeze(-1)
        error = self.predict(self._inputs[first].masked_fill(~there, 0)) - self._targets[first]
        return (error.masked_fill(~there, 0).square().mean(-1) * rows).sum(-1) / rows.sum(-1)

    def _refine(self) -> None:
        """Refine the best joined networks, keep them by evidence, and write them back into the elite where fitter."""
        settings = self.settings
        candidate, evidence = self._with_waves(*self._descend(self._evolved()))
        self._refined = _choose(evidence > self._evidence, candidate, self._refined)
        self._evidence = torch.maximum(self._evidence, evidence)
        width = candidate.masks[-1].shape[-1] - 2 * self._slots
        end = candidate.masks[-1].shape[-1]
        readout = torch.cat([candidate.weights[-1][..., :width], candidate.weights[-1][..., end:]], -1)
        refined = tuple(
            Genome(part.mask, weight.unsqueeze(1))
            for part, weight in zip(self._state.best, [*candidate.weights[:-1], readout], strict=True)
        )
        scores = fitness(joined_errors(0, refined[0], refined, self._task)[:, 0, 0], settings.epsilon)
        self._state = keep_refined(self._state, refined, scores)

    def _descend(self, model: _Model) -> tuple[_Model, Tensor]:
        """The refined model and its log evidence, `(r members)`."""
        # Slots are filled from the first on: those that are free in every network need not be carried along.
        used = int((model.waves.frequency != 0).sum(-1).max()) if self._slots else 0
        small = _slots(model, self._slots, used)
        refined = refine(
            small.masks,
            small.weights,
            self._inputs,
            self._targets,
            self._rows,
            RefinementSettings(iterations=self.settings.refinement_iterations),
            self._metric,
            small.waves,
        )
        # Networks that were done earlier made fewer iterations; this counts those of the last one.
        self._passes = self._passes + refined.iterations * (self._targets.shape[-1] + 1)
        found = _slots(_Model(small.masks, refined.weights, refined.waves), used, self._slots)
        return found, refined.log_evidence

    def _with_waves(self, model: _Model, evidence: Tensor) -> tuple[_Model, Tensor]:
        """Periodic nodes found in what the members of a repeat leave together, and all refined once more."""
        first = slice(None, None, self.settings.members)
        for _ in range(self.settings.wave_searches if self._slots else 0):
            left = self._by_repeat(self._targets - forward(model.masks, model.weights, self._inputs, model.waves))
            before = Waves(*(self._by_repeat(part)[:, 0] for part in model.waves))
            found = find_waves(before, left.mean(1), self._inputs[first], self._rows[first], self._readable, 2)
            new = (found.frequency != 0) & (before.frequency == 0)
            if not bool(new.any()):
                break
            members = self.settings.members
            fresh, source, frequency = (
                part.repeat_interleave(members, 0) for part in (new, found.source, found.frequency)
            )
            masks = list(model.masks)
            width = masks[-1].shape[-1] - 2 * self._slots
            connected = masks[-1].clone()
            connected[..., width:] |= fresh.repeat(1, 2).unsqueeze(-2)
            wider = _Model(
                [*masks[:-1], connected],
                model.weights,
                Waves(
                    torch.where(fresh, source, model.waves.source),
                    torch.where(fresh, frequency, model.waves.frequency),
                ),
            )
            candidate, better = self._descend(wider)
            take = fresh.any(-1) & (better > evidence)
            model, evidence = _choose(take, candidate, model), torch.where(take, better, evidence)
        return model, evidence


class _Model(NamedTuple):
    """A batch of networks: masks and weights, one a layer, and their periodic nodes."""

    masks: list[Tensor]
    weights: list[Tensor]
    waves: Waves


def _slots(model: _Model, have: int, want: int) -> _Model:
    """The same networks with fewer free slots for periodic nodes, or more."""

    def fitted(values: Tensor) -> Tensor:
        return nn.functional.pad(values, (0, want - have)) if want > have else values[..., :want]

    def columns(values: Tensor, hidden: int) -> Tensor:
        parts = torch.split(values, [hidden, have, have, values.shape[-1] - hidden - 2 * have], -1)
        return torch.cat([parts[0], fitted(parts[1]), fitted(parts[2]), parts[3]], -1)

    hidden = model.masks[-1].shape[-1] - 2 * have
    return _Model(
        [*model.masks[:-1], columns(model.masks[-1], hidden)],
        [*model.weights[:-1], columns(model.weights[-1], hidden)],
        Waves(*(fitted(part) for part in model.waves)),
    )


def _choose(first: Tensor, one: _Model, other: _Model) -> _Model:
    """Network by network. first: `b`, bool."""
    take = first[:, None, None]
    return _Model(
        [torch.where(take, a, b) for a, b in zip(one.masks, other.masks, strict=True)],
        [torch.where(take, a, b) for a, b in zip(one.weights, other.weights, strict=True)],
        Waves(*(torch.where(first[:, None], a, b) for a, b in zip(one.waves, other.waves, strict=True))),
    )
