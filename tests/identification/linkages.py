"""Machines as built, their joints and measured poses, for the tests of identification."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from ccnn_torch.coordinates import plausible_error
from ccnn_torch.mechanisms import Mechanism, load_mechanism

NOISE = 1e-4


class Measured(NamedTuple):
    """truth: parameters as built, `r x k`; joints `r x s x n`; pose measured and true, `r x s x p`."""

    mechanism: Mechanism
    truth: Tensor
    joints: Tensor
    pose: Tensor
    clean: Tensor


def measured(
    count: int, rows: int, seed: int, noise: float = NOISE, error: float = 1.0, name: str = "five_bar"
) -> Measured:
    """Machines whose parameters are off by `error` plausible errors, each at its own poses, kept off the edge."""
    mechanism = load_mechanism(name)
    generator = torch.Generator().manual_seed(seed)
    scale = torch.tensor([plausible_error(p) for p in mechanism.geometry], dtype=torch.float64)
    truth = mechanism.nominal + error * scale * torch.randn(count, len(scale), generator=generator, dtype=torch.float64)
    middle = (mechanism.low + mechanism.high) / 2
    ideal = middle + 0.6 * (mechanism.sample_workspace(count * rows, generator) - middle)
    joints = mechanism.solve_inverse(ideal).reshape(count, rows, -1)
    clean = mechanism.forward_kinematics(joints, truth[:, None])
    return Measured(
        mechanism,
        truth,
        joints,
        clean + noise * torch.randn(clean.shape, generator=generator, dtype=torch.float64),
        clean,
    )
