"""A network that stands for a trained one: one hidden layer of sigmoids, weights from a seed."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import torch
from torch import Tensor, nn

from ccnn_torch.compensation import Compensator, fit_compensator, register_network
from ccnn_torch.coordinates import Coordinate
from ccnn_torch.mechanisms import load_mechanism
from ccnn_torch.training import Scaling


class Sigmoids(nn.Module):
    def __init__(self, sizes: list[int], seed: int | None = None, gain: float = 1.0) -> None:
        super().__init__()
        self.sizes = sizes
        generator = torch.Generator().manual_seed(seed or 0)
        draw = [torch.randn(o, i, generator=generator, dtype=torch.float64) * gain for i, o in pairwise(sizes)]
        self.weights = nn.ParameterList(draw)

    def forward(self, features: Tensor) -> Tensor:
        hidden = torch.sigmoid(features @ self.weights[0].mT)
        return hidden @ self.weights[1].mT

    def variance(self, features: Tensor) -> Tensor:
        hidden = torch.sigmoid(features @ self.weights[0].mT)
        return 0.015625 + (hidden * hidden) @ (self.weights[1] * self.weights[1]).mT

    def describe(self) -> dict[str, Any]:
        return {"kind": "sigmoids", "sizes": self.sizes}

    @classmethod
    def from_description(cls, description: dict[str, Any]) -> Sigmoids:
        return cls(description["sizes"])


register_network("sigmoids", Sigmoids)


def tripod_joints(count: int = 200, seed: int = 0) -> Tensor:
    machine = load_mechanism("tripod")
    return machine.sample_joints(count, torch.Generator().manual_seed(seed))


def tripod_compensator(gain: float = 0.5, size: float = 2e-4, **keys: Any) -> Compensator:
    """Deviations of about `size` [m] over the tripod's workspace, by a network that gives them exactly."""
    joints = tripod_joints()
    network = Sigmoids([3, 5, 3], seed=3, gain=gain)
    blank = torch.ones(1, len(joints), dtype=torch.float64)
    scaling = Scaling.fit(joints[None], torch.zeros_like(joints)[None], blank, torch.zeros(3, dtype=torch.bool)).repeat(
        0
    )
    scaling.deviation.fill_(size)
    with torch.no_grad():
        deviations = scaling.restore(network(scaling.features(joints)))
    names = [Coordinate(f"q{i}", "m") for i in (1, 2, 3)]
    scales = torch.tensor([1.0, 0.5, 2.0], dtype=torch.float64)
    return fit_compensator(network, scaling, joints, deviations, names, **{"sd_scale": scales} | keys)


def arm_compensator() -> Compensator:
    """Two revolute joints, the second of which turns far, with time and temperature."""
    generator = torch.Generator().manual_seed(5)
    draw = torch.rand(200, 4, generator=generator, dtype=torch.float64)
    inputs = torch.stack([draw[:, 0], 6 * draw[:, 1] - 3, 3600 * draw[:, 2], 290 + 10 * draw[:, 3]], -1)
    network = Sigmoids([5, 4, 2], seed=7, gain=0.5)
    blank = torch.ones(1, len(inputs), dtype=torch.float64)
    periodic = torch.tensor([False, True, False, False])
    scaling = Scaling.fit(inputs[None], torch.zeros(1, 200, 2, dtype=torch.float64), blank, periodic).repeat(0)
    scaling.deviation.fill_(1e-3)
    with torch.no_grad():
        deviations = scaling.restore(network(scaling.features(inputs)))
    joints = [Coordinate("q1", "rad"), Coordinate("q2", "rad")]
    return fit_compensator(
        network, scaling, inputs, deviations, joints, [Coordinate("time", "s"), Coordinate("temperature", "K")]
    )


def fields() -> dict[str, Any]:
    return {
        "mechanism": load_mechanism("tripod").describe(),
        "metrics": {"mse": 1e-10},
        "data_sha256": "ab" * 32,
        "seed": 4,
    }
