"""The parallelogram-based 3-DOF tripod of the paper's first case study (Zhang and Gao 2012, section IV-A)."""

from __future__ import annotations

import torch
from torch import Tensor

from ccnn_torch.coordinates import Coordinate, Parameter
from ccnn_torch.mechanisms.mechanism import Mechanism
from ccnn_torch.numerics.batching import expand_leading, stack_last
from ccnn_torch.numerics.least_squares import jacobian_of


class Tripod(Mechanism):
    """Two parallelogram legs along x, one bar along y; joints q1, q2, q3 [m] (ρ1..ρ3), pose y, z [m], phi [rad].

    The printed eq. 15 has 15b twice; the first of the two is ρ2. The platform turns about -y by phi. The workspace is
    the assembly mode det(∂ρ/∂X) < 0, which Newton from (0, 0.55 m, 0) does not leave; the sampling box is
    y ±0.2 m, z 0.4..0.7 m, phi ±0.3 rad.
    """

    closed_form = "inverse"

    def __init__(self, L: float = 1.0, r: float = 0.3, per_leg: bool = False) -> None:
        """L: length of the legs [m]; r: radius of the platform [m].

        per_leg: leg i has parameters of its own, for identification: its length Li, the radius ri of its joint on the
        platform and the offset di of its drive [m] (its carriage is at the joint plus this); else L and r are
        common.
        """
        geometry = [Parameter("L", "m", L), Parameter("r", "m", r)]
        if per_leg:
            parts = (("L", L), ("r", r), ("d", 0.0))
            geometry = [Parameter(f"{n}{i}", "m", v, i) for i in (1, 2, 3) for n, v in parts]
        super().__init__(
            name="tripod",
            joints=[Coordinate(q, "m") for q in ("q1", "q2", "q3")],
            pose=[Coordinate("y", "m"), Coordinate("z", "m"), Coordinate("phi", "rad")],
            geometry=geometry,
            low=(-0.2, 0.4, -0.3),
            high=(0.2, 0.7, 0.3),
            home_pose=(0.0, 0.55, 0.0),
        )
        if type(self) is Tripod:
            self.recipe = {"spec": "tripod", "keys": {"per_leg": True} if per_leg else {}}

    def solve_inverse(self, pose: Tensor, parameters: Tensor | None = None, guess: Tensor | None = None) -> Tensor:
        """Eq. 15, closed form; NaN where a root is not real."""
        length, radius, offset = self._legs(self.resolve(parameters))
        y, z, phi = pose.unbind(-1)
        (l1, l2, l3), (r1, r2, r3) = length.unbind(-1), radius.unbind(-1)
        s, c = torch.sin(phi), torch.cos(phi)
        rho1 = torch.sqrt(l1**2 - y**2 - (z + r1 * s) ** 2) + r1 * c
        rho2 = torch.sqrt(l2**2 - y**2 - (z - r2 * s) ** 2) + r2 * c
        rho3 = torch.sqrt(l3**2 - z**2) + y + r3
        return stack_last(rho1, rho2, rho3) - offset

    def _legs(self, values: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Length, radius and offset of each leg, `... x 3` [m]."""
        if len(self.geometry) == 2:
            length, radius = (values[..., i, None].expand(*values.shape[:-1], 3) for i in (0, 1))
            return length, radius, torch.zeros_like(length)
        legs = values.reshape(*values.shape[:-1], 3, 3)
        return legs[..., 0], legs[..., 1], legs[..., 2]

    def forward_kinematics(
        self, joints: Tensor, parameters: Tensor | None = None, guess: Tensor | None = None
    ) -> Tensor:
        """Newton on eq. 15; NaN where it leaves the assembly mode (beyond the edge of the workspace)."""
        pose = super().forward_kinematics(joints, parameters, guess)
        return torch.where(self.reachable(pose.detach(), parameters)[..., None], pose, torch.nan)

    def skeleton(self, pose: Tensor, joints: Tensor, parameters: Tensor | None = None) -> dict[str, Tensor]:
        """From the carriage of each leg to its joint on the platform; see `Mechanism.skeleton`."""
        _, radius, offset = self._legs(self.resolve(parameters))
        centre, rotation = self.frame(pose)
        assert rotation is not None
        # Legs 1 and 2 run along x, leg 3 along y.
        side = torch.tensor([[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0]], dtype=pose.dtype)
        carriage, on_platform = side * (joints + offset)[:, None], centre + (side * radius[:, None]) @ rotation.mT
        return {f"leg {i + 1}": torch.stack([carriage[i], on_platform[i], centre]) for i in range(3)}

    def frame(self, pose: Tensor) -> tuple[Tensor, Tensor | None]:
        """Centre of the platform (0, y, z) and its rotation about -y by phi."""
        y, z, phi = pose.unbind(-1)
        zero, one = torch.zeros_like(phi), torch.ones_like(phi)
        s, c = torch.sin(phi), torch.cos(phi)
        rotation = torch.stack([c, zero, -s, zero, one, zero, s, zero, c], dim=-1).reshape(*phi.shape, 3, 3)
        return torch.stack([zero, y, z], dim=-1), rotation

    def reachable(self, pose: Tensor, parameters: Tensor | None = None) -> Tensor:
        """Real roots, and det(∂ρ/∂X) < 0: the assembly mode of the machine as built."""
        parameters = self.resolve(parameters)
        joints, slope = jacobian_of(lambda x: self.solve_inverse(x, parameters), expand_leading(pose, parameters))
        real = torch.isfinite(joints).all(-1)
        determinant: Tensor = torch.linalg.det(torch.where(real[..., None, None], slope, 0.0))
        return real & (determinant < 0)
