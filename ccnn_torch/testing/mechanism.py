"""Conformance checks of a mechanism. See `ccnn_torch.mechanisms.Mechanism`."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence

import torch
from torch import Tensor
from torch.autograd.gradcheck import GradcheckError, gradcheck

from ccnn_torch.mechanisms import Mechanism, mechanism_from_description
from ccnn_torch.mechanisms.registry import jump_sentence, wrong_names
from ccnn_torch.numerics.rotations import vee

_BATCHES: tuple[tuple[int, ...], ...] = ((), (2,), (2, 3))
# A root is settled to about 1e-12; a pose closes to this [m, rad].
_CLOSES = 1e-8
_STEP = 1e-5
_SLOPE_TOLERANCE = 2e-5
# Near singular configurations, differences do not approximate the derivative.
_REGULAR = 200.0


_ARGUMENT = ("joints", "pose", "parameters")
_Call = Callable[[Tensor, Tensor, Tensor | None], Tensor]


def check_mechanism(mechanism: Mechanism, seed: int = 0) -> None:
    """Check names and units, the branch of a numeric inverse, IK∘FK, derivatives, batch shapes, hooks, the description.

    Numeric inverse kinematics are compared with a path from home in small steps, which must end on the same branch.

    Args:
        mechanism: any `Mechanism`, at its nominal parameters.
        seed: of the test configurations.

    Raises:
        AssertionError: one sentence that names the mistake.
    """
    _check_names(mechanism)
    jump = jump_sentence(mechanism, seed)
    _require(not jump, mechanism, jump)
    joints, pose = _configurations(mechanism, seed)
    _check_round_trip(mechanism, joints, pose)
    _check_batches(mechanism, joints, pose)
    _check_derivatives(mechanism, joints, pose)
    _check_hooks(mechanism, joints, pose)
    _check_description(mechanism, joints, pose)


def _require(fine: bool, m: Mechanism, sentence: str) -> None:
    if not fine:
        raise AssertionError(f"mechanism '{m.name}': {sentence}")


def _check_names(m: Mechanism) -> None:
    _require(bool(m.name), m, "has no name")
    wrong = wrong_names(m)
    _require(not wrong, m, wrong)
    for name, buffer, count in (("nominal", m.nominal, len(m.geometry)), ("low", m.low, len(m.pose))):
        _require(buffer.shape == (count,), m, f"{name} has shape {tuple(buffer.shape)}, expected ({count},)")
        _require(buffer.dtype == torch.float64, m, f"{name} is {buffer.dtype}, expected torch.float64")


def _configurations(m: Mechanism, seed: int) -> tuple[Tensor, Tensor]:
    """Six regular configurations, `6 x n` and `6 x p`."""
    generator = torch.Generator().manual_seed(seed)
    joints = m.sample_joints(64, generator)
    again = m.sample_joints(64, torch.Generator().manual_seed(seed))
    _require(torch.equal(joints, again), m, "sample_joints depends on more than its generator")
    _require(bool(torch.isfinite(joints).all()), m, "sample_workspace gives poses that have no joints")
    joints = joints[m.condition_number(joints) < _REGULAR][:6]
    _require(len(joints) == 6, m, "nearly all its sampled configurations are singular, or its forward map fails there")
    pose = m.forward_kinematics(joints)
    _require(bool(torch.isfinite(pose).all()), m, "forward_kinematics gives no pose for joints of a reachable pose")
    _require(bool(m.reachable(pose).all()), m, "reachable() denies poses that its own joints reach")
    return joints, pose


def _pose_gap(m: Mechanism, first: Tensor, second: Tensor) -> float:
    error = m.pose_error(first, second)
    return max(float(e.max()) for e in error if e is not None)


def _check_round_trip(m: Mechanism, joints: Tensor, pose: Tensor) -> None:
    _require(pose.shape == (len(joints), len(m.pose)), m, f"forward_kinematics has shape {tuple(pose.shape)}")
    near = joints + 1e-3
    back = m.solve_inverse(pose, guess=near)
    gap = _pose_gap(m, pose, m.forward_kinematics(back, guess=pose))
    _require(gap <= _CLOSES, m, f"forward_kinematics(solve_inverse(pose)) has a pose error of {gap:.2g}")
    closed = float(m.closure(pose, back).abs().max())
    _require(closed <= _CLOSES, m, f"closure(pose, solve_inverse(pose)) is {closed:.2g}, expected 0")
    if len(m.joints) <= len(m.pose):
        off = float(m.wrap(back - joints).abs().max())
        _require(
            off <= _CLOSES * _REGULAR, m, f"solve_inverse(forward_kinematics(joints)) has a joint error of {off:.2g}"
        )
    off_closure = float(m.closure(pose, near).abs().max())
    _require(off_closure > _CLOSES, m, "closure is 0 for joints that do not belong to the pose")


def _calls(m: Mechanism) -> dict[str, _Call]:
    """Functions of joints, pose and parameters, by name.

    The forward map is compared by `frame`: a rotation vector jumps at half a turn, the frame does not.
    """

    def placed(q: Tensor, x: Tensor, k: Tensor | None) -> Tensor:
        position, rotation = m.frame(m.forward_kinematics(q, k, x))
        return position if rotation is None else torch.cat([position, rotation.flatten(-2)], dim=-1)

    return {
        "solve_inverse": lambda q, x, k: m.solve_inverse(x, k, q),
        "forward_kinematics": placed,
        "closure": lambda q, x, k: m.closure(x, q, k),
        "jacobian": lambda q, x, k: m.jacobian(q, k, x).flatten(-2),
    }


def _check_batches(m: Mechanism, joints: Tensor, pose: Tensor) -> None:
    """Every leading shape, of configurations and of parameters, gives what single calls give."""
    for name, call in _calls(m).items():
        single = torch.stack([call(q, x, None) for q, x in zip(joints, pose, strict=True)])
        _require(single.dtype == torch.float64, m, f"{name} returns {single.dtype}, expected torch.float64")
        for lead in _BATCHES:
            count = 1 if not lead else int(torch.tensor(lead).prod())
            q, x = joints[:count].reshape(*lead, -1), pose[:count].reshape(*lead, -1)
            got = call(q, x, None)
            expected = single[:count].reshape(*lead, -1)
            _require(got.shape == expected.shape, m, f"{name} of batch shape {lead} has shape {tuple(got.shape)}")
            _close(m, got, expected, f"{name} of batch shape {lead} differs from single calls")
        if len(m.geometry):
            factors = torch.tensor([1.0, 1.0 + 1e-4], dtype=torch.float64)[:, None, None]
            sets = m.nominal * factors
            got = call(joints, pose, sets)
            expected = torch.stack([call(joints, pose, s) for s in sets[:, 0]])
            shapes = f"{tuple(sets.shape)} with {len(joints)} rows"
            _require(got.shape == expected.shape, m, f"{name} of parameters {shapes} has shape {tuple(got.shape)}")
            _close(m, got, expected, f"{name} of parameters {shapes} differs from one set at a time")


def _close(m: Mechanism, got: Tensor, expected: Tensor, sentence: str) -> None:
    gap = float((got - expected).abs().max())
    _require(gap <= _CLOSES, m, f"{sentence} by {gap:.2g}")


def _check_derivatives(m: Mechanism, joints: Tensor, pose: Tensor) -> None:
    """Reverse-mode derivatives, and the Jacobians, against central differences."""
    # solve_inverse of a redundant arm stays at the guess's side, whose derivative Newton's last step does not see.
    arguments = {"solve_inverse": (1, 2), "forward_kinematics": (0, 2), "closure": (0, 1, 2)}
    if len(m.joints) > len(m.pose):
        del arguments["solve_inverse"]
    for name, places in arguments.items():
        call = _calls(m)[name]
        for place in places:
            point = [joints, pose, m.nominal.expand(len(joints), -1).clone()]
            if point[place].shape[-1] == 0:
                continue
            point[place].requires_grad_()
            what = f"{name} is not differentiable in its {_ARGUMENT[place]}"
            _require(call(*point).requires_grad, m, what)
            try:
                gradcheck(call, point, eps=_STEP, atol=_SLOPE_TOLERANCE, rtol=_SLOPE_TOLERANCE, fast_mode=True)
            except GradcheckError as reason:
                raise AssertionError(f"mechanism '{m.name}': {what} as differences are: {reason}") from None
            point[place].requires_grad_(False)
    _check_jacobians(m, joints, pose)


def _check_jacobians(m: Mechanism, joints: Tensor, pose: Tensor) -> None:
    """By the joints and by the parameters, against central differences of the forward kinematics; the frame's by the
    pose."""

    def by_joints(steps: Tensor) -> Tensor:
        return m.forward_kinematics(joints + steps, guess=pose.expand(len(steps), -1, -1))

    def by_parameters(steps: Tensor) -> Tensor:
        return m.forward_kinematics(joints, m.nominal + steps, guess=pose)

    found = {"jacobian": m.jacobian(joints, guess=pose), "jacobian_at": m.jacobian_at(pose, joints)}
    _check_slopes(m, found, by_joints, [f"joint {j.name}" for j in m.joints])
    if len(m.geometry):
        along = [f"parameter {g.name}" for g in m.geometry]
        found = {
            "parameter_jacobian": m.parameter_jacobian(joints, guess=pose),
            "parameter_jacobian_at": m.parameter_jacobian_at(pose, joints),
        }
        _check_slopes(m, found, by_parameters, along)
    along = [f"pose coordinate {c.name}" for c in m.pose]
    _check_slopes(m, {"frame_slope": m.frame_slope(pose)}, lambda steps: pose + steps, along)


def _check_slopes(
    m: Mechanism, found: dict[str, Tensor], pose_at: Callable[[Tensor], Tensor], along: Sequence[str]
) -> None:
    """found: slopes `s x c x k` by the name of what returned them; pose_at: poses `k x s x p` at steps `k x 1 x k`;
    along: names of the k."""
    steps = _STEP * torch.eye(len(along), dtype=torch.float64)[:, None]
    ahead, behind = m.frame(pose_at(steps)), m.frame(pose_at(-steps))
    wanted = (ahead[0] - behind[0]) / (2 * _STEP)
    if ahead[1] is not None and behind[1] is not None:
        wanted = torch.cat([wanted, vee(ahead[1] @ behind[1].mT) / (2 * _STEP)], dim=-1)
    wanted = wanted.movedim(0, -1)
    for name, slopes in found.items():
        _require(slopes.shape == wanted.shape, m, f"{name} has shape {tuple(slopes.shape)}, not {tuple(wanted.shape)}")
        gaps = ((slopes - wanted).abs() / (1 + wanted.abs())).amax((0, 1)).tolist()
        for gap, what in zip(gaps, along, strict=True):
            _require(gap <= _SLOPE_TOLERANCE, m, f"{name} is off by {gap:.2g} for {what}")


def _check_hooks(m: Mechanism, joints: Tensor, pose: Tensor) -> None:
    """A hook fires on `mechanism.inverse_kinematics`, sees the covariates, and never touches the plain functions."""
    plain = m.solve_inverse(pose, guess=joints)
    seen: list[object] = []

    def hook(module: object, args: object, kwargs: dict[str, object], output: Tensor) -> Tensor:
        seen.append(kwargs.get("covariates"))
        return output + 1.0

    covariates = torch.zeros(len(joints), 1, dtype=torch.float64)
    handle = m.inverse_kinematics.register_forward_hook(hook, with_kwargs=True)
    try:
        hooked = m.inverse_kinematics(pose, guess=joints, covariates=covariates)
        _require(len(seen) == 1, m, "a hook on inverse_kinematics does not fire exactly once per call")
        _require(seen[0] is covariates, m, "a hook on inverse_kinematics does not get the covariates keyword")
        _require(torch.equal(hooked, plain + 1.0), m, "inverse_kinematics does not return what its hook returns")
        m.solve_inverse(pose, guess=joints)
        m.forward_kinematics(joints)
        _require(len(seen) == 1, m, "solve_inverse or forward_kinematics goes through the hooked module")
    finally:
        handle.remove()
    _require(torch.equal(m.inverse_kinematics(pose, guess=joints), plain), m, "inverse_kinematics is not solve_inverse")


def _check_description(m: Mechanism, joints: Tensor, pose: Tensor) -> None:
    """The description survives JSON and gives the same mechanism, also with other nominal parameters."""
    other = m.with_nominal(m.nominal * (1.0 + 1e-4) + 1e-5)
    for original in (m, other):
        twin = mechanism_from_description(json.loads(json.dumps(original.describe())), allow_code=True)
        _require(torch.equal(twin.nominal, original.nominal), m, "parameters do not survive describe()")
        same = (twin.joints, twin.pose) == (original.joints, original.pose)
        _require(same and twin.name == original.name, m, "names do not survive describe()")
        first, second = (t.solve_inverse(pose, guess=joints) for t in (original, twin))
        _require(torch.equal(first, second), m, "the described mechanism gives other joints")
