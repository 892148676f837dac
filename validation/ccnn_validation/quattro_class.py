"""A Par4/Quattro picker as a user of the program draws it: four legs with one rod each, a plate with its gear.

Without `closed_form` no model file could be written (no polynomial of the joints is good enough), so the forward
kinematics are Newton's steps in sums and products, from the middle of the workspace: five settle it to 1e-14 m.
"""

import math

import torch
from torch import Tensor

from ccnn_torch.coordinates import Coordinate, Parameter
from ccnn_torch.mechanisms import Mechanism

LEG = ("Ax", "Ay", "Az", "azimuth", "tilt", "crank", "rod", "offset")
REST = ("barA", "barB", "bar_zero", "gear", "point_x", "point_y", "point_z")
STAND = ("stand_x", "stand_y", "stand_z", "stand_rx", "stand_ry", "stand_rz")
# Ball pairs on the plate, less half the bar [m].
PLATE = ((0.07, 0.02), (-0.07, 0.02), (-0.07, -0.02), (0.07, -0.02))


class Quattro(Mechanism):
    """Joints q1..q4 [rad], 0 = arm level, positive = down; pose: the reflector x, y, z [m], turn of the flange rz."""

    closed_form = "forward"

    def __init__(self) -> None:
        geometry = []
        for leg, angle in enumerate((math.radians(a) for a in (45.0, 135.0, 225.0, 315.0)), start=1):
            place = {"Ax": 0.275 * math.cos(angle), "Ay": 0.275 * math.sin(angle), "Az": 0.0}
            geometry += [Parameter(f"{name}{leg}", "m", value, leg, scale=2e-4) for name, value in place.items()]
            geometry += [
                Parameter(f"{name}{leg}", "rad", value, leg) for name, value in (("azimuth", angle), ("tilt", 0))
            ]
            geometry += [
                Parameter(f"{name}{leg}", "m", v, leg, scale=2e-4) for name, v in (("crank", 0.375), ("rod", 0.825))
            ]
            geometry.append(Parameter(f"offset{leg}", "rad", 0.0, leg))
        geometry += [Parameter(name, "m", 0.05, scale=1e-4) for name in ("barA", "barB")]
        geometry.append(Parameter("bar_zero", "rad", 0.0))
        geometry.append(Parameter("gear", "1", 4.0, scale=4e-3))
        geometry += [Parameter(f"point_{c}", "m", v, scale=5e-4) for c, v in (("x", 0.06), ("y", 0.0), ("z", -0.03))]
        geometry += [Parameter(name, "m", 0.0, scale=1e-3) for name in STAND[:3]]
        geometry += [Parameter(name, "rad", 0.0, scale=1e-3) for name in STAND[3:]]
        super().__init__(
            name="quattro",
            joints=[Coordinate(f"q{i}", "rad") for i in range(1, 5)],
            pose=[Coordinate("x", "m"), Coordinate("y", "m"), Coordinate("z", "m"), Coordinate("rz", "rad")],
            geometry=geometry,
            low=(-0.36, -0.36, -0.98, -2.62),
            high=(0.36, 0.36, -0.78, 2.62),
            home_joints=[0.54, 0.54, 0.54, 0.54],
        )

    def parts(self, parameters: Tensor | None) -> tuple[tuple[Tensor, ...], tuple[Tensor, ...]]:
        """Numbers of the legs, `... x 4` each, and the others."""
        values = self.resolve(parameters)
        return values[..., :32].reshape(*values.shape[:-1], 4, 8).unbind(-1), values[..., 32:].unbind(-1)

    def solve_inverse(self, pose: Tensor, parameters: Tensor | None = None, guess: Tensor | None = None) -> Tensor:
        """Joints of poses, `... x 4`."""
        (ax, ay, az, azimuth, tilt, crank, rod, offset), rest = self.parts(parameters)
        bar_a, bar_b, bar_zero, gear, px, py, pz, sx, sy, sz, rx, ry, rz = rest
        x, y, z, turn = pose.unbind(-1)
        # The pose is the stand's shift and small turn after the machine's own.
        x, y, z, phi = x - sx, y - sy, z - sz, turn - rz
        share, dot = 1 / (1 + rx * rx + ry * ry + rz * rz), rx * x + ry * y + rz * z
        x, y, z = (
            (x + rx * dot - ry * z + rz * y) * share,
            (y + ry * dot - rz * x + rx * z) * share,
            (z + rz * dot - rx * y + ry * x) * share,
        )
        c, s = torch.cos(phi), torch.sin(phi)
        x, y, z = x - c * px + s * py, y - s * px - c * py, z - pz
        theta = phi / gear - bar_zero
        shift = torch.stack([bar_a, bar_a, -bar_b, -bar_b], -1)
        plate = torch.tensor(PLATE, dtype=pose.dtype, device=pose.device)
        dx = x[..., None] + plate[:, 0] - shift * torch.sin(theta)[..., None] - ax
        dy = y[..., None] + plate[:, 1] + shift * torch.cos(theta)[..., None] - ay
        dz = z[..., None] - az
        ca, sa, ct, st = torch.cos(azimuth), torch.sin(azimuth), torch.cos(tilt), torch.sin(tilt)
        out, along = ca * dx + sa * dy, -sa * dx + ca * dy
        # The motor's axis leans by tilt about the leg's outward direction.
        down = st * along - ct * dz
        square = dx * dx + dy * dy + dz * dz
        level = (square + crank * crank - rod * rod) / (2 * crank)
        across = torch.sqrt(out * out + down * down)
        return torch.atan2(down, out) - torch.acos(level / across) - offset

    def forward_kinematics(
        self, joints: Tensor, parameters: Tensor | None = None, guess: Tensor | None = None
    ) -> Tensor:
        """Poses of joints, `... x 4`."""
        (ax, ay, az, azimuth, tilt, crank, rod, offset), rest = self.parts(parameters)
        bar_a, bar_b, bar_zero, gear, px, py, pz, sx, sy, sz, rx, ry, rz = rest
        ca, sa, ct, st = torch.cos(azimuth), torch.sin(azimuth), torch.cos(tilt), torch.sin(tilt)
        cq, sq = crank * torch.cos(joints + offset), crank * torch.sin(joints + offset)
        plate = torch.tensor(PLATE, dtype=joints.dtype, device=joints.device)
        # From each elbow to the middle of its balls on the plate, less the plate's place and the bar's half.
        gx = plate[:, 0] - ax - cq * ca + sq * st * sa
        gy = plate[:, 1] - ay - cq * sa - sq * st * ca
        gz = sq * ct - az
        shift = torch.stack([bar_a, bar_a, -bar_b, -bar_b], -1)
        x, y, theta = (0 * (gx + shift).sum(-1) for _ in range(3))
        z = x - 0.85
        for _ in range(6):
            s, c = torch.sin(theta)[..., None] * shift, torch.cos(theta)[..., None] * shift
            dx, dy, dz = x[..., None] + gx - s, y[..., None] + gy + c, z[..., None] + gz
            miss = (dx * dx + dy * dy + dz * dz - rod * rod) / 2
            step = solved(dz, dx, dy, -dx * c - dy * s, miss)
            z, x, y, theta = (a - b for a, b in zip((z, x, y, theta), step, strict=True))
        # A machine that does not close has no pose: the root of a negative number is NaN.
        phi = gear * (theta + bar_zero) + 0 * torch.sqrt(1e-16 - (miss * miss).sum(-1))
        c, s = torch.cos(phi), torch.sin(phi)
        x, y, z = x + c * px - s * py, y + s * px + c * py, z + pz
        placed = x + sx + ry * z - rz * y, y + sy + rz * x - rx * z, z + sz + rx * y - ry * x
        return torch.stack([*placed, phi + rz], -1)


def solved(*columns: Tensor) -> list[Tensor]:
    """Four unknowns of four equations, whose columns (the right side last) are `... x 4`: elimination row by row."""
    table = [list(row) for row in zip(*(column.unbind(-1) for column in columns), strict=True)]
    for k in range(4):
        table[k] = [cell / table[k][k] for cell in table[k]]
        for i in range(4):
            if i != k:
                table[i] = [cell - table[i][k] * pivot for cell, pivot in zip(table[i], table[k], strict=True)]
    return [row[4] for row in table]
