"""Domain of a learned deviation, and how it fades outside."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from ccnn_torch.coordinates import Coordinate
from ccnn_torch.errors import InputError

# A principal direction thinner than this share of the inputs' half range counts as so thick: the training rows say
# nothing about finer detail, and a guard that thin would be all slope.
_THINNEST = 0.05
# Share of the slope of 0.2 (above which the command is not solved) that the guard's own transition may take.
_SLOPE = 0.1
# Largest slope of (1 - e²)² over e, at e = 1/√3.
_STEEPEST = 8 / (3 * math.sqrt(3))
# Points of `spread_points`: training inputs, and six times as many between and around them.
POINTS = 2048
# Beyond this many transitions the guard has long reached its end; inputs are clamped there to stay finite.
_CAGE = 1.01


class Known(NamedTuple):
    """Inputs made finite: `inputs`, `... x d` [SI], and `strange`, `... x 1`, the number of those that were not."""

    inputs: Tensor
    strange: Tensor


class Domain(nn.Module):
    """Two boxes around the training inputs: one in the inputs themselves, one along their principal directions.

    The joints of a parallel machine fill only part of a box, hence the second one. With z = (x - centre) / half_range,
    the guard's coordinates are y = directions · z; e = max(0, |y - middle| - radius) / width counts transitions beyond
    the margin, u = Σ e², and the learned deviation weighs w = max(0, 1 - u)²: 1 inside, 0 where u reaches 1, C¹
    between, and made of sums, products and maxima alone. A periodic input is guarded by its raw angle.

    Attributes:
        centre, half_range: of the training inputs, `d` [the input's SI unit].
        directions: `2d x d` [1], the inputs and then the principal directions of z.
        middle, radius, width: of the two boxes (margin included) and their transitions, `2d` [1].
        huge: magnitude from which an input counts as infinite, `d` [SI].
        low, high: edges of the box in the inputs, margin included, `d` [SI]; follow from the above.
    """

    centre: Tensor
    half_range: Tensor
    directions: Tensor
    middle: Tensor
    radius: Tensor
    width: Tensor
    huge: Tensor
    low: Tensor
    high: Tensor
    _cage_low: Tensor
    _cage_high: Tensor
    _axes: Tensor
    _ones: Tensor

    def __init__(
        self,
        centre: Tensor,
        half_range: Tensor,
        directions: Tensor,
        middle: Tensor,
        radius: Tensor,
        width: Tensor,
        huge: Tensor,
    ) -> None:
        super().__init__()
        self.register_buffer("centre", centre)
        self.register_buffer("half_range", half_range)
        self.register_buffer("directions", directions)
        self.register_buffer("middle", middle)
        self.register_buffer("radius", radius)
        self.register_buffer("width", width)
        self.register_buffer("huge", huge)
        # What follows is worked out once and for all: an exported graph would repeat it at every step.
        box = half_range * radius[: len(centre)]
        room = box + half_range * _CAGE * width[: len(centre)]
        self.register_buffer("low", centre - box, persistent=False)
        self.register_buffer("high", centre + box, persistent=False)
        self.register_buffer("_cage_low", centre - room, persistent=False)
        self.register_buffer("_cage_high", centre + room, persistent=False)
        self.register_buffer("_axes", (directions / half_range).mT.contiguous(), persistent=False)
        self.register_buffer("_ones", torch.ones(2 * len(centre), 1, dtype=centre.dtype), persistent=False)

    @classmethod
    def fit(cls, inputs: Tensor, reach: Tensor, margin: float = 0.1, transition: float = 0.5) -> Domain:
        """Fit to training inputs.

        Args:
            inputs: `s x d` [SI], joints, then covariates.
            reach: how far a correction moves each input, `d` [SI]: the limits of the joints, 0 for covariates. Where
                it is not small against the half range, the transition is made wider, so that the command stays
                solvable.
            margin: how far the boxes extend beyond the training inputs, as a share of their half range.
            transition: width of the transition beyond the margin, as a share of the half range.

        Raises:
            InputError: an input is not finite, or margin or transition is out of range.
        """
        if not bool(torch.isfinite(inputs).all()) or len(inputs) == 0:
            raise InputError("the training inputs of a compensator must be finite, and at least one row")
        if not (0 <= margin < 10 and 0 < transition < 10):
            raise InputError(f"margin ({margin}) must be in 0..10 and transition ({transition}) above 0, up to 10")
        low, high = inputs.amin(0), inputs.amax(0)
        centre, half = (low + high) / 2, (high - low) / 2
        # An input that does not vary is known at one value only; a correction's reach is then the only scale there is.
        scale = torch.where(half > 0, half, torch.where(reach > 0, 20 * reach, torch.ones_like(half)))
        z = (inputs - centre) / scale
        directions = torch.cat([torch.eye(len(centre), dtype=z.dtype), torch.linalg.eigh(z.mT @ z / len(z))[1].mT])
        y = z @ directions.mT
        thickness = ((y.amax(0) - y.amin(0)) / 2).clamp_min(_THINNEST)
        # In units of the limits a correction differs from the safe one by 2 at most.
        steepness = 2 * _STEEPEST * (directions.abs() @ (reach / scale)) * math.sqrt(len(directions)) / _SLOPE
        return cls(
            centre,
            scale,
            directions,
            (y.amax(0) + y.amin(0)) / 2,
            thickness * (1 + margin) + 1e-9,
            torch.maximum(transition * thickness, steepness),
            torch.full_like(centre, 1e300),
        )

    def clean(self, inputs: Tensor) -> Known:
        """Replace what is no number by the domain's centre and what is infinite by the domain's edge.

        Args:
            inputs: `... x d` [SI], anything.
        """
        # A comparison with NaN is false, so this catches NaN and infinity alike.
        d = len(self.centre)
        known = inputs.abs() < self.huge
        number = torch.where(inputs == inputs, inputs, self.centre)
        edge = torch.minimum(torch.maximum(number, self.low), self.high)
        strange = torch.where(known, torch.zeros_like(self.centre), torch.ones_like(self.centre)) @ self._ones[:d]
        return Known(torch.where(known, inputs, edge), strange)

    def cage(self, inputs: Tensor) -> Tensor:
        """Clamp `... x d` [SI] to where the guard has ended: nothing far outside reaches network or guard."""
        return torch.minimum(torch.maximum(inputs, self._cage_low), self._cage_high)

    def excess(self, caged: Tensor) -> Tensor:
        """How far beyond the margin: u, `... x 1` [1], exactly 0 inside, 1 where the transition ends.

        Args:
            caged: `... x d` [SI], out of `cage`.
        """
        y = (caged - self.centre) @ self._axes
        beyond = torch.relu((y - self.middle).abs() - self.radius) / self.width
        # A sum as a product: engines with a narrow operator list have no other reduction.
        return (beyond * beyond) @ self._ones

    def describe(self, inputs: tuple[Coordinate, ...]) -> dict[str, Any]:
        """For the model card: edges with the margin, and where the transition ends, per input [SI]."""
        fade = self.half_range * self.width[: len(self.centre)]
        return {
            "inputs": {
                c.name: {"unit": c.unit, "low": low, "high": high, "transition": width}
                for c, low, high, width in zip(
                    inputs, self.low.tolist(), self.high.tolist(), fade.tolist(), strict=True
                )
            },
            "principal": {
                "centre": self.centre.tolist(),
                "half_range": self.half_range.tolist(),
                "directions": self.directions[len(self.centre) :].tolist(),
                "low": (self.middle - self.radius)[len(self.centre) :].tolist(),
                "high": (self.middle + self.radius)[len(self.centre) :].tolist(),
                "transition": self.width[len(self.centre) :].tolist(),
            },
        }


def spread_points(inputs: Tensor, domain: Domain, generator: torch.Generator, count: int = POINTS) -> Tensor:
    """The training inputs, points between them, and points all through the transition around them, `s x d` [SI]."""
    rows = inputs[torch.randperm(len(inputs), generator=generator)[:count]]
    pick = torch.randint(len(inputs), (2, 2 * count), generator=generator)
    share = torch.rand(3, 2 * count, 1, generator=generator, dtype=inputs.dtype)
    between = inputs[pick[0]] + share[0] * (inputs[pick[1]] - inputs[pick[0]])
    d = len(domain.centre)
    widest = float((1 + domain.width[:d] / domain.radius[:d]).max()) * 1.1
    outward = domain.centre + (between - domain.centre) * (1 + share[1] * (widest - 1))
    noise = torch.randn(outward.shape, generator=generator, dtype=inputs.dtype)
    around = inputs[pick[1]] + noise * share[2] * domain.half_range * domain.width[:d]
    return domain.cage(torch.cat([rows, between, outward, around]))
