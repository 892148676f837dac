"""A robot on eight cables as its user describes it to ccnn_torch: numbers of the data sheet, and statics in torch.

This file is what the judge `cable_robot.py` hands to the program, and shares no code with it.
"""

import torch
from torch import Tensor

from ccnn_torch.coordinates import Coordinate, Parameter
from ccnn_torch.mechanisms import Mechanism

HOME, DRUM, PULLEY, DEAD, EA, HOMED, MASS, G = 1.4, 0.05, 0.03, 1.5, 120e3, 250.0, 14.0, 9.81
CORNERS = ((-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0))
INLETS = [(2 * x, 2 * y, z) for z in (3.0, 0.0) for x, y in CORNERS]
ENDS = [(0.075 * x, 0.25 * y, -0.12) for x, y in CORNERS] + [(0.25 * x, 0.075 * y, 0.12) for x, y in CORNERS]
SIDE = torch.tensor([1.0] * 4 + [-1.0] * 4, dtype=torch.float64)
POSE = [*(Coordinate(axis, "m") for axis in "xyz"), *(Coordinate(f"r{axis}", "rad") for axis in "xyz")]
LOW, HIGH = (-0.8, -0.8, 0.9, -0.12, -0.12, -0.12), (0.8, 0.8, 2.0, 0.12, 0.12, 0.12)


def matrix(turn: Tensor) -> Tensor:
    """Rotation matrix of a rotation vector."""
    x, y, z = turn.unbind(-1)
    cross = torch.stack([0 * x, -z, y, z, 0 * x, -x, -y, x, 0 * x], -1).reshape(*turn.shape[:-1], 3, 3)
    found: Tensor = torch.linalg.matrix_exp(cross)
    return found


def cables(pose: Tensor, inlets: Tensor, ends: Tensor, radius: Tensor) -> tuple[Tensor, Tensor]:
    """Lengths `... x 8` from inlets around swivelling pulleys, and their change by shift and turn `... x 8 x 6`."""
    arm = ends @ matrix(pose[..., 3:]).mT
    away = pose[..., None, :3] + arm - inlets
    flat = torch.hypot(away[..., 0], away[..., 1])
    rise = SIDE * away[..., 2]
    free = torch.sqrt((flat - radius) ** 2 + rise**2 - radius**2)
    leaves = torch.atan2(rise, flat - radius) + torch.atan2(free, radius + 0 * free)
    out = away[..., :2] / flat[..., None] * torch.sin(leaves)[..., None]
    way = torch.cat([out, (-SIDE * torch.cos(leaves))[..., None]], -1)
    return free + radius * (torch.pi - leaves), torch.cat([way, torch.linalg.cross(arm, way)], -1)


def places(radius: float) -> tuple[Tensor, Tensor, Tensor]:
    """Inlets and ends by the drawing, and lengths at home."""
    inlets, ends = torch.tensor(INLETS, dtype=torch.float64), torch.tensor(ENDS, dtype=torch.float64)
    home = torch.tensor([0, 0, HOME, 0, 0, 0], dtype=torch.float64)
    return inlets, ends, cables(home, inlets, ends, torch.tensor(radius, dtype=torch.float64))[0]


def leaving() -> Tensor:
    """Points where cables leave the pulleys at home: what the controller has in their place."""
    inlets, ends, _ = places(PULLEY)
    home = torch.tensor([0, 0, HOME, 0, 0, 0], dtype=torch.float64)
    _, rows = cables(home, inlets, ends, torch.tensor(PULLEY, dtype=torch.float64))
    away = home[:3] + ends - inlets
    out = away[:, :2] / torch.linalg.vector_norm(away[:, :2], dim=-1, keepdim=True)
    cos, sin = -SIDE * rows[:, 2], torch.linalg.vector_norm(rows[:, :2], dim=-1)
    return inlets + torch.cat([out * (PULLEY * (1 + cos))[:, None], (SIDE * PULLEY * sin)[:, None]], -1)


def straight(pose: Tensor, points: Tensor, ends: Tensor) -> Tensor:
    """Lengths of cables that are straight lines from points, `... x 8`."""
    found: Tensor = torch.linalg.vector_norm(pose[..., None, :3] + ends @ matrix(pose[..., 3:]).mT - points, dim=-1)
    return found


def numbers(points: Tensor, ends: Tensor, lengths: Tensor) -> list[Parameter]:
    """The numbers of each cable, and how far they may be off."""
    geometry = []
    for leg in range(8):
        for name, many, scale in (("A", points, 2e-3), ("P", ends, 1e-3)):
            geometry += [
                Parameter(f"{name}{axis}{leg + 1}", "m", value, leg + 1, scale=scale)
                for axis, value in zip("xyz", many[leg].tolist(), strict=True)
            ]
        geometry.append(Parameter(f"length{leg + 1}", "m", float(lengths[leg]), leg + 1, scale=3e-3))
        geometry.append(Parameter(f"drum{leg + 1}", "m", DRUM, leg + 1, scale=5e-5))
    return geometry


class Winches(Mechanism):
    """Joints q1..q8 [rad], angles of the winches, 0 at home; straight cables from the controller's points."""

    def __init__(self) -> None:
        """By the data sheet."""
        home = torch.tensor([0, 0, HOME, 0, 0, 0], dtype=torch.float64)
        points, ends = leaving(), places(PULLEY)[1]
        super().__init__(
            name="cable_robot",
            joints=[Coordinate(f"q{k}", "rad") for k in range(1, 9)],
            pose=POSE,
            geometry=numbers(points, ends, straight(home, points, ends)),
            low=LOW,
            high=HIGH,
            home_pose=(0.0, 0.0, HOME, 0.0, 0.0, 0.0),
            home_joints=[0.0] * 8,
        )

    def solve_inverse(self, pose: Tensor, parameters: Tensor | None = None) -> Tensor:  # type: ignore[override]
        """Angles of the winches, `... x 8` [rad]."""
        values = self.resolve(parameters)
        values = values.reshape(*values.shape[:-1], 8, 8)
        lengths = straight(pose, values[..., :3], values[..., 3:6])
        return (lengths - values[..., 6]) / values[..., 7]


def composed(step: Tensor, turn: Tensor) -> Tensor:
    """Rotation vector of a turn and a small step after it."""

    def quaternion(of: Tensor) -> tuple[Tensor, Tensor]:
        half = torch.sqrt((of**2).sum(-1, keepdim=True) + 1e-30) / 2
        return torch.cos(half), of / 2 * torch.sin(half) / half

    (a, u), (b, v) = quaternion(step), quaternion(turn)
    real, part = a * b - (u * v).sum(-1, keepdim=True), a * v + b * u + torch.linalg.cross(u, v)
    size = torch.sqrt((part**2).sum(-1, keepdim=True) + 1e-30)
    found: Tensor = part / size * 2 * torch.atan2(size, real)
    return found


class Commanded(Mechanism):
    """Joints q1..q3 [m], q4..q6 [rad]: the commanded pose; from it the winches, and statics of the cables."""

    def __init__(self, elastic: bool = True, slack: bool = False) -> None:
        """elastic: pulleys and weight, else straight cables that fit best; slack: cables cannot push."""
        radius = PULLEY if elastic else 0.0
        inlets, ends, lengths = places(radius)
        self.points, self.ends, self.elastic, self.slack = leaving(), ends, elastic, slack
        home = torch.tensor([0, 0, HOME, 0, 0, 0], dtype=torch.float64)
        self.at_home = straight(home, self.points, ends)
        if not elastic:
            inlets, lengths = self.points, self.at_home
        more = []
        if elastic:
            # As homed, under tension: unstretched lengths.
            lengths = (lengths - HOMED / EA * DEAD) / (1 + HOMED / EA)
            more = [Parameter("pulley", "m", PULLEY, scale=5e-4), Parameter("softness", "1", 1.0, scale=0.1)]
            more += [Parameter(f"weight_{axis}", "m", 0.0, scale=0.01) for axis in "xyz"]
        super().__init__(
            name="cable_robot",
            joints=[Coordinate(f"q{k}", c.unit) for k, c in enumerate(POSE, 1)],
            pose=POSE,
            geometry=[Parameter(p.name, p.unit, p.nominal, scale=p.scale) for p in numbers(inlets, ends, lengths)]
            + more,
            low=LOW,
            high=HIGH,
            home_pose=(0.0, 0.0, HOME, 0.0, 0.0, 0.0),
            home_joints=[0.0, 0.0, HOME, 0.0, 0.0, 0.0],
        )

    def closure(self, pose: Tensor, joints: Tensor, parameters: Tensor | None = None) -> Tensor:
        """Force left at the pose over the stiffness of the cables: how far it is from rest, `... x 6`."""
        values = self.resolve(parameters)
        each = values[..., :64].reshape(*values.shape[:-1], 8, 8)
        slack = each[..., 6] + each[..., 7] / DRUM * (straight(joints, self.points, self.ends) - self.at_home)
        if not self.elastic:
            arm = each[..., 3:6] @ matrix(pose[..., 3:]).mT
            away = pose[..., None, :3] + arm - each[..., :3]
            length = torch.linalg.vector_norm(away, dim=-1)
            way = away / length[..., None]
            rows = torch.cat([way, torch.linalg.cross(arm, way)], -1)
            fitted: Tensor = torch.linalg.solve(rows.mT @ rows, rows.mT @ (length - slack)[..., None])[..., 0]
            return fitted
        length, rows = cables(pose, each[..., :3], each[..., 3:6], values[..., 64, None])
        stiff = EA / (values[..., 65, None] * (slack + DEAD))
        arm = (matrix(pose[..., 3:]) @ values[..., 66:69, None])[..., 0]
        down = torch.zeros_like(arm) + torch.tensor([0, 0, -MASS * G], dtype=torch.float64)
        hung = torch.cat([down, torch.linalg.cross(arm, down)], -1)
        pull = stiff * (length - slack)
        if self.slack:
            pull = torch.nn.functional.softplus(pull / 2) * 2  # N, smooth within some newtons of 0
        push = (rows.mT @ pull[..., None])[..., 0] - hung
        away_from_rest: Tensor = torch.linalg.solve(rows.mT @ (stiff[..., None] * rows), push[..., None])[..., 0]
        return away_from_rest

    def forward_kinematics(self, joints: Tensor, parameters: Tensor | None = None) -> Tensor:  # type: ignore[override]
        """The platform at rest, `... x 6`, from where it is commanded to: from home some poses are found elsewhere."""
        pose = joints + 0 * self.resolve(parameters)[..., :6]
        for _ in range(20 if self.slack else 8):
            step = self.closure(pose, joints, parameters)
            pose = torch.cat([pose[..., :3] - step[..., :3], composed(-step[..., 3:], pose[..., 3:])], -1)
        return pose

    def solve_inverse(self, pose: Tensor, parameters: Tensor | None = None) -> Tensor:  # type: ignore[override]
        """The pose to command, `... x 6`, from the wanted one: from home 4 of 10 are not found with `slack`."""
        joints = pose + 0 * self.resolve(parameters)[..., :6]
        for _ in range(40 if self.slack else 8):
            step = self.closure(pose, joints, parameters)
            joints = torch.cat([joints[..., :3] + step[..., :3], composed(step[..., 3:], joints[..., 3:])], -1)
        return joints
