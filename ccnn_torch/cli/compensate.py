"""`ccnn compensate`: correct a table of joints or poses with a model file."""

from __future__ import annotations

import os
import warnings
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ccnn_torch.errors import FallbackWarning, InputError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray
    from torch import Tensor

    from ccnn_torch.compensation import IdentifiedGeometry, LoadedModel
    from ccnn_torch.mechanisms import Mechanism
    from ccnn_torch.records import Table

    Model = LoadedModel | IdentifiedGeometry
    Array = NDArray[np.float64]

# Largest pose error of the nominal machine at the joints found [m, rad].
_CLOSE = 1e-8
# Initial guesses solved at once where that of the previous row does not converge.
_STARTS = 64


def compensate(
    model: Annotated[Path, typer.Argument(help=".safetensors, .onnx, identified.yaml or identified_motion.json.")],
    input: Annotated[Path, typer.Argument(metavar="IN.csv", help="Ideal joints; columns are name[unit].")],
    output: Annotated[Path, typer.Argument(metavar="OUT.csv", help="IN's columns and the commands.")],
    pose: Annotated[bool, typer.Option("--pose", help="IN has wanted poses instead of joints.")] = False,
    back: Annotated[bool, typer.Option("--back", help="IN has commands; OUT gets the ideal joints.")] = False,
    sd: Annotated[bool, typer.Option("--sd", help="OUT gets the deviations' standard deviations, too.")] = False,
    public_key: Annotated[
        Path | None, typer.Option("--public-key", metavar="PUBLIC.pem", help="Take only a model signed by this key.")
    ] = None,
    allow_code: Annotated[
        bool, typer.Option("--allow-code", help="Run the Python file that the model names as its mechanism.")
    ] = False,
    quiet: Annotated[bool, typer.Option("--quiet", help="Print nothing.")] = False,
) -> None:
    """Correct joints so that the machine reaches the intended pose; or, with --back, convert commands to ideal joints.

    Headers that the model's run mapped by `columns` are mapped again.

    OUT.csv repeats the columns of IN.csv and adds command_q1[unit]…, deviation_q1[unit]… and inside_domain[1] (0 =
    outside the model's domain, where the correction tends to its safe value). With --back it adds ideal_q1[unit]…
    and inside_domain[1]; the commands are the columns command_q1… where IN.csv has them, else q1…. With --pose a
    serial arm takes the branch of guess_q1[unit]… where given, else that of the previous row. With --sd it also adds
    deviation_sd_q1[unit]…: inside the domain, about 95 % of new measurements are within 1.96 times it of the predicted
    deviation. With identified.yaml, which ccnn identify writes, the commands are those of the identified kinematics.

    With identified_motion.json, which ccnn diagnose --motion writes, IN.csv has time[s] and command1[unit]…, the
    motion that is wanted, and OUT.csv gets corrected1[unit]…, the commands at which the machine follows it, and
    predicted1[unit]…, where it then goes.

    Every row is checked against the limits in the model's card. Where the model violates them (a number that is not
    finite, a deviation above the limit), the row has command = joints and inside_domain = 0, and the exit code is 2.

    Examples:

    ccnn compensate checkpoints/tripod/model.onnx joints.csv commands.csv

    ccnn compensate runs/ur10/model.safetensors poses.csv commands.csv --pose

    ccnn compensate checkpoints/tripod/model.onnx commands.csv ideal.csv --back

    ccnn compensate checkpoints/tripod/model.onnx joints.csv commands.csv --sd

    ccnn compensate runs/five_bar/identified.yaml poses.csv commands.csv --pose

    ccnn compensate runs/axis/identified_motion.json motion.csv commands.csv

    ccnn compensate from_a_stranger/model.onnx joints.csv commands.csv --public-key theirs.public.pem
    """
    if pose and back:
        raise InputError("--pose and --back exclude each other: --pose takes wanted poses, --back takes commands")
    if sd and back:
        raise InputError(
            "--sd and --back exclude each other: --sd gives the standard deviation of a command, --back takes commands"
        )
    for file, what in ((input, "IN.csv"), (model, "the model")):
        if os.path.realpath(output) == os.path.realpath(file):
            raise InputError(f"{output}: OUT.csv is {what} itself, which would be overwritten; name another file")
    from ccnn_torch.motion.identified import is_identified

    if is_identified(model):
        if pose or back or sd or public_key:
            raise InputError(f"{model}: a model of a motion takes none of --pose, --back, --sd and --public-key")
        _motion(model, input, output, allow_code, quiet)
        return
    import numpy as np

    from ccnn_torch.compensation import load_compensation
    from ccnn_torch.records import name_lines, read_table, stack_columns, write_table
    from ccnn_torch.records.headers import columns_there
    from ccnn_torch.report.screen import say

    loaded = load_compensation(model, public_key=public_key, allow_code=allow_code)
    original = read_table(input)
    # Headers that the model's run mapped are mapped alike; OUT repeats them as they are.
    columns = columns_there(original.units, loaded.columns)
    table = read_table(input, columns) if columns else original
    mechanism = _mechanism_of(loaded, allow_code) if pose else None
    if mechanism is not None:
        joints, units = _joints_of_poses(loaded, mechanism, table), {c.name: c.unit for c in loaded.joints}
    else:
        joints, units = _joints(loaded, table, back)
    covariates = stack_columns(table, loaded.covariates) if loaded.covariates else None
    with warnings.catch_warnings():
        # Reported at the end, with the line of the table.
        warnings.simplefilter("ignore", FallbackWarning)
        found = loaded(joints, covariates)
    if back:
        added = _named("ideal", loaded, found["ideal"], units)
        inside = found["ideal_inside_domain"]
    else:
        added = _named("command", loaded, found["command"], units)
        added |= _named("deviation", loaded, found["deviation"], units)
        inside = found["inside_domain"]
    added["inside_domain[1]"] = inside.astype(float)
    if sd:
        if "deviation_sd" not in found:
            raise InputError(f"--sd: {model} is identified geometry, which has no standard deviation of a command")
        added |= _named("deviation_sd", loaded, found["deviation_sd"], units)
    names = {header.partition("[")[0] for header in added}
    kept = {original.header(name): original.raw(name) for name in original.names if name not in names}
    write_table(output, kept | added)
    if not quiet:
        _report(output, inside, trained=bool(loaded.covariates) or "deviation_sd" in found)
        if mechanism is not None and _chooses_branch(loaded, mechanism, table):
            say(
                "An arm reaches a pose on several branches (elbow, wrist): these are the joints nearest to those of "
                "the previous row, and may be on another branch than intended; give "
                f"{_guess_headers(loaded)} near the joints wanted."
            )
    bad = np.flatnonzero(found["fallback"])
    if len(bad):
        raise InputError(
            f"{output}: in {len(bad)} of {len(joints)} rows, the first from {name_lines(table.lines, bad[:1])} of "
            f"{input}, {model} violates the limits in its card (finite numbers, |deviation| within the limit); they "
            "were written without any correction and with inside_domain = 0: do not use this model"
        )


def _motion(model: Path, input: Path, output: Path, allow_code: bool, quiet: bool) -> None:
    from ccnn_torch.motion.compensate import compensate_motion
    from ccnn_torch.report.screen import say

    for sentence in compensate_motion(model, input, output, allow_code):
        if not quiet:
            say(f"{sentence}.")


def _mechanism_of(loaded: Model, allow_code: bool) -> Mechanism:
    """The mechanism that the model was made for."""
    from ccnn_torch.mechanisms import mechanism_from_description
    from ccnn_torch.plugins import code_refused

    with code_refused(f"{loaded.path}: its mechanism", allow_code):
        return mechanism_from_description(loaded.facts["mechanism"], allow_code=True)


def _joints(loaded: Model, table: Table, back: bool) -> tuple[Array, dict[str, str]]:
    """Joints `rows x n` [SI], and the unit of each as written."""
    from ccnn_torch.coordinates import Coordinate
    from ccnn_torch.records import JOINT_LIMIT, stack_columns

    names = {c.name: c.name for c in loaded.joints}
    if back and all(f"command_{name}" in table for name in names):
        names = {name: f"command_{name}" for name in names}
    _refuse_other_machine(loaded, table)
    columns = tuple(Coordinate(names[c.name], c.unit) for c in loaded.joints)
    return stack_columns(table, columns, JOINT_LIMIT), {c.name: table.units[names[c.name]] for c in loaded.joints}


def _refuse_other_machine(loaded: Model, table: Table) -> None:
    """Raise `InputError` for a file with more joints than the model; a missing one is reported when it is read."""
    known = {c.name for c in loaded.joints}
    other = [name for name in table.names if name[:1] == "q" and name[1:].isdigit() and name not in known]
    if other:
        mechanism = loaded.facts["mechanism"]["name"]
        raise InputError(
            f"{table.path}: column '{other[0]}' is no joint of this model, which was made for {mechanism} "
            f"({', '.join(c.header for c in loaded.joints)}); take the model of the other machine, or rename the column"
        )


def _joints_of_poses(loaded: Model, mechanism: Mechanism, table: Table) -> Array:
    """Ideal joints of wanted poses on the mechanism that the model was made for, `rows x n` [SI].

    Raises:
        InputError: a column is missing, or poses cannot be reached (named by line).
    """
    import numpy as np
    import torch

    from ccnn_torch.coordinates import Coordinate
    from ccnn_torch.records import JOINT_LIMIT, name_lines, read_pose, stack_columns

    values, coordinates, *_ = read_pose(table, mechanism)
    if len(coordinates) != len(mechanism.pose):
        missing = [c.header for c in mechanism.pose if c.name not in {k.name for k in coordinates}]
        raise InputError(f"{table.path}: the poses of {mechanism.name} need the columns {', '.join(missing)}, too")
    poses = torch.from_numpy(values)
    guess = torch.from_numpy(loaded.middle)
    guesses = tuple(Coordinate(f"guess_{c.name}", c.unit) for c in mechanism.joints)
    guided = any(c.name in table for c in guesses)
    if guided:
        guess = torch.from_numpy(stack_columns(table, guesses, JOINT_LIMIT))
    follow = bool(mechanism.orientations) and not guided
    joints = _follow(mechanism, poses, guess) if follow else mechanism.solve_inverse(poses, guess=guess)
    # Of all full turns of a revolute joint the one nearest to the guess, or to the middle of the model's domain.
    turning = torch.tensor([c.unit == "rad" for c in mechanism.joints])
    joints = joints - torch.where(turning, 2 * torch.pi * torch.round((joints - guess) / (2 * torch.pi)), 0.0)
    lost = np.flatnonzero(~_reached(mechanism, joints, poses).numpy())
    if len(lost):
        raise InputError(
            f"{table.path}: no joints of {mechanism.name} were found for the pose at {name_lines(table.lines, lost)}; "
            f"correct or remove it, or give guess_q1[{mechanism.joints[0].unit}]… near the solution"
        )
    return joints.detach().numpy()


def _chooses_branch(loaded: Model, mechanism: Mechanism, table: Table) -> bool:
    """Whether joints of poses were found without a given branch, where there are several."""
    return bool(mechanism.orientations) and not any(f"guess_{c.name}" in table for c in loaded.joints)


def _guess_headers(loaded: Model) -> str:
    first, last = loaded.joints[0], loaded.joints[-1]
    return f"guess_{first.header} to guess_{last.header}"


def _follow(mechanism: Mechanism, poses: Tensor, guess: Tensor) -> Tensor:
    """Joints of successive poses, each on the branch of the previous row, the first on that of the guess.

    Where that branch has no solution, take the one nearest to the previous row, out of many initial guesses.
    """
    import torch

    starts = mechanism.sample_joints(_STARTS, torch.Generator().manual_seed(0))
    rows = []
    for pose in poses:
        joints = mechanism.solve_inverse(pose, guess=guess)
        if not bool(_reached(mechanism, joints, pose)):
            found = mechanism.solve_inverse(pose.expand(_STARTS, -1), guess=starts)
            distance = mechanism.wrap(found - guess).norm(dim=-1)
            good = _reached(mechanism, found, pose.expand(_STARTS, -1))
            joints = found[torch.where(good, distance, torch.inf).argmin()]
        rows.append(joints)
        guess = torch.where(_reached(mechanism, joints, pose), joints, guess)
    return torch.stack(rows)


def _reached(mechanism: Mechanism, joints: Tensor, poses: Tensor) -> Tensor:
    """Whether joints bring the nominal machine to the poses, `...`; an arm's solver stops at the nearest one."""
    error = mechanism.pose_error(mechanism.forward_kinematics(joints, guess=poses), poses)
    # A comparison with NaN is false, so a pose without joints is not reached either.
    reached = error.position < _CLOSE
    return reached if error.rotation is None else reached & (error.rotation < _CLOSE)


def _named(what: str, loaded: Model, values: Array, units: dict[str, str]) -> dict[str, Array]:
    """Columns `what_joint[unit]` in the units that the joints were written in."""
    from ccnn_torch.units import from_si

    return {
        f"{what}_{c.name}[{units[c.name]}]": from_si(values[:, k], c.unit, units[c.name])
        for k, c in enumerate(loaded.joints)
    }


def _report(output: Path, inside: NDArray[Any], trained: bool) -> None:
    from ccnn_torch.report.screen import say

    outside = len(inside) - int(inside.sum())
    say(f"{output}: {len(inside)} rows written.")
    if outside:
        what = (
            "outside the domain that the model was trained on" if trained else "out of the identified machine's reach"
        )
        then = (
            "their correction fades into the safe one, the mean training deviation"
            if trained
            else "their joints are as they were"
        )
        say(f"{outside} of them {'is' if outside == 1 else 'are'} {what} (inside_domain = 0): {then}.")
