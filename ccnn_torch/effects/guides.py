"""Guides of sliding axes that shift and turn what they carry while it travels."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from ccnn_torch.effects.columns import TWIST, inside, twist_columns
from ccnn_torch.effects.protocol import Coefficient, Effect
from ccnn_torch.effects.situation import Situation
from ccnn_torch.mechanisms import Mechanism, SerialArm
from ccnn_torch.numerics.rotations import rotation_vector_to_matrix

# Legendre's polynomials of the degrees 1 to 4, by the powers 0 to 4.
_LEGENDRE = ((0, 1, 0, 0, 0), (-0.5, 0, 1.5, 0, 0), (0, -1.5, 0, 2.5, 0), (0.375, 0, -3.75, 0, 4.375))
# Of machine tools as built over a metre [m], [rad] (ISO 10791-1); the rows say what it is here.
_SIZE = {"m": 1e-5, "rad": 2e-5}
# Up to here a form is that of a bow or a twist; beyond it is secondary.
_SIMPLE = 2


class ErrorMotion(Effect):
    """Δx = Σ P_k(u) (t_k + ω_k × (x - o)), ΔR = Σ P_k(u) ω_k: error motions of linear axes (ISO 230-1:2012, 3.4).

    u is a sliding joint's place in its travel, -1 to 1, P_k Legendre's polynomial of degree k = 1 to 4, o the origin of
    the frame that the joint carries, and t and ω are along and about that frame's axes. Shifts begin with degree 2:
    those in proportion to the travel are leads and squarenesses. Above degree 2 they are secondary.
    """

    name = "error_motion"
    kind = "pose"
    description = "guides of sliding axes that are bent or twisted: what they carry shifts and turns as it travels"

    def missing(self, mechanism: Mechanism, covariates: Sequence[str]) -> str:
        """A joint that slides, of an arm."""
        slides = isinstance(arm := inside(mechanism), SerialArm) and not bool(arm.revolute.all())
        return "" if slides else "a joint that slides, in a machine whose links follow one another"

    def coefficients(self, situation: Situation) -> tuple[Coefficient, ...]:
        """Of each sliding joint the shifts and turns of its first polynomial, then of the next."""
        joints = situation.mechanism.joints
        return tuple(
            Coefficient(
                f"{joints[i].name} {name} {degree}", unit, _SIZE[unit], joints[i].name, secondary=degree > _SIMPLE
            )
            for i in _sliding(situation)
            for degree in range(1, len(_LEGENDRE) + 1)
            for name, unit in TWIST
            if degree > 1 or unit == "rad"
        )

    def basis(self, situation: Situation, shape: Tensor) -> Tensor:
        """`... x s x c x m`."""
        arm = situation.whole.mechanism
        assert isinstance(arm, SerialArm)
        values = arm.resolve(situation.whole.parameters)
        base, frames = rotation_vector_to_matrix(values[..., 3:6]), arm.link_frames(situation.joints, values)
        low, high = arm.limits.unbind(-1)
        travel = ((2 * situation.joints - low - high) / (high - low).clamp_min(1e-9)).clamp(-1, 1)[..., None]
        forms = torch.cat([travel**k for k in range(len(_LEGENDRE) + 1)], -1) @ travel.new_tensor(_LEGENDRE).mT
        parts = []
        for i in _sliding(situation):
            turn, place = frames[i + 1]
            origin = (base @ place[..., None])[..., 0] + values[..., :3]
            twist = twist_columns(situation, situation.platform[0] - origin, base @ turn)
            columns = (twist[..., None, :] * forms[..., i, None, :, None]).flatten(-2)
            parts.append(columns[..., len(TWIST) // 2 :])
        return torch.cat(parts, -1)


def _sliding(situation: Situation) -> list[int]:
    arm = situation.whole.mechanism
    assert isinstance(arm, SerialArm)
    return torch.nonzero(~arm.revolute).flatten().tolist()
