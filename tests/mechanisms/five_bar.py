"""A user's mechanism in one file: a planar five-bar with closure alone; everything else is the package's default."""

import torch
from torch import Tensor

from ccnn_torch.coordinates import Coordinate, Parameter
from ccnn_torch.mechanisms import Mechanism


class FiveBar(Mechanism):
    """Two cranks at x = -a and x = a, two couplers that meet at the tool; joints q1, q2 [rad], pose x, y [m]."""

    def __init__(self, a: float = 0.25, crank: float = 0.4, coupler: float = 0.6) -> None:
        lengths = {"a": a, "crank": crank, "coupler": coupler}
        super().__init__(
            name="five_bar_of_a_user",
            joints=[Coordinate("q1", "rad"), Coordinate("q2", "rad")],
            pose=[Coordinate("x", "m"), Coordinate("y", "m")],
            geometry=[Parameter(name, "m", value) for name, value in lengths.items()],
            low=(-0.15, 0.55),
            high=(0.15, 0.75),
            home_joints=(2.2, 0.94),
        )

    def closure(self, pose: Tensor, joints: Tensor, parameters: Tensor | None = None) -> Tensor:
        """Squared distance from each elbow to the tool, less the coupler's."""
        a, crank, coupler = (v[..., None] for v in self.values(parameters))
        side = torch.tensor([-1.0, 1.0], dtype=torch.float64)
        across = pose[..., :1] - side * a - crank * torch.cos(joints)
        up = pose[..., 1:] - crank * torch.sin(joints)
        return across**2 + up**2 - coupler**2
