"""`ccnn compensate`: correct a table of joints or poses with a model file."""

from __future__ import annotations

import math
import os
from pathlib import Path
from typing import Annotated

import typer

from ccnn_torch.errors import InputError
from ccnn_torch.run_folder.interrupt import NOTHING_WRITTEN, if_stopped


def compensate(
    model: Annotated[
        Path, typer.Argument(help=".safetensors, .onnx, identified.yaml, diagnosis.json or identified_motion.json.")
    ],
    input: Annotated[Path, typer.Argument(metavar="IN.csv", help="Ideal joints; columns are name[unit].")],
    output: Annotated[Path, typer.Argument(metavar="OUT.csv", help="IN's columns and the commands.")],
    pose: Annotated[bool, typer.Option("--pose", help="IN has wanted poses instead of joints.")] = False,
    back: Annotated[bool, typer.Option("--back", help="IN has commands; OUT gets the ideal joints.")] = False,
    sd: Annotated[bool, typer.Option("--sd", help="OUT gets the deviations' standard deviations, too.")] = False,
    tool: Annotated[
        str | None,
        typer.Option(
            metavar="X,Y,Z,RX,RY,RZ",
            help="With --pose, of an arm: another tool than the measured one, from the end of the last link.",
        ),
    ] = None,
    base: Annotated[
        str | None,
        typer.Option(
            metavar="X,Y,Z,RX,RY,RZ",
            help="With --pose, of an arm: the frame that poses are given in, in the measured one.",
        ),
    ] = None,
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

    OUT.csv repeats the columns of IN.csv and adds command_q1[unit]…, deviation_q1[unit]…, inside_domain[1] and
    status[1]: 0 exact, 1 outside what was measured or fallen back, 2 input not finite, 3 damped near a singular pose,
    at a limit or not settled (the nearest safe command). With --back it adds ideal_q1[unit]… and inside_domain[1];
    the commands are the columns command_q1… where IN.csv has them, else q1…. With --pose a
    serial arm takes the branch of guess_q1[unit]… where given, else that of the previous row. With --sd it also adds
    deviation_sd_q1[unit]…: inside the domain, about 95 % of new measurements are within 1.96 times it of the predicted
    deviation. With identified.yaml, which ccnn identify writes, the commands are those of the identified kinematics,
    with diagnosis.json, which ccnn diagnose writes, those of the machine with the effects that it names.

    With identified_motion.json, which ccnn diagnose --motion writes, IN.csv has time[s] and command1[unit]…, the
    motion that is wanted, and OUT.csv gets corrected1[unit]…, the commands at which the machine follows it, and
    predicted1[unit]…, where it then goes.

    Every row is checked against the model's card. Where the model violates it (a number that is not finite, a
    deviation above most_deviation), the row has command = joints and inside_domain = 0, and the exit code is 2.

    Examples:

    ccnn compensate checkpoints/tripod/model.onnx joints.csv commands.csv

    ccnn compensate runs/ur10/model.safetensors poses.csv commands.csv --pose

    ccnn compensate runs/ur10/model.safetensors poses.csv out.csv --pose --tool "10mm,0,120mm,0,90deg,0"

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
    for option, frame in (("--tool", tool), ("--base", base)):
        if frame is not None and not pose:
            raise InputError(f"{option}: needs --pose; joints are the same with every tool and in every frame")
    for file, what in ((input, "IN.csv"), (model, "the model")):
        if os.path.realpath(output) == os.path.realpath(file):
            raise InputError(f"{output}: OUT.csv is {what} itself, which would be overwritten; name another file")
    with if_stopped(NOTHING_WRITTEN):
        from ccnn_torch.motion.identified import is_identified

        refused = ""
        if is_identified(model):
            from ccnn_torch.motion.compensate import compensate_motion

            if pose or back or sd or public_key:
                raise InputError(f"{model}: a model of a motion takes none of --pose, --back, --sd and --public-key")
            said = [f"{sentence}." for sentence in compensate_motion(model, input, output, allow_code)]
        else:
            from ccnn_torch.compensation.job import compensate_table

            frames = [
                None if text is None else _numbers(text, f"--{o}") for o, text in (("tool", tool), ("base", base))
            ]
            said, refused = compensate_table(model, input, output, pose, back, sd, public_key, allow_code, *frames)
    if not quiet:
        from ccnn_torch.report.screen import say

        for sentence in said:
            say(sentence)
    if refused:
        raise InputError(refused)


def _numbers(text: str, option: str) -> list[float]:
    """x, y, z and a rotation vector [m, rad]."""
    from ccnn_torch.config.sizes import size

    parts = [part.strip() for part in text.split(",")]
    if len(parts) != 6:
        raise InputError(f'{option} {text}: give x,y,z,rx,ry,rz with units, e.g. "10mm,0,120mm,0,90deg,0"')
    found = [size(part, unit, option) for part, unit in zip(parts, ("m", "m", "m", "rad", "rad", "rad"), strict=True)]
    if not all(map(math.isfinite, found)):
        raise InputError(f"{option} {text}: has a number that is not finite; write lengths and angles")
    return found
