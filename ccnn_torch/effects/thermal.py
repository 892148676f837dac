"""Thermal growth, by thermometers and their lags."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from ccnn_torch.coordinates import is_temperature
from ccnn_torch.effects.loads import Member, like_parts, members
from ccnn_torch.effects.protocol import Coefficient, Effect, Shape
from ccnn_torch.effects.situation import REFERENCE, Situation
from ccnn_torch.effects.time import elapsed, lagged
from ccnn_torch.mechanisms import Mechanism

_STEEL = 1.2e-5
# Of a member against the whole machine, and kelvins by which the reference may be off.
_UNEVEN, _REFERENCE_OFF = 0.5, 5.0
# A motor's mount of 0.2 m; a beam warped by its two sides.
_MOUNT = {"m": 2e-6, "rad": 5e-6}
# Of a drive warmed by its own work [K], and how long that takes [s]; the legs take on a part.
_OWN_WARMTH, _WARM_UP, _TAKEN_ON = 10.0, 2000.0, 0.4
_LAGS = 12
# What the surroundings are taken to have become warmer by at the first row where nobody recorded it [K].
_RISE = 10.0
_WARM_SHARES = (0.01, 1.0)


class Thermal(Effect):
    """Δp = (α + α_k) p θ for all lengths p (k = their leg or link), Δq_i = β_i q_i θ for sliding drives.

    θ is the temperature less 20 degC, as a body of one heat capacity follows it with a lag: θ' = (T - θ) / lag, settled
    at the first row. Without a column of times there is no lag. Secondary: mounts that move a joint by γ_i θ; a
    reference that was not 20 degC (a constant growth); beams that bend by what the surroundings are ahead of the body,
    T - θ; parts of the growth that follow at once, or with a second lag, of members and drives as well (a core in its
    skin, screws behind thin rods); and the drives' own warmth, which no thermometer in the hall sees: growth of all and
    of the sliding drives by 1 - exp(-t / 2000 s). By each further thermometer, `temperature_NAME`, growth of all these
    parts by what it shows beyond the first one, and of drives and mounts by what it shows itself, each there or not for
    itself: a leg, or a screw, grows by its own thermometer. Lengths that every leg has one of may grow together, as a
    base plate does. Without `temperature` the mean of the others stands for it; where none was recorded at all, but the
    time, the surroundings are taken to have become 10 K warmer at the first row: growth that settles, without what
    moves one turning joint alone.

    Lengths are parameters and drives are joints. Both move the measured frame, to first order by the mechanism's
    derivatives, so the effect is one on the pose: no joint has to replace a length (near a singularity of an arm
    that would take a large one), and growth of 1e-4 leaves 1e-8 to the second order.
    """

    name = "thermal"
    kind = "pose"
    description = "thermal growth with a first-order lag"

    def missing(self, mechanism: Mechanism, covariates: Sequence[str]) -> str:
        """Temperature, or at least the time, and something that has a length."""
        if not members(mechanism) and all(j.unit != "m" for j in mechanism.joints):
            return f"lengths: mechanism '{mechanism.name}' has no parameter in metres"
        known = "time" in covariates or any(map(is_temperature, covariates))
        return "" if known else "the temperature of the surroundings: temperature[degC]"

    def coefficients(self, situation: Situation) -> tuple[Coefficient, ...]:
        """The whole machine, its members, its sliding drives; then what is secondary."""
        mechanism = situation.mechanism
        recorded = _recorded(situation)
        found = [Coefficient("growth", "1/K", _STEEL, positive=recorded)]
        uneven = _STEEL * _UNEVEN
        found += [Coefficient(m.name, "1/K", uneven, joint=m.joint, leg=m.leg) for m in _apart(mechanism)]
        following = [*found]
        drives = [
            Coefficient(f"{j.name} travel", "1/K", _STEEL, joint=j.name, positive=recorded)
            for j in mechanism.joints
            if j.unit == "m"
        ]
        sliding = [j.name for j in mechanism.joints if j.unit == "m"]
        low, high = situation.workspace
        drives += [
            Coefficient(f"{j.name} mount", f"{j.unit}/K", _mount(j.unit, reach), joint=j.name, secondary=True)
            for j, reach in zip(mechanism.joints, (high - low).tolist(), strict=True)
            # In time alone what moves one turning joint is its drift.
            if recorded or j.unit == "m"
        ]
        found += drives
        if recorded:
            found.append(Coefficient("reference", "1", _STEEL * _REFERENCE_OFF, secondary=True))
        if _timed(situation):
            if recorded:
                found.append(Coefficient("at once", "1/K", uneven, secondary=True))
            later = [*following, *(c for c in drives if c.joint in sliding)]
            names = ["late", *(f"{c.name} late" for c in later[1:])]
            found += [replace(c, name=n, secondary=True, positive=False) for c, n in zip(later, names, strict=True)]
        if _timed(situation) and recorded:
            own = _STEEL * _OWN_WARMTH
            found += [
                Coefficient(f"{j.name} bend", f"{j.unit}/K", _MOUNT[j.unit], joint=j.name, secondary=True)
                for j in mechanism.joints
            ]
            found += [
                Coefficient(f"{name} warm-up".strip(), "1", own * _TAKEN_ON, joint, leg, secondary=True)
                for name, joint, leg in [("", None, None), *((m.name, m.joint, m.leg) for m in _apart(mechanism))]
            ]
            found += [
                Coefficient(f"{j.name} warm-up", "1", own, joint=j.name, secondary=True)
                for j in mechanism.joints
                if j.unit == "m"
            ]
        bodies = [Coefficient(p.name, "1/K", _STEEL, secondary=True, part=p.name) for p in like_parts(mechanism)]
        found += bodies
        found += [
            replace(
                c, name=f"{c.name} {name.partition('_')[2]}", secondary=True, positive=False, part=f"{name} {c.name}"
            )
            for name in situation.thermometers
            for c in (*following, *bodies, *drives)
        ]
        return tuple(found)

    def shapes(self, situation: Situation) -> tuple[Shape, ...]:
        """The lag, from none to the time of all rows; () without times."""
        if not _timed(situation):
            return ()
        whole = max(float(elapsed(situation.covariates["time"]).max()), 1e-6)
        low, high = (math.log(share * whole) for share in _WARM_SHARES)
        lags = [math.exp(low + (high - low) * k / (_LAGS - 1)) for k in range(_LAGS)]
        mechanism, names = situation.mechanism, [c.name for c in self.coefficients(situation)]
        # By place: a plate may have a thermometer, and its growth a name that ends alike.
        late = range(names.index("late"), len(names))
        late = late[: 1 + len(_apart(mechanism)) + 2 * sum(j.unit == "m" for j in mechanism.joints)]
        others = tuple(k for k in range(len(names)) if k not in late)
        return Shape("lag", "s", (0.0, *lags), others), Shape("late lag", "s", tuple(lags), tuple(late))

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
        following = [whole, *apart, travel]
        mounts = jacobian[..., sliding]
        if not _recorded(situation):
            columns = [*following, mounts, *following, mounts]
        elif _timed(situation):
            columns = [*following, jacobian, whole, whole, *following, mounts, jacobian, *following]
        else:
            columns = [*following, jacobian, whole]
        bodies = [longer[..., p.lengths].sum(-1, keepdim=True) for p in like_parts(mechanism)]
        others = [whole, *apart, *bodies, travel, jacobian] * len(situation.thermometers)
        return torch.cat([*columns, *bodies, *others], -1)

    def column_factors(self, situation: Situation, shape: Tensor) -> Tensor:
        """What each of the fixed columns is multiplied by: warmth [K], or what has become of it, `... x s x m`."""
        mechanism = situation.mechanism
        warm = _warmth(situation)
        others = [situation.covariates[name] - REFERENCE for name in situation.thermometers]
        n, sliding = len(mechanism.joints), sum(j.unit == "m" for j in mechanism.joints)
        following, one = 1 + len(_apart(mechanism)) + sliding, torch.ones_like(warm)
        bodies = len(like_parts(mechanism))
        body, mounts, kinds = warm, n, [(one, 1)]
        if _timed(situation):
            time = situation.covariates["time"]
            body, core = (lagged(time, warm, shape[..., k]) for k in (0, 1))
            own = -torch.expm1(-elapsed(time).expand(warm.shape) / _WARM_UP)
            kinds += [(warm, 1), (core, following + sliding), (warm - body, n), (own, following)]
            others = [lagged(time, other, shape[..., 0]) for other in others]
            if not _recorded(situation):
                mounts, kinds = sliding, [(core, following + sliding)]
        kinds = [(body, following + mounts), *kinds, (body, bodies)]
        for other in others:
            # A screw is as warm as its own thermometer; what a leg's shows is beside the growth of the whole machine.
            kinds += [(other - body, following - sliding + bodies), (other, sliding + n)]
        each = torch.stack(torch.broadcast_tensors(*(k for k, _ in kinds)), -1)  # type: ignore[no-untyped-call]
        return each[..., [i for i, (_, count) in enumerate(kinds) for _ in range(count)]]


def _mount(unit: str, reach: float) -> float:
    """Plausible size [SI/K]; a sliding drive is held at either end of its reach, a turning one moves on its mount."""
    return max(_MOUNT[unit], _STEEL * reach) if unit == "m" else _MOUNT[unit]


def _recorded(situation: Situation) -> bool:
    return any(map(is_temperature, situation.covariates))


def _warmth(situation: Situation) -> Tensor:
    """Of the surroundings beyond the reference, `... x s` [K]."""
    if _recorded(situation):
        return situation.temperature.expand(situation.joints.shape[:-1]) - REFERENCE
    return _RISE * (elapsed(situation.covariates["time"]).expand(situation.joints.shape[:-1]) > 0)


def _timed(situation: Situation) -> bool:
    return "time" in situation.covariates


def _apart(mechanism: Mechanism) -> list[Member]:
    """Members that may grow unlike each other; a single one is the whole machine."""
    found = members(mechanism)
    return found if len(found) > 1 else []
