"""Does an effect keep what simulation, diagnosis and compensation rely on? See `ccnn_torch.effects.Effect`."""

from __future__ import annotations

import random
from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor

from ccnn_torch.effects import Acting, Effect, Situation, default_gravity, make_effect, reached, signature
from ccnn_torch.effects._protocol import missing_verbs
from ccnn_torch.effects.covariates import draw_covariates
from ccnn_torch.errors import InputError
from ccnn_torch.mechanisms import Mechanism, load_mechanism
from ccnn_torch.rotations import matrix_to_rotation_vector, rotation_vector_to_matrix
from ccnn_torch.units import to_si

__all__ = ["check_effect"]

_ROWS = 8
# Differences of `reached` over this share of a plausible size, and how well they fit what is to be linear [1].
_SHARE, _SLOPE_TOLERANCE = 1e-3, 1e-4
_SAME, _ABSENT = 1e-9, 1e-12
# Differences of nearly singular configurations say nothing about the derivative.
_REGULAR = 200.0


def check_effect(effect: str | Callable[[], Effect], mechanism: Mechanism | str = "five_bar", seed: int = 0) -> None:
    """Check names and units, absence at 0, first order against `reached`, batch shapes, and that all is finite.

    Args:
        effect: a name, `path/to/file.py:Name`, or what makes it.
        mechanism: a mechanism on which the effect has all that it needs, or its name.
        seed: of the rows that are tried.

    Raises:
        AssertionError: one sentence that says what is wrong.
    """
    made = make_effect(effect) if isinstance(effect, str) else effect()
    lacking = missing_verbs(made)
    if lacking:
        raise AssertionError(f"effect {made!r} lacks {', '.join(lacking)}")
    machine = load_mechanism(mechanism) if isinstance(mechanism, str) else mechanism
    situation = _situation(machine, seed)
    before = (torch.random.get_rng_state(), random.getstate())
    _check_needs(made, situation)
    _check_names(made, situation)
    _check_basis(made, situation)
    _check_order(made, situation)
    _check_batches(made, situation)
    _check_first_order(made, situation)
    after = (torch.random.get_rng_state(), random.getstate())
    untouched = torch.equal(before[0], after[0]) and before[1] == after[1]
    _require(untouched, made, "changes a global random state; an effect has none of its own")


def _require(fine: bool, effect: Effect, sentence: str) -> None:
    if not fine:
        raise AssertionError(f"effect '{effect.name}': {sentence}")


def _situation(machine: Mechanism, seed: int) -> Situation:
    """Regular rows with every column that the library knows."""
    generator = torch.Generator().manual_seed(seed)
    joints = machine.sample_joints(8 * _ROWS, generator)
    joints = joints[machine.condition_number(joints) < _REGULAR][:_ROWS]
    if len(joints) < _ROWS:
        raise AssertionError(f"mechanism '{machine.name}': nearly all its sampled configurations are singular")
    columns = draw_covariates(machine, joints, generator)
    speeds = torch.randn(joints.shape, generator=generator, dtype=torch.float64)
    columns |= {f"speed{i + 1}": 0.1 * speeds[:, i] for i in range(len(machine.joints))}
    return Situation(machine, joints, columns, default_gravity(machine))


def _shape(effect: Effect, situation: Situation) -> Tensor:
    """A value inside the grid of each shape, `h`."""
    middles = [s.grid[len(s.grid) // 2] for s in effect.shapes(situation)]
    return torch.tensor(middles, dtype=torch.float64)


def _check_needs(effect: Effect, situation: Situation) -> None:
    """`missing` tells the truth: without complaint the effect works with the columns there are."""
    names = list(situation.covariates)
    said = effect.missing(situation.mechanism, names)
    _require(isinstance(said, str), effect, f"missing() gives {type(said).__name__}, expected a sentence or ''")
    _require(not said, effect, f"finds nothing to act on in mechanism '{situation.mechanism.name}': {said}")
    if effect.missing(situation.mechanism, []):
        return
    alone = replace(situation, covariates={})
    try:
        effect.basis(alone, _shape(effect, alone))
    except KeyError as column:
        raise AssertionError(
            f"effect '{effect.name}': needs the column {column}, which missing() does not say where it is not there"
        ) from None


def _check_names(effect: Effect, situation: Situation) -> None:
    found = effect.coefficients(situation)
    names = [c.name for c in found] + [s.name for s in effect.shapes(situation)]
    twice = sorted({n for n in names if names.count(n) > 1})
    _require(not twice, effect, f"two of its coefficients or shapes are called '{''.join(twice[:1])}'")
    _require(any(not c.secondary for c in found), effect, "has no coefficient that is not secondary")
    joints, legs = [j.name for j in situation.mechanism.joints], {g.leg for g in situation.mechanism.geometry}
    for one in found:
        _require(one.scale > 0, effect, f"coefficient '{one.name}' has the scale {one.scale}, expected more than 0")
        _require(one.joint is None or one.joint in joints, effect, f"'{one.name}' is of joint '{one.joint}'")
        _require(one.leg is None or one.leg in legs, effect, f"'{one.name}' is of leg {one.leg}, which is not there")
        _check_unit(effect, one.name, one.unit)
    for shape in effect.shapes(situation):
        _check_unit(effect, shape.name, shape.unit)
        rising = all(a < b for a, b in zip(shape.grid, shape.grid[1:], strict=False))
        _require(bool(shape.grid) and rising, effect, f"the grid of shape '{shape.name}' does not ascend")
        wrong = [k for k in shape.columns or () if k not in range(len(found))]
        _require(not wrong, effect, f"shape '{shape.name}' names coefficient {wrong[:1]}, there are {len(found)}")


def _check_unit(effect: Effect, name: str, unit: str) -> None:
    try:
        one = float(to_si([1.0], unit, where="it")[0])
    except InputError as reason:
        raise AssertionError(f"effect '{effect.name}': the unit of '{name}' is none: {reason}") from None
    _require(one == 1.0, effect, f"the unit '{unit}' of '{name}' is no SI unit")


def _check_basis(effect: Effect, situation: Situation) -> None:
    """Shape, numbers, the same again, and finite also where the nominal machine has no pose."""
    channels = situation.jacobian.shape[-2]
    sizes = {"joints": situation.joints.shape[-1], "parameters": len(situation.mechanism.geometry), "pose": channels}
    found = effect.coefficients(situation)
    shape = _shape(effect, situation)
    basis = effect.basis(situation, shape)
    expected = (_ROWS, sizes[effect.kind], len(found))
    _require(tuple(basis.shape) == expected, effect, f"basis has shape {tuple(basis.shape)}, expected {expected}")
    _require(basis.dtype == torch.float64, effect, f"basis is {basis.dtype}, expected torch.float64")
    _require(torch.equal(basis, effect.basis(situation, shape)), effect, "basis is not the same when asked again")
    primary = [k for k, c in enumerate(found) if not c.secondary]
    moved = signature(situation, effect, shape)[..., primary].abs().amax()
    _require(bool(moved > 0), effect, f"does nothing to mechanism '{situation.mechanism.name}'")
    outside = replace(situation, joints=torch.cat([situation.joints[:-1], 100 + 0 * situation.joints[-1:]]))
    ends = [torch.tensor([s.grid[k] for s in effect.shapes(situation)], dtype=torch.float64) for k in (0, -1)]
    for rows, at in ((situation, ends[0]), (situation, ends[1]), (outside, shape)):
        fine = bool(torch.isfinite(effect.basis(rows, at)).all())
        where = "where the nominal machine has no pose" if rows is outside else "at an end of a shape's grid"
        _require(fine, effect, f"basis is not finite {where}")


def _check_order(effect: Effect, situation: Situation) -> None:
    """An effect that does not need the order gives each row the same wherever it stands."""
    if effect.ordered:
        return
    turned = replace(
        situation, joints=situation.joints.flip(0), covariates={k: v.flip(0) for k, v in situation.covariates.items()}
    )
    shape = _shape(effect, situation)
    gap = _distance(effect.basis(turned, shape).flip(-3), effect.basis(situation, shape))
    _require(gap <= _SAME, effect, "depends on the order of the rows, but `ordered` is False")


def _check_batches(effect: Effect, situation: Situation) -> None:
    """Sets of rows side by side, and several shapes at once, give what single calls give."""
    other = _situation(situation.mechanism, 1)
    both = replace(
        situation,
        joints=torch.stack([situation.joints, other.joints]),
        covariates={k: torch.stack([v, other.covariates[k]]) for k, v in situation.covariates.items()},
    )
    shape = _shape(effect, situation)
    single = torch.stack([effect.basis(one, shape) for one in (situation, other)])
    for lead in ((2,), (2, 1)):
        rows = replace(
            both,
            joints=both.joints.reshape(*lead, *situation.joints.shape),
            covariates={k: v.reshape(*lead, -1) for k, v in both.covariates.items()},
        )
        got = effect.basis(rows, shape)
        expected = single.reshape(*lead, *single.shape[1:])
        _require(got.shape == expected.shape, effect, f"basis of rows {lead} has shape {tuple(got.shape)}")
        _require(_distance(got, expected) <= _SAME, effect, f"basis of rows {lead} differs from single calls")
    grids = [s.grid for s in effect.shapes(situation)]
    if grids:
        ends = torch.tensor([[g[k] for g in grids] for k in (0, -1)], dtype=torch.float64)
        apart = torch.stack([effect.basis(situation, one) for one in ends])
        got = effect.basis(situation, ends)
        _require(got.shape == apart.shape, effect, f"basis at two shapes has shape {tuple(got.shape)}")
        _require(_distance(got, apart) <= _SAME, effect, "basis at two shapes differs from one shape at a time")


def _check_first_order(effect: Effect, situation: Situation) -> None:
    """Central differences of the pose that a machine with the effect reaches, coefficient by coefficient."""
    shape, found = _shape(effect, situation), effect.coefficients(situation)
    none = reached(situation, [Acting(effect, shape, torch.zeros(len(found), dtype=torch.float64))])
    off = float((none - reached(situation, [])).abs().max())
    _require(off <= _ABSENT, effect, f"moves the pose by {off:.2g} where all its coefficients are 0")
    steps = _SHARE * torch.diag(torch.tensor([c.scale for c in found], dtype=torch.float64)).unsqueeze(1)
    ahead, behind = (_frames(situation, Acting(effect, shape, s)) for s in (steps, -steps))
    slope = (ahead[0] - behind[0]) / 2
    if ahead[1] is not None and behind[1] is not None:
        slope = torch.cat([slope, matrix_to_rotation_vector(ahead[1] @ behind[1].mT) / 2], -1)
    expected = (signature(situation, effect, shape) * steps.diagonal(dim1=0, dim2=-1)).movedim(-1, 0)
    gap = (slope - expected).abs().amax((-2, -1)) / (expected.abs().amax((-2, -1)) + 1e-11)
    worst = int(gap.argmax())
    _require(
        bool(gap[worst] <= _SLOPE_TOLERANCE),
        effect,
        f"signature of '{found[worst].name}' is off by a share of {float(gap[worst]):.2g} from what is reached",
    )


def _frames(situation: Situation, acting: Acting) -> tuple[Tensor, Tensor | None]:
    """As `reached`, one machine for each set of coefficients: `m x s x 3` and `m x s x 3 x 3`."""
    many = replace(situation, joints=situation.joints.expand(acting.coefficients.shape[0], -1, -1))
    there = reached(many, [acting._replace(coefficients=acting.coefficients.squeeze(1))])
    return there[..., :3], rotation_vector_to_matrix(there[..., 3:]) if there.shape[-1] == 6 else None


def _distance(first: Tensor, second: Tensor) -> float:
    return float(((first - second).abs() / (1 + second.abs())).max())
