"""Predicted deviations of a trained method, and the pose error before and after its commands."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from ccnn_torch.calibration.fitting import Fitted
from ccnn_torch.calibration.prepare import Prepared
from ccnn_torch.compensation import Compensator
from ccnn_torch.errors import MethodFailedError
from ccnn_torch.mechanisms import Instrument, PoseError, Seen
from ccnn_torch.mechanisms.frames.partial import completed
from ccnn_torch.numerics.rotations import matrix_to_rotation_vector, rotation_vector_to_matrix
from ccnn_torch.records.commanded import SECOND

# The fixed point q = q* - δ(q) gains a factor of the Lipschitz constant of δ each time, about 1e-3 for real machines.
_COMMAND_ITERATIONS = 8


@dataclass(frozen=True)
class Outcome:
    """A method's figures on every row of every repeat; which rows are held out is for the reader to choose.

    Attributes:
        deviation: predicted deviation at the commanded joints, `r x s x n` [SI]; of what the identified machine leaves
            where that is a part of the compensator.
        score: what repeats and methods are compared by, lower is better, `r`: that of the training where it held rows
            out, else the mean squared standardised error on the test rows.
        explained: pose error that the model leaves of the poses at the joints as they were commanded, `r x s`.
        after: pose error under the commands of the compensator, `r x s`; what is explained where there is none.
        after_systematic: the same without the machine's noise, where it is simulated.
        compensators: of every repeat of measured records; () of a simulated machine, and where `without` says why
            there is none.
        damped: share of the rows at which the command is damped near a singular pose or at a limit [1].
        left: position and rotation vector of `after`, `r x s x c` [m, rad]; None of a simulated machine.
    """

    fitted: Fitted
    deviation: Tensor
    score: Tensor
    explained: PoseError
    after: PoseError
    after_systematic: PoseError | None = None
    compensators: tuple[Compensator, ...] = ()
    without: str = ""
    damped: float = 0.0
    left: Tensor | None = None


def pose_before(prepared: Prepared) -> PoseError:
    """Pose error without compensation, `r x s`.

    Simulated: the pose reached under the ideal joints against the ideal pose. Recorded: the pose measured against the
    nominal machine's, fitted frames included.
    """
    if prepared.simulation is not None:
        return prepared.simulation.pose_errors(prepared.joints)[0]
    return prepared.mechanism.pose_error(prepared.pose, _nominal(prepared))


def place_and_error(prepared: Prepared, repeat: int) -> tuple[Tensor, Tensor]:
    """Measured position, and its difference from the nominal machine's, `s x 3` [m] each."""
    place, nominal = (prepared.mechanism.frame(pose[repeat])[0] for pose in (prepared.pose, _nominal(prepared)))
    return place, place - nominal


def _nominal(prepared: Prepared) -> Tensor:
    """Poses of the nominal machine, fitted frames included, `r x s x p`."""
    return prepared.mechanism.forward_kinematics(prepared.joints, prepared.parameters, _given(prepared))


def pose_with_geometry(prepared: Prepared) -> PoseError | None:
    """Pose error that geometric calibration alone leaves, `r x s`; None where no geometry was fitted."""
    if prepared.identified is None:
        return None
    reached = prepared.mechanism.forward_kinematics(prepared.joints, prepared.identified, _given(prepared))
    return prepared.mechanism.pose_error(prepared.pose, reached)


def evaluate(prepared: Prepared, fitted: Fitted, make: Callable[[int], Compensator]) -> Outcome:
    """Predict on every row, and find the pose error that is left.

    Simulated: the machine is commanded q with q + δ(q) = q*, and the pose that it then reaches is solved.
    Recorded: the commanded joints are taken as ideal ones. Their command c, by the compensator as it is written,
    brings the model to f(c), and what the model leaves of the measured pose at the joints themselves is added:
    |f(c) - wanted + (measured - f(q))|.

    Args:
        make: the compensator of a repeat.
    """
    joints = prepared.joints
    deviation = fitted.predict(torch.cat([joints, prepared.covariates], -1))
    score = fitted.score if fitted.choice is not None else _test_score(prepared, fitted, deviation)
    if prepared.simulation is None:
        return _of_records(prepared, fitted, deviation, score, make)
    command = joints
    for _ in range(_COMMAND_ITERATIONS):
        command = joints - fitted.predict(torch.cat([command, prepared.covariates], -1))
    after, systematic = prepared.simulation.pose_errors(command)
    return Outcome(fitted, deviation, score, after, after, systematic)


def _test_score(prepared: Prepared, fitted: Fitted, deviation: Tensor) -> Tensor:
    """Mean squared standardised error on the usable test rows, `r`."""
    rows = prepared.dataset.usable_rows("test")
    apart = rows.take(deviation) - rows.take(prepared.dataset.deviation)
    square = (apart / fitted.scaling.deviation.unsqueeze(1)).square().mean(-1)
    return (square * rows.weights).sum(1) / rows.weights.sum(1)


def _of_records(
    prepared: Prepared, fitted: Fitted, deviation: Tensor, score: Tensor, make: Callable[[int], Compensator]
) -> Outcome:
    repeats, found, without = range(len(prepared.joints)), list[Compensator](), ""
    try:
        found = [make(repeat) for repeat in repeats]
    except MethodFailedError as reason:
        found, without = [], str(reason)
    left, reached, damped = [], [], 0.0
    for k in repeats:
        joints, measured = prepared.joints[k], _vectors(prepared, prepared.pose[k])
        visited = zip(_places(prepared, k), ("", SECOND), strict=False)
        places = [(q, _covariates(prepared, k, found, ending)) for q, ending in visited]
        with torch.no_grad():
            learned = [q + (found[k].learned(q, c) if found else deviation[k]) for q, c in places]
        rest = _apart(prepared, measured, _model(prepared, k, *learned))
        left.append(rest)
        if not found:
            reached.append(rest)
            continue
        with torch.no_grad():
            solved = [found[k].solve(q, c) for q, c in places]
            moved = [s.command + found[k].learned(s.command, c) for s, (_, c) in zip(solved, places, strict=True)]
        given = _given(prepared)
        about = (_wanted(prepared, k), None if given is None else given[k])
        nominal = prepared.mechanism.forward_kinematics(joints, *about)
        wanted = _vectors(prepared, nominal)
        reached.append(_apart(prepared, _model(prepared, k, *moved), wanted) + rest)
        damped += float((solved[0].status == 3).double().mean()) / len(prepared.joints)
    whole = torch.stack(reached)
    explained, after = (_error(prepared, each) for each in (torch.stack(left), whole))
    return Outcome(fitted, deviation, score, explained, after, None, tuple(found), without, damped, whole)


def pose_with_effects(prepared: Prepared) -> PoseError | None:
    """Pose error that known effects leave by themselves, with the geometry beside them, `r x s`; None without them."""
    if prepared.physics is None or not prepared.physics.source:
        return None
    rows = [
        _apart(prepared, _vectors(prepared, prepared.pose[k]), _model(prepared, k, *_places(prepared, k)))
        for k in range(len(prepared.joints))
    ]
    return _error(prepared, torch.stack(rows))


def _parameters(prepared: Prepared, repeat: int) -> Tensor | None:
    """Of the nominal machine in one repeat, frames fitted, `1 x k` or `s x k`."""
    return None if prepared.parameters is None else prepared.parameters[repeat]


def _given(prepared: Prepared) -> Tensor | None:
    """The rows where they say what an instrument was pointed at, `r x s x p`."""
    return prepared.pose if prepared.mechanism.compared < prepared.pose.shape[-1] else None


def _wanted(prepared: Prepared, repeat: int) -> Tensor | None:
    """The same as the model's instrument shows it, in its set-up: a focal length is no error of the machine."""
    nominal, mechanism = _parameters(prepared, repeat), prepared.mechanism
    if nominal is None or prepared.physics is None:
        return nominal
    if mechanism.grouped:
        # A file of such a machine is in its own base, whatever the groups differ in.
        of_set_ups = ("base_", *("tool_",) * bool(mechanism.tool_per))
        own = torch.tensor([p.name.startswith(of_set_ups) for p in mechanism.geometry])
        return torch.where(own, prepared.physics.values[repeat], nominal)
    if not isinstance(mechanism, Seen):
        return nominal
    inner = len(mechanism.mechanism.geometry)
    own = prepared.physics.values[repeat, :, inner:]
    return torch.cat([nominal[..., :inner], own.expand(*nominal.shape[:-1], -1)], -1)


def _places(prepared: Prepared, repeat: int) -> list[Tensor]:
    """Joints of each place that the rows are of, `s x n` each."""
    return prepared.mechanism.places(prepared.joints[repeat], prepared.pose[repeat])


def _covariates(prepared: Prepared, repeat: int, found: Sequence[Compensator], ending: str) -> Tensor:
    """What the compensator asks for in one of the places, all without one, `s x m`; ending: of that place's columns."""
    names = [c.name for c in prepared.covariate_coordinates]
    asked = [c.name for c in found[repeat].covariates] if found else names
    columns = [names.index(f"{n}{ending}" if f"{n}{ending}" in names else n) for n in asked]
    return prepared.covariates[repeat][:, columns]


def _model(prepared: Prepared, repeat: int, moved: Tensor, *second: Tensor) -> Tensor:
    """Frame of the model's pose at command and what was learned there, `s x n`, as `_vectors`; second: likewise."""
    if prepared.physics is not None:
        return prepared.physics.frames(repeat, moved, *second)
    guess = completed(prepared.mechanism, moved, prepared.pose[repeat], _parameters(prepared, repeat))
    if second:
        assert isinstance(prepared.mechanism, Instrument)
        guess = prepared.mechanism.with_second(guess, second[0])
    return _vectors(prepared, prepared.mechanism.forward_kinematics(moved, _parameters(prepared, repeat), guess))


def _vectors(prepared: Prepared, pose: Tensor) -> Tensor:
    """Position and rotation vector of the frame of poses, `s x c`."""
    position, rotation = prepared.mechanism.frame(pose)
    return position if rotation is None else torch.cat([position, matrix_to_rotation_vector(rotation)], -1)


def _apart(prepared: Prepared, there: Tensor, here: Tensor) -> Tensor:
    """From one frame to another, `s x c`: difference of the positions, and the rotation vector between them."""
    if prepared.mechanism.frame(prepared.mechanism.home_pose)[1] is None:
        return there - here
    first, last = (rotation_vector_to_matrix(v[..., -3:]) for v in (here, there))
    return torch.cat([there[..., :-3] - here[..., :-3], matrix_to_rotation_vector(last @ first.mT)], -1)


def _error(prepared: Prepared, apart: Tensor) -> PoseError:
    """Of what was measured; NaN where nothing of the kind was."""
    turns = torch.tensor([c.unit == "rad" for c in prepared.mechanism.channels])
    parts = [apart[..., ~turns], *([apart[..., turns]] if bool(turns.any()) else [])]
    sizes = [torch.where(p.isnan().all(-1), torch.nan, p.nan_to_num().norm(dim=-1)) for p in parts]
    return PoseError(sizes[0], sizes[1] if len(sizes) == 2 else None)
