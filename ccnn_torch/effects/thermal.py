"""Thermal growth with a first-order lag."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from ccnn_torch.effects.lag import elapsed, lagged
from ccnn_torch.effects.members import Member, members
from ccnn_torch.effects.protocol import Coefficient, Kind, Shape
from ccnn_torch.effects.situation import Situation
from ccnn_torch.mechanisms import Mechanism

REFERENCE = 293.15
"""Temperature at which a machine has its dimensions, ISO 1 [K]."""
_STEEL = 1.2e-5
# Of a member against the whole machine, and kelvins by which the reference may be off.
_UNEVEN, _REFERENCE_OFF = 0.5, 5.0
# A motor's mount of 0.2 m; a beam warped by its two sides.
_MOUNT = {"m": 2e-6, "rad": 5e-6}
# Of a drive warmed by its own work [K], and how long that takes [s]; the legs take on a part.
_OWN_WARMTH, _WARM_UP, _TAKEN_ON = 10.0, 2000.0, 0.4
_LAGS = 12
_SHARES = (0.01, 1.0)


class Thermal:
    """Δp = (α + α_k) p θ for all lengths p (k = their leg or link), Δq_i = β_i q_i θ for sliding drives.

    θ is the temperature less 20 degC, as a body of one heat capacity follows it with a lag: θ' = (T - θ) / lag, settled
    at the first row. Without a column of times there is no lag. Secondary: mounts that move a joint by γ_i θ; a
    reference that was not 20 degC (a constant growth); beams that bend by what the surroundings are ahead of the body,
    T - θ; parts of the growth that follow at once, or with a lag of their own (a core in its skin); and the drives' own
    warmth, which no thermometer in the hall
    sees: growth of all and of the sliding drives by 1 - exp(-t / 2000 s).

    Lengths are parameters and drives are joints. Both move the measured frame, to first order by the mechanism's
    derivatives, so the effect is one on the pose: no joint has to replace a length (near a singularity of an arm
    that would take a large one), and growth of 1e-4 leaves 1e-8 to the second order.
    """

    name = "thermal"
    kind: Kind = "pose"
    description = "thermal growth with a first-order lag"
    ordered = False

    def missing(self, mechanism: Mechanism, covariates: Sequence[str]) -> str:
        """Temperature, and something that has a length."""
        if not members(mechanism) and all(j.unit != "m" for j in mechanism.joints):
            return f"lengths: mechanism '{mechanism.name}' has no parameter in metres"
        return "" if "temperature" in covariates else "the temperature of the surroundings: temperature[degC]"

    def coefficients(self, situation: Situation) -> tuple[Coefficient, ...]:
        """The whole machine, its members, its sliding drives; then what is secondary."""
        mechanism = situation.mechanism
        found = [Coefficient("growth", "1/K", _STEEL, positive=True)]
        uneven = _STEEL * _UNEVEN
        found += [Coefficient(m.name, "1/K", uneven, joint=m.joint, leg=m.leg) for m in _apart(mechanism)]
        found += [
            Coefficient(f"{j.name} travel", "1/K", _STEEL, joint=j.name, positive=True)
            for j in mechanism.joints
            if j.unit == "m"
        ]
        found += [
            Coefficient(f"{j.name} mount", f"{j.unit}/K", _MOUNT[j.unit], joint=j.name, secondary=True)
            for j in mechanism.joints
        ]
        found.append(Coefficient("reference", "1", _STEEL * _REFERENCE_OFF, secondary=True))
        if "time" in situation.covariates:
            own = _STEEL * _OWN_WARMTH
            found.append(Coefficient("at once", "1/K", uneven, secondary=True))
            found.append(Coefficient("late", "1/K", uneven, secondary=True))
            found += [
                Coefficient(f"{j.name} bend", f"{j.unit}/K", _MOUNT[j.unit], joint=j.name, secondary=True)
                for j in mechanism.joints
            ]
            found.append(Coefficient("warm-up", "1", own * _TAKEN_ON, secondary=True))
            found += [
                Coefficient(f"{j.name} warm-up", "1", own, joint=j.name, secondary=True)
                for j in mechanism.joints
                if j.unit == "m"
            ]
        return tuple(found)

    def shapes(self, situation: Situation) -> tuple[Shape, ...]:
        """The lag, from none to the time of all rows; () without times."""
        if "time" not in situation.covariates:
            return ()
        whole = max(float(elapsed(situation.covariates["time"]).max()), 1e-6)
        low, high = (math.log(share * whole) for share in _SHARES)
        lags = [math.exp(low + (high - low) * k / (_LAGS - 1)) for k in range(_LAGS)]
        late = [c.name for c in self.coefficients(situation)].index("late")
        every = range(len(self.coefficients(situation)))
        return (
            Shape("lag", "s", (0.0, *lags), tuple(k for k in every if k != late)),
            Shape("late lag", "s", tuple(lags), (late,)),
        )

    def basis(self, situation: Situation, shape: Tensor) -> Tensor:
        """`... x s x c x m`."""
        return situation.once(self.fixed_columns) * self.column_factors(situation, shape).unsqueeze(-2)

    def fixed_columns(self, situation: Situation) -> Tensor:
        """Of the columns what does not depend on the shapes, `... x s x c x m`, to be times `column_factors`."""
        mechanism = situation.mechanism
        values = mechanism.resolve(situation.parameters).unsqueeze(-2)
        longer = torch.nan_to_num(situation.parameter_jacobian) * values
        jacobian = torch.nan_to_num(situation.jacobian)
        sliding = [i for i, j in enumerate(mechanism.joints) if j.unit == "m"]
        lengths = [k for m in members(mechanism) for k in m.lengths]
        whole = longer[..., lengths].sum(-1, keepdim=True)
        apart = [longer[..., m.lengths].sum(-1, keepdim=True) for m in _apart(mechanism)]
        travel = (jacobian * situation.joints.unsqueeze(-2))[..., sliding]
        parts = [whole, *apart, travel, jacobian, whole]
        return torch.cat([*parts, *([whole, whole, jacobian, whole, travel] if _timed(situation) else [])], -1)

    def column_factors(self, situation: Situation, shape: Tensor) -> Tensor:
        """What each of the fixed columns is multiplied by: warmth [K], or what has become of it, `... x s x m`."""
        mechanism = situation.mechanism
        warm = (situation.covariates["temperature"] - REFERENCE).expand(situation.joints.shape[:-1])
        n, sliding = len(mechanism.joints), sum(j.unit == "m" for j in mechanism.joints)
        following, one = 1 + len(_apart(mechanism)) + sliding + n, torch.ones_like(warm)
        if not _timed(situation):
            kinds = [(warm, following), (one, 1)]
        else:
            time = situation.covariates["time"]
            body, core = (lagged(time, warm, shape[..., k]) for k in (0, 1))
            own = -torch.expm1(-elapsed(time).expand(warm.shape) / _WARM_UP)
            kinds = [(body, following), (one, 1), (warm, 1), (core, 1), (warm - body, n), (own, 1 + sliding)]
        each = torch.stack(torch.broadcast_tensors(*(k for k, _ in kinds)), -1)  # type: ignore[no-untyped-call]
        return each[..., [i for i, (_, count) in enumerate(kinds) for _ in range(count)]]


def _timed(situation: Situation) -> bool:
    return "time" in situation.covariates


def _apart(mechanism: Mechanism) -> list[Member]:
    """Members that may grow unlike each other; a single one is the whole machine."""
    found = members(mechanism)
    return found if len(found) > 1 else []
