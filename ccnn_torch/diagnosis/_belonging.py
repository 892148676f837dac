"""Whether rows are of this machine at all: how far poses lie from where the model puts them, against its size."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import combinations
from typing import NamedTuple

import torch
from torch import Tensor

from ccnn_torch.diagnosis._rows import picked
from ccnn_torch.effects import Situation, pose_residual
from ccnn_torch.errors import RowsError
from ccnn_torch.mechanisms import BlackBox, Framed

__all__ = ["Belonging", "Size", "belonging", "distance", "size_of"]

# Sizes of the machine: a row farther off is of other joints; and where the usual row is so far off, no small deviation
# is to be looked for in any of them.
_ROW, _USUAL = 1.0, 0.3
# A mistake is named where without it so small a share of the distance is left.
_MENDED = 0.1
_FEW = 40
# Rows astray among which a mistake in common is looked for.
_MANY = 5
# What a machine that does not move or turn is taken to [m], [rad].
_LEAST = 1e-6
_TURN = 180 / torch.pi


class Size(NamedTuple):
    """Spread of a machine's poses over its workspace.

    Attributes:
        place: RMS distance from their mean [m].
        angle: RMS angle to their mean [rad], or None without orientation.
    """

    place: Tensor
    angle: Tensor | None


def size_of(situation: Situation) -> Size:
    """How large the machine is."""
    place, rotation = situation.samples.platform
    spread = (place - place.mean(0)).square().sum(-1).mean().sqrt()
    # The mean of rotation matrices falls short of one by twice the square of the angle that they are spread by.
    angle = None if rotation is None else ((3 - rotation.mean(0).square().sum()).clamp_min(0) / 2).sqrt()
    return Size(spread, angle)


def distance(situation: Situation, measured: Tensor, size: Size) -> Tensor:
    """How far each pose lies from the nominal one, in sizes of the machine, `s` [1].

    The larger of position and rotation; NaN where the machine has no pose.

    Args:
        situation: `s` rows.
        measured: poses, `s x p` [SI].
        size: of the machine.
    """
    residual = pose_residual(situation, measured)
    far: Tensor = torch.linalg.vector_norm(residual[:, :3], dim=-1) / size.place.clamp_min(_LEAST)
    if residual.shape[-1] == 6 and size.angle is not None:
        far = torch.maximum(far, torch.linalg.vector_norm(residual[:, 3:], dim=-1) / size.angle.clamp_min(_LEAST))
    return far


class Belonging(NamedTuple):
    """Which rows are of the machine.

    Attributes:
        fine: those that are, `s` bool.
        astray: those that are not because their pose lies elsewhere, `s` bool.
        mistake: the one that many of these have in common, in words; empty where there is none.
    """

    fine: Tensor
    astray: Tensor
    mistake: str

    @property
    def lost(self) -> float:
        """Share of the rows that are not."""
        return 1 - float(self.fine.double().mean())


def belonging(situation: Situation, measured: Tensor) -> Belonging:
    """Whether the pose of each row lies about where its joints put it.

    Raises:
        RowsError: most of them do not, or are out of reach.
    """
    size = size_of(situation)
    far = distance(situation, measured, size)
    reached = torch.isfinite(far)
    if 2 * int(reached.sum()) < len(far):
        raise RowsError(
            f"{int((~reached).sum())} of {len(far)} rows are outside the reach of {situation.mechanism.name}; "
            + (
                _remedy(situation, measured, size)
                or "check the units, the order of the joints, and that this is the machine"
            )
        )
    usual = float(far[reached].median())
    if usual > _USUAL:
        raise RowsError(
            f"the usual pose lies {usual:.3g} times as far from where {situation.mechanism.name} puts it as its poses "
            "are spread over the workspace, so that these rows are not of this model; "
            + (
                _remedy(situation, measured, size)
                or "check the units, the order and signs of joints and pose, the frame that the pose is given in, and "
                "that joints and pose of a row belong together"
            )
        )
    astray = reached & (far >= _ROW)
    many = int(astray.sum()) >= _MANY
    mistake = _remedy(picked(situation, torch.nonzero(astray)[:, 0]), measured[astray], size) if many else ""
    return Belonging(reached & ~astray, astray, mistake)


def _remedy(situation: Situation, measured: Tensor, size: Size) -> str:
    """The one mistake, of those often made, without which model and rows would agree, in words; empty for none."""
    rows = torch.linspace(0, len(measured) - 1, min(_FEW, len(measured))).round().long()
    here, poses = picked(situation, rows), measured[rows]
    # A row that the machine does not reach is off by its whole workspace, and more.
    before = float(distance(here, poses, size).nan_to_num(nan=10.0).median())
    best, said = min(_MENDED * before, _USUAL), ""
    for words, other, there in _mistakes(here, poses):
        left = float(distance(replace(other, guess=_guess(other, there)), there, size).nan_to_num(nan=10.0).median())
        if left < best:
            best, said = left, words
    return said


def _mistakes(situation: Situation, measured: Tensor) -> Iterator[tuple[str, Situation, Tensor]]:
    """What is wrong, in words, and the rows as they would be without it."""
    mechanism = situation.mechanism
    pose, joints = mechanism.pose, mechanism.joints
    lengths = torch.tensor([c.unit == "m" for c in pose])
    for unit, factor in (("millimetres", 1e-3), ("centimetres", 1e-2), ("inches", 0.0254)):
        mended = torch.where(lengths, factor * measured, measured)
        yield f"the pose's lengths seem to be in {unit} under m", situation, mended
    words = (
        "the records' lengths are about 1000 times smaller than the model's: metres under mm, or a model in millimetres"
    )
    yield words, situation, torch.where(lengths, 1e3 * measured, measured)
    for i, one in enumerate(pose):
        if one.unit == "m":
            factors = torch.ones(len(pose), dtype=measured.dtype)
            factors[i] = 1e-3
            yield f"{one.name} of the pose seems to be in millimetres under m", situation, measured * factors
    shift = torch.where(lengths, torch.nan_to_num((measured - situation.pose).nanmedian(0).values), 0.0)
    far = ", ".join(f"{c.name} by {float(v):.4g} m" for c, v in zip(pose, shift, strict=True) if c.unit == "m")
    words = f"the frame that the pose is given in seems to be shifted ({far}): give the pose in the model's base frame"
    yield words, situation, measured - shift
    turned = torch.where(lengths, measured, measured / _TURN)
    yield "the pose's angles seem to be in degrees under rad", situation, turned
    for i, one in enumerate(pose):
        yield f"{one.name} of the pose seems to be reversed", situation, _reversed(measured, i)
    for i, k in combinations(range(len(pose)), 2):
        if pose[i].unit == pose[k].unit:
            words = f"{pose[i].name} and {pose[k].name} of the pose seem to be swapped"
            yield words, situation, _swapped(measured, i, k)
    inner = mechanism.mechanism if isinstance(mechanism, Framed) else mechanism
    if isinstance(inner, BlackBox):
        # Each of these would be simulated anew, which may take long.
        return
    at = situation.joints
    for i, k in combinations(range(len(joints)), 2):
        if joints[i].unit == joints[k].unit:
            words = f"the joints {joints[i].name} and {joints[k].name} seem to be swapped"
            yield words, replace(situation, joints=_swapped(at, i, k)), measured
    for i, joint in enumerate(joints):
        words = f"joint {joint.name} seems to count in the other direction"
        yield words, replace(situation, joints=_reversed(at, i)), measured
    angles = torch.tensor([j.unit == "rad" for j in joints])
    for factor, words in ((1 / _TURN, "degrees under rad"), (_TURN, "radians under deg")):
        scaled = torch.where(angles, factor * at, at)
        yield f"the joints seem to be in {words}", replace(situation, joints=scaled), measured
    for factor, words in ((1e-3, "millimetres under m"), (1e3, "metres under mm")):
        scaled = torch.where(angles, at, factor * at)
        yield f"the joints seem to be in {words}", replace(situation, joints=scaled), measured


def _guess(situation: Situation, measured: Tensor) -> Tensor | None:
    return None if situation.guess is None else measured


def _reversed(values: Tensor, i: int) -> Tensor:
    sign = torch.ones(values.shape[-1], dtype=values.dtype)
    sign[i] = -1
    return values * sign


def _swapped(values: Tensor, i: int, k: int) -> Tensor:
    order = [*range(values.shape[-1])]
    order[i], order[k] = order[k], order[i]
    return values[..., order]
