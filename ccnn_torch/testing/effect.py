"""Conformance checks of an effect of poses and of an effect of motion."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor

from ccnn_torch.effects import Acting, Effect, Situation, default_gravity, make_effect, owned, reached, signature
from ccnn_torch.effects.covariates import SHIFT, draw_covariates, rest_torques
from ccnn_torch.effects.registry import OwnEffect, label_of, missing_on
from ccnn_torch.errors import InputError
from ccnn_torch.mechanisms import Mechanism, load_mechanism
from ccnn_torch.motion.axis import Drive, simulate_axes
from ccnn_torch.motion.effects import Facts, MotionEffect, motion_effects
from ccnn_torch.motion.library import library_of
from ccnn_torch.numerics.rotations import matrix_to_rotation_vector, rotation_vector_to_matrix
from ccnn_torch.testing.learner import global_random_state

_ROWS = 8
# Differences of `reached` over this share of a plausible size, and how well they fit what is to be linear [1].
_SHARE, _SLOPE_TOLERANCE = 1e-3, 1e-4
_SAME, _ABSENT = 1e-9, 1e-12
# Near singular configurations, differences do not approximate the derivative.
_REGULAR = 200.0


def check_effect(effect: str | Callable[[], Effect], mechanism: Mechanism | str = "five_bar", seed: int = 0) -> None:
    """Check names and units, absence at 0, first order against `reached`, batch shapes, and that all is finite.

    Args:
        effect: a name, `path/to/file.py:Name`, or a factory.
        mechanism: a mechanism on which the effect has all that it needs, or its name.
        seed: of the test rows.

    Raises:
        AssertionError: one sentence with the mistake; with the line where the effect's code raised.
    """
    before = global_random_state()
    try:
        made = _made(effect)
        _check(made, load_mechanism(mechanism) if isinstance(mechanism, str) else mechanism, seed)
    except InputError as reason:
        raise AssertionError(str(reason)) from reason
    _require(global_random_state() == before, made, "changes a global random state; an effect has none of its own")


def _made(effect: str | Callable[[], Effect]) -> OwnEffect:
    """The effect with every call checked, also if it is one of the library."""
    made = make_effect(effect) if isinstance(effect, str) else owned(effect())
    return made if isinstance(made, OwnEffect) else OwnEffect(made, label_of(made))


def _check(made: OwnEffect, machine: Mechanism, seed: int) -> None:
    situation = _situation(machine, seed)
    lacks = missing_on(made, situation)
    _require(not lacks, made, f"finds nothing to act on in mechanism '{machine.name}': {lacks}")
    _check_needs(made, situation)
    _check_basis(made, situation)
    _check_order(made, situation)
    _check_batches(made, situation)
    _check_first_order(made, situation)


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
    # A night in the middle of them.
    columns["time"] = columns["time"] + SHIFT * (torch.arange(_ROWS) >= _ROWS // 2)
    speeds = torch.randn(joints.shape, generator=generator, dtype=torch.float64)
    columns |= {f"speed{i + 1}": 0.1 * speeds[:, i] for i in range(len(machine.joints))}
    rows = Situation(machine, joints, columns, default_gravity(machine))
    return replace(rows, covariates=columns | rest_torques(rows))


def _shape(effect: Effect, situation: Situation) -> Tensor:
    """A value inside the grid of each shape, `h`."""
    middles = [s.grid[len(s.grid) // 2] for s in effect.shapes(situation)]
    return torch.tensor(middles, dtype=torch.float64)


def _check_needs(effect: Effect, situation: Situation) -> None:
    """`missing` is right: if it returns no text, the effect works with the given columns."""
    if effect.missing(situation.mechanism, []):
        return
    alone = replace(situation, covariates={})
    try:
        effect.basis(alone, _shape(effect, alone))
    except InputError as reason:
        if not isinstance(reason.__cause__, KeyError):
            raise
        raise AssertionError(
            f"effect '{effect.name}': needs the column {reason.__cause__}, which missing() does not say where it is "
            "not there"
        ) from None


def _check_basis(effect: Effect, situation: Situation) -> None:
    """The basis is repeatable, and finite also where the nominal machine has no pose."""
    found = effect.coefficients(situation)
    shape = _shape(effect, situation)
    basis = effect.basis(situation, shape)
    _require(torch.equal(basis, effect.basis(situation, shape)), effect, "basis differs when called again")
    primary = [k for k, c in enumerate(found) if not c.secondary]
    moved = signature(situation, effect, shape)[..., primary].abs().amax()
    _require(bool(moved > 0), effect, f"does nothing to mechanism '{situation.mechanism.name}'")
    outside = replace(situation, joints=torch.cat([situation.joints[:-1], 100 + 0 * situation.joints[-1:]]))
    effect.basis(outside, shape)


def _check_order(effect: Effect, situation: Situation) -> None:
    """An effect that does not need the order gives each row the same wherever it is in the table."""
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
        _require(_distance(got, expected) <= _SAME, effect, f"basis of rows {lead} differs from single calls")
    grids = [s.grid for s in effect.shapes(situation)]
    if grids:
        ends = torch.tensor([[g[k] for g in grids] for k in (0, -1)], dtype=torch.float64)
        apart = torch.stack([effect.basis(situation, one) for one in ends])
        got = effect.basis(situation, ends)
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


# A turning and a sliding axis of which all is known, and one of which nothing is.
_KNOWN = {"inertia": 2e-3, "load": 1e-3, "viscous": 0.05, "coulomb": 0.01, "weakness": 1.0}
_TURNING = Facts("rad", _KNOWN | {"gravity_sin": 0.1}, gain=2.0, length=0.1, error=0.6, supply=0.2, temperature=20.0)
_AXES = (_TURNING, replace(_TURNING, unit="m", nominal=_KNOWN, length=None), replace(_TURNING, nominal={}, gain=None))
# Times where a fit begins at which the axis is simulated.
_SIZES = (1.0, 100.0, -100.0)
_UNMOVED, _SECONDS, _RATE = 1e-12, 4.0, 100.0


def check_motion_effect(effect: str | MotionEffect) -> None:
    """Check form and names, absence at 0, that it moves an axis that can show it, and that all is finite.

    Args:
        effect: a name, `path/to/file.py:NAME`, or the effect.

    Raises:
        AssertionError: one sentence with the mistake.
    """
    try:
        made = motion_effects([effect])[0] if isinstance(effect, str) else effect
        shown = [axis for axis in _AXES if not made.missing(axis)]
        if not shown:
            raise AssertionError(f"effect '{made.name}': no axis of the check can show it: {made.missing(_AXES[0])}")
        if max(_check_motion(made, axis) for axis in shown) <= _UNMOVED:
            raise AssertionError(f"effect '{made.name}': moves nothing, and missing() does not say what lacks")
    except InputError as reason:
        raise AssertionError(str(reason)) from reason


def _check_motion(effect: MotionEffect, axis: Facts) -> float:
    """The largest change of a position where a fit begins."""
    library, time = library_of([effect], [axis]), torch.arange(0, _SECONDS, 1 / _RATE, dtype=torch.float64)[None]
    course = 0.4 * (time / _SECONDS - 0.5)
    command = 0.6 * torch.sin(3 * time) + 0.2 * torch.sin(11 * time)
    drive = Drive(time, command, torch.zeros(1, 2, dtype=torch.float64), course, 50 * (course + 0.2))
    where, zero = f"effect '{effect.name}', an axis in {axis.unit}", torch.zeros(1, library.size, dtype=torch.float64)

    def moved(theta: torch.Tensor) -> torch.Tensor:
        values = library.parameters(theta, torch.zeros(len(theta), dtype=torch.int64))
        return simulate_axes(drive, {name: value[:, None] for name, value in values.items()})

    plain = simulate_axes(drive, {name: value[:, None] for name, value in library.nominal.items()})
    if float((moved(zero) - plain).abs().max()) > _UNMOVED:
        raise AssertionError(f"{where}: moves the axis where all its numbers are 0")
    begins = [(variant, size) for variant in library.variants[0] for size in _SIZES]
    theta = zero.repeat(len(begins), 1)
    for row, (variant, size) in zip(theta, begins, strict=True):
        begin = torch.where(variant.values.abs() < 0.1, 1.0, variant.values)
        row[list(variant.active)], row[list(variant.held)] = size * begin, variant.shapes
    positions = moved(theta).flatten(1)
    for (_, size), found in zip(begins, positions, strict=True):
        if not bool(torch.isfinite(found).all()):
            raise AssertionError(f"{where}: at {size:g} times where a fit begins its positions are not finite")
    return float((positions - plain.flatten(1)).abs()[[size == 1.0 for _, size in begins]].max())
