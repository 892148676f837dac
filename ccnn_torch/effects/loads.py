"""Members of a machine, and how they deflect under external loads and their own weight."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from ccnn_torch.coordinates import force_of, is_temperature, per_force, torque_of
from ccnn_torch.effects.columns import as_shown, by_joint, inside, own_parameters
from ccnn_torch.effects.protocol import Coefficient, Effect
from ccnn_torch.effects.situation import PLATFORM_WEIGHT, REFERENCE, Situation, arm_axes, load_columns
from ccnn_torch.mechanisms import Mechanism, SerialArm, sees_directions
from ccnn_torch.mechanisms.frames.set_ups import GIVE
from ccnn_torch.numerics.rotations import rotation_vector_to_matrix


class Member(NamedTuple):
    """A part of the machine: what results call it, and the numbers of its parameters that are lengths."""

    name: str
    lengths: list[int]
    leg: int | None
    joint: str | None


def members(mechanism: Mechanism) -> list[Member]:
    """The parts that have lengths; a length that belongs to no leg is a part of its own."""
    mechanism = inside(mechanism)
    own = own_parameters(mechanism)
    found: dict[str, Member] = {}
    for place, k in enumerate(own):
        parameter = mechanism.geometry[k]
        if parameter.unit != "m":
            continue
        name, leg, joint = parameter.word or parameter.name, parameter.leg, None
        if leg is not None:
            name = f"leg {leg}"
        elif not parameter.word and isinstance(mechanism, SerialArm):
            i = place * len(mechanism.joints) // len(own)
            name, joint = f"link {i + 1}", mechanism.joints[i].name
        if name not in found:
            found[name] = Member(name, [], leg, joint)
        found[name].lengths.append(k)
    return list(found.values())


def like_parts(mechanism: Mechanism) -> list[Member]:
    """Lengths that every leg has one of, all legs together: rods, or the joints' places on a base, which is one body.

    They are known by their names, less the number of the leg and a coordinate's letter: `A1x`, `Ax1` and `A_1` are `A`.
    """
    found: dict[str, Member] = {}
    legs: dict[str, set[int]] = {}
    inner = inside(mechanism)
    for k in own_parameters(inner):
        parameter = inner.geometry[k]
        if parameter.unit == "m" and parameter.leg is not None:
            whole = parameter.name.replace(str(parameter.leg), "", 1).replace("_", "")
            name = f"all {whole.rstrip('xyz') or whole}"
            found.setdefault(name, Member(name, [], None, None)).lengths.append(k)
            legs.setdefault(name, set()).add(parameter.leg)
    # What has no length grows by nothing.
    return [p for p in found.values() if len(legs[p.name]) > 1 and any(inner.geometry[k].nominal for k in p.lengths)]


def _weights(arm: SerialArm, joints: Tensor, values: Tensor, ends: Tensor) -> tuple[Tensor, Tensor]:
    """Where an arm's links weigh in the base frame, `... x n x 3` [m], and their shares, `n` [1]; evenly at their ends
    `... x n x 3` [m] where their masses are not known."""
    if not len(arm.masses):
        return ends, ends.new_full(ends.shape[-2:-1], 1 / ends.shape[-2])
    base, origin = rotation_vector_to_matrix(values[..., 3:6]), values[..., :3]
    tool = ((ends[..., -1:, :] - origin[..., None, :]) @ base)[..., 0, :]
    places, shares = arm.weighs(arm.link_frames(joints, values), tool)
    return places @ base.mT + origin[..., None, :], shares


_SECONDARY = 0.3
# How far from the measured point a load may act [m].
_AWAY = 0.1
# What a joint carries, by and large [N], [N·m]: stiffening is given there.
_TYPICAL = {"m": 100.0, "rad": 30.0}


class Compliance(Effect):
    """Δq_i = c_i τ_i + d_i τ_i |τ_i| / τ_0 + h_i τ_i³ / τ_0², τ = force or torque of the load on the joint, and of an
    arm's own weight where its file tells its masses: one spring carries both; and members that give, e_k.

    τ_0 = 100 N or 30 N·m: d and h are changes of compliance there. Secondary as well, the members: a leg stretches in
    all its lengths p in proportion to the force of the load on them, Δp = e (∂x/∂p) · load (virtual work); a link of an
    arm tilts at its joint under the part of the moment that the joint does not carry. All to first order about the
    nominal pose, so that the effect is one on the pose.
    """

    name = "compliance"
    kind = "pose"
    description = "deflection of joints, legs and links under an external load (linear and stiffening)"

    def missing(self, mechanism: Mechanism, covariates: Sequence[str]) -> str:
        """A load that was measured."""
        columns = load_columns(mechanism)
        along = " or ".join(f"{name}[{unit}]" for name, unit in columns.items())
        return "" if any(c in covariates for c in columns) else f"a column of the load on the platform: {along}"

    def coefficients(self, situation: Situation) -> tuple[Coefficient, ...]:
        """One a joint, then two a joint for what is not proportional, then the members."""
        mechanism = situation.mechanism
        found = [
            Coefficient(
                f"{j.name}{part}",
                per_force(j.unit),
                GIVE[j.unit] * (_SECONDARY if part else 1.0),
                joint=j.name,
                secondary=bool(part),
                positive=not part,
            )
            for part in ("", " stiffening", " hardening")
            for j in mechanism.joints
        ]
        if isinstance(inside(mechanism), SerialArm):
            tilt, away = GIVE["rad"] * _SECONDARY, GIVE["rad"] * _AWAY
            turning = [mechanism.joints[i].name for i in _turning(mechanism)]
            return (
                *found,
                *(Coefficient(f"{j.name} tilt", "rad/N/m", tilt, j.name, None, True) for j in mechanism.joints),
                *(Coefficient(f"{j} load {axis}", "rad/N", away, j, None, True) for j in turning for axis in "xyz"),
            )
        stretch = GIVE["m"] * _SECONDARY
        return (*found, *(Coefficient(m.name, "m/N", stretch, m.joint, m.leg, True) for m in members(mechanism)))

    def basis(self, situation: Situation, shape: Tensor) -> Tensor:
        """`... x s x c x m`."""
        jacobian, torque = torch.nan_to_num(situation.motor_jacobian), situation.carried_torque
        typical = torch.tensor([_TYPICAL[j.unit] for j in situation.mechanism.joints], dtype=torch.float64)
        ratio = torque.abs() / typical
        parts = [jacobian * (torque * ratio**k).unsqueeze(-2) for k in range(3)]
        arm = isinstance(inside(situation.mechanism), SerialArm)
        return torch.cat([*parts, *_of_an_arm(situation)] if arm else [*parts, _stretching(situation)], -1)


# Change of a stiffness per kelvin: of steel 0.0003, of polymers, belts and grease some hundredths.
_SOFTER = 0.02


class ThermalCompliance(Effect):
    """Δq_i = (T - 20 °C) (c_i τ_load,i + d_i τ_weight,i): a joint's compliance changes with the temperature T.

    What it is at 20 °C is `compliance`, of the machine's own weight `gravity`; τ as there.
    """

    name = "thermal_compliance"
    kind = "joints"
    description = "joints whose stiffness changes with the temperature"

    def missing(self, mechanism: Mechanism, covariates: Sequence[str]) -> str:
        """The temperature, and positions."""
        if sees_directions(mechanism):
            return "positions: what bends turns a direction as flexure does"
        return "" if any(map(is_temperature, covariates)) else "the temperature of the surroundings: temperature[degC]"

    def coefficients(self, situation: Situation) -> tuple[Coefficient, ...]:
        """By load (where one was recorded) and by weight, joint by joint."""
        found = []
        for joint in situation.mechanism.joints:
            size = GIVE[joint.unit] * _SOFTER
            weight = "rad/m/K" if joint.unit == "rad" else "m/K"
            if situation.loaded:
                found.append(Coefficient(f"{joint.name} load", f"{per_force(joint.unit)}/K", size, joint=joint.name))
            found.append(Coefficient(f"{joint.name} weight", weight, size * PLATFORM_WEIGHT, joint=joint.name))
        return tuple(found)

    def basis(self, situation: Situation, shape: Tensor) -> Tensor:
        """`... x s x n x m`."""
        torques = [situation.load_torque] if situation.loaded else []
        warm = situation.temperature[..., None, None] - REFERENCE
        return situation.joints_by(by_joint(torch.stack([*torques, situation.own_weight_torque], -1) * warm))


class Sag(Effect):
    """Δq_i = c_i τ_i, τ = force or torque of each drive as measured at rest.

    c is negative where the controller tells the torque with which a drive holds, and positive where it tells that of
    the weight and load that it holds.
    """

    name = "sag"
    kind = "joints"
    description = "joints that give under their own torque, as measured at rest"

    def missing(self, mechanism: Mechanism, covariates: Sequence[str]) -> str:
        """A torque that was measured."""
        there = any(torque_of(j) in covariates for j in mechanism.joints)
        one = mechanism.joints[0]
        return "" if there else f"a column of the drives' torques: {torque_of(one)}[{force_of(one.unit)}]"

    def _measured(self, situation: Situation) -> list[int]:
        joints = situation.mechanism.joints
        return [i for i, j in enumerate(joints) if torque_of(j) in situation.covariates]

    def coefficients(self, situation: Situation) -> tuple[Coefficient, ...]:
        """One for each joint whose torque was measured."""
        joints = [situation.mechanism.joints[i] for i in self._measured(situation)]
        return tuple(Coefficient(j.name, per_force(j.unit), GIVE[j.unit], joint=j.name) for j in joints)

    def basis(self, situation: Situation, shape: Tensor) -> Tensor:
        """`... x s x n x m`."""
        joints, zero = situation.mechanism.joints, torch.zeros_like(situation.joints[..., 0])
        torques = [situation.covariates.get(torque_of(j), zero).expand_as(zero) for j in joints]
        return situation.joints_by(by_joint(torch.stack(torques, -1).unsqueeze(-1), self._measured(situation)))


def _stretching(situation: Situation) -> Tensor:
    """Change of the pose by the members of a machine with legs, `... x s x c x (members)`."""
    slope, whole = torch.nan_to_num(situation.parameter_jacobian), situation.whole
    torques = torch.nan_to_num(whole.parameter_jacobian).mT @ whole.wrench.unsqueeze(-1)
    found = members(situation.mechanism)
    moved = [slope[..., m.lengths] @ torques[..., m.lengths, :] for m in found]
    return torch.cat(moved, -1) if found else slope[..., :0]


def _turning(mechanism: Mechanism) -> list[int]:
    return [i for i, j in enumerate(mechanism.joints) if j.unit == "rad"]


def _of_an_arm(situation: Situation) -> list[Tensor]:
    """Change of the pose by links that tilt at their joints, `... x s x c x n`, and by joints that give under the
    moment of a load that acts 1 m away from the measured point along each axis of the tool, `... x s x c x 3t`."""
    arm, whole = situation.whole.mechanism, situation.whole
    assert isinstance(arm, SerialArm)
    points, axes = arm_axes(arm, situation.joints, arm.resolve(whole.parameters))
    place, rotation = situation.platform
    if rotation is None:
        # Only what a changed file describes.
        raise ValueError("an arm whose frame has no orientation")
    lever = place.unsqueeze(-2) - points
    wrench = whole.wrench.unsqueeze(-2)
    force = wrench[..., :3]
    moment = torch.linalg.cross(*torch.broadcast_tensors(lever, force), dim=-1)  # type: ignore[no-untyped-call]
    if wrench.shape[-1] == 6:
        moment = moment + wrench[..., 3:]
    across = moment - (moment * axes).sum(-1, keepdim=True) * axes
    shift = torch.linalg.cross(across, lever, dim=-1)
    tilting = as_shown(situation, torch.cat([shift, across], -1).mT)
    away = torch.linalg.cross(*torch.broadcast_tensors(rotation.mT, force), dim=-1)  # type: ignore[no-untyped-call]
    turning = _turning(arm)
    torque = (axes @ away.mT)[..., turning, :]
    jacobian = torch.nan_to_num(situation.jacobian)[..., turning]
    return [tilting, (jacobian.unsqueeze(-1) * torque.unsqueeze(-3)).flatten(-2)]


# What an arm may carry elsewhere than evenly: no correction of a form.
_MASSES = ("tool", "inner links")
# Lever by which a turning joint carries weight, by and large [m]; a sliding one carries a share of it [1].
_LEVER = 0.3
# Weight times the way from the measured point to the centre of mass [N·m].
_MOMENT = 5.0


class Gravity(Effect):
    """Δq_i = c_i τ_i, τ = force or torque of the machine's own weight on the joint per newton, by virtual work.

    For an arm the newton is where its masses are, or spread evenly over the origins of its links and the tool where
    these are not known; for other machines it hangs on the measured point of the platform. c is compliance times
    weight: a sag for each metre of lever (turning joints), or along a joint that carries all (sliding ones). Secondary:
    a joint that stiffens, d τ|τ| / 0.3 m (or / 1); what another mass distribution does: for an arm a weight at the
    tool, and one that is larger towards the base; for a revolute drive of another machine the weight of its crank, a
    torque in proportion to cos q and sin q, and for a platform that turns the moment of its weight about the measured
    point, in its axes, on drives of plausible give.
    """

    name = "gravity"
    kind = "joints"
    description = "deflection under the machine's own weight"

    def missing(self, mechanism: Mechanism, covariates: Sequence[str]) -> str:
        """Positions."""
        return "positions: what bends turns a direction as flexure does" if sees_directions(mechanism) else ""

    def coefficients(self, situation: Situation) -> tuple[Coefficient, ...]:
        """Sag of each joint and what goes with it, joint by joint; then the centre of mass."""
        mechanism, found = situation.mechanism, []
        for joint in mechanism.joints:
            turning = joint.unit == "rad"
            unit, size = "rad/m" if turning else "m", GIVE[joint.unit] * PLATFORM_WEIGHT
            found.append(Coefficient(joint.name, unit, size, joint=joint.name, positive=True))
            parts = [("stiffening", unit, size)]
            if isinstance(inside(mechanism), SerialArm):
                parts += [("tool", unit, size), ("inner links", unit, size)]
            elif turning:
                parts += [(f"crank {wave}", "rad", size * _LEVER) for wave in ("cos", "sin")]
            # No input link weighs many times as much as the platform; a tool may.
            found += [
                Coefficient(
                    f"{joint.name} {part}",
                    u,
                    _SECONDARY * v,
                    joint=joint.name,
                    secondary=True,
                    mends=part not in _MASSES,
                )
                for part, u, v in parts
            ]
        if _centred(situation):
            found += [Coefficient(f"centre {axis}", "N*m", _MOMENT, secondary=True) for axis in "xyz"]
        return tuple(found)

    def basis(self, situation: Situation, shape: Tensor) -> Tensor:
        """`... x s x n x m`."""
        mechanism, joints = situation.mechanism, situation.joints
        turning = [j.unit == "rad" for j in mechanism.joints]
        lever = torch.tensor([_LEVER if turns else 1.0 for turns in turning], dtype=joints.dtype)
        arm = isinstance(inside(mechanism), SerialArm)
        weight = situation.own_weight_torque
        parts = [weight, weight * weight.abs() / lever]
        if arm:
            parts += [situation.weight_torque, situation.inner_weight_torque]
        else:
            parts += [torch.cos(joints), torch.sin(joints)]
        columns = situation.joints_by(by_joint(torch.stack(parts, -1)))
        if not arm:
            kept = [4 * i + k for i, turns in enumerate(turning) for k in (range(4) if turns else range(2))]
            columns = columns[..., kept]
        return torch.cat([columns, _off_centre(situation)], -1) if _centred(situation) else columns


# What a beam does under what pulls at its end.
_OF_BEAM = ("", " twist")
# How a base tilts under a moment, in its own axes: symmetric in x and y, since its stiffest and its softest axis are
# square to each other. A turn about z is one of the first joint.
_OF_BASE = {
    "x": ((1, 0, 0), (0, 0, 0), (0, 0, 0)),
    "y": ((0, 0, 0), (0, 1, 0), (0, 0, 0)),
    "xy": ((0, 1, 0), (1, 0, 0), (0, 0, 0)),
}


class Bending(Effect):
    """Links of an arm that bend and twist between their joints as beams of one section, clamped at the joint before;
    and a base that tilts on what it stands on.

    Under a force F and a moment M at its end a beam of length L gives F L³ / 3EI + M L² / 2EI and turns by
    F L² / 2EI + M L / EI (Euler and Bernoulli), and by M L / GJ about itself. Coefficients of a link: 1/EI for the
    recorded load; weight / EI for own weight, 1 N of which is where the masses are, or spread evenly over the ends of
    the links where these are not known.
    Secondary: the same for a weight at the tool alone, and of each 1/GJ; and for the weight of the link itself along
    it, which gives F L³ / 8EI and turns by F L² / 6EI. The base tilts about its origin by C M, M the moment there and C
    a symmetric matrix in its axes x and y: a table is softer in one direction. To first order about the nominal pose.
    """

    name = "bending"
    kind = "pose"
    description = "links of an arm that bend between their joints, or a base that tilts, under own weight or a load"

    def missing(self, mechanism: Mechanism, covariates: Sequence[str]) -> str:
        """Links, and positions."""
        if not isinstance(inside(mechanism), SerialArm):
            return "links one after the other: the legs of a machine give as its members do, by 'compliance'"
        return "positions: what bends turns a direction as flexure does" if sees_directions(mechanism) else ""

    def coefficients(self, situation: Situation) -> tuple[Coefficient, ...]:
        """By load (where one was recorded), by weight, by a weight at the tool and by the link's own, link by link;
        then of the base by what pulls."""
        kinds = [(f"weight{part}", "rad/m^2", PLATFORM_WEIGHT) for part in _OF_BEAM]
        kinds += [(pull, "rad/m^2", _SECONDARY * PLATFORM_WEIGHT) for pull in ("tool", "tool twist", "own")]
        if situation.loaded:
            kinds = [(f"load{part}", "rad/N/m^2", 1.0) for part in _OF_BEAM] + kinds
        main = ("load", "weight")
        links = [
            Coefficient(f"link {i + 1} {kind}", unit, GIVE["rad"] * size, joint.name, None, kind not in main)
            for i, joint in enumerate(situation.mechanism.joints)
            for kind, unit, size in kinds
        ]
        base = [
            Coefficient(f"base {kind} {axes}", unit.replace("m^2", "m"), GIVE["rad"] * size, secondary=kind not in main)
            for kind, unit, size in kinds
            if kind in (*main, "tool")
            for axes in _OF_BASE
        ]
        return (*links, *base)

    def basis(self, situation: Situation, shape: Tensor) -> Tensor:
        """`... x s x c x m`."""
        arm = situation.whole.mechanism
        assert isinstance(arm, SerialArm)
        values = arm.resolve(situation.whole.parameters)
        points, _ = arm_axes(arm, situation.joints, values)
        tool = situation.platform[0].unsqueeze(-2)
        ends = torch.cat([points[..., 1:, :], tool.expand_as(points)[..., :1, :]], -2)
        beam, beyond, n = ends - points, tool - ends, points.shape[-2]
        down = situation.down.unsqueeze(-2).expand_as(beam)
        # What hangs at the end of link j acts on link i ≤ j.
        places, shares = _weights(arm, situation.joints, values, ends)
        onward = torch.ones(n, n, dtype=points.dtype).triu() * shares
        lever = (onward[..., None] * (places.unsqueeze(-3) - ends.unsqueeze(-2))).sum(-2)
        pulls = [(onward.sum(-1, keepdim=True) * down, _cross(lever, down)), (down, _cross(beyond, down))]
        if situation.loaded:
            wrench = situation.whole.wrench.unsqueeze(-2)
            moment = _cross(beyond, wrench[..., :3])
            pulls.insert(0, (wrench[..., :3], moment + wrench[..., 3:] if wrench.shape[-1] == 6 else moment))
        bent = [_of_beam(beam, *pull, beyond) for pull in pulls]
        own = _of_beam(beam, down, torch.zeros_like(beam), beyond, (1 / 6, 1 / 8))[..., :1, :]
        foot, turn = values[..., None, :3], rotation_vector_to_matrix(values[..., 3:6])
        tilts = turn[..., None, :, :] @ torch.tensor([*_OF_BASE.values()], dtype=turn.dtype) @ turn.mT[..., None, :, :]
        tilted = []
        for force, moment in pulls:
            below = (moment + _cross(ends - foot, force))[..., :1, :]
            angle = (tilts @ below.mT.unsqueeze(-3)).squeeze(-1)
            tilted.append(torch.cat([_cross(angle, tool - foot), angle], -1))
        columns = torch.cat([torch.cat([*bent, own], -2).flatten(-3, -2), *tilted], -2)
        return as_shown(situation, columns.mT)


def _of_beam(
    beam: Tensor, force: Tensor, moment: Tensor, beyond: Tensor, shares: tuple[float, float] = (1 / 2, 1 / 3)
) -> Tensor:
    """Shift and turn of a point by clamped beams of EI = 1 that bend, and of GJ = 1 that twist, under what pulls at
    their ends; all `... x n x 3` but the result, `... x n x 2 x 6`; beyond: from the end to the point; shares: by which
    a force turns and shifts the end, times L² and L³."""
    length = torch.linalg.vector_norm(beam, dim=-1, keepdim=True)
    along = beam / length.clamp_min(1e-12)
    twist = length * (moment * along).sum(-1, keepdim=True) * along
    across = force - (force * along).sum(-1, keepdim=True) * along
    turn = length * (shares[0] * _cross(beam, force) + moment) - twist
    sink = length * (shares[1] * length.square() * across + _cross(moment, beam) / 2)
    both = [torch.cat([_cross(turn, beyond) + sink, turn], -1), torch.cat([_cross(twist, beyond), twist], -1)]
    return torch.stack(both, -2)


def _cross(first: Tensor, second: Tensor) -> Tensor:
    return torch.linalg.cross(*torch.broadcast_tensors(first, second), dim=-1)  # type: ignore[no-untyped-call, no-any-return]


def _centred(situation: Situation) -> bool:
    """Whether the platform's centre of mass has columns: it turns, and is no arm's, whose tool is small."""
    return not isinstance(inside(situation.mechanism), SerialArm) and situation.platform[1] is not None


def _off_centre(situation: Situation) -> Tensor:
    """Change of the joints by a moment of 1 N·m of the weight along each axis of the platform, `... x s x n x 3`."""
    rotation = situation.platform[1]
    assert rotation is not None
    moment = torch.linalg.cross(rotation.mT, situation.down.expand_as(rotation), dim=-1)
    scale = torch.tensor([GIVE[j.unit] for j in situation.mechanism.joints], dtype=rotation.dtype)
    jacobian = torch.nan_to_num(situation.whole.jacobian)
    torques: Tensor = jacobian[..., 3:, :].mT @ moment.mT
    return scale[:, None] * torques
