"""Plausibility of fitted frames, and what the rows do not determine of them."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from ccnn_torch.errors import InputError
from ccnn_torch.mechanisms.frames.fit import ROTATION_WEIGHT, best_closed_form, fit_frames, whole_rows
from ccnn_torch.mechanisms.machines.serial import SerialArm
from ccnn_torch.mechanisms.pose import PoseError
from ccnn_torch.numerics.outliers import inlying

# What the median row may be missed by, as a share of the arm's reach, and the orientation by [rad]. The worst arms that
# we have rows of miss by 0.7 % (Panda 1 of MUKCa), a cable-driven one by 0.5 %, industrial ones by 0.1 % and 2 mrad.
_SHARE, _ANGLE = 0.015, 0.03
# The same as a share of how far the tool moves: a fit that leaves more explains nothing.
_OF_MOTION = 0.2
# A count of the joints that leaves less than this share of what another leaves is the right one of the two.
_FAR_BETTER = 0.2
# Frames are fitted with another count where closed forms, at a hundredth of the cost, halve what is left.
_WORTH_A_FIT = 0.5
# More rows than this share are not outliers: another model describes them.
OUTLIERS = 0.25


def judge_frames(
    arm: SerialArm,
    joints: Tensor,
    pose: Tensor,
    values: Tensor,
    weights: Tensor | None = None,
    where: str = "records",
    name_rows: Callable[[Sequence[int]], str] | None = None,
) -> list[str]:
    """Refuse frames that leave more than any machine of such a size misses by, and name gross outliers.

    Args:
        arm: with unknown frames; one whose frames are known is not judged.
        joints: `s x n` [SI].
        pose: measured, `s x p` [SI].
        values: parameters with fitted frames, `k` or `r x 1 x k`, or one set a row, `s x k` or `r x s x k` [SI].
        weights: `r x s` or `s` [1]; 0 = a row that was not fitted to; all 1 when None.
        where: the file, which opens the sentence.
        name_rows: formats rows (0-based) as the user knows them; they are only counted when None.

    Returns:
        Sentences on rows that are gross outliers.

    Raises:
        InputError: the median position or orientation that was fitted to is missed by too much.
    """
    if not arm.unknown_frames:
        return []
    error = arm.pose_error(arm.forward_kinematics(joints, values), pose)
    used = ((torch.ones(len(joints)) if weights is None else weights) > 0) & ~pose.isnan().any(-1)
    median = _median(error.position, used)
    turned = None if error.rotation is None else _median(error.rotation, used)
    length, far = far_rows(error, used)
    rotation, place = arm.flange(joints)
    tool = place + (rotation @ values[..., -6:-3, None])[..., 0]
    motion = float((tool - tool.mean(-2, keepdim=True)).norm(dim=-1).square().mean(-1).sqrt().max())
    limit = min(_SHARE * arm.reach, _OF_MOTION * motion)
    # A sound model may miss a part of its rows by more than the others: something acts there.
    share = float(((far & (length > limit)).sum(-1) / used.expand(far.shape).sum(-1)).max())
    wrong = ""
    if median > limit:
        short = limit < _SHARE * arm.reach
        what = f"rows that move by {1e3 * motion:.3g} mm" if short else f"a reach of {arm.reach:.3g} m"
        wrong = f"positions by more than {1e3 * median:.3g} mm (plausible for {what}: {1e3 * limit:.2g} mm)"
    elif turned is not None and turned > _ANGLE:
        wrong = f"orientations by more than {1e3 * turned:.3g} mrad (plausible: {1e3 * _ANGLE:.0f} mrad)"
    wrong = wrong and f"half of the measured {wrong}"
    if not wrong and share > OUTLIERS:
        wrong = (
            f"{share:.0%} of the measured poses by far more than the others, up to {1e3 * float(length.max()):.3g} mm"
        )
    if wrong:
        fitted = f"with {' and '.join(arm.unknown_frames)} frame fitted"
        counted = coupled_count(arm, joints, pose)
        if counted is not None:
            raise InputError(
                f"{where}: {fitted}, {arm.name} misses {wrong}, and fits with the third joint counted as {counted}, "
                f'as on controllers that count it from the horizontal; write joint_map: {{q3: "{counted}"}}'
            )
        raise InputError(
            f"{where}: {fitted}, {arm.name} still misses {wrong}, so this model does not describe these rows; "
            "check the units, the order, signs and zeros of the joints, the convention (standard or modified), and "
            "whether this is the robot that was measured; ccnn check names a single mistake among these"
        )
    rows = torch.nonzero(far.reshape(-1, len(joints)).any(0)).squeeze(-1).tolist()
    if not rows:
        return []
    named = "" if name_rows is None else f": {name_rows(rows)}"
    size = float(length.reshape(-1, len(joints))[:, rows].max())
    return [
        f"{len(rows)} {'row is a gross outlier' if len(rows) == 1 else 'rows are gross outliers'}, up to "
        f"{1e3 * size:.3g} mm off, and frames and links are fitted without{named}."
    ]


def far_rows(error: PoseError, used: Tensor) -> tuple[Tensor, Tensor]:
    """Length of each row's pose error, `... x s` [m], and whether the row is a gross outlier among those used, bool."""
    length = error.position if error.rotation is None else torch.hypot(error.position, ROTATION_WEIGHT * error.rotation)
    length = length.nan_to_num()
    channels, free = (3, 9) if error.rotation is None else (6, 12)
    return length, used & ~inlying(length, used, channels, free)


def coupled_count(arm: SerialArm, joints: Tensor, pose: Tensor) -> str | None:
    """The third joint as a sum of what the controller shows, where frames fit far better with it than without.

    Controllers such as Fanuc's count the third joint from the horizontal: what they show is q3 + q2 or q3 - q2.

    Args:
        arm: whose unknown frames are fitted, if it has any.
        joints: as the controller shows them, `s x n` [SI].
        pose: measured, `s x p` [SI].

    Returns:
        `q3 - q2` or `q3 + q2`; None where neither fits, or frames are by group.
    """
    if len(arm.joints) < 3 or arm.grouped:
        return None
    counts = {"q3": 0.0, "q3 - q2": -1.0, "q3 + q2": 1.0}
    trials = joints.repeat(len(counts), 1, 1)
    trials[..., 2] += torch.tensor([*counts.values()], dtype=joints.dtype)[:, None] * joints[:, 1]
    rivals = [0, 1, 2]
    if arm.orientation != "direction":
        weights, whole = whole_rows(pose.expand(len(counts), *pose.shape), None)
        frames = best_closed_form(*arm.flange(trials), arm.frame(whole), arm.nominal[-6:], weights, ROTATION_WEIGHT)
        links = arm.nominal[6:-6].expand(len(counts), -1)
        nearly = _missed(arm, trials, pose, torch.cat([frames[:, :6], links, frames[:, 6:]], -1))
        rivals = [0, int(nearly.argmin())]
        if float(nearly.min()) > _WORTH_A_FIT * float(nearly[0]):
            return None
    trials = trials[rivals]
    left = _missed(arm, trials, pose, torch.stack([fit_frames(arm, trial, pose) for trial in trials]))
    best = int(left.argmin())
    far_better = float(left[best]) < min(_FAR_BETTER * float(left[0]), _SHARE * arm.reach)
    return [*counts][rivals[best]] if far_better else None


def _missed(arm: SerialArm, joints: Tensor, pose: Tensor, values: Tensor) -> Tensor:
    """Median distance of rows from poses `s x p`, `c` [m], of joints `c x s x n` and parameters `c x k`."""
    error = arm.pose_error(arm.forward_kinematics(joints, values[:, None]), pose.expand(len(joints), *pose.shape))
    turned = torch.zeros_like(error.position) if error.rotation is None else error.rotation
    return torch.hypot(error.position, ROTATION_WEIGHT * turned).nanmedian(-1).values


def _median(size: Tensor, used: Tensor) -> float:
    """The largest median over the repeats."""
    return float(torch.where(used.expand(size.shape), size, torch.nan).nanmedian(-1).values.max())
