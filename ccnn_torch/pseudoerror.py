"""Pseudoerror: every source of error as one deviation of the actuated joints (Zhang and Gao 2012, section II)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from ccnn_torch.mechanisms import Mechanism, PoseError
from ccnn_torch.mechanisms.frames.partial import completed

# Rows x repeats solved at once: about 100 MB for a six-joint arm.
_CHUNK = 20_000


@dataclass(frozen=True)
class Pseudoerror:
    """Joint deviations of measured rows; `[r x]` is there when the parameters have repeats.

    Attributes:
        deviation: δ = g(X) - q_c, `[r x] s x n` [SI], revolute joints in [-pi, pi]; 0 where the pose has no joints.
        usable: rows fit to learn from, `[r x] s`, bool.
        reasons: why rows are not, by "unreachable", "condition" and "deviation", where poses have gaps also "partial",
            beside an identified machine "outlier"; each `[r x] s`, bool.
        condition: condition number of the Jacobian at the commanded joints, `[r x] s` [1].
        remainder_position: what no joint deviation compensates, `[r x] s` [m].
        remainder_rotation: the same of the orientation, `[r x] s` [rad], or None.
    """

    deviation: Tensor
    usable: Tensor
    reasons: dict[str, Tensor]
    condition: Tensor
    remainder_position: Tensor
    remainder_rotation: Tensor | None

    @property
    def known(self) -> Tensor:
        """Rows that a machine may be identified from, `[r x] s`, bool: also those with a part of their pose."""
        return self.usable | self.reasons.get("partial", torch.zeros_like(self.usable))

    def notes(self, max_named: int = 10) -> list[str]:
        """One sentence per reason, naming the first rows (counted from 1); a row counts if it is so in any repeat."""
        sentences = {
            "partial": "a part of their pose was not measured; geometry is identified from them, too, and they judge",
            "unreachable": "no joints of the nominal mechanism reach the measured pose",
            "condition": "the arm is near a singularity, where a small pose error needs a large joint deviation",
            "deviation": "the joint deviation is larger than max_deviation",
            "outlier": "the identified machine misses them by more than ten times the usual",
        }
        found = []
        for reason, flagged in self.reasons.items():
            rows = torch.nonzero(flagged.reshape(-1, flagged.shape[-1]).any(0)).squeeze(-1)
            if len(rows):
                named = ", ".join(str(int(i) + 1) for i in rows[:max_named]) + (", …" if len(rows) > max_named else "")
                which, are = ("rows", "are") if len(rows) > 1 else ("row", "is")
                found.append(f"{len(rows)} {which} {are} not trained on: {sentences[reason]} ({which} {named})")
        return found


def joint_deviations(
    mechanism: Mechanism,
    commanded: Tensor,
    measured: Tensor,
    parameters: Tensor | None = None,
    rotation_weight: float = 0.04,
    max_condition: float = 50.0,
    max_deviation: float | None = None,
    damping: float = 0.0,
) -> Pseudoerror:
    """Deviation of the joints that best explains the measured poses, δ(q_c) = g(X) - q_c.

    g(X) is the joint vector whose nominal pose is closest to X in (position, rotation_weight x rotation vector), on the
    branch of the commanded joints, with the least-norm δ where joints are redundant. Rows that must not be learned from
    are flagged, not dropped: they still count in the pose error.

    Args:
        mechanism: nominal kinematics.
        commanded: `[r x] s x n` [SI].
        measured: `[r x] s x p` [SI]; rows that lack a part of it (NaN) are not usable.
        parameters: `k`, or `r x 1 x k` for one set per repeat (fitted frames), or `[r x] s x k` for one per row (frames
            per group of rows); nominal when None.
        rotation_weight: η of eq. 5 [m/rad]; the paper's 10..40 mm.
        max_condition: rows whose Jacobian (rotation rows times η) has a larger condition number are not usable.
        max_deviation: rows with a joint deviation above this are not usable [SI]; no bound when None.
        damping: weight of the deviation itself beside the pose error [m per joint unit]: it bounds δ of a serial arm
            near singularities by |pose error| / (2 damping), at the price of a larger remainder. A pose noise of
            0.01 mm and deviations of 1 mrad make it 0.01; 0 gives the closest pose. With it, `max_condition` may be
            infinite.

    Returns:
        Pseudoerror.
    """
    partial = measured.isnan().any(-1) & ~measured.isnan().all(-1)
    measured = completed(mechanism, commanded, measured, parameters) if bool(partial.any()) else measured
    rows = commanded.shape[-2]
    by_row = parameters is not None and parameters.dim() > 1 and parameters.shape[-2] == rows > 1
    sets = (t.shape[:-2] for t in (commanded, measured, parameters) if t is not None)
    size = max(1, _CHUNK // max(1, *(math.prod(s) for s in sets)))
    parts = []
    for i in range(0, rows, size):
        here = slice(i, i + size)
        own = parameters[..., here, :] if parameters is not None and by_row else parameters
        parts.append(_chunk(mechanism, commanded[..., here, :], measured[..., here, :], own, rotation_weight, damping))
    deviation = torch.cat([p[0] for p in parts], dim=-2)
    condition = torch.cat([p[1] for p in parts], dim=-1)
    position = torch.cat([p[2].position for p in parts], dim=-1)
    turned = [p[2].rotation for p in parts if p[2].rotation is not None]
    reached = torch.isfinite(deviation).all(-1)
    largest = deviation.abs().amax(-1)
    partial = partial.expand(reached.shape)
    reached = reached & ~partial
    reasons = {
        **({"partial": partial} if bool(partial.any()) else {}),
        "unreachable": ~reached & ~partial,
        "condition": reached & ~(condition <= max_condition),
        "deviation": reached & (largest > (math.inf if max_deviation is None else max_deviation)),
    }
    return Pseudoerror(
        deviation=torch.where(reached[..., None], deviation, 0.0),
        usable=~(partial | reasons["unreachable"] | reasons["condition"] | reasons["deviation"]),
        reasons=reasons,
        condition=condition,
        remainder_position=position,
        remainder_rotation=torch.cat(turned, dim=-1) if turned else None,
    )


def _chunk(
    mechanism: Mechanism,
    commanded: Tensor,
    measured: Tensor,
    parameters: Tensor | None,
    rotation_weight: float,
    damping: float,
) -> tuple[Tensor, Tensor, PoseError]:
    """Deviation, condition number and remainder of some rows."""
    ideal = mechanism.nearest_joints(measured, parameters, commanded, rotation_weight, damping)
    deviation = mechanism.wrap(ideal - commanded)
    condition = mechanism.condition_number(commanded, rotation_weight, parameters, guess=measured)
    # Around the measured pose, so that a numerical forward map stays on its branch.
    remainder = mechanism.pose_error(measured, mechanism.forward_kinematics(ideal, parameters, guess=measured))
    return deviation, condition, remainder
