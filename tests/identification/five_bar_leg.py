"""One leg of a planar five-bar (paper 004, eqs. 9 and 12): a small real identification problem in closed form."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from ccnn_torch.coordinates import Parameter
from ccnn_torch.identification import Channel, Problem

NOISE = 1e-4
NOMINAL = {"l": 0.75, "L": 1.1, "Ax": -0.5, "Ay": 0.0, "k": 1.0, "gamma": 0.0}
UNITS = ("m", "m", "m", "m", "1", "rad")
SCALE = torch.tensor([5e-3, 5e-3, 5e-3, 5e-3, 5e-3, 5e-3], dtype=torch.float64)


def crank_angle(values: Tensor, pose: Tensor) -> Tensor:
    """Commanded angle of the left crank, elbow outward; values `... x 6`, pose `... x 2`; returns `... x 1`."""
    crank, coupler, ax, ay, gain, offset = values.unbind(-1)
    x, y = pose[..., 0] - ax, pose[..., 1] - ay
    square = x**2 + y**2
    inner = torch.acos((crank**2 + square - coupler**2) / (2 * crank * square.sqrt()))
    return ((torch.atan2(y, x) + inner - offset) / gain)[..., None]


def poses(count: int, seed: int) -> Tensor:
    """Uniform in a circle of 0.4 m around (0, 1.1 m); `count x 2`."""
    draws = torch.rand(count, 2, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    radius, angle = 0.4 * draws[:, 0].sqrt(), 2 * math.pi * draws[:, 1]
    return torch.stack([radius * angle.cos(), 1.1 + radius * angle.sin()], dim=-1)


def leg_problem(machines: int = 1, rows: int = 18, noise: float = NOISE, seed: int = 0) -> tuple[Problem, Tensor]:
    """A problem and the true parameters `r x 6`; every machine has errors and noise of its own."""
    generator = torch.Generator().manual_seed(seed)
    nominal = torch.tensor(list(NOMINAL.values()), dtype=torch.float64)
    truth = nominal + SCALE * torch.randn(machines, 6, generator=generator, dtype=torch.float64)
    pose = poses(rows, seed).expand(machines, -1, -1)
    joints = crank_angle(truth[:, None], pose)
    joints = joints + noise * torch.randn(joints.shape, generator=generator, dtype=torch.float64)

    def residual(values: Tensor, pose: Tensor, joints: Tensor) -> Tensor:
        return (crank_angle(values, pose) - joints) / NOISE

    names = zip(NOMINAL.items(), UNITS, strict=True)
    problem = Problem(
        parameters=tuple(Parameter(f"{name}1", unit, value, 1) for (name, value), unit in names),
        start=nominal.expand(machines, -1),
        scale=SCALE,
        prior_sd=torch.full((6,), math.inf, dtype=torch.float64),
        residual=residual,
        data=(pose, joints),
        weights=torch.ones(machines, rows, dtype=torch.float64),
        channels=(Channel("q1", 1),),
    )
    return problem, truth
