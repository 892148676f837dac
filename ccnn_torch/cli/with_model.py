"""Commands on the file of a model: compensate, export, verify, sign; and on a folder: report."""

from __future__ import annotations

import math
import os
from pathlib import Path
from typing import Annotated

import typer

from ccnn_torch.cli.options import (
    AllowCode,
    ConfigOption,
    Mechanism,
    OutFolder,
    PublicKey,
    Quiet,
    Records,
    config_and_changes,
    noted,
)
from ccnn_torch.errors import InputError
from ccnn_torch.run_folder.folder import NOTHING_WRITTEN, if_stopped

_FRAME = "X,Y,Z,RX,RY,RZ"


def compensate(
    model: Annotated[
        Path, typer.Argument(help=".safetensors, .onnx, identified.yaml, diagnosis.json or identified_motion.json.")
    ],
    input: Annotated[
        Path,
        typer.Argument(metavar="IN.csv", help="Ideal joints; columns are name[unit]. Or a robot's or CNC program."),
    ],
    output: Annotated[
        Path, typer.Argument(metavar="OUT.csv", help="IN's columns and the commands; or the program, corrected.")
    ],
    pose: Annotated[bool, typer.Option("--pose", help="IN has wanted poses instead of joints.")] = False,
    back: Annotated[bool, typer.Option("--back", help="IN has commands; OUT gets the ideal joints.")] = False,
    sd: Annotated[bool, typer.Option("--sd", help="OUT gets the deviations' standard deviations, too.")] = False,
    tool: Annotated[
        str | None,
        typer.Option(
            metavar=_FRAME,
            help="With --pose or a program, of an arm: another tool than the measured one, from the last link's end.",
        ),
    ] = None,
    base: Annotated[
        str | None,
        typer.Option(
            metavar=_FRAME,
            help="With --pose, of an arm: the frame that poses are given in, in the measured one. With a program: "
            "the frame of its positions, in the machine's own base.",
        ),
    ] = None,
    public_key: PublicKey = None,
    allow_code: AllowCode = False,
    quiet: Quiet = False,
) -> None:
    """Correct joints so that the machine reaches the intended pose; or, with --back, convert commands to ideal joints.

    Headers that the model's run mapped by `columns` are mapped again.

    OUT.csv repeats the columns of IN.csv and adds command_q1[unit]…, deviation_q1[unit]…, inside_domain[1] and
    status[1]: 0 exact, 1 outside what was measured or fallen back, 2 input not finite, 3 damped near a singular pose,
    at a limit or not settled (the nearest safe command). With --back it adds ideal_q1[unit]… and inside_domain[1];
    the commands are the columns command_q1… where IN.csv has them, else q1…. With --pose a
    serial arm takes the branch of guess_q1[unit]… where given, else that of the previous row; poses that the
    machine does not reach are left out and named (exit code 2), and OUT.csv also gets
    command_x[unit]…, the poses to command where a controller takes no joints; so it does where IN.csv has goal_x[unit]…
    (poses as they are commanded) in the place of joints. With --sd it also adds
    deviation_sd_q1[unit]…: inside the domain, about 95 % of new measurements are within 1.96 times it of the predicted
    deviation. With identified.yaml, which ccnn identify writes, the commands are those of the identified kinematics,
    with diagnosis.json, which ccnn diagnose writes, those of the machine with the effects that it names.

    With identified_motion.json, which ccnn diagnose --motion writes, IN.csv has time[s] and command1[unit]…, the
    motion that is wanted, and OUT.csv gets corrected1[unit]…, the commands at which the machine follows it, and
    predicted1[unit]…, where it then goes.

    IN may be a program: G-code (.nc, .ngc, .gcode, .tap, .cnc), KRL (.src, .dat) or RAPID (.mod, .prg). OUT is the same
    program with other numbers in its positions, and nothing else: straight moves G0 and G1, frames {X …} and axes
    {A1 …}, robtarget and jointtarget. Positions that are out of reach or of the measured domain, or whose correction
    exceeds the model's limit, are left and listed, and the exit code is 2.

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

    ccnn compensate runs/kr10/diagnosis.json weld.src weld_corrected.src --tool "0,0,120mm,0,90deg,0"

    ccnn compensate from_a_stranger/model.onnx joints.csv commands.csv --public-key theirs.public.pem
    """
    if pose and back:
        raise InputError("--pose and --back exclude each other: --pose takes wanted poses, --back takes commands")
    from ccnn_torch.compensation.programs import PROGRAMS

    program = input.suffix.lower() in PROGRAMS
    if program and (pose or back or sd):
        raise InputError(f"{input}: a program takes none of --pose, --back and --sd; give a table for these")
    if sd and back:
        raise InputError(
            "--sd and --back exclude each other: --sd gives the standard deviation of a command, --back takes commands"
        )
    for option, frame in (("--tool", tool), ("--base", base)):
        if frame is not None and not pose and not program:
            raise InputError(f"{option}: needs --pose; joints are the same with every tool and in every frame")
    for file, what in ((input, "IN.csv"), (model, "the model")):
        if os.path.realpath(output) == os.path.realpath(file):
            raise InputError(f"{output}: OUT.csv is {what} itself, which would be overwritten; name another file")
    with if_stopped(NOTHING_WRITTEN):
        from ccnn_torch.compensation.job import compensate_table, is_of_motion
        from ccnn_torch.compensation.model_files.load import load_compensation

        refused = ""
        if is_of_motion(model):
            from ccnn_torch.motion.compensate import compensate_motion

            if pose or back or sd or public_key:
                raise InputError(f"{model}: a model of a motion takes none of --pose, --back, --sd and --public-key")
            if program:
                raise InputError(f"{model}: a model of a motion corrects a table of times, not a program")
            said = [f"{sentence}." for sentence in compensate_motion(model, input, output, allow_code)]
        else:
            frames = [
                None if text is None else _numbers(text, f"--{o}") for o, text in (("tool", tool), ("base", base))
            ]
            loaded = load_compensation(model, public_key=public_key, allow_code=allow_code)
            if program:
                from ccnn_torch.compensation.programs.job import compensate_program

                said, refused = compensate_program(loaded, input, output, allow_code, *frames)
            else:
                said, refused = compensate_table(loaded, input, output, pose, back, sd, allow_code, *frames)
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


def export(
    model: Annotated[
        Path, typer.Argument(help="A .safetensors file with its card, an identified.yaml or diagnosis.json.")
    ],
    to: Annotated[str, typer.Option(help="The target, one of the list.")],
    out: OutFolder,
    dtype: Annotated[str, typer.Option(help="float64 or float32, in which the controller computes.")] = "float64",
    sd: Annotated[bool, typer.Option("--sd", help="Add a function for the deviation's standard deviation.")] = False,
    current: Annotated[
        Path | None,
        typer.Option(help="Your file of the stack, which is read: printer.cfg, calibration.json, a robot's URDF."),
    ] = None,
    public_key: PublicKey = None,
    allow_code: AllowCode = False,
    quiet: Quiet = False,
) -> None:
    """Write a model for a controller: both directions, with domain, limit and fallback inside; or for a simulator.

    c99: compensator.h, compensator.c, selftest.c and a Makefile. make test builds them without warnings and compares
    more than a thousand golden vectors. No heap, no recursion, no global state; the same operations in each call.

    st: compensator.st, selftest.st and a README.md for TwinCAT and CODESYS (IEC 61131-3 Structured Text).

    linuxcnc: ccnnkins.comp, the machine's kinematics with the compensation around them, for halcompile; of a
    geometry alone the kinematics with the identified parameters.

    onnx: model.onnx with master and card, and controller.onnx with the command alone.

    ros2_control: a chainable controller in C++ around the code of c99, as a package; or, where offsets of the joints
    suffice, these for the transmissions in the URDF.

    table, beckhoff: the deviation over a grid, tables of single axes (LinuxCNC, Heidenhain, Beckhoff), the grid of
    TF5280 and a mesh where they suffice, and how far off each is.

    urdf, mjcf: an arm with its identified links as URDF, MuJoCo model and DH table; --current robot.urdf: your own URDF
    with other origins of its joints, all else as it is.

    ur: kinematics.yaml of a UR arm for ur_description and ur_robot_driver; --current keeps its hash.

    pal: master_calibration.yaml of a PAL robot, whose URDF is --current.

    lerobot: calibration.json with the joints' zeros; the one that is there is --current.

    klipper: printer_delta.cfg with radius, rods, angles and endstops of a delta printer; --current: its printer.cfg.

    linuxcnc_hal: kinematics.hal, the numbers of genhexkins (hexapods) or genserkins (arms of six turning joints).

    Files of numbers hold the geometry alone, that which comes nearest to the whole model: the screen and their
    README.md say what they leave.

    Source code returns the same codes: 0 exact; 1 outside the domain, or where the model broke its limit; 2 where an
    input is not finite: then command = joints, with the middle of the domain for what is no number and its edge for
    infinity; 3 damped near a singular pose, at a limit or not settled. Before a file is written its operations are
    compared with the model: in float64 to 1e-12 of the limit (1e-9 with a Gaussian process, an identified machine or
    physical effects), in float32 to 1e-5.

    Examples:

    ccnn export checkpoints/tripod/model.safetensors --to c99 --out controller && make -C controller test

    ccnn export runs/ur10/model.safetensors --to st --out plc

    ccnn export checkpoints/tripod/model.safetensors --to c99 --dtype float32 --sd --out microcontroller

    ccnn export checkpoints/tripod/model.safetensors --to linuxcnc --out kins

    ccnn export runs/arm/identified.yaml --to urdf --out robot

    ccnn export runs/ur10/diagnosis.json --to ur --out robot

    ccnn export runs/printer/identified.yaml --to klipper --current printer.cfg --out firmware
    """
    with if_stopped(NOTHING_WRITTEN):
        from ccnn_torch.compensation.targets.export import export_model

        told: list[str] = []
        files = export_model(model, to, out, dtype, sd, public_key, allow_code, current, told.append)
    if not quiet:
        proven = (
            "; their operations give the model's numbers"
            if to in ("c99", "st", "linuxcnc", "onnx") or "compensator.c" in files
            else ""
        )
        typer.echo(f"{out}: {', '.join(files)} written{proven}.")
        if to == "c99":
            typer.echo(f"Compile them and compare golden vectors: make -C {out} test")
        if told:
            from ccnn_torch.report.screen import say

            say(*told)
            typer.echo(f"How to load them: {out / 'README.md'}")


def verify(
    model: Annotated[Path, typer.Argument(help="A .safetensors or .onnx file, an identified.yaml or diagnosis.json.")],
    out: OutFolder,
    records: Annotated[
        str | None, typer.Argument(metavar="RECORDS.csv", help="New rows: joints and measured poses.")
    ] = None,
    records_option: Records = None,
    config: ConfigOption = None,
    mechanism: Mechanism = None,
    compensated: Annotated[
        bool, typer.Option("--compensated", help="The model was in use while the rows were measured.")
    ] = False,
    refit_frames: Annotated[
        bool, typer.Option("--refit-frames", help="The measuring device was moved since the model was made.")
    ] = False,
    public_key: PublicKey = None,
    allow_code: AllowCode = False,
    quiet: Quiet = False,
) -> None:
    """Test a model on new measurements, against the error promised by its held-out rows.

    The machine is the model's where --mechanism names no other.

    Without --compensated the rows are of the uncompensated machine: joints commanded, pose measured. With --compensated
    the joints are the ideal ones, the machine was commanded by the model, and the pose should be the nominal one.

    Exit code 0: the promise is kept; 1: the RMS of position or rotation is above its limit at 95 %; 2: bad input.

    Examples:

    ccnn verify runs/ur10/model.safetensors next_week.csv --out runs/next_week

    ccnn verify runs/ur10/model.safetensors with_it_on.csv --compensated --out runs/acceptance

    ccnn verify runs/five_bar/identified.yaml other_day.csv --refit-frames --out runs/other_day
    """
    with if_stopped(NOTHING_WRITTEN):
        from ccnn_torch.compensation import load_compensation
        from ccnn_torch.verification.job import VerifyConfig, verify_model
        from ccnn_torch.verification.page import write_verify_report

        file, changes = config_and_changes([], config, records=records or records_option, mechanism=mechanism)
        wanted = VerifyConfig.from_file(file, changes, noted(quiet))
        if wanted.records is None:
            raise InputError("records: are missing; give RECORDS.csv, --records, or the key in a config")
        loaded = load_compensation(model, public_key=public_key, allow_code=allow_code)
        how = {name: getattr(wanted, name) for name in ("columns", "joint_map", "mechanism_keys")}
        how["allow_code"] = allow_code
        results, arrays = verify_model(loaded, wanted.records, wanted.mechanism, compensated, refit_frames, **how)
        write_verify_report(out, results, arrays)
    if not quiet:
        typer.echo(results.text)
        for note in results.notes:
            typer.echo(note)
        typer.echo(f"Everything is in {out}; open {out / 'verify.html'}")
        if not (results.kept or compensated):
            typer.echo(f"What changed? ccnn diagnose --since {model} {wanted.records} --out {out}_since")
    if not results.kept:
        raise typer.Exit(1)


def sign(
    model: Annotated[Path | None, typer.Argument(help="A .safetensors or .onnx file, or identified.yaml.")] = None,
    key: Annotated[Path | None, typer.Option("--key", metavar="PRIVATE.pem", help="Private Ed25519 key.")] = None,
    new_key: Annotated[str | None, typer.Option("--new-key", metavar="NAME", help="Make a pair of keys.")] = None,
    quiet: Quiet = False,
) -> None:
    """Sign a model and its card with Ed25519: by MODEL.sig and the public key others verify that neither was changed.

    With --new-key it writes NAME.private.pem, which you keep secret, and NAME.public.pem, which you give to the users
    of your models; they run ccnn compensate MODEL … --public-key NAME.public.pem. A signature covers one file and its
    card: sign again whenever the model is rewritten. It needs pip install 'ccnn-torch[sign]'.

    Examples:

    ccnn sign --new-key our_robots

    ccnn sign runs/ur10/model.onnx --key our_robots.private.pem
    """
    if (model is None) == (new_key is None) or (model is None) != (key is None):
        raise InputError("ccnn sign takes either MODEL and --key PRIVATE.pem, or --new-key NAME alone")
    from ccnn_torch.compensation import new_key_pair, sign_model

    if new_key is not None:
        private, public = new_key_pair(new_key)
        message = f"{private}: keep it secret. {public}: give it to the users of your models."
    else:
        assert model is not None and key is not None
        message = f"{sign_model(model, key)}: written; pass it on with {model.name} and its card."
    if not quiet:
        typer.echo(message)


def report(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Folder of a run, diagnosis, identification, check …")],
    quiet: Quiet = False,
) -> None:
    """Open the page of a folder in the browser; without a display its path is printed.

    Example:

    ccnn report runs/tripod
    """
    import sys
    import webbrowser

    page = next(
        (folder / name for name in ("report.html", "verify.html", "since.html") if (folder / name).is_file()), None
    )
    if page is None:
        raise InputError(
            f"{folder}: has no report.html, verify.html or since.html; name a folder that a command has filled"
        )
    # On Linux a browser that needs no display would take the terminal.
    shows = not sys.platform.startswith("linux") or os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    if shows:
        webbrowser.open(page.resolve().as_uri())
    if not quiet:
        typer.echo(page)
