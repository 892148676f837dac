"""Common mistakes in records: the one whose correction makes model and rows agree; rows that no machine has reached."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import combinations
from typing import NamedTuple

import torch
from torch import Tensor

from ccnn_torch.coordinates import Coordinate
from ccnn_torch.diagnosis.residual.distance import USUAL, Size, distance, size_of
from ccnn_torch.diagnosis.residual.rows import picked
from ccnn_torch.display import number_text
from ccnn_torch.effects import Situation, pose_residual
from ccnn_torch.errors import InputError, RowsError
from ccnn_torch.mechanisms import BlackBox, Framed, Mechanism, Seen, SerialArm
from ccnn_torch.mechanisms.frames.fit import ROTATION_WEIGHT, best_closed_form, fit_frames
from ccnn_torch.numerics.rotations import matrix_to_rotation_vector, rotation_vector_to_matrix
from ccnn_torch.records.headers import EULER_ANGLES

# Places that are searched from, and steps of each before the best of them are searched on.
_ROUNDS = ((72, 3), (18, 3), (5, 8))
# Rows of the search.
_ROWS = 30
_DIFFERENCE = 1e-6
_DAMPED = 1e-3
# Zeros nearer than this are where they should be [rad].
_SAME = math.radians(0.05)


def wrong_zeros(arm: SerialArm, joints: Tensor, measured: Tensor, enough: float) -> str:
    """Zeros with which an arm's model and the rows agree, in words; empty where there are none.

    Args:
        arm: with both frames unknown, which take the zeros of the first and the last joint.
        joints: `s x n` [SI].
        measured: poses, `s x p`.
        enough: the usual position error [m] with which they agree.
    """
    rows = torch.linspace(0, len(joints) - 1, min(_ROWS, len(joints))).round().long()
    joints, measured = joints[rows], measured[rows]
    middle = [i for i in range(1, len(arm.joints) - 1) if arm.joints[i].unit == "rad"]
    if not middle:
        return ""
    generator = torch.Generator().manual_seed(0)
    starts = math.pi * (2 * torch.rand(_ROUNDS[0][0], len(middle), generator=generator, dtype=joints.dtype) - 1)
    starts[0] = 0.0
    for turned in (None, *(i for i, joint in enumerate(arm.joints) if joint.unit == "rad")):
        signs = torch.ones_like(joints[0])
        if turned is not None:
            signs[turned] = -1.0
        zeros = _searched(arm, signs * joints, measured, middle, starts)
        usual = _left(arm, signs * joints, measured, middle, zeros)[..., :3].norm(dim=-1).median(-1).values
        best = int(usual.argmin())
        if float(usual[best]) < enough:
            names, told, written = [j.name for j in arm.joints], [], {}
            there = torch.remainder(zeros[best] + math.pi, 2 * math.pi) - math.pi
            if turned is not None:
                told.append(f"joint {names[turned]} seems to count in the other direction")
                written[names[turned]] = f"-{names[turned]}"
            for i, zero in zip(middle, there.tolist(), strict=True):
                if abs(zero) > _SAME:
                    angle = f"{math.degrees(abs(zero)):.3f}"
                    sign = "-" if zero < 0 else "+"
                    told.append(f"joint {names[i]} seems to stand at {sign.strip('+')}{angle}° where it counts 0")
                    written[names[i]] = f"{written.get(names[i], names[i])} {sign} {angle} deg"
            if told:
                entries = ", ".join(f'{name}: "{text}"' for name, text in written.items())
                left = number_text(1e3 * float(usual[best]), 3)
                return f"{', '.join(told)}, which leaves {left} mm; write joint_map: {{{entries}}} to have it so"
    return ""


def _left(arm: SerialArm, joints: Tensor, measured: Tensor, middle: list[int], zeros: Tensor) -> Tensor:
    """What zeros `... x m` leave in position and weighted rotation, frames in closed form; `... x s x 6` or `3` [m]."""
    offsets = torch.zeros(*zeros.shape[:-1], 1, joints.shape[-1], dtype=joints.dtype)
    offsets[..., 0, middle] = zeros
    rotation, position = arm.flange(joints + offsets)
    seen = arm.frame(measured.expand(*zeros.shape[:-1], *measured.shape))
    weights = torch.ones(len(joints), dtype=joints.dtype)
    frames = best_closed_form(rotation, position, seen, arm.nominal[-6:], weights, ROTATION_WEIGHT)
    base, tool = (rotation_vector_to_matrix(frames[..., None, k : k + 3]) for k in (3, 9))
    lever = position + (rotation @ frames[..., None, 6:9, None])[..., 0]
    place: Tensor = (base @ lever[..., None])[..., 0] + frames[..., None, :3] - seen[0]
    if seen[1] is None:
        return place
    turn = matrix_to_rotation_vector(base @ rotation @ tool @ seen[1].mT)
    return torch.cat([place, ROTATION_WEIGHT * turn], -1)


def _searched(arm: SerialArm, joints: Tensor, measured: Tensor, middle: list[int], zeros: Tensor) -> Tensor:
    """Damped Gauss-Newton from all starts side by side, `k x m`."""

    def left(values: Tensor) -> Tensor:
        return _left(arm, joints, measured, middle, values).flatten(-2)

    here, damping = left(zeros), torch.full_like(zeros[:, :1], _DAMPED)
    eye = torch.eye(len(middle), dtype=zeros.dtype)
    for kept, steps in _ROUNDS:
        best = here.square().sum(-1).argsort()[:kept]
        zeros, here, damping = zeros[best], here[best], damping[best]
        for _ in range(steps):
            slopes = ((left(zeros[:, None] + _DIFFERENCE * eye) - here[:, None]) / _DIFFERENCE).mT
            inner, right = slopes.mT @ slopes, slopes.mT @ here[..., None]
            usual = inner.diagonal(dim1=-2, dim2=-1).mean(-1)[:, None, None]
            tried = zeros - torch.linalg.solve(inner + damping[..., None] * usual * eye, right)[..., 0]
            there = left(tried)
            better = (there.square().sum(-1) < here.square().sum(-1))[:, None]
            zeros, here = torch.where(better, tried, zeros), torch.where(better, there, here)
            damping = torch.where(better, damping / 5, damping * 10)
    return zeros


# A mistake is named where without it so small a share of the distance is left.
_MENDED = 0.1
_FEW = 40
# Rows that have to be far off before their order is questioned.
_FEWEST_LATE = 8
_TOLD = 2
# Mistakes that leave no more than this many times the least are as likely.
_ALIKE = 1.2
# Distance in sizes of the machine that a row without a pose counts as.
_UNREACHED = 10.0
_TURN = 180 / torch.pi
# What values are to be multiplied by that were taken for another unit.
_LENGTHS = {
    "millimetres under m": 1e-3,
    "centimetres under m": 1e-2,
    "inches under m": 0.0254,
    "inches under mm": 25.4,
    "millimetres under inches": 1 / 25.4,
    "metres under mm, or the model in millimetres under m": 1e3,
}
_ANGLES = {"degrees under rad": 1 / _TURN, "radians under deg": _TURN}
_CONVENTIONS = ("standard", "modified")
_POSE = ("x", "y", "z", "rx", "ry", "rz")
# Share of the usual distance that a fitted frame may leave.
_LEFT = 0.1


OF_FRAME = "the frame that the pose is given in"
"""How a mistake begins that a measuring device makes which was moved."""


def what_is_wrong(situation: Situation, measured: Tensor, size: Size) -> str:
    """What would make model and rows agree if it were put right, with unknown frames fitted anew; empty for nothing."""
    return (
        late_rows(situation, measured, size, anew=True)
        or mistake(situation, measured, size, anew=True)
        or tool_remedy(situation, measured, size)
        or frame_remedy(situation, measured, size)
        or zero_remedy(situation, measured, size)
    )


def mistake(situation: Situation, measured: Tensor, size: Size, anew: bool = False) -> str:
    """The mistake, of those often made, without which model and rows would agree, in words; empty for none.

    With `anew` unknown frames are fitted to the rows without each of them.
    """
    rows = torch.linspace(0, len(measured) - 1, min(_FEW, len(measured))).round().long()
    here, poses = picked(situation, rows), measured[rows]
    # A row that the machine does not reach is off by its whole workspace, and more.
    before = min(float(_far(here, poses, size, fitted).median()) for fitted in {False, anew})
    found = []
    for words, other, there in _mistakes(here, poses):
        if other is here and torch.equal(there.nan_to_num(), poses.nan_to_num()):
            continue
        left = float(_far(other, there, size, anew).median())
        if left < min(_MENDED * before, USUAL):
            found.append((left, f"{words}, which leaves {_remainder(other, there, anew)}"))
    # On a machine that is its own mirror image two mistakes may come to the same.
    least = min((left for left, _ in found), default=0.0)
    return ", or ".join(words for left, words in sorted(found)[:_TOLD] if left <= _ALIKE * least)


def late_rows(situation: Situation, measured: Tensor, size: Size, anew: bool = False) -> str:
    """Poses that belong to the row before or after, in words; empty where there are none; anew: as for `mistake`."""
    before = _far(situation, measured, size)
    far = before > _MENDED * USUAL
    if int(far.sum()) < _FEWEST_LATE:
        return ""
    for step, word in ((-1, "late"), (1, "early")):
        shifted = measured.roll(step, 0)
        left = _far(situation, shifted, size, anew)
        if float(left[far].median()) < _MENDED * min(float(before[far].median()), USUAL):
            first = int(torch.nonzero(far)[0])
            return (
                f"the poses seem to be one row {word} from row {first + 1} on (counted from 1), shifted against their "
                "joints: look whether a row is missing or twice there"
            )
    return ""


def _mistakes(situation: Situation, measured: Tensor) -> Iterator[tuple[str, Situation, Tensor]]:
    """What is wrong, in words, and the rows as they would be without it."""
    yield from _of_pose(situation, measured)
    inner = situation.mechanism.mechanism if isinstance(situation.mechanism, Framed) else situation.mechanism
    # Of a simulator each of the others would be simulated anew, which may take long.
    if not isinstance(inner, BlackBox):
        yield from _of_model_and_joints(situation, measured, inner)


def _of_pose(situation: Situation, measured: Tensor) -> Iterator[tuple[str, Situation, Tensor]]:
    """In the measured pose."""
    pose = situation.mechanism.pose
    lengths = torch.tensor([c.unit == "m" for c in pose])
    for words, factors in _other_units("the pose's ", " of the pose", pose):
        yield words, situation, factors * measured
    shift = torch.where(lengths, torch.nan_to_num((measured - situation.pose).nanmedian(0).values), 0.0)
    far = ", ".join(f"{c.name} by {float(v):.4g} m" for c, v in zip(pose, shift, strict=True) if c.unit == "m")
    words = f"{OF_FRAME} seems to be shifted ({far}): give the pose in the model's base frame"
    yield words, situation, measured - shift
    yield from _orientations(situation, measured)
    for i, one in enumerate(pose):
        yield f"{one.name} of the pose seems to be reversed", situation, _reversed(measured, i)
    for i, k in combinations(range(len(pose)), 2):
        if pose[i].unit == pose[k].unit:
            words = f"{pose[i].name} and {pose[k].name} of the pose seem to be swapped"
            yield words, situation, _swapped(measured, i, k)


def _of_model_and_joints(
    situation: Situation, measured: Tensor, inner: Mechanism
) -> Iterator[tuple[str, Situation, Tensor]]:
    """In the model's file or in the joints; inner: the mechanism without the frames around it."""
    mechanism, joints = situation.mechanism, situation.mechanism.joints
    turns = torch.tensor([g.unit == "rad" for g in inner.geometry])
    if inner is mechanism and bool(turns.any()):
        corrected = torch.where(turns, inner.nominal / _TURN, inner.nominal)
        words = "the angles of the model seem to be in degrees under rad: look at the units in its file"
        yield words, replace(situation, mechanism=mechanism.with_nominal(corrected), parameters=None), measured
    if isinstance(mechanism, SerialArm) and mechanism.convention in _CONVENTIONS:
        other = next(name for name in _CONVENTIONS if name != mechanism.convention)
        words = f"the model's table seems to be of the {other} Denavit-Hartenberg convention: see its file"
        arm = SerialArm(**{**mechanism.recipe["keys"], "convention": other})
        yield words, replace(situation, mechanism=arm, parameters=None), measured
    at = situation.joints
    for i, k in combinations(range(len(joints)), 2):
        if joints[i].unit == joints[k].unit:
            words = f"the joints {joints[i].name} and {joints[k].name} seem to be swapped"
            yield words, replace(situation, joints=_swapped(at, i, k)), measured
    for i, joint in enumerate(joints):
        words = f"joint {joint.name} seems to count in the other direction"
        yield words, replace(situation, joints=_reversed(at, i)), measured
    for words, factors in _other_units("the joints' ", "", joints):
        yield words, replace(situation, joints=factors * at), measured


def _other_units(whose: str, of: str, coordinates: Sequence[Coordinate]) -> Iterator[tuple[str, Tensor]]:
    """Units that may have been meant, in words, and what values are to be multiplied by: all of a kind, or one."""
    for unit, kind, others in (("m", "lengths", _LENGTHS), ("rad", "angles", _ANGLES)):
        own = torch.tensor([c.unit == unit for c in coordinates])
        for words, factor in others.items():
            yield f"{whose}{kind} seem to be in {words}", torch.where(own, factor, 1.0).double()
            for i in torch.nonzero(own)[:, 0].tolist() if int(own.sum()) > 1 else ():
                one = torch.ones(len(own), dtype=torch.float64)
                one[i] = factor
                yield f"{coordinates[i].name}{of} seems to be in {words.partition(',')[0]}", one


def _orientations(situation: Situation, measured: Tensor) -> Iterator[tuple[str, Situation, Tensor]]:
    """Of poses x, y, z, rx, ry, rz: Euler angles that were taken for a rotation vector, and inverted transforms."""
    if [c.name for c in situation.mechanism.pose] != [*_POSE]:
        return
    # Imported here: few rows need it, and the import takes long.
    from scipy.spatial.transform import Rotation

    finite = measured.nan_to_num()
    place, angles = finite[..., :3], finite[..., 3:]
    for columns, axes in EULER_ANGLES.values():
        if axes == "ZYX":
            # The same as about fixed axes, in the other order.
            continue
        vector = torch.from_numpy(Rotation.from_euler(axes, angles.numpy()).as_rotvec())
        words = f"rx, ry, rz seem to be Euler angles and no rotation vector: name them {', '.join(columns)}"
        yield words, situation, torch.cat([place, vector], -1)
    back = rotation_vector_to_matrix(-angles)
    inverse = torch.cat([-(back @ place[..., None])[..., 0], -angles], -1)
    words = "the pose seems to be inverted: that of the base in the tool's axes, as a camera on the hand sees a board"
    yield words, situation, inverse


def _remainder(situation: Situation, measured: Tensor, anew: bool) -> str:
    """What the usual row is off by in position, or where that is not measured in orientation."""
    other = placed(situation, measured) if anew else situation
    residual = pose_residual(replace(other, guess=None if situation.guess is None else measured), measured)
    turns = torch.tensor([c.unit == "rad" for c in situation.mechanism.channels])
    place, turn = (float(part.norm(dim=-1).nanmedian()) for part in (residual[:, ~turns], residual[:, turns]))
    return f"{1e3 * place:.3g} mm" if place > 0 else f"{1e3 * turn:.3g} mrad"


def _far(situation: Situation, measured: Tensor, size: Size, anew: bool = False) -> Tensor:
    """Distance of each row, `s` [1]; one that is not reached counts as some sizes of the machine."""
    other = placed(situation, measured) if anew else situation
    other = replace(other, guess=None if situation.guess is None else measured)
    return distance(other, measured, size).nan_to_num(nan=_UNREACHED)


def _reversed(values: Tensor, i: int) -> Tensor:
    sign = torch.ones(values.shape[-1], dtype=values.dtype)
    sign[i] = -1
    return values * sign


def _swapped(values: Tensor, i: int, k: int) -> Tensor:
    order = [*range(values.shape[-1])]
    order[i], order[k] = order[k], order[i]
    return values[..., order]


def placed(situation: Situation, measured: Tensor) -> Situation:
    """The rows with unknown frames fitted to these poses; as they are where no frame is unknown, or one per group."""
    mechanism, parameters = situation.mechanism, None
    if isinstance(mechanism, Framed) and mechanism.unknown_frames and not mechanism.grouped:
        parameters = mechanism.inlying_frames(situation.joints, measured)
    elif isinstance(mechanism, SerialArm) and mechanism.unknown_frames and not mechanism.grouped:
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
    if isinstance(mechanism, Framed | Seen) or (isinstance(mechanism, SerialArm) and mechanism.unknown_frames):
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
        inside = {"mechanism": mechanism.recipe.get("spec", ""), "keys": mechanism.recipe.get("keys", {})}
        # As JSON, whose quotes a shell takes within its own.
        told = json.dumps({key: value for key, value in inside.items() if value}, ensure_ascii=False)
        key = f"mechanism=framed 'mechanism_keys={told}'"
        missing = [c.name for c in framed.pose if c.name not in {own.name for own in mechanism.pose}]
        key += f", and give the pose as {', '.join(c.name for c in framed.pose)}" if missing and not framed.flat else ""
    left = torch.linalg.vector_norm(there - seen[0], dim=-1).nan_to_num(nan=torch.inf) / size.place
    if float(left.median()) > _LEFT * USUAL:
        return ""
    return f"seen from a frame that is not the model's they are; to have it fitted write {key}"


def tool_remedy(situation: Situation, measured: Tensor, size: Size) -> str:
    """What to write where the measured point is elsewhere on the flange of an arm than its file says; else empty."""
    arm, finite = situation.mechanism, torch.isfinite(measured).all(-1)
    if not isinstance(arm, SerialArm) or "tool" in arm.unknown_frames or arm.grouped:
        return ""
    joints, measured = situation.joints[finite], measured[finite]
    if len(joints) < _FEWEST_LATE:
        return ""
    keys = arm.recipe["keys"]
    unknown = {"unknown_frames": (*arm.unknown_frames, "tool")}
    free = unknown if arm.orientation == "rotation_vector" else {"tool_offset": "unknown"}
    values = fit_frames(SerialArm(**{**keys, **free}), joints, measured)
    error = arm.pose_error(arm.forward_kinematics(joints, values), measured)
    before = arm.pose_error(arm.forward_kinematics(joints, situation.parameters), measured)
    left = float(error.position.median())
    if left > min(_MENDED * float(before.position.median()), _LEFT * USUAL * float(size.place)):
        return ""
    there, own = (", ".join(f"{1e3 * float(v):.1f}" for v in tool) for tool in (values[-6:-3], arm.nominal[-6:-3]))
    return (
        f"the measured point seems to be at {there} mm from the flange and not at {own} mm, which leaves "
        f"{1e3 * left:.3g} mm; correct tool_offset in its file, or write tool_offset: unknown (in place of "
        "tool_frame, where that is there) to have it fitted"
    )


def zero_remedy(situation: Situation, measured: Tensor, size: Size) -> str:
    """Zeros of an arm's joints with which rows and model agree, frames fitted anew; empty where there are none."""
    arm, finite = situation.mechanism, torch.isfinite(measured).all(-1)
    if not isinstance(arm, SerialArm) or len(arm.unknown_frames) < 2 or arm.grouped:
        return ""
    if arm.orientation == "direction" or int(finite.sum()) < _FEWEST_LATE:
        return ""
    joints, measured = situation.joints[finite], measured[finite]
    before = arm.pose_error(arm.forward_kinematics(joints, _closed_form(arm, joints, measured)), measured).position
    return wrong_zeros(arm, joints, measured, min(_MENDED * float(before.median()), _LEFT * USUAL * float(size.place)))


def _closed_form(arm: SerialArm, joints: Tensor, measured: Tensor) -> Tensor:
    """Parameters with base and tool in closed form, `k`: near enough to judge sixty mistakes by."""
    weights = torch.ones(len(joints), dtype=joints.dtype)
    frames = best_closed_form(*arm.flange(joints), arm.frame(measured), arm.nominal[-6:], weights, ROTATION_WEIGHT)
    return torch.cat([frames[:6], arm.nominal[6:-6], frames[6:]])


# Sizes of the machine: a row farther off is of other joints.
_ROW = 1.0
# Rows astray among which a mistake in common is searched.
_MANY = 5


class PlausibleRows(NamedTuple):
    """Which rows are of the machine.

    Attributes:
        fine: those that are, `s` bool.
        astray: those that are not because their pose is elsewhere, `s` bool.
        mistake: the one that many of these have in common, in words; empty where there is none.
    """

    fine: Tensor
    astray: Tensor
    mistake: str

    @property
    def lost(self) -> float:
        """Share of the rows that are not."""
        return 1 - float(self.fine.double().mean())


def plausible_rows(situation: Situation, measured: Tensor) -> PlausibleRows:
    """Whether the pose of each row is near where its joints put it.

    Raises:
        RowsError: most of them do not, are out of reach, or belong to the row before or after.
    """
    size = size_of(situation)
    far = distance(situation, measured, size)
    late = late_rows(situation, measured, size)
    if late:
        raise RowsError(late)
    reached = torch.isfinite(far)
    if 2 * int(reached.sum()) < len(far):
        raise RowsError(
            f"{int((~reached).sum())} of {len(far)} rows are outside the reach of {situation.mechanism.name}; "
            + (
                what_is_wrong(situation, measured, size)
                or "check the units, the order of the joints, and that this is the machine"
            )
        )
    usual = float(far[reached].median())
    if usual > USUAL:
        raise RowsError(
            f"the usual pose lies {usual:.3g} times as far from where {situation.mechanism.name} puts it as its poses "
            "are spread over the workspace, so that these rows are not of this model; "
            + (
                what_is_wrong(situation, measured, size)
                or "check the units, the order and signs of joints and pose, the frame that the pose is given in, and "
                "that joints and pose of a row belong together"
            )
        )
    astray = reached & (far >= _ROW)
    many = int(astray.sum()) >= _MANY
    common = mistake(picked(situation, torch.nonzero(astray)[:, 0]), measured[astray], size) if many else ""
    return PlausibleRows(reached & ~astray, astray, common)
