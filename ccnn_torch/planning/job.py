"""From a config to the poses to measure, as a CSV file, a page, and the skeleton of a robot program."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ccnn_torch.config.sizes import prior_sizes, size, sizes_of_joints, sizes_of_pose
from ccnn_torch.coordinates import Coordinate
from ccnn_torch.errors import InputError
from ccnn_torch.files.write import make_folder, write_whole
from ccnn_torch.identification import ParameterChoice
from ccnn_torch.identification.problems.problem import Progress
from ccnn_torch.mechanisms import Mechanism, load_mechanism
from ccnn_torch.planning import Plan, plan_poses
from ccnn_torch.planning.config import PlanConfig
from ccnn_torch.planning.page import plan_page, plan_plot
from ccnn_torch.records import write_table
from ccnn_torch.records.commanded import SECOND
from ccnn_torch.records.joint_map import JointMap, read_joint_map
from ccnn_torch.report.figures import inline_svg, save_figure
from ccnn_torch.report.page import InlineFigure, Section
from ccnn_torch.units import from_si, split_header

Array = NDArray[np.float64]


def make_plan(
    mechanism: str | Mechanism, poses: int, config: PlanConfig | None = None, progress: Progress | None = None
) -> tuple[Mechanism, list[Plan]]:
    """Plan poses by a config.

    Args:
        mechanism: a name, a file, or a mechanism.
        poses: their number; with `per_leg` for each leg.
        config: defaults when None.
        progress: called with the share that is done.

    Raises:
        InputError: as `load_mechanism` and `plan_poses`; a size that is invalid, or of an unknown name.
    """
    config = config or PlanConfig.from_file(None)
    if poses < 1:
        raise InputError(f"--poses: plan at least 1 pose, not {poses}")
    machine = load_mechanism(mechanism, **config.mechanism_keys) if isinstance(mechanism, str) else mechanism
    if config.program is not None:
        # Refused before minutes are spent.
        program_text(config.program, "", np.zeros((0, len(machine.joints))), machine.joints)
    wanted = config.parameters
    prior = prior_sizes(wanted.prior, machine.geometry, "parameters.prior")
    plans = plan_poses(
        machine,
        poses,
        choice=ParameterChoice(wanted.free, wanted.fixed, wanted.tied, prior),
        pose_noise=_pose_noise(config, machine),
        joint_noise=_joint_noise(config, machine),
        residual=config.residual,
        candidates=config.candidates,
        limits=_limits(config, machine),
        max_condition=config.max_condition,
        rotation_weight=config.rotation_weight,
        per_leg=config.per_leg,
        repeat=config.repeat,
        least_gain=config.least_gain,
        margin=config.margin,
        seed=config.seed,
        progress=progress,
    )
    return machine, plans


def check_plan_file(path: Path) -> None:
    """Raise `InputError` where the name of the CSV does not end in .csv."""
    if path.suffix.lower() != ".csv":
        raise InputError(f"--out: '{path}' must end in .csv; the page and the picture are written beside it")


def write_plan(
    path: Path, mechanism: Mechanism, plans: list[Plan], least_gain: float, config: PlanConfig | None = None
) -> list[Path]:
    """Write the poses as CSV, and beside it a page (.html, .md) with its picture (.png, .svg).

    The CSV has a row for each pose: `leg[1]` where each leg has its own, the joints to command, and the pose at which
    they bring the nominal machine; the most informative rows come first. With a `joint_map` of the config the joints
    stand there as the controller counts them, too, as `command_q1[unit]` …. A `program` is written beside it.

    Returns:
        The files.

    Raises:
        InputError: the name does not end in .csv, or the folder cannot be written.
    """
    check_plan_file(path)
    columns = {}
    if plans[0].leg is not None:
        columns["leg[1]"] = torch.cat([torch.full((len(p.pose),), float(p.leg or 0)) for p in plans]).numpy()
    for coordinates, part in ((mechanism.joints, "joints"), (mechanism.pose, "pose")):
        values = torch.cat([getattr(plan, part) for plan in plans])
        columns |= {c.header: values[:, i].numpy() for i, c in enumerate(coordinates)}
    config = config or PlanConfig.from_file(None)
    counted = read_joint_map(config.joint_map, mechanism.joints, config.columns)
    places = []
    for ending in ("", SECOND):
        headers = [replace(joint, name=f"{joint.name}{ending}").header for joint in mechanism.joints]
        if headers[0] in columns:
            joints = np.stack([columns[header] for header in headers], -1)
            places.append(joints if counted is None else counted.shown(joints))
            columns |= {} if counted is None else _commands(places[-1], counted, mechanism, config, ending)
    program = None
    if config.program is not None:
        # The places of a row one after the other.
        every = np.stack(places, 1).reshape(-1, len(mechanism.joints))
        program, suffix = program_text(config.program, path.stem, every, mechanism.joints)
    make_folder(path.parent)
    write_table(path, columns)
    plot = plan_plot(mechanism.pose, plans, least_gain)
    svg, png = save_figure(plot.figure, path), path.with_suffix(".png")
    drawn = InlineFigure(plot.name, plot.caption, inline_svg(svg.read_text(encoding="utf-8"), plot.name))
    linked = Section(sentences=[f"![{plot.caption}]({png.name})", plot.caption])
    page, text = path.with_suffix(".html"), path.with_suffix(".md")
    write_whole(text, plan_page(mechanism.name, plans, least_gain, [linked]).markdown())
    drawn_page = plan_page(mechanism.name, plans, least_gain, [Section(figures=[drawn])])
    write_whole(page, drawn_page.html([path.name, text.name]))
    files = [path, page, text, png, svg]
    if program is not None:
        files.append(path.with_suffix(suffix))
        write_whole(files[-1], program)
    return files


def _commands(
    shown: Array, counted: JointMap, mechanism: Mechanism, config: PlanConfig, ending: str
) -> dict[str, Array]:
    """The joints as the controller counts them, `s x n` [SI], in the units of its columns; ending: of their names."""
    units = dict(split_header(target) for target in config.columns.values())
    found = {}
    for k, (joint, column) in enumerate(zip(mechanism.joints, counted.columns, strict=True)):
        unit = units.get(column) or joint.unit
        found[f"command_{joint.name}{ending}[{unit}]"] = from_si(shown[:, k], joint.unit, unit)
    return found


def _limits(config: PlanConfig, machine: Mechanism) -> dict[str, tuple[float, float]]:
    """Limits [SI]; a name that the machine does not have is refused where they are used."""
    units = {c.name: c.unit for c in (*machine.joints, *machine.pose)}
    found = {}
    for name, bounds in config.limits.items():
        low, high = (size(value, units.get(name), f"limits.{name}") for value in bounds)
        found[name] = (low, high)
    return found


def _pose_noise(config: PlanConfig, machine: Mechanism) -> Tensor:
    found = sizes_of_pose(config.noise, machine.pose, "noise")
    if not bool((found > 0).all()):
        raise InputError("noise: a standard deviation is above 0; write e.g. noise='0.1 mm'")
    return found


def _joint_noise(config: PlanConfig, machine: Mechanism) -> Tensor | None:
    """None where there is none."""
    found = sizes_of_joints(config.joint_noise, machine.joints, "joint_noise")
    if bool((found < 0).any()):
        raise InputError("joint_noise: a standard deviation is not negative; write e.g. joint_noise='0.01 deg', or 0")
    return found if bool((found > 0).any()) else None


# Seconds of rest before a reading.
_REST = 2.0
_MOST = 6


class _Language(NamedTuple):
    """Ending of its files, and what writes a program: name, joints `s x n` [deg, mm] of at most six -> text."""

    suffix: str
    text: Callable[[str, Array], str]


def program_text(language: str, name: str, joints: Array, coordinates: Sequence[Coordinate]) -> tuple[str, str]:
    """The program of a list of joints, and the ending of its file.

    Speeds are low, and nothing is known of obstacles: a person has to look at every move first.

    Args:
        language: `krl`, `rapid`, `urscript` or `gcode`.
        name: of the program; other characters than letters, digits and _ become _.
        joints: as the controller counts them, `s x n` [SI].
        coordinates: names and SI units of the joints, `n`.

    Raises:
        InputError: more joints than six, or for `urscript` another number than six joints that turn.
    """
    units = [c.unit for c in coordinates]
    if len(units) > _MOST or (language == "urscript" and units != ["rad"] * _MOST):
        takes = "six joints that turn" if language == "urscript" else "at most six joints"
        raise InputError(f"program: {language} takes {takes}, and the machine has {len(units)}; leave out the key")
    shown = [from_si(joints[:, k], unit, "deg" if unit == "rad" else "mm") for k, unit in enumerate(units)]
    plain = re.sub(r"[^A-Za-z0-9_]", "_", name)
    # A name begins with a letter, and KRL's has at most 24 characters.
    plain = (plain if plain[:1].isalpha() else f"p_{plain}")[:24]
    suffix, text = LANGUAGES[language]
    return text(plain, np.stack(shown, -1)), suffix


def _krl(name: str, joints: Array) -> str:
    moves = []
    for number, row in enumerate(joints, start=1):
        axes = ", ".join(f"A{k} {value:.4f}" for k, value in enumerate(row, start=1))
        moves += [f"  PTP {{{axes}}}", f"  WAIT SEC {_REST}", f"  ; reading {number}"]
    return "\n".join(
        [f"DEF {name}()", "  BAS(#INITMOV, 0)", "  BAS(#VEL_PTP, 10)", "  BAS(#ACC_PTP, 10)", *moves, "END", ""]
    )


def _rapid(name: str, joints: Array) -> str:
    moves = []
    for number, row in enumerate(joints, start=1):
        axes = ", ".join([*(f"{value:.4f}" for value in row), *("0" for _ in range(_MOST - len(row)))])
        target = f"[[{axes}], [9E9, 9E9, 9E9, 9E9, 9E9, 9E9]]"
        moves += [f"    MoveAbsJ {target}, v50, fine, tool0;", f"    WaitTime {_REST};", f"    ! reading {number}"]
    return "\n".join([f"MODULE {name}", "  PROC main()", *moves, "  ENDPROC", "ENDMODULE", ""])


def _urscript(name: str, joints: Array) -> str:
    moves = []
    for number, row in enumerate(joints, start=1):
        axes = ", ".join(f"d2r({value:.4f})" for value in row)
        moves += [f"  movej([{axes}], a=0.3, v=0.2)", f"  sleep({_REST})", f'  textmsg("reading {number}")']
    return "\n".join([f"def {name}():", *moves, "end", ""])


def _gcode(name: str, joints: Array) -> str:
    moves = []
    for number, row in enumerate(joints, start=1):
        axes = " ".join(f"{letter}{value:.4f}" for letter, value in zip("XYZABC", row, strict=False))
        moves += [f"G1 {axes} F600", f"G4 P{_REST:g}", f"(reading {number})"]
    return "\n".join([f"({name}: joints of the machine as the axes X Y Z A B C)", "G21 G90 G94", *moves, "M30", ""])


LANGUAGES = {
    "krl": _Language(".src", _krl),
    "rapid": _Language(".mod", _rapid),
    "urscript": _Language(".script", _urscript),
    "gcode": _Language(".ngc", _gcode),
}
"""By the value of the key `program`."""
