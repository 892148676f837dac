"""Settings of the evolved networks, with the reason for each default."""

from __future__ import annotations

from typing import Annotated

from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass

STRICT = ConfigDict(extra="forbid")
"""A key that is not known is an error."""
Count = Annotated[int, Field(ge=1)]
Some = Annotated[int, Field(ge=2)]
Amount = Annotated[int, Field(ge=0)]
Above = Annotated[float, Field(gt=0)]
Individuals = Annotated[int, Field(ge=4)]
Share = Annotated[float, Field(ge=0, le=1)]
Widths = tuple[Count, ...]
"""Nodes of each hidden layer."""

_NODES_AN_OUTPUT, _FEWEST_NODES = 8, 24
_RIVAL, _RIVAL_OUTPUTS = (12, 12), 3


@dataclass(frozen=True, config=STRICT)
class CCNNSettings:
    """Settings of the CCNN. Defaults are for users; figures of the paper (section IV-A) are given beside them.

    Attributes:
        hidden: nodes of each hidden layer; null = one layer of 8 nodes for each output, at least 24. The paper has two
            layers and wants more individuals than one has genes (bits and reals): 80 individuals allow two layers
            of 6. With refinement more nodes pay, and one layer is best where the deviation is smooth or hidden in
            noise. For the six outputs of an arm 48 nodes did better than 24 or 36, and 64 no better.
        rival_hidden: hidden layers of a second structure that is coevolved and refined beside the first, for deviations
            with edges and little noise; each repeat takes the one of higher evidence. [] = none (paper: none); null =
            two layers of 12 for up to three outputs, none for more, where evidence took it and predictions got worse.
            It needs refinement.
        population: individuals of each subpopulation (paper: 80).
        generations: generations (paper: 120). With refinement more than 30 brought nothing on a UR10.
        crossover: probability that a pair of parents is crossed (paper: 0.72).
        structural_mutation: probability that a bit of a structural offspring flips (paper: 0.0015).
        weight_mutation: probability that a weight of a weight offspring mutates (paper: 0.0025). With some 30 weights
            that alone would leave nine of ten offspring as they are, so one weight of each always mutates.
        weight_range: weights start and mutate in -weight_range .. weight_range (LD and UD of eq. 12). On case one
            1 holds a sigmoid network back (test error 1.10 to 1.12 of the noise), 1.5 to 3 are alike (1.03 to 1.06).
        density: share of connections that exist at the start. No difference on the paper's cases; refined networks
            predict better with a third to a half of the connections than with all, on a UR10 and on simulated
            machines (0.35 and 0.5 were compared there; 0.4 is between).
        bias: whether nodes have a bias, an input that is always on; the paper's strings have none.
        members: independent coevolutions of each repeat (paper: 1).
        kept: with refinement, the members of highest evidence that get periodic nodes and are averaged, into one masked
            network with their hidden layers side by side. All six did better than three on most tuning machines, and
            their intervals held more often what they should.
        waves: slots for periodic nodes, each a sine and a cosine of one input found in what the refined network leaves,
            since gears and screws repeat their errors; 0 = none (paper: none). They need refinement.
        wave_searches: how often to look for them, each time followed by a refinement.
        harmonics: harmonics of each turning joint in its own deviation, fitted before anything else (one for every
            eight rows at most, and none with fewer than 50 rows a turning joint), since gears repeat their errors;
            0 = none (paper: none). They need refinement. Inside a UR10's training rows 75 or 100 did better than 30
            or 50.
        refinement_iterations: Levenberg-Marquardt iterations of one refinement at most; in a training with rows held
            out a third of them, and the others on all rows, from its networks; 0 = none, as in the paper. On ten
            simulated machines 36 (12 with rows held out) did as well as 50.

    Raises:
        ValueError: a value out of its range, in one sentence with the key.
    """

    hidden: Widths | None = None
    rival_hidden: Widths | None = None
    population: Individuals = 80
    generations: Count = 10
    crossover: Share = 0.72
    structural_mutation: Share = 0.0015
    weight_mutation: Share = 0.0025
    weight_range: Above = 2.0
    density: Share = 0.4
    bias: bool = True
    members: Count = 6
    kept: Count = 6
    waves: Amount = 32
    wave_searches: Amount = 3
    harmonics: Amount = 96
    refinement_iterations: Amount = 36

    def structures(self, outputs: int) -> list[tuple[int, ...]]:
        """Hidden layers of the structures that compete for a map with so many outputs, the first always there."""
        first = self.hidden if self.hidden is not None else (max(_NODES_AN_OUTPUT * outputs, _FEWEST_NODES),)
        rival = self.rival_hidden
        if rival is None:
            rival = _RIVAL if outputs <= _RIVAL_OUTPUTS else ()
        return [first, rival] if rival and self.refinement_iterations else [first]


@dataclass(frozen=True, config=STRICT)
class ENNSettings:
    """Settings of the ENN, named as those of the CCNN. Paper 000 gives none for its ENN: probabilities are its CCNN's.

    Attributes:
        hidden: nodes of each hidden layer, those of the paper's CCNN.
        population: networks. With `generations`, as many are evaluated as joined networks of the paper's CCNN (116,000:
            80 individuals of three layers, each in four networks, over 120 generations).
        generations: generations.
        crossover: probability that a pair of parents is crossed.
        structural_mutation: probability that a bit of a structural offspring flips.
        weight_mutation: probability that a weight of a weight offspring mutates; one of each layer always does.
        weight_range: weights start and mutate in -weight_range .. weight_range.
        density: share of connections that exist at the start. With nothing to learn, 0.2 costs less than 0.5 (1.02 to
            1.05 of the constant's error), and where there is something it makes no difference.
        bias: whether nodes have a bias, an input that is always on.

    Raises:
        ValueError: a value out of its range, in one sentence with the key.
    """

    hidden: Widths = (6, 6)
    population: Individuals = 320
    generations: Count = 360
    crossover: Share = 0.72
    structural_mutation: Share = 0.0015
    weight_mutation: Share = 0.0025
    weight_range: Above = 2.0
    density: Share = 0.2
    bias: bool = True


EvolutionSettings = CCNNSettings | ENNSettings
"""Those of any evolution of networks."""
