"""A machine seen from a frame that is not its own: frames fitted anew to rows, and the key that has them fitted."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from ccnn_torch.diagnosis.residual.distance import USUAL, Size
from ccnn_torch.effects import Situation
from ccnn_torch.errors import InputError
from ccnn_torch.mechanisms import Framed, SerialArm
from ccnn_torch.mechanisms.frames.fit import ROTATION_WEIGHT, best_closed_form

# Share of the usual distance that a fitted frame may leave.
_LEFT = 0.1


def placed(situation: Situation, measured: Tensor) -> Situation:
    """The rows with unknown frames fitted to these poses; as they are where no frame is unknown, or one per group."""
    mechanism, parameters = situation.mechanism, None
    if isinstance(mechanism, Framed) and mechanism.unknown_frames:
        parameters = mechanism.inlying_frames(situation.joints, measured)
    elif isinstance(mechanism, SerialArm) and mechanism.unknown_frames and not _grouped(mechanism):
        parameters = _closed_form(mechanism, situation.joints, measured)
    return situation if parameters is None else replace(situation, parameters=parameters)


def frame_remedy(situation: Situation, measured: Tensor, size: Size) -> str:
    """The key to write where a rigid motion of the whole machine makes rows and model agree; empty otherwise.

    Args:
        situation: `s` rows.
        measured: poses, `s x p` [SI].
        size: of the machine.
    """
    mechanism, finite = situation.mechanism, torch.isfinite(measured).all(-1)
    joints, measured = situation.joints[finite], measured[finite]
    if not len(joints):
        return ""
    seen = mechanism.frame(measured)
    if isinstance(mechanism, Framed) or (isinstance(mechanism, SerialArm) and mechanism.unknown_frames):
        return ""
    if isinstance(mechanism, SerialArm):
        there = mechanism.frame(mechanism.forward_kinematics(joints, _closed_form(mechanism, joints, measured)))[0]
        key = "base_frame: unknown and tool_frame: unknown in its file"
    else:
        try:
            framed = Framed(mechanism)
        except InputError:
            return ""
        there = framed.frame(framed.forward_kinematics(joints, framed.fitted_frames(joints, seen)))[0]
        key = f"mechanism=framed 'mechanism_keys={{mechanism: {_inside(mechanism.recipe)}}}'"
        missing = [c.name for c in framed.pose if c.name not in {own.name for own in mechanism.pose}]
        key += f", and give the pose as {', '.join(c.name for c in framed.pose)}" if missing else ""
    left = torch.linalg.vector_norm(there - seen[0], dim=-1).nan_to_num(nan=torch.inf) / size.place
    if float(left.median()) > _LEFT * USUAL:
        return ""
    return f"seen from a frame that is not the model's they are; to have it fitted write {key}"


def _grouped(arm: SerialArm) -> bool:
    return bool(arm.frame_per or arm.tool_per)


def _closed_form(arm: SerialArm, joints: Tensor, measured: Tensor) -> Tensor:
    """Parameters with base and tool in closed form, `k`: near enough to judge sixty mistakes by."""
    weights = torch.ones(len(joints), dtype=joints.dtype)
    frames = best_closed_form(*arm.flange(joints), arm.frame(measured), arm.nominal[-6:], weights, ROTATION_WEIGHT)
    return torch.cat([frames[:6], arm.nominal[6:-6], frames[6:]])


def _inside(recipe: dict[str, Any]) -> str:
    keys = ", ".join(f"{name}: {value}" for name, value in recipe.get("keys", {}).items())
    return str(recipe.get("spec", "")) + (f", keys: {{{keys}}}" if keys else "")
