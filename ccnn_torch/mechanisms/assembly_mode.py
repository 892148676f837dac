"""Whether numeric inverse kinematics stay on the branch of the home configuration over the whole sampling box."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from ccnn_torch.mechanisms.mechanism import Mechanism

_POSES, _STEPS = 256, 8
# A walk whose joints change by more than this in a step, or that differs by less from the direct answer, is not
# conclusive.
_LARGEST_STEP, _APART = 1.0, 0.1


class Jump(NamedTuple):
    """A pose `p` [SI], its joints straight from home, and its joints on a walk in small steps, `n` each [SI]."""

    pose: Tensor
    direct: Tensor
    walked: Tensor


def is_numeric(mechanism: Mechanism) -> bool:
    """Whether the mechanism's inverse kinematics are the numeric default, which needs a branch to start from."""
    return type(mechanism).solve_inverse is Mechanism.solve_inverse


def settle_home(mechanism: Mechanism) -> None:
    """Put `home_joints` exactly where `home_pose` is, by Newton from where they are; changed in place.

    From a guess that is only near, a search for another pose first has to return to the branch, and may miss it.
    Where there is no solution near, they stay.
    """
    if is_numeric(mechanism):
        exact = mechanism.solve_inverse(mechanism.home_pose)
        if exact.shape == mechanism.home_joints.shape and bool(torch.isfinite(exact).all()):
            mechanism.home_joints.copy_(exact)


def jump_sentence(mechanism: Mechanism, seed: int = 0) -> str:
    """What is wrong where `find_jump` finds a pose; empty where it finds none."""
    jump = find_jump(mechanism, seed) if is_numeric(mechanism) else None
    if jump is None:
        return ""
    where = ", ".join(f"{c.name} = {v:.4g} {c.unit}" for c, v in zip(mechanism.pose, jump.pose.tolist(), strict=True))
    direct, walked = ([f"{v:.4g}" for v in joints.tolist()] for joints in (jump.direct, jump.walked))
    return (
        f"its numeric inverse kinematics leave the branch of home_joints: at {where} they give the joints "
        f"{', '.join(direct)}, and {', '.join(walked)} when they go there in small steps; make low and high narrower, "
        "put home_pose in their middle with its exact home_joints, or write solve_inverse"
    )


def find_jump(mechanism: Mechanism, seed: int = 0) -> Jump | None:
    """The sampled pose at which the joints found straight from home differ most from those of a walk there, if any.

    The walk goes along a straight line of pose coordinates, each step from the joints of the last. A line that leaves
    the workspace or comes near a singularity proves nothing and is left out.
    """
    poses = mechanism.sample_workspace(_POSES, torch.Generator().manual_seed(seed))
    direct = mechanism.solve_inverse(poses)
    walked = mechanism.home_joints.expand_as(direct)
    smooth = torch.ones(len(poses), dtype=torch.bool)
    for step in range(1, _STEPS + 1):
        here = torch.lerp(mechanism.home_pose.expand_as(poses), poses, step / _STEPS)
        there = mechanism.solve_inverse(here, guess=torch.where(smooth[:, None], walked, mechanism.home_joints))
        smooth &= mechanism.wrap(there - walked).abs().amax(-1) <= _LARGEST_STEP  # false for NaN, too
        walked = there
    gap = torch.where(smooth, mechanism.wrap(direct - walked).abs().amax(-1), 0.0)
    worst = int(gap.argmax())
    return Jump(poses[worst], direct[worst], walked[worst]) if float(gap[worst]) > _APART else None
