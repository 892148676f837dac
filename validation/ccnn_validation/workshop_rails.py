"""Three carriages on parallel rails along x, a platform on rods of 0.9 m; it does not turn."""

from torch import Tensor

from ccnn_torch.coordinates import Coordinate, Parameter
from ccnn_torch.mechanisms import Mechanism


class Rails(Mechanism):
    """Joints q1..q3 [m] along x, pose x, y, z [m]; y, z, place: of a rail less those of the platform's joint."""

    def __init__(self, rod: float = 0.9) -> None:
        geometry = []
        for leg, (y, z) in enumerate([(-0.4, 0.85), (0.0, 0.85), (0.4, 0.85)], start=1):
            places = {"rod": (rod, "m"), "y": (y, "m"), "z": (z, "m"), "place": (0.0, "m")}
            angles = {"yaw": (0.0, "rad"), "pitch": (0.0, "rad")}
            geometry += [
                Parameter(f"{name}{leg}", unit, value, leg) for name, (value, unit) in {**places, **angles}.items()
            ]
        super().__init__(
            name="rails",
            joints=[Coordinate(q, "m") for q in ("q1", "q2", "q3")],
            pose=[Coordinate(c, "m") for c in "xyz"],
            geometry=geometry,
            low=(-0.25, -0.2, 0.25),
            high=(0.25, 0.2, 0.5),
            home_joints=[-0.65, 0.75, -0.65],
        )

    def closure(self, pose: Tensor, joints: Tensor, parameters: Tensor | None = None) -> Tensor:
        """Length of each rod as posed, less its length; `... x 3` [m]."""
        values = self.resolve(parameters)
        rod, y, z, place, yaw, pitch = values.reshape(*values.shape[:-1], 3, 6).unbind(-1)
        px, py, pz = (c[..., None] for c in pose.unbind(-1))
        along, across, up = px - joints - place, py - y - yaw * joints, pz - z - pitch * joints
        return (along**2 + across**2 + up**2).sqrt() - rod
