"""Pose errors of an identified geometry, as predicted and as commanded; many machines as one; warnings."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import torch
from scipy.stats import chi2
from torch import Tensor

from ccnn_torch.display import number_text, with_unit
from ccnn_torch.errors import InputError
from ccnn_torch.identification.config import IdentifyConfig
from ccnn_torch.identification.measured import Measured, Rows, read_records, rows_of_split, split_records
from ccnn_torch.mechanisms import Instrument, Mechanism, PoseError, Seen, SerialArm, SetUps, fit_frames
from ccnn_torch.mechanisms.drawn import drawn
from ccnn_torch.mechanisms.frames.partial import completed
from ccnn_torch.numerics.least_squares import jacobian_of

_LOW, _HIGH = 0.05, 0.95


def figures(values: Mapping[str, Tensor | None]) -> dict[str, Any]:
    """One number for each key, and `spread: {key: [low, high]}` where there are several machines.

    Args:
        values: `r` each; None, or a tensor without a finite number, gives None.
    """
    numbers: dict[str, Any] = {}
    spread: dict[str, list[float]] = {}
    for key, table in values.items():
        known = None if table is None else table[torch.isfinite(table)]
        if table is None or known is None or len(known) == 0:
            numbers[key] = None
            continue
        numbers[key] = float(known.quantile(0.5))
        if len(table) > 1:
            spread[key] = [float(known.quantile(_LOW)), float(known.quantile(_HIGH))]
    return numbers | ({"spread": spread} if spread else {})


def figure_text(block: Mapping[str, Any] | None, key: str, scale: float = 1.0, digits: int = 3) -> str:
    """One of the `figures` with its interval, or –."""
    if block is None or block.get(key) is None:
        return "–"
    text = number_text(block[key] / scale, digits)
    spread = block.get("spread", {}).get(key)
    if spread is not None:
        low, high = (number_text(v / scale, digits) for v in spread)
        text += f" [{low}, {high}]"
    return text


def before_and_after(
    before: PoseError, after: PoseError, noise: PoseError | None = None, removed: bool = False
) -> dict[str, Any]:
    """Position and rotation: RMS, mean and maximum over the poses of a machine, before and after.

    Args:
        before, after: `r x t`; NaN where nothing of the kind was measured.
        noise: of the measurement, `r x t`, where it is known.
        removed: whether the share of the RMS that was removed is of interest.
    """
    answer: dict[str, Any] = {}
    for name, unit, first, last, floor in zip(
        PoseError._fields, ("m", "rad"), before, after, noise or (None, None), strict=True
    ):
        if first is None or last is None or float(first.abs().nan_to_num().max()) == 0:
            answer[name] = None
            continue
        entries: dict[str, Tensor | None] = {
            "before": _rms(first),
            "after": _rms(last),
            "mean_before": first.nanmean(-1),
            "mean_after": last.nanmean(-1),
            "max_before": first.nan_to_num().amax(-1),
            "max_after": last.nan_to_num().amax(-1),
        }
        if floor is not None:
            entries["noise"] = _rms(floor)
        if removed:
            entries["removed"] = 1 - _rms(last) / _rms(first)
        answer[name] = {"unit": unit} | figures(entries)
    return answer


def _rms(values: Tensor) -> Tensor:
    """`r x t` -> `r`."""
    return values.square().nanmean(-1).sqrt()


def drawn_errors(measured: Measured, values: Tensor) -> dict[str, Tensor]:
    """The picture of the first machine: errors of the held-out poses by the geometry at the start, and by `r x K`.

    {} of readings that have no place, and of set-ups with frames of their own.
    """
    mechanism, rows = measured.mechanism, measured.test
    if isinstance(mechanism, Instrument | SetUps) or not rows.joints.shape[1]:
        return {}
    joints, observed = rows.joints[0], rows.observed[0]

    def frame(parameters: Tensor) -> Tensor:
        guess = completed(mechanism, joints, observed, parameters)
        return measured.kinematics.frame(joints, parameters, guess)[0].detach()

    place = mechanism.frame(observed)[0]
    before, after = (place - frame(one[0]) for one in (measured.start, values))
    return drawn(mechanism, joints, observed, place, before, after, values[0])


def drawn_sizes(
    mechanism: Mechanism, joints: Tensor, before: Tensor, after: Tensor, geometry: Tensor
) -> dict[str, Tensor]:
    """The machine at the held-out rows `t x n` with the sizes of their errors `t` [m]; a constraint has no pose."""
    arm, values = mechanism, geometry
    if isinstance(mechanism, Seen):
        arm, values = mechanism.mechanism, geometry[: len(mechanism.mechanism.geometry)]
    pose = arm.forward_kinematics(joints, values)
    return drawn(arm, joints, pose, arm.frame(pose)[0], before, after, values)


class Commanded(NamedTuple):
    """Pose errors of the simulated machine at wanted poses: commanded by nominal geometry, exactly, and linearly."""

    before: PoseError
    exact: PoseError
    linear: PoseError


def predicted(measured: Measured, values: Tensor, machines: Tensor) -> PoseError:
    """Distance of the held-out measured poses from those that a geometry predicts from the joints, `r x t`.

    Args:
        values: `r x K` [SI].
        machines: which machines the rows are of, `r`.
    """
    rows = measured.test.of(machines)
    guess = completed(measured.mechanism, rows.joints, rows.observed, values[:, None])
    pose = measured.kinematics.reached(rows.joints, values[:, None], guess)
    return measured.mechanism.pose_error(pose, rows.observed)


def noise_of_test(measured: Measured) -> PoseError | None:
    """Distance of the held-out measured poses from the true ones, `r x t`; None for records."""
    if measured.reached is None:
        return None
    return measured.mechanism.pose_error(measured.test.observed, measured.reached)


def commanded(measured: Measured, values: Tensor, machines: Tensor) -> Commanded | None:
    """Pose errors of the simulated machines at the wanted held-out poses, `r x t` each; None for records.

    Exact: the joints of the pose by the identified geometry. Linear: Sun et al. 2018, eq. 15, the nominal joints and
    the parameters' errors by the nominal identification Jacobian dg/dθ (-J_p⁻¹ E_ac there).
    """
    if measured.wanted is None or measured.truth is None or measured.wanted_joints is None:
        return None
    wanted, guess, truth = (t[machines] for t in (measured.wanted, measured.wanted_joints, measured.truth))
    nominal, mechanism = measured.start[machines], measured.mechanism
    near = mechanism.solve_inverse(wanted, nominal[:, None], guess)
    exact = measured.kinematics.command(wanted, values[:, None], near)

    def joints_of(parameters: Tensor) -> Tensor:
        return mechanism.solve_inverse(wanted, parameters, near)

    slope = jacobian_of(joints_of, nominal[:, None].expand(*wanted.shape[:-1], -1))[1]
    linear = near + (slope @ (values - nominal)[:, None, :, None])[..., 0]

    def error(joints: Tensor) -> PoseError:
        return mechanism.pose_error(measured.kinematics.reached(joints, truth[:, None], wanted), wanted)

    return Commanded(error(near), error(exact), error(linear))


# Residuals that chance makes as rarely as this do not fit the noise given; a ratio this near 1 is nothing to speak of.
_RARE, _NEAR = 1e-3, 1.5
# Held-out errors above so many times the noise, or this share of the error before, say that something else is wrong.
_ABOVE_NOISE, _LITTLE_GAINED = 10.0, 0.5
# An error within so many times the noise has nothing left to gain.
_AT_NOISE = 2.0


def doubts_of(
    test: Mapping[str, Any], ratio: float | None, freedom: float, noise: float | None, noise_given: bool
) -> list[str]:
    """Whether the rows contradict the noise given, and whether too much is left of the held-out error.

    Args:
        test: `position` of before and after, as in `identified.json`.
        ratio: standard deviation of the residual over the noise given [1].
        freedom: equations to spare.
        noise: of a measured position, all coordinates together [m]; None where it is not known.
        noise_given: whether `ratio` compares with a noise that the config names.
    """
    said = []
    if noise_given and ratio is not None and math.isfinite(ratio) and freedom > 0:
        chance = chi2.sf(ratio**2 * freedom, freedom) if ratio > 1 else chi2.cdf(ratio**2 * freedom, freedom)
        if chance < _RARE and ratio > _NEAR:
            said.append(
                f"The noise given does not fit the rows: their residuals are {ratio:.3g} times as large, so that the "
                "noise is larger or more than the geometry is wrong, and the standard deviations are too small."
            )
        elif chance < _RARE and ratio < 1 / _NEAR:
            said.append(
                f"The noise given does not fit the rows: their residuals are {ratio:.2g} times as large, so that the "
                "noise is smaller and the standard deviations are too large."
            )
    position = test["position"]
    before, after = (None, None) if position is None else (position["before"], position["after"])
    if before is None or after is None or (noise is not None and after <= _AT_NOISE * noise):
        return said
    if noise is not None and after > _ABOVE_NOISE * noise:
        said.append(
            f"The held-out position error is still {after / noise:.3g} times the noise ({with_unit(after, 'm')}, "
            f"{with_unit(noise, 'm')}): something else is wrong beside the geometry that was identified."
        )
    if before > 0 and after > _LITTLE_GAINED * before:
        said.append(
            f"The held-out position error is still {100 * after / before:.0f} % of what it was: what was identified "
            "explains little of it."
        )
    return said


def read_elsewhere(config: IdentifyConfig, mechanism: Mechanism) -> tuple[SerialArm, Rows, Rows] | None:
    """The records of `transfer`, split as the others are; None where there are none.

    Returns:
        The arm with nominal links, rows that place it anew, and rows that judge.
    """
    if config.transfer is None:
        return None
    if not isinstance(mechanism, SerialArm) or not mechanism.unknown_frames:
        raise InputError(
            f"transfer: {mechanism.name} has no frame to be fitted anew; it takes a serial arm whose base_frame or "
            "tool_frame is unknown"
        )
    if mechanism.grouped:
        raise InputError(
            "transfer: takes an arm with one frame for all rows; remove frame_per and tool_per, or transfer"
        )
    records, arm = read_records(config, config.transfer, mechanism)
    assert isinstance(arm, SerialArm)
    return arm, *rows_of_split(records, split_records(config, records))


def transferred(config: IdentifyConfig, own: SerialArm, train: Rows, test: Rows, values: Tensor) -> dict[str, Any]:
    """The block `transfer` of identified.json: pose errors with nominal and with identified links.

    Args:
        own, train, test: as of `read_elsewhere`.
        values: identified parameters, `k` [SI]; the frames are fitted anew to either.
    """
    errors = []
    # What joints give under torques is no part of an arm.
    for nominal in (own.nominal, values[: len(own.nominal)]):
        arm = own.with_nominal(nominal)
        assert isinstance(arm, SerialArm)
        placed = fit_frames(arm, train.joints[0], train.observed[0], rotation_weight=config.rotation_weight)
        errors.append(arm.pose_error(arm.forward_kinematics(test.joints, placed), test.observed))
    return {
        "records": "/".join(Path(str(config.transfer)).parts[-2:]),
        "rows": {"train": train.joints.shape[1], "test": test.joints.shape[1]},
        "test": before_and_after(errors[0], errors[1]),
    }


def scatter(points: Tensor, group: Tensor, weights: Tensor) -> Tensor:
    """Distance of every point from the mean of its group's points that count, `s` [m]: what a held point shows.

    Args:
        points: `s x 3` [m].
        group: number of each point's group, `s`, any numbers.
        weights: `s` [1]; the means are of the rows with weight, the distances of all rows.

    Raises:
        InputError: a group has no row that counts.
    """
    numbers, which = torch.unique(group, return_inverse=True)
    total = torch.zeros(len(numbers), dtype=points.dtype).index_add(0, which, weights)
    if bool((total <= 0).any()):
        raise InputError(f"group {float(numbers[total <= 0][0]):g} has no row that counts, so it has no mean")
    mean = torch.zeros(len(numbers), 3, dtype=points.dtype).index_add(0, which, points * weights[:, None])
    distance: Tensor = torch.linalg.vector_norm(points - (mean / total[:, None])[which], dim=-1)
    return distance
