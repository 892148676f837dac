"""Rows of machines with a known cause, injected in the true kinematics."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from ccnn_torch.effects import Acting, Situation, default_gravity, make_effect, reached
from ccnn_torch.mechanisms import Mechanism, load_mechanism

NOISE = 2e-5


def rows_of(name: str, rows: int, seed: int) -> Situation:
    """A machine in random poses, over four hours, under changing loads."""
    mechanism = load_mechanism(name, **({"per_leg": True} if name == "tripod" else {}))
    g = torch.Generator().manual_seed(seed)

    def draw(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=g, dtype=torch.float64)

    pose = mechanism.sample_workspace(rows, g)
    joints = mechanism.solve_inverse(pose)
    time = (draw(rows) * 14400).sort().values
    covariates = {"time": time, "temperature": 293.15 + 4 * torch.sin(time / 2500) + 2 * torch.cos(time / 900)}
    lengths = [c.name for c in mechanism.pose if c.unit == "m"][:2]
    covariates |= {f"load_{c}": (draw(rows) - 0.3) * 100 for c in lengths}
    covariates |= {f"direction{i + 1}": torch.sign(draw(rows) - 0.5) for i in range(len(mechanism.joints))}
    return Situation(mechanism, joints, covariates, default_gravity(mechanism), None, pose)


def cramped(name: str, rows: int, seed: int, share: float = 0.15) -> Situation:
    """The same in a small part of the workspace, where one cause looks like another."""
    here = rows_of(name, rows, seed)
    middle = (here.mechanism.low + here.mechanism.high) / 2
    pose = middle + share * (here.pose - middle)
    return replace(here, joints=here.mechanism.solve_inverse(pose), guess=pose)


def acting(situation: Situation, name: str, **values: float) -> Acting:
    """An effect at its usual shapes, with the named coefficients [SI] and no others."""
    effect = make_effect(name)
    names = [c.name.replace(" ", "_") for c in effect.coefficients(situation)]
    assert set(values) <= set(names), names
    coefficients = [values.get(n, 0.0) for n in names]
    shape = [s.grid[0] if s.usual is None else s.usual for s in effect.shapes(situation)]
    return Acting(effect, *(torch.tensor(v, dtype=torch.float64) for v in (shape, coefficients)))


def reached_with(situation: Situation, causes: list[Acting], seed: int, noise: float = NOISE) -> Tensor:
    """Poses of a machine with causes, measured with noise, `s x p`."""
    there = reached(situation, causes)
    drawn = torch.randn(there.shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return pose_of(situation.mechanism, there + noise * drawn)


def measured(situation: Situation, causes: dict[str, float], seed: int, noise: float = NOISE) -> Tensor:
    """Poses with causes of a size in units of the noise, drawn at random in their coefficients, `s x p`."""
    g = torch.Generator().manual_seed(seed)
    acting = []
    still = reached(situation, [])
    for name, size in causes.items():
        effect = make_effect(name)
        coefficients = effect.coefficients(situation)
        scale = torch.tensor([0.0 if c.secondary else c.scale for c in coefficients], dtype=torch.float64)
        drawn = torch.randn(len(scale), generator=g, dtype=torch.float64) * scale * 1e-3
        # Edges of the usual width leave the flanks apart.
        shapes = [s.usual if s.name == "width" else s.grid[len(s.grid) // 3] for s in effect.shapes(situation)]
        shape = torch.tensor(shapes, dtype=torch.float64)
        for _ in range(3):
            moved = (reached(situation, [Acting(effect, shape, drawn)]) - still)[:, :3]
            # The usual row, so that one close to a singularity does not have the whole gap.
            usual = moved[:, moved.abs().amax(0) > 1e-13].square().mean(-1).median().sqrt()
            drawn = drawn * size * noise / usual
        acting.append(Acting(effect, shape, drawn))
    there = reached(situation, acting)
    there = there + noise * torch.randn(there.shape, generator=g, dtype=torch.float64)
    return pose_of(situation.mechanism, there)


def pose_of(mechanism: Mechanism, frame: Tensor) -> Tensor:
    """The pose coordinates of position and rotation vector (small angles in the tripod's)."""
    if mechanism.name == "tripod":
        return torch.stack([frame[:, 1], frame[:, 2], -frame[:, 4]], -1)
    names = [c.name for c in mechanism.pose]
    order = ["x", "y", "z", "rx", "ry", "rz"]
    return frame[:, [order.index(n) for n in names]]
