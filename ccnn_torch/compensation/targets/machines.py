"""Identified machines for Klipper and LinuxCNC's own kinematics: lines of their files."""

from __future__ import annotations

import math
from collections.abc import Mapping
from itertools import pairwise

import numpy as np
import torch

from ccnn_torch.compensation.targets.lowered import (
    Array,
    Chain,
    Found,
    Stack,
    chain,
    inner_of,
    links_of,
    screw,
    told_frame,
)
from ccnn_torch.errors import MethodFailedError
from ccnn_torch.mechanisms import SerialArm
from ccnn_torch.mechanisms.machines.delta import DeltaLinear
from ccnn_torch.mechanisms.machines.stewart import Stewart
from ccnn_torch.records.formats.klipper import STEPPERS, of_towers, sections_of, whole_text

# Where Klipper has its third tower [rad].
_THIRD = math.pi / 2


def klipper_numbers(parameters: Mapping[str, float]) -> tuple[float, Array, Array, Array, complex, float]:
    """What Klipper knows of a delta printer: one radius and two free angles.

    The centre is that of the circle through the three towers, and the third tower stands at 90°.

    Args:
        parameters: of a `DeltaLinear` by name [SI].

    Returns:
        Radius [m], rods `3` [m], angles `3` [°], endstops less a constant `3` [m]; the centre x + iy [m] and by how
        much Klipper's axes are turned from the machine's [rad].
    """
    rod, base, platform, angle, end = (
        np.array([parameters[f"{name}{i}"] for i in (1, 2, 3)])
        for name in ("rod", "base", "platform", "angle", "offset")
    )
    towers = (base - platform) * np.exp(1j * angle)
    # The circle's centre c: |t_i - c| is the same for all.
    sides = np.array([[2 * (t - towers[0]).real, 2 * (t - towers[0]).imag] for t in towers[1:]])
    centre = complex(*np.linalg.solve(sides, np.abs(towers[1:]) ** 2 - np.abs(towers[0]) ** 2))
    radius = float(abs(towers[0] - centre))
    turn = float(np.angle(towers[2] - centre)) - _THIRD
    turned = np.degrees(np.angle((towers - centre) * np.exp(-1j * turn))) % 360
    # With the nozzle on the bed in the middle a carriage is as high as its rod reaches.
    return radius, rod, turned, end - np.sqrt(rod**2 - radius**2), centre, turn


def print_klipper(found: Found) -> Stack:
    """`printer_delta.cfg` with the keys of a delta's kinematics; copied beside a printer.cfg it overwrites nothing.

    Raises:
        MethodFailedError: the machine is no linear delta.
        InputError: the printer.cfg that is there lacks an endstop.
    """
    inner, _ = inner_of(found.nominal)
    if not isinstance(inner, DeltaLinear):
        raise MethodFailedError(f"klipper has kinematics of linear deltas, and '{inner.name}' is none; export table")
    real, seen = inner_of(found.identified)
    was, now = (
        klipper_numbers(dict(zip((p.name for p in m.geometry), m.nominal.tolist(), strict=True))) for m in (inner, real)
    )
    current = found.current
    # In mm, as Klipper reads them: what SAVE_CONFIG wrote comes last.
    ends = None if current is None else of_towers(sections_of(whole_text(current)), current, "position_endstop")
    lines = ["[printer]", f"delta_radius: {1e3 * now[0]:.6f}"]
    for i, stepper in enumerate(STEPPERS):
        more = 1e3 * (now[3][i] - was[3][i])
        lines += ["", f"[{stepper}]", f"arm_length: {1e3 * now[1][i]:.6f}", f"angle: {now[2][i]:.6f}"]
        said = f"# position_endstop: what is there {more:+.6f}"
        lines.append(f"position_endstop: {ends[i] + more:.6f}" if ends is not None else said)
    values = real.nominal.reshape(3, -1).clone()
    for i, row in enumerate(values):
        tower = now[4] + round(now[0], 9) * np.exp(1j * (np.radians(round(now[2][i], 6)) + now[5]))
        # base, angle, lean, skew, platform, rod; the offset is what the endstop says.
        row[:6] = torch.tensor([abs(tower), np.angle(tower), 0.0, 0.0, 0.0, round(now[1][i], 9)])
    load = (
        "Replace these keys in `printer.cfg`, or write `[include printer_delta.cfg]` at its end; delete them from its "
        "block `SAVE_CONFIG` (`#*#` at the end), `RESTART`, "
        "and probe again. Endstops are written where the file that is there was given, `--current printer.cfg`; else "
        "add what the comments say. "
        f"Klipper's x and y are those of the circle through the towers: its zero is at ({1e3 * now[4].real:.4f}, "
        f"{1e3 * now[4].imag:.4f}) mm, its axes are turned by {math.degrees(now[5]):.5f} deg. It has no key for rails "
        "that lean or are skew."
    )
    return Stack({"printer_delta.cfg": "\n".join(lines) + "\n"}, seen(values.flatten()), load)


def print_hal(found: Found) -> Stack:
    """`kinematics.hal`: genhexkins of a hexapod, genserkins of an arm of six turning joints.

    Raises:
        MethodFailedError: the machine is neither.
    """
    inner, _ = inner_of(found.nominal)
    six = isinstance(inner, SerialArm) and len(inner.joints) == 6 and bool(inner.revolute.all())
    if not six and not isinstance(inner, Stewart):
        raise MethodFailedError(
            f"genhexkins and genserkins are of hexapods and of arms of six turning joints, and '{inner.name}' is "
            "neither; export linuxcnc, which has its own kinematics"
        )
    machine, seen = inner_of(found.identified)
    if isinstance(machine, Stewart):
        legs = machine.nominal.reshape(6, 8)
        lines = [
            f"setp genhexkins.{part}.{i}.{c} {1e3 * float(v):.9f}"
            for i, leg in enumerate(legs)
            for part, k in (("base", 0), ("platform", 3))
            for c, v in zip("xyz", leg[k : k + 3], strict=True)
        ]
        rounded = legs.clone()
        rounded[:, :6] = (legs[:, :6] * 1e12).round() / 1e12
        rows = "\n".join(
            f"| {i} | {1 / float(leg[7]):.9f} | {float(leg[7]):.9f} * what is there {1e3 * float(leg[6]):+.6f} |"
            for i, leg in enumerate(legs)
        )
        load = (
            "`KINEMATICS = genhexkins` in the INI file, and `source kinematics.hal` in the HAL file, after the "
            "kinematics are loaded. Lengths are in mm. LinuxCNC's joints are whole lengths of legs:\n\n"
            f"| `[JOINT_N]` | `SCALE` times | `HOME_OFFSET` [mm] |\n| --- | --- | --- |\n{rows}"
        )
        return Stack({"kinematics.hal": "\n".join(lines) + "\n"}, seen(rounded.flatten()), load)
    assert isinstance(machine, SerialArm) and isinstance(found.nominal, SerialArm)
    made, table = craig(chain(machine))
    before = craig(chain(found.nominal))[1]
    lines = []
    for i, (a, alpha, d, _) in enumerate(table):
        lines += [
            f"setp genserkins.{key}-{i} {v:.12f}" for key, v in (("A", 1e3 * a), ("ALPHA", alpha), ("D", 1e3 * d))
        ]
    links = [[round(a, 15), round(alpha, 12), round(d, 15), theta] for a, alpha, d, theta in table]
    rows = ""
    for i, (now, was) in enumerate(zip(table, before, strict=True)):
        more = math.degrees(math.remainder(now[3] - was[3], 2 * math.pi))
        rows += f"| {i} | {math.degrees(now[3]):.9f} | {more:+.9f} |\n"
    load = (
        "`KINEMATICS = genserkins` in the INI file, and `source kinematics.hal` in the HAL file, after the kinematics "
        "are loaded. Lengths are in mm, ALPHA in rad (Craig's parameters). genserkins has no zero of a joint: joint N "
        "of LinuxCNC is joint N+1 of the model and the angle below; add what it changed by to `HOME_OFFSET`:\n\n"
        f"| `[JOINT_N]` | angle [deg] | `HOME_OFFSET` [deg] |\n| --- | --- | --- |\n{rows}\n"
        f"Frames are no part of it. Its base in the frame of the measurement: {told_frame(made.base)}; the measured "
        f"tool from its last frame: {told_frame(made.last)} [m, rad]."
    )
    return Stack({"kinematics.hal": "\n".join(lines) + "\n"}, links_of(made, machine, "modified", links), load)


# Axes by a smaller angle than this are parallel [rad]: their common normal is 1e9 times as far away as their distance.
_PARALLEL = 1e-9
# With room for rounding, so that it does not decide a sign.
_QUARTER = math.pi / 2 + 1e-6


def craig(made: Chain) -> tuple[Chain, list[list[float]]]:
    """An arm with frames on the common normals of its axes, and its a, alpha, d, theta `n x 4` (Craig 1986)."""
    axes, frames = made.frames, []
    for here, there in pairwise(axes):
        gap = np.linalg.inv(here) @ there
        across = np.array([-gap[1, 2], gap[0, 2]])
        size = float(np.linalg.norm(across))
        if size > _PARALLEL:
            along = gap[2, 3] - gap[2, 2] * float(gap[:2, 2] @ gap[:2, 3]) / size**2
        else:
            along, across = 0.0, gap[:2, 3]
        turn = math.atan2(across[1], across[0])
        # Of the two ways the one nearest to the frame that is there.
        turn = turn if abs(turn) <= _QUARTER else turn - math.copysign(math.pi, turn)
        frames.append(here @ screw(along, turn))
    frames.append(axes[-1])
    first = axes[0].copy()
    first[:3, 3] -= first[:3, 2] * float(first[:3, 2] @ first[:3, 3])
    placed = made.through(first, frames)
    table = []
    for m in placed.origins:
        alpha, theta = math.atan2(-m[1, 2], m[2, 2]), math.atan2(-m[0, 1], m[0, 0])
        d = float(-m[1, 3] * math.sin(alpha) + m[2, 3] * math.cos(alpha))
        table.append([float(m[0, 3]), alpha, d, theta])
    return placed, table
