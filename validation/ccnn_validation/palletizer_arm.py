"""A palletizing robot of four axes as its user describes it to ccnn_torch, with ideal or with real parallelograms.

This file is what the judge `palletizer.py` hands to the program, and shares no code with it.
"""

import math

import torch
from torch import Tensor

from ccnn_torch.coordinates import Coordinate, Parameter
from ccnn_torch.mechanisms import Mechanism


def turn(axis: int, angle: Tensor) -> Tensor:
    """Matrices of turns about a coordinate axis, `... x 3 x 3`."""
    c, s, one, zero = torch.cos(angle), torch.sin(angle), torch.ones_like(angle), torch.zeros_like(angle)
    rows = ([one, zero, zero, zero, c, -s, zero, s, c], [c, zero, s, zero, one, zero, -s, zero, c])
    chosen = [*rows, [c, -s, zero, s, c, zero, zero, zero, one]][axis]
    return torch.stack(chosen, -1).reshape(*angle.shape, 3, 3)


def closed(pivot: Tensor, link: Tensor, far: Tensor, rod: Tensor, side: float) -> Tensor:
    """Direction of a link at a pivot whose end is a rod's length from a far place, left of it (side 1) or right."""
    apart = far - pivot
    square = (apart**2).sum(-1)
    along = (square + link**2 - rod**2) / (2 * square * link)
    aside = side * torch.sqrt(1 / square - along**2)
    across = torch.stack([-apart[..., 1], apart[..., 0]], -1)
    return along[..., None] * apart + aside[..., None] * across


def product(a: Tensor, b: Tensor) -> Tensor:
    """Two turns in a plane behind each other, each a cosine and a sine."""
    (c, s), (d, t) = a.unbind(-1), b.unbind(-1)
    return torch.stack([c * d - s * t, c * t + s * d], -1)


class Palletizer(Mechanism):
    """Joints q1..q4 [rad], as the motors count; pose x, y, z [m] of the reflector and rz, the turn of the gripper.

    q3 is the forearm's angle to the horizontal. `bars`: the three parallelograms close as their bars are; else they are
    ideal. `inside`: the reflector on the gripper belongs to the machine; else the pose is that of the flange.
    `stand`: the frame of the pose is known to a mm.
    """

    closed_form = "forward"

    def __init__(self, bars: bool = False, inside: bool = True, leans: bool = True, stand: bool = False) -> None:
        geometry = [
            Parameter(name, "m", value, scale=5e-4)
            for name, value in {"a1": 0.26, "upper": 0.945, "fore": 1.025, "a4": 0.22}.items()
        ]
        geometry += [Parameter(f"offset{k}", "rad", 0.0, scale=1.5e-3) for k in (2, 3)]
        geometry += [Parameter("level", "rad", 0.0, scale=2e-3)]
        self.leans, self.bars, self.inside = leans, bars, inside
        names = ("lean2_x", "lean3_x", "lean3_z", "lean5_x", "lean4_x") if leans else ()
        geometry += [Parameter(name, "rad", 0.0, scale=4e-4) for name in names]
        if inside:
            point = {"point_x": 0.2, "point_y": 0.1, "point_z": -0.15}
            geometry += [Parameter(name, "m", value, scale=3e-3) for name, value in point.items()]
        if stand:
            # Where the tracker's frame, fitted to the drawing beforehand, really stands.
            geometry += [Parameter(f"stand_{axis}", "m", 0.0, scale=1e-3) for axis in "xyz"]
            geometry += [Parameter(f"stand_r{axis}", "rad", 0.0, scale=1e-3) for axis in "xyz"]
        if bars:
            # Crank on the motor, tail of the forearm, rod between; levelling links at base, elbow (two), wrist; rods.
            lengths = {"crank": 0.3, "tail": 0.3, "rod": 0.945, "low": 0.2, "back": 0.2, "top": 0.2, "end": 0.2}
            lengths |= {"rise": 0.945, "along": 1.025}
            geometry += [Parameter(name, "m", value, scale=3e-4) for name, value in lengths.items()]
        super().__init__(
            name="palletizer",
            joints=[Coordinate(f"q{k}", "rad") for k in (1, 2, 3, 4)],
            pose=[Coordinate("x", "m"), Coordinate("y", "m"), Coordinate("z", "m"), Coordinate("rz", "rad")],
            geometry=geometry,
            low=(0.9, -1.0, 0.2, -1.5),
            high=(1.9, 1.0, 1.4, 1.5),
            home_joints=[0.0, math.radians(85), math.radians(-20), 0.0],
        )

    def forward_kinematics(
        self, joints: Tensor, parameters: Tensor | None = None, guess: Tensor | None = None
    ) -> Tensor:
        """Pose of joints, `... x 4`."""
        values = self.resolve(parameters)
        shape = torch.broadcast_shapes(joints.shape[:-1], values.shape[:-1])  # type: ignore[no-untyped-call]
        p = {c.name: v.expand(shape) for c, v in zip(self.geometry, values.unbind(-1), strict=True)}
        q1, q2, q3, q4 = (q.expand(shape) for q in joints.unbind(-1))
        zero = torch.zeros_like(q1)
        up = torch.stack([torch.cos(q2 + p["offset2"]), torch.sin(q2 + p["offset2"])], -1)
        out = torch.stack([torch.cos(q3 + p["offset3"]), torch.sin(q3 + p["offset3"])], -1)
        tilt = torch.stack([torch.cos(p["level"]), torch.sin(p["level"])], -1)
        arm = p["upper"][..., None] * up
        if self.bars:
            # Seen from the elbow the crank's end is behind and below, the tail turned from there as the arm leads.
            out = -closed(arm, p["tail"], -p["crank"][..., None] * out, p["rod"], -1.0)
            foot = torch.stack([-p["low"], zero], -1)
            first = product(-closed(arm, p["back"], foot, p["rise"], -1.0), tilt)
            hook = arm + p["top"][..., None] * torch.stack([-first[..., 1], first[..., 0]], -1)
            last = closed(arm + p["fore"][..., None] * out, p["end"], hook, p["along"], -1.0)
            tilt = torch.stack([last[..., 1], -last[..., 0]], -1)
        reach = p["fore"][..., None] * out

        def flat(place: Tensor) -> Tensor:
            return torch.stack([place[..., 0], zero, place[..., 1]], -1)

        def tipped(way: Tensor) -> Tensor:
            c, s, one = way[..., 0], way[..., 1], torch.ones_like(zero)
            return torch.stack([c, zero, -s, zero, one, zero, s, zero, c], -1).reshape(*c.shape, 3, 3)

        def moved(frame: Tensor, place: Tensor) -> Tensor:
            return (frame @ place[..., None])[..., 0]

        lean = {name: p.get(name, zero) for name in ("lean2_x", "lean3_x", "lean3_z", "lean5_x", "lean4_x")}
        frame = turn(2, q1)
        at = moved(frame, torch.stack([p["a1"], zero, zero + 0.75], -1))
        frame = frame @ turn(0, lean["lean2_x"])
        at = at + moved(frame, flat(arm))
        # The elbow's axis leans with the upper arm: along it and across it.
        c, s = up.unbind(-1)
        frame = frame @ turn(0, lean["lean3_x"] * c - lean["lean3_z"] * s)
        frame = frame @ turn(2, lean["lean3_x"] * s + lean["lean3_z"] * c)
        at = at + moved(frame, flat(reach))
        frame = frame @ turn(0, lean["lean5_x"]) @ tipped(tilt)
        at = at + moved(frame, torch.stack([p["a4"], zero, zero - 0.25], -1))
        frame = frame @ turn(0, lean["lean4_x"]) @ turn(2, q4)
        if self.inside:
            at = at + moved(frame, torch.stack([p["point_x"], p["point_y"], p["point_z"]], -1))
        if "stand_x" in p:
            way = [p[f"stand_r{axis}"] for axis in "xyz"]
            at = moved(turn(2, way[2]) @ turn(1, way[1]) @ turn(0, way[0]), at)
            at = at + torch.stack([p[f"stand_{axis}"] for axis in "xyz"], -1)
        return torch.cat([at, (q1 + q4)[..., None]], -1)
