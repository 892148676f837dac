"""The machine of a compensator, by what closed forms a mechanism has."""

from __future__ import annotations

from collections.abc import Sequence

from torch import Tensor

from ccnn_torch.compensation.effects import PhysicalEffects, expand_effects
from ccnn_torch.compensation.expanded_machine import expand_machine
from ccnn_torch.compensation.expansions import expand
from ccnn_torch.compensation.inverse_machine import MOST_NEWTON, InverseMachine, inner_of
from ccnn_torch.compensation.machine import RULE, ForwardMachine, Machine, Rule
from ccnn_torch.effects import Acting, Situation
from ccnn_torch.errors import MethodFailedError
from ccnn_torch.mechanisms import Framed, Mechanism, SerialArm

# Error of the polynomial from which Newton's method comes to the right pose, as a share of the largest.
_START = 0.1


def machine_of(
    rows: Situation, acting: Sequence[Acting], values: Tensor, covariates: Sequence[str], margin: float
) -> Machine:
    """Geometry and effects as a machine that a model file can hold.

    Args:
        rows: on the nominal machine, frames fitted, `s x n`; its region is what they fill.
        acting: effects on joints and pose.
        values: all parameters as identified, `k` [SI].
        covariates: names of the compensator's, in order.
        margin: of the compensator's domain.

    Raises:
        InputError, MethodFailedError: what effects see of the machine, or where it is, is no polynomial of the joints.
    """
    _refuse_redundant(rows.mechanism)
    effects = expand_effects(rows, acting, covariates, margin) if acting else None
    return build_machine(rows.mechanism, values, effects, rows.joints, margin)


def build_machine(
    mechanism: Mechanism,
    identified: Tensor,
    effects: PhysicalEffects | None,
    joints: Tensor,
    margin: float,
    rule: Rule = RULE,
) -> Machine:
    """The machine of a compensator, by its closed forms, or without one of either direction by polynomials.

    Args:
        mechanism: with the nominal parameters, fitted frames included.
        identified: all parameters, `k` [SI].
        effects: on joints and pose; None without any.
        joints: commanded joints of the training rows, `s x n` [SI].
        margin: of the compensator's domain.

    Raises:
        InputError, MethodFailedError: as `expand`.
    """
    _refuse_redundant(mechanism)
    way = _closed_form_of(mechanism)
    if way == "forward":
        return ForwardMachine(mechanism, identified, effects, rule)
    if way is None:
        return expand_machine(mechanism, identified, effects, joints, margin, rule)
    inner = inner_of(mechanism)
    start = expand(lambda q: inner.forward_kinematics(q), joints, margin, "pose", worst=_START)
    made = InverseMachine(mechanism, identified, effects, rule, start)
    made.newton = max(one.steps_needed(joints, MOST_NEWTON) for one in made._closed)
    return made


def _refuse_redundant(mechanism: Mechanism) -> None:
    """Raise `MethodFailedError` for a machine whose drives do not fit each other but where a pose is: cables, say."""
    n, p = len(mechanism.joints), len(mechanism.pose)
    # One that says itself where its joints take it has joints to choose from, and none that do not fit.
    says_itself = type(inner_of(mechanism)).forward_kinematics is not Mechanism.forward_kinematics
    if n > p and not says_itself and _closed_form_of(mechanism) is None:
        raise MethodFailedError(
            f"{mechanism.name} has {n} joints and {p} pose coordinates, and no model file holds such a machine: take "
            "the commanded pose for its joints, and let `closure` say where the drives then hold it"
        )


def _closed_form_of(mechanism: Mechanism) -> str | None:
    """Which direction of a machine a command can take: that of the machine inside, where it is seen through frames."""
    if isinstance(mechanism, SerialArm):
        return "forward"
    if not isinstance(mechanism, Framed) or mechanism.grouped:
        return mechanism.closed_form
    inner = mechanism.mechanism
    turns = inner.frame(inner.home_pose)[1] is not None
    # Out of the plane, say, a frame may differ as no pose coordinate does.
    fits = not turns if inner.closed_form == "forward" else len(inner.pose) == 6
    return inner.closed_form if fits else None
