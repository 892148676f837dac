"""Members of a machine by its parameters: legs, links of an arm, single lengths."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from ccnn_torch.effects.columns import own_parameters
from ccnn_torch.mechanisms import Mechanism, SerialArm
from ccnn_torch.numerics.rotations import rotation_vector_to_matrix


class Member(NamedTuple):
    """A part of the machine: what results call it, and the numbers of its parameters that are lengths."""

    name: str
    lengths: list[int]
    leg: int | None
    joint: str | None


def members(mechanism: Mechanism) -> list[Member]:
    """The parts that have lengths; a length that belongs to no leg is a part of its own."""
    own = own_parameters(mechanism)
    found: dict[str, Member] = {}
    for place, k in enumerate(own):
        parameter = mechanism.geometry[k]
        if parameter.unit != "m":
            continue
        name, leg, joint = parameter.name, None, None
        if isinstance(mechanism, SerialArm):
            i = place * len(mechanism.joints) // len(own)
            name, joint = f"link {i + 1}", mechanism.joints[i].name
        elif parameter.leg is not None:
            name, leg = f"leg {parameter.leg}", parameter.leg
        if name not in found:
            found[name] = Member(name, [], leg, joint)
        found[name].lengths.append(k)
    return list(found.values())


def arm_axes(arm: SerialArm, joints: Tensor, values: Tensor) -> tuple[Tensor, Tensor]:
    """A point on each joint's axis and the axis' direction in the base frame, `... x n x 3` each [m], [1]."""
    frames = arm.link_frames(joints, values)
    holders = frames[:-1] if arm._axis_before else frames[1:]
    base = rotation_vector_to_matrix(values[..., 3:6])
    points = torch.stack([place for _, place in holders], -2) @ base.mT + values[..., None, :3]
    axes = (torch.stack([turn for turn, _ in holders], -3) @ arm.axes.unsqueeze(-1)).squeeze(-1) @ base.mT
    return points, axes
