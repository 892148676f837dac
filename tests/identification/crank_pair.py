"""A planar five-bar in closed form with six parameters a leg, for the tests of identification."""

from __future__ import annotations

import torch
from torch import Tensor

from ccnn_torch.batching import stack_last
from ccnn_torch.coordinates import Coordinate, Parameter
from ccnn_torch.mechanisms import Mechanism

LEGS = ((1, -0.5, 1.0), (2, 0.5, -1.0))


class CrankPair(Mechanism):
    """Crank l and coupler L from (Ax, Ay) to the tool, elbows outward; the crank's angle is k q + gamma."""

    def __init__(self) -> None:
        geometry = []
        for leg, x, _ in LEGS:
            values = {"l": 0.75, "L": 1.1, "k": 1.0, "gamma": 0.0}
            units = {"l": "m", "L": "m", "k": "1", "gamma": "rad"}
            geometry += [Parameter(f"{n}{leg}", units[n], v, leg) for n, v in values.items()]
            geometry += [Parameter(f"A{leg}x", "m", x, leg), Parameter(f"A{leg}y", "m", 0.0, leg)]
        super().__init__(
            name="crank_pair",
            joints=[Coordinate("q1", "rad"), Coordinate("q2", "rad")],
            pose=[Coordinate("x", "m"), Coordinate("y", "m")],
            geometry=geometry,
            low=(-0.4, 0.8),
            high=(0.4, 1.3),
        )

    def solve_inverse(self, pose: Tensor, parameters: Tensor | None = None, guess: Tensor | None = None) -> Tensor:
        values = self.resolve(parameters)
        joints = []
        for number, (_, _, side) in enumerate(LEGS):
            l, L, k, gamma, x, y = values[..., 6 * number : 6 * number + 6].unbind(-1)
            across, up = pose[..., 0] - x, pose[..., 1] - y
            reach = across**2 + up**2
            bend = torch.acos((reach + l**2 - L**2) / (2 * l * torch.sqrt(reach)))
            joints.append((torch.atan2(up, across) + side * bend - gamma) / k)
        return stack_last(*joints)

    def forward_kinematics(
        self, joints: Tensor, parameters: Tensor | None = None, guess: Tensor | None = None
    ) -> Tensor:
        values = self.resolve(parameters)
        tips, lengths = [], []
        for number in range(2):
            l, L, k, gamma, x, y = values[..., 6 * number : 6 * number + 6].unbind(-1)
            angle = k * joints[..., number] + gamma
            tips.append(stack_last(x + l * torch.cos(angle), y + l * torch.sin(angle)))
            lengths.append(L)
        gap = tips[1] - tips[0]
        span = gap.square().sum(-1)
        along = (span + lengths[0] ** 2 - lengths[1] ** 2) / (2 * span)
        above = torch.sqrt(lengths[0] ** 2 / span - along**2)
        turned = stack_last(-gap[..., 1], gap[..., 0])
        return tips[0] + along[..., None] * gap + above[..., None] * turned


def machines(count: int, rows: int, seed: int, noise: float = 1e-4, error: float = 1.0) -> tuple[Tensor, ...]:
    """True parameters `r x 12` (5 mm, 4e-3 gain, 5 mrad off), joints `r x s x 2`, measured and true poses."""
    mechanism = CrankPair()
    generator = torch.Generator().manual_seed(seed)
    sd = error * torch.tensor([5e-3, 5e-3, 4e-3, 5e-3, 5e-3, 5e-3] * 2, dtype=torch.float64)
    truth = mechanism.nominal + sd * torch.randn(count, 12, generator=generator, dtype=torch.float64)
    joints = mechanism.sample_joints(count * rows, generator).reshape(count, rows, 2)
    pose = mechanism.forward_kinematics(joints, truth[:, None])
    measured = pose + noise * torch.randn(pose.shape, generator=generator, dtype=torch.float64)
    return truth, joints, measured, pose
