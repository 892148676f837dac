"""One structure of a CCNN: coevolution of its members, refinement, search for periodic nodes."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from ccnn_torch.evolution.coevolution import Coevolution, Task, advance, start
from ccnn_torch.evolution.gauss_newton import prior_groups, resized_prior
from ccnn_torch.evolution.genome import genomes_of, named_genomes
from ccnn_torch.evolution.network import Bundle, averaged, forward, resized
from ccnn_torch.evolution.refinement import Precisions, refine
from ccnn_torch.evolution.settings import CCNNSettings
from ccnn_torch.evolution.waves import Waves, find_waves, no_waves
from ccnn_torch.numerics.blocks import blocks
from ccnn_torch.numerics.trees import below, chosen, joined, picked, put

# Passes of one search: after each, what was found before is fitted anew.
_PASSES = 2
# Log evidence per measured value by which a member may fall short of the best and still be averaged. That is a lot: a
# descent that failed. Evidence is too rough a guide to leave out more; averages did better than the best member.
_SHORT = 0.5
# Matrices of weights by weights that a descent holds at a time.
_MATRICES = 6


class MemberRows(NamedTuple):
    """The training rows of `b` = repeats x members networks, the members of a repeat beside each other.

    Attributes:
        inputs: `b x s x i`; sigmoids read the leading ones, as many as `task` has.
        targets: `b x s x o`.
        weights: `b x s`.
        metric: `b x s x c x o`, or None.
        task: the same rows laid out for evolution.
        seeds: `b`.
    """

    inputs: Tensor
    targets: Tensor
    weights: Tensor
    metric: Tensor | None
    task: Task
    seeds: Tensor


class Structure:
    """Networks with the hidden layers `hidden`, `members` of them to each of `r` repeats.

    Evolution comes first, all members side by side; then all are refined; then the `kept` members of highest evidence
    get periodic nodes, in several searches, and are refined again after each. The model is the mean of these members.
    """

    def __init__(
        self, hidden: tuple[int, ...], settings: CCNNSettings, rows: MemberRows, readable: Tensor, iterations: int
    ) -> None:
        """readable: which inputs periodic nodes may read, `i` bool; iterations: of a refinement."""
        self.settings, self.rows, self.readable, self.iterations = settings, rows, readable, iterations
        self.slots = settings.waves if settings.refinement_iterations else 0
        self.kept = min(settings.kept, settings.members) if settings.refinement_iterations else settings.members
        inputs, outputs = rows.task.inputs.shape[1], rows.targets.shape[-1]
        self.state = start((inputs, *hidden, outputs), rows.task, settings, rows.seeds)
        self.evidence = torch.full_like(self.state.best_fitness, -torch.inf)
        self.passes = torch.zeros_like(self.evidence)
        self.refined = self._evolved()
        groups = prior_groups([mask.shape[-2:] for mask in self.refined.masks], settings.bias, self.slots)
        channels = outputs if rows.metric is None else rows.metric.shape[-2]
        batch, zeros = len(self.evidence), self.evidence.new_zeros
        self.precisions = Precisions(zeros(batch, int(groups.max()) + 1), zeros(batch, channels), zeros(batch))
        # Whether a search found nothing in what these networks leave: the next one would not either.
        self._searched = False
        self._first: tuple[Bundle, Precisions, Tensor] | None = None
        self._going = torch.ones_like(self.evidence, dtype=torch.bool)

    def begin_from(self, tensors: dict[str, Tensor], wanted: Tensor, iterations: int) -> None:
        """Refine the networks of an earlier training on fewer rows instead of those evolved; nothing more is sought.

        Args:
            tensors: as of `tensors`.
            wanted: repeats that take this structure, `r` bool; nothing is done for the others.
            iterations: of the refinement.
        """
        self._first, self.iterations = _refined(tensors), iterations
        self._going = wanted.repeat_interleave(self.settings.members)
        self._searched = True

    def evolve(self) -> None:
        """One generation."""
        if self._first is not None and bool((self._first[-1] > -torch.inf)[self._going].all()):
            # Nobody asks for what would evolve.
            self.state = replace(self.state, generation=self.state.generation + 1)
            return
        self.state = advance(self.state, self.rows.task, self.settings, self.rows.seeds)

    def refine(self) -> None:
        """Refine the best joined network of every member, and keep it by evidence."""
        index = torch.nonzero(self._going).flatten()
        if len(index) == 0:
            return
        model, known = self._evolved(), None
        if self._first is not None:
            earlier, precisions, evidence = self._first
            model = chosen(evidence > -torch.inf, earlier, model)
            known = picked(precisions, index)
        candidate, evidence, precisions = self._descend(picked(model, index), index, known)
        self._take(index, candidate, evidence, precisions, evidence > self.evidence[index])

    def search_waves(self) -> None:
        """Look for periodic nodes in what the kept members of a repeat leave, and refine those that got any."""
        if self._searched:
            return
        best = self._best()
        index = best.flatten()
        rows, model = picked((self.rows, self.refined), index)
        each = best.shape[1]
        first = slice(None, None, each)
        left = rows.targets - forward(model.masks, model.weights, rows.inputs, model.waves)
        left = left.unflatten(0, (-1, each)).mean(1)  # type: ignore[no-untyped-call]
        # The members of a repeat share their slots; only the frequencies were refined apart.
        before = picked(model.waves, first)
        found = find_waves(before, left, rows.inputs[first], rows.weights[first], self.readable, _PASSES)
        fresh = ((found.frequency != 0) & (before.frequency == 0)).repeat_interleave(each, 0)
        going = torch.nonzero(fresh.any(-1)).flatten()
        if len(going) == 0:
            self._searched = True
            return
        source, frequency = (part.repeat_interleave(each, 0) for part in found)
        connected = model.masks[-1].clone()
        connected[..., connected.shape[-1] - 2 * self.slots :] |= fresh.repeat(1, 2).unsqueeze(-2)
        wider = Bundle(
            [*model.masks[:-1], connected],
            model.weights,
            Waves(torch.where(fresh, source, model.waves.source), torch.where(fresh, frequency, model.waves.frequency)),
        )
        # With all precisions anew: those of the last descent hold the network where it is.
        candidate, evidence, precisions = self._descend(picked(wider, going), index[going], None)
        # A member whose descent failed is replaced by the best of its repeat, and costs the others nothing.
        own = torch.arange(len(evidence), device=evidence.device).reshape(-1, each)
        leader = own.gather(1, evidence.reshape(-1, each).argmax(1, keepdim=True))
        taken_from = torch.where(evidence.reshape(-1, each) > -torch.inf, own, leader).flatten()
        candidate, evidence, precisions = picked((candidate, evidence, precisions), taken_from)
        # Taken by all members of a repeat or by none, so that they go on sharing their slots.
        gain = (evidence - self.evidence[index[going]]).reshape(-1, each).sum(1).repeat_interleave(each)
        self._take(index[going], candidate, evidence, precisions, gain > 0)

    def _take(self, index: Tensor, candidate: Bundle, evidence: Tensor, precisions: Precisions, taken: Tensor) -> None:
        """Keep the refined networks that are `taken`, bool; index: which of the `b` they are."""
        found = picked((candidate, evidence, precisions), taken)
        kept = put((self.refined, self.evidence, self.precisions), index[taken], found)
        self.refined, self.evidence, self.precisions = kept

    def members(self) -> Bundle:
        """The kept members of each repeat, refined where they are: `r x kept x ...`."""
        best = self._best()
        evidence = self.evidence[best]
        rows = self.rows.weights[best].sum(-1) * self.rows.targets.shape[-1]
        # A member that fell short is replaced by a copy of the best one: every repeat has as many networks.
        short = evidence < evidence[:, :1] - _SHORT * rows
        model = chosen(self.evidence > -torch.inf, self.refined, self._evolved())
        voters = torch.where(short, best[:, :1], best)
        return picked(model, voters)

    def model(self) -> Bundle:
        """Their mean: `r x ...`."""
        return averaged(self.members())

    def score(self) -> Tensor:
        """Mean log evidence of the kept members, `r`; -inf before the first refinement."""
        return self.evidence[self._best()].mean(1)

    def by_repeat(self, tensor: Tensor) -> Tensor:
        """`b x ...` to `r x members x ...`."""
        members = self.settings.members
        return tensor.reshape(len(tensor) // members, members, *tensor.shape[1:])

    def tensors(self) -> dict[str, Tensor]:
        """Everything that changes, `r x members x ...`, but for the generation."""
        state = self.state
        named = {"best_fitness": state.best_fitness, "evidence": self.evidence, "passes": self.passes}
        named |= named_genomes("population_", state.populations) | named_genomes("best_", state.best)
        named |= {f"fitness_{layer}": scores for layer, scores in enumerate(state.fitness)}
        named |= {f"refined_{name}": tensor for name, tensor in self.refined.tensors.items()}
        named |= {f"precision_{name}": tensor for name, tensor in self.precisions._asdict().items()}
        return {name: self.by_repeat(tensor) for name, tensor in named.items()}

    def load(self, tensors: dict[str, Tensor], generation: int) -> None:
        """Take back what `tensors` gave."""
        flat = {name: tensor.flatten(0, 1) for name, tensor in tensors.items()}
        self.state = Coevolution(
            populations=tuple(genomes_of(below(flat, "population_"))),
            fitness=tuple(flat[f"fitness_{n}"] for n in range(len(self.state.fitness))),
            best=tuple(genomes_of(below(flat, "best_"))),
            best_fitness=flat["best_fitness"],
            generation=generation,
        )
        self.refined, self.precisions, self.evidence = _refined(tensors)
        self.passes = flat["passes"]

    def _best(self) -> Tensor:
        """Numbers of the kept members, those of highest evidence, `r x kept` in `b`."""
        by_repeat = self.by_repeat(self.evidence)
        # Stable, so that members of equal evidence keep their order.
        order = by_repeat.sort(dim=1, descending=True, stable=True).indices[:, : self.kept]
        return order + torch.arange(len(by_repeat), device=order.device).unsqueeze(-1) * self.settings.members

    def _evolved(self) -> Bundle:
        """Best joined network of every coevolution, its slots for periodic nodes free: `b x ...`."""
        masks = [part.mask[:, 0].clone() for part in self.state.best]
        weights = [part.weight[:, 0].clone() for part in self.state.best]
        plain = Bundle(masks, weights, no_waves(tuple(masks[0].shape[:1]), 0, weights[0]))
        return resized(plain, self.slots)

    def _descend(self, model: Bundle, index: Tensor, known: Precisions | None) -> tuple[Bundle, Tensor, Precisions]:
        """The refined networks, their log evidence and precisions. index: which of the `b` networks the model has."""
        # Matrices of a network, at their largest: the normal matrix, its factors, its inverse.
        weights = sum(int(mask.flatten(1).sum(1).max()) + mask.shape[-2] for mask in model.masks)
        parts = []
        for few in blocks(len(index), _MATRICES * 8 * weights**2):
            parts.append(self._descend_together(*picked((model, index, known), few)))
        return parts[0] if len(parts) == 1 else joined(parts)

    def _descend_together(
        self, model: Bundle, index: Tensor, known: Precisions | None
    ) -> tuple[Bundle, Tensor, Precisions]:
        """The same of as many networks as the budget of memory holds."""
        rows = picked(self.rows, index)
        outputs = rows.targets.shape[-1]
        # Slots are filled from the first on: those that are free in every network need not be carried along.
        used = int((model.waves.frequency != 0).sum(-1).max()) if self.slots else 0
        small = resized(model, used)
        refined = refine(
            small.masks,
            small.weights,
            rows.inputs,
            rows.targets,
            rows.weights,
            self.iterations,
            rows.metric,
            small.waves,
            known and known._replace(prior=resized_prior(known.prior, outputs, self.slots, used)),
        )
        # Networks that were done earlier made fewer iterations; this counts those of the last one.
        self.passes = self.passes.index_add(
            0, index, torch.full_like(refined.log_evidence, refined.iterations * (outputs + 1))
        )
        found = refined.precisions
        found = found._replace(prior=resized_prior(found.prior, outputs, used, self.slots))
        return resized(Bundle(small.masks, refined.weights, refined.waves), self.slots), refined.log_evidence, found


def _refined(tensors: dict[str, Tensor]) -> tuple[Bundle, Precisions, Tensor]:
    """Refined networks, their precisions and evidence from `Structure.tensors`, the repeats and members in one."""
    flat = {name: tensor.flatten(0, 1) for name, tensor in tensors.items()}
    bundle = Bundle.from_tensors(below(flat, "refined_"))
    return bundle, Precisions(**below(flat, "precision_")), flat["evidence"]
