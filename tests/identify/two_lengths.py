"""A slide whose joint shows only the sum of two lengths: a user's mechanism in a file, for the tests."""

import torch
from torch import Tensor

from ccnn_torch.coordinates import Coordinate, Parameter
from ccnn_torch.mechanisms import Mechanism


class TwoLengths(Mechanism):
    """q1 = x (first + second) + offset."""

    def __init__(self) -> None:
        super().__init__(
            "two_lengths",
            joints=[Coordinate("q1", "m")],
            pose=[Coordinate("x", "m")],
            geometry=[Parameter("first", "1", 1.0), Parameter("second", "1", 2.0), Parameter("offset", "m", 0.0)],
            low=(-1.0,),
            high=(1.0,),
        )

    def solve_inverse(self, pose: Tensor, parameters: Tensor | None = None, guess: Tensor | None = None) -> Tensor:
        first, second, offset = self.values(parameters)
        return pose * (first + second)[..., None] + offset[..., None]

    def forward_kinematics(
        self, joints: Tensor, parameters: Tensor | None = None, guess: Tensor | None = None
    ) -> Tensor:
        first, second, offset = self.values(parameters)
        return torch.as_tensor((joints - offset[..., None]) / (first + second)[..., None])
