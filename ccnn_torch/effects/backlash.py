"""Play and friction of the drives: the rest position depends on the last motion."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from ccnn_torch.coordinates import per_force
from ccnn_torch.effects.columns import OfJoints, of_rows
from ccnn_torch.effects.protocol import Coefficient, Shape
from ccnn_torch.effects.situation import PLATFORM_WEIGHT, WEIGHTS, Situation, load_columns
from ccnn_torch.mechanisms import Mechanism
from ccnn_torch.mechanisms.frames.set_ups import GIVE

_SCALE = {"m": 1.5e-4, "rad": 2e-4}
# Pushes at which a joint leaves its flank, in units of the usual one; and over what range of push it does, as a share.
_HOLDS = (0.0, 0.1, 0.2, 0.4, 0.7, 1.2, 2.0, 3.5, 6.0, 60.0)
# Where no direction is known: beyond them a change is in proportion to the load.
_LOOSE = _HOLDS[1:3]
_WIDTHS = (0.3, 1.0, 4.0)
_EDGES = ((" softer", 2.0), (" harder", 0.5))


class Backlash(OfJoints):
    """Δq_i = b_i / 2 tanh((w_i / h - s_i) / e) / tanh(1 / e): s the direction of approach, w the push on the joint.

    Without any direction s is 0, and h so small that a load throws the joint from one flank to the other, as it does
    one whose bolt or bearing is loose.

    A joint rests on the flank that drove it, half the backlash b behind the motor's middle, unless weight and load push
    it onto the other flank whichever way it came; friction holds it there up to the push h, and gears give over a range
    e h of it (lost motion). The machine's weight, h and e are shapes, h and e for all joints alike; without a push that
    reaches h this is -b s / 2. Secondary: the same with an edge twice and half as wide, less the part with e, so that b
    stays the backlash.
    """

    name = "backlash"
    description = "backlash of the drives: the rest position depends on the direction of approach, or on the load"

    def missing(self, mechanism: Mechanism, covariates: Sequence[str]) -> str:
        """The direction of approach of at least one joint, or a load that pushes the joints to either flank."""
        loaded = any(name in covariates for name in load_columns(mechanism))
        return "" if loaded else _without_direction(mechanism, covariates)

    def coefficients(self, situation: Situation) -> tuple[Coefficient, ...]:
        """Play, and what a softer and a harder edge change, of each joint whose direction is known."""
        parts = (("", 1.0, False), *((edge, 0.5, True) for edge, _ in _EDGES))
        return tuple(
            Coefficient(
                f"{j.name}{part}",
                j.unit,
                _SCALE[j.unit] * size,
                joint=j.name,
                secondary=mends,
                mends=mends,
                positive=not mends,
            )
            for j in (situation.mechanism.joints[i] for i in self.moving(situation))
            for part, size, mends in parts
        )

    def shapes(self, situation: Situation) -> tuple[Shape, ...]:
        """The machine's weight beside a load that was recorded, the push that friction holds, and the edge's width."""
        found = [Shape("weight", "N", (0.0, *WEIGHTS), usual=PLATFORM_WEIGHT)] if situation.loaded else []
        if situation.directed:
            found += [Shape("hold", "1", _HOLDS, usual=_HOLDS[-1]), Shape("width", "1", _WIDTHS, usual=_WIDTHS[0])]
        else:
            # Of another name: numbers that were found with directions are none without.
            found.append(Shape("edge", "1", _LOOSE, usual=_LOOSE[0]))
        return tuple(found)

    def moving(self, situation: Situation) -> list[int]:
        """Joints whose direction is known; all, where that is of none."""
        return situation.directed or super().moving(situation)

    def moves(self, situation: Situation, shape: Tensor, rows: Tensor | None = None) -> Tensor:
        """Where each joint rests, and what other edges change of that."""
        weight = shape[..., 0] if situation.loaded else shape.new_tensor(PLATFORM_WEIGHT)
        hold, width = shape[..., -1, None, None], torch.full_like(shape[..., -1, None, None], _WIDTHS[0])
        if situation.directed:
            hold, width = shape[..., -2, None, None], hold
        # A joint that friction does not hold at all changes its flank as softly as one that it hardly holds.
        unit = hold.clamp_min(_HOLDS[1])
        left = (situation.push(weight, rows) - hold * of_rows(situation.direction, rows)) / unit
        rest = _rest(left, width)
        # What friction holds against any push comes to no edge.
        edges = [(_rest(left, times * width) - rest) * (hold < _HOLDS[-1]) for _, times in _EDGES]
        return torch.stack([rest, *edges], -1)


def _without_direction(mechanism: Mechanism, covariates: Sequence[str]) -> str:
    """What is missing where no direction of approach is among the covariates, as in `missing`."""
    n = len(mechanism.joints)
    there = any(f"direction{i + 1}" in covariates for i in range(n))
    return "" if there else f"the sign of each joint's last motion before it stopped: direction1[1]…direction{n}[1]"


def _rest(left: Tensor, width: Tensor) -> Tensor:
    """Where a joint rests within its backlash, ±1/2 where nothing pushes it off its flank."""
    return torch.tanh(left / width) / (2 * torch.tanh(1 / width))


# A joint's friction is some tenths of what it carries, its constant part like that of a tenth of the platform's weight.
_SHARE = 0.3
# Small: the part that does not depend on the load is backlash, and is called so unless the rest of friction is there.
_CONSTANT = {"m": 6e-6, "rad": 1e-5}


class Friction(OfJoints):
    """Δq_i = -s_i (c_i |τ_load,i| + d_i |τ_weight,i| + e_i): s the direction of approach, τ what the joint carries.

    Coulomb's friction is in proportion to what presses the surfaces together; a drive of compliance C and friction
    coefficient μ stops C μ |τ| short. The weight is that of a platform of 100 N: of another one d is as much larger.
    Secondary: load and weight together, |τ_load + τ_weight|, where they pull apart, the weight a shape; and the part e
    that does not depend on them, which alone is what backlash does.
    """

    name = "friction"
    description = "friction that winds up the drives against their last motion, growing with their load"

    def missing(self, mechanism: Mechanism, covariates: Sequence[str]) -> str:
        """The direction of approach of at least one joint."""
        return _without_direction(mechanism, covariates)

    def coefficients(self, situation: Situation) -> tuple[Coefficient, ...]:
        """By load (where one was recorded), by weight, constant: for each joint whose direction is known."""
        found = []
        for joint in (situation.mechanism.joints[i] for i in situation.directed):
            size = GIVE[joint.unit] * _SHARE
            for part in ("load", "weight") if situation.loaded else ("weight",):
                found.append(
                    Coefficient(f"{joint.name} {part}", per_force(joint.unit), size, joint=joint.name, positive=True)
                )
            if situation.loaded:
                unit = per_force(joint.unit)
                found.append(Coefficient(f"{joint.name} together", unit, size, joint=joint.name, secondary=True))
            constant = _CONSTANT[joint.unit]
            found.append(
                Coefficient(
                    f"{joint.name} constant", joint.unit, constant, joint=joint.name, secondary=True, borrowed=True
                )
            )
        return tuple(found)

    def shapes(self, situation: Situation) -> tuple[Shape, ...]:
        """The machine's weight beside a load that was recorded."""
        if not situation.loaded:
            return ()
        together = tuple(k for k, c in enumerate(self.coefficients(situation)) if c.name.endswith("together"))
        return (Shape("weight", "N", WEIGHTS, together, usual=PLATFORM_WEIGHT),)

    def moving(self, situation: Situation) -> list[int]:
        """Joints whose direction is known."""
        return situation.directed

    def moves(self, situation: Situation, shape: Tensor, rows: Tensor | None = None) -> Tensor:
        """By what each joint carries."""
        load, weight = situation.load_torque, situation.own_weight_torque
        carried = [(weight * PLATFORM_WEIGHT).abs(), torch.ones_like(weight)]
        if situation.loaded:
            carried[:1] = [load.abs(), carried[0], (load + weight * shape[..., 0, None, None]).abs()]
        columns = torch.stack(torch.broadcast_tensors(*carried), -1)  # type: ignore[no-untyped-call]
        return of_rows(-situation.direction.unsqueeze(-1) * columns, rows, -3)
