"""Error tables for controllers that take nothing else, each with how far its interpolation is from the model."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ccnn_torch.compensation.compensator import Compensator
from ccnn_torch.display import identifiers, plain
from ccnn_torch.errors import MethodFailedError
from ccnn_torch.files.write import csv_text
from ccnn_torch.mechanisms import Mechanism, SerialArm
from ccnn_torch.numerics.rotations import rotation_vector_to_matrix

Array = NDArray[Any]

# Points of the whole grid at most, and along one axis (LinuxCNC takes 256).
_MOST, _ALONG = 20_000, 64
_CHECKED, _FEWEST = 2000, 50
# What one axis alone must explain of its own deviation, by RMS, so that its table is worth having.
_SUFFICES = 0.2
_MESH = 9
# Points along an axis of a grid for a controller that takes 2000; and how far its axes may be from x, y, z [1].
_RECORDS, _ALIGNED = 12, 0.05
_NAMES = {"m": ("mm", 1e3), "rad": ("deg", 180 / np.pi)}


def print_tables(compensator: Compensator, mechanism: Mechanism | None, mesh: bool = True) -> dict[str, str]:
    """Contents of the files by name: the grid, tables of single axes, a mesh, and what each leaves.

    Args:
        compensator: fitted; its covariates stand at the middle of the domain, but for directions of approach in tables
            of single axes.
        mechanism: nominal, for the mesh; None where it is not known.
        mesh: whether a mesh for Klipper is wanted.

    Raises:
        MethodFailedError: a grid of so many joints would have less than three points along each.
    """
    n = len(compensator.joints)
    count = min(_ALONG, int(_MOST ** (1 / n)))
    if count < 3:
        raise MethodFailedError(f"a table over {n} joints would be too coarse; export the model as c99 or st")
    low, high = (v[:n].numpy() for v in (compensator.domain.low, compensator.domain.high))
    middle = compensator.domain.centre[n:]
    drawn = low + (high - low) * np.random.default_rng(0).random((_CHECKED, n))
    checked = _inside(compensator, drawn, middle)
    truth = _deviation(compensator, checked, middle)

    def gridded(name: str, what: str, count: int) -> tuple[Array, Array]:
        """Points of a grid and their deviations, `s x n` each; how far off it is goes to `told`."""
        lines = [np.linspace(a, b, count) for a, b in zip(low, high, strict=True)]
        grid = np.stack(np.meshgrid(*lines, indexing="ij"), -1)
        points = grid.reshape(-1, n)
        values = _deviation(compensator, points, middle)
        between = _between(lines, values.reshape(grid.shape), checked)
        told.append(_said(name, f"{what}, linear between the points", truth, between))
        return points, values

    told: list[str] = []
    tables = {"table.csv": _csv(compensator, *gridded("table.csv", "all joints", count))}
    axes, rows, said = _axis_tables(compensator, low, high, drawn)
    tables |= axes
    told.append(rows)
    if mechanism is not None and _is_cartesian(mechanism):
        tables["beckhoff_grid.csv"] = _isg(*gridded("beckhoff_grid.csv", "X, Y, Z", _RECORDS))
    if mesh and mechanism is not None and [c.name for c in mechanism.pose] == ["x", "y", "z"]:
        tables["klipper_mesh.cfg"], sentence = _mesh(compensator, mechanism)
        told.append(sentence)
    told += said
    told += [text for form, text in _FORMS.items() if any(name.startswith(form) for name in tables)]
    stand = zip(compensator.covariates, middle.tolist(), strict=True)
    at = ", ".join(f"`{f'{plain(c.name)} = {v:.6g} {plain(c.unit)}'.removesuffix(' 1')}`" for c, v in stand)
    return tables | {"README.md": README.format(told="\n\n".join(told), at=f" Covariates stand at {at}." if at else "")}


def _axis_tables(
    compensator: Compensator, low: Array, high: Array, drawn: Array
) -> tuple[dict[str, str], str, list[str]]:
    """Files of the joints for which an own table suffices, what each leaves, and what is said of their directions."""
    joints = compensator.joints
    tables: dict[str, str] = {}
    rows, lost, joined, files = [], [], [], identifiers([joint.name for joint in joints])
    for j, joint in enumerate(joints):
        name, scale = _NAMES.get(joint.unit, (plain(joint.unit), 1.0))
        line = np.linspace(low[j], high[j], _ALONG)
        ways, seen, apart = _approached(compensator, j, drawn)
        both = np.stack([_deviation(compensator, seen, way)[:, j] for way in ways])
        own = np.array([both[:, near].mean(1) for near in _bins(seen[:, j], line)]).T
        own = own if apart else np.broadcast_to(own.mean(0), own.shape)
        left = both - np.stack([np.interp(seen[:, j], line, one) for one in own])
        share = _rms(left) / max(_rms(both), 1e-300)
        rows.append(
            f"| `{plain(joint.name)}` | {_rms(both) * scale:.3g} {name} | {_rms(left) * scale:.3g} {name} | "
            f"{np.abs(left).max() * scale:.3g} {name} | {'yes' if share <= _SUFFICES else 'no: c99, st or table.csv'} |"
        )
        if ways[0] is not ways[1]:
            joined += [] if apart else [f"`{plain(joint.name)}`"]
            lost.append(f"{_rms(both[0] - both[1]) / 2 * scale:.3g} {name} of `{plain(joint.name)}`")
        if share <= _SUFFICES:
            tables[f"linuxcnc_{files[j]}.comp"] = _screw(line * scale, *own * scale)
            tables[f"beckhoff_axis_{files[j]}.lis"] = _ssfk(j + 1, files[j], joint.unit, line, *own)
            tables[f"heidenhain_{files[j]}.com"] = _heidenhain(files[j], name, line * scale, *own * scale)
    head = "| joint | deviation, RMS | left by its own table, RMS | at most | one axis suffices |\n"
    told = head + "| --- | --- | --- | --- | --- |\n" + "\n".join(rows)
    said = []
    if lost:
        but = f" (not those of {', '.join(joined)}: the model knows its direction only with others')" if joined else ""
        said.append(
            f"Directions of approach: tables of single axes hold both{but}. Every other file stands between them, and "
            f"leaves in either direction {', '.join(lost)} (RMS)."
        )
    return tables, told, said


README = """# Error tables

Deviation: what the machine adds to a commanded joint, so subtract it.{at}
Errors are over random points of the domain of the training rows.

{told}
"""
_FORMS = {
    "linuxcnc": "`linuxcnc_JOINT.comp`: `COMP_FILE` of its `[JOINT_N]`, with `COMP_FILE_TYPE = 1` (nominal, forward "
    "trim, reverse trim).",
    "heidenhain": "`heidenhain_JOINT.com`: columns AXISPOS, BACKLASH and the axis, in the form of the manufacturer's "
    "manuals. The axis has the deviation as it is in the positive direction of traverse, BACKLASH what the negative "
    "direction adds to it. It was not tried on a control, so check the signs with one point in both directions, and in "
    "the control's manual whether its BACKLASH is this difference.",
    "beckhoff_grid": "`beckhoff_grid.csv` is an error parameter file of the volumetric compensation (TF5280): "
    "`file[0] ...\\beckhoff_grid.csv`, `file_format[0] ISG_CSV` in its list, and `vol_comp[0].max_records 2000` in "
    "hochlauf.lis. It has the errors of the place over X, Y and Z as EXX, EYX, EZX [mm], what the machine is beyond "
    "the command; angles are not in it. Check the sign with one point: `negate` turns it.",
    "beckhoff_axis": "`beckhoff_axis_JOINT.lis`: an axis compensation list (`kw.ssfk`, 0.1 um or 0.0001 deg, actual "
    "less commanded, in both directions) of TwinCAT CNC and ISG kernels; write the number of your axis into "
    "`kopf.log_achs_nr`, and activate it by `lr_param.ssfk 1`.",
    "klipper": "`klipper_mesh.cfg` is a saved profile of `[bed_mesh]` for the section SAVE_CONFIG of printer.cfg.",
}


def _deviation(compensator: Compensator, joints: Array, covariates: Tensor) -> Array:
    given = covariates.expand(len(joints), -1) if len(covariates) else None
    with torch.no_grad():
        found: Array = compensator.deviation(torch.from_numpy(joints), given).numpy()
    return found


def _within(compensator: Compensator, joints: Array, covariates: Tensor) -> Array:
    inputs = torch.cat([torch.from_numpy(joints), covariates.expand(len(joints), -1)], -1)
    inside: Array = (compensator.domain.excess(compensator.domain.cage(inputs)) <= 0).squeeze(-1).numpy()
    return inside


def _inside(compensator: Compensator, joints: Array, covariates: Tensor) -> Array:
    """Those in the domain; all where too few are."""
    inside = _within(compensator, joints, covariates)
    return joints[inside] if inside.sum() > _FEWEST else joints


def _approached(compensator: Compensator, j: int, joints: Array) -> tuple[list[Tensor], Array, bool]:
    """Covariates with joint j coming from below and from above, the others in the middle, and the joints in the domain.

    All joints come from there, and the last is False, where the model knows that joint's direction only together with
    others'. Both are the middle where it does not know it.
    """
    middle, names = compensator.domain.centre[len(compensator.joints) :], [c.name for c in compensator.covariates]
    own, every = f"direction{j + 1}", {f"direction{k + 1}" for k in range(len(compensator.joints))}
    for moved in ({own}, every) if own in names else ():
        way = torch.tensor([name in moved for name in names])
        ways = [torch.where(way, sign, middle) for sign in (1.0, -1.0)]
        inside = _within(compensator, joints, ways[0]) & _within(compensator, joints, ways[1])
        if inside.sum() > _FEWEST:
            return ways, joints[inside], moved == {own}
    return [middle, middle], _inside(compensator, joints, middle), False


def _between(lines: list[Array], values: Array, points: Array) -> Array:
    # It takes a second to load, which commands that write no table need not wait for.
    from scipy.interpolate import RegularGridInterpolator

    return np.asarray(RegularGridInterpolator(lines, values)(points))


def _bins(at: Array, line: Array) -> list[Array]:
    """For each point of a line the rows nearest to it, at least twenty."""
    order = [np.argsort(np.abs(at - x), kind="stable") for x in line]
    half = (line[1] - line[0]) / 2
    return [o[: max(20, int((np.abs(at - x) <= half).sum()))] for o, x in zip(order, line, strict=True)]


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def _said(name: str, what: str, truth: Array, found: Array) -> str:
    off = np.abs(found - truth)
    return (
        f"`{name}`: {what}. RMS deviation {_rms(truth):.3g}; the table is off by {_rms(off):.3g} (RMS), "
        f"{off.max():.3g} at most [SI]."
    )


def _csv(compensator: Compensator, grid: Array, values: Array) -> str:
    headers = [plain(c.header) for c in compensator.joints]
    names = headers + [f"deviation_{header}" for header in headers]
    return csv_text([names, *(map(repr, row) for row in np.hstack([grid, values]).tolist())])


def _screw(line: Array, up: Array, down: Array) -> str:
    """Nominal position and what is added to it, forward and back."""
    return "".join(f"{x:.6f} {-d:.6f} {-e:.6f}\n" for x, d, e in zip(line, up, down, strict=True))


def _ssfk(number: int, joint: str, unit: str, line: Array, up: Array, down: Array) -> str:
    """Commanded position, and what the axis is beyond it forward and back [0.1 um or 0.0001 deg]."""
    scale = 1e7 if unit == "m" else 1e4 * 180 / np.pi
    head = {"kopf.log_achs_nr": number, "kopf.log_achs_name": joint.upper(), "kw.ssfk.interval": 0}
    head |= {"kw.ssfk.kw_startpos": round(line[0] * scale), "kw.ssfk.kw_nr_max": len(line), "kw.ssfk.unit": 1}
    head |= {"kw.ssfk.bilateral": 1}
    for key, values in (("setpoint", line), ("pos", up), ("neg", down)):
        head |= {f"kw.ssfk.table[{i}].{key}": round(float(v) * scale) for i, v in enumerate(values)}
    return "".join(f"{key:<36}{value}\n" for key, value in head.items())


def _is_cartesian(mechanism: Mechanism) -> bool:
    """Whether joints are x, y and z, so that what they are off by is where the tool is off."""
    if [j.unit for j in mechanism.joints] != ["m"] * 3 or [c.name for c in mechanism.pose][:3] != ["x", "y", "z"]:
        return False
    slope = mechanism.jacobian(mechanism.home_joints)[:3]
    if isinstance(mechanism, SerialArm):
        slope = rotation_vector_to_matrix(mechanism.nominal[3:6]).mT @ slope
    return bool((slope - torch.eye(3, dtype=slope.dtype)).abs().max() < _ALIGNED)


def _isg(grid: Array, values: Array) -> str:
    rows = "".join(" ".join(f"{v:.6f}" for v in row) + "\n" for row in 1e3 * np.hstack([grid, values]))
    return f"// Errors of the place [mm] over the commanded axes [mm].\nX Y Z EXX EYX EZX\n{rows}"


def _heidenhain(joint: str, unit: str, line: Array, up: Array, down: Array) -> str:
    head = f"BEGIN {joint.upper()}.COM {unit.upper()}\n{'NR':<4}{'AXISPOS':>14}{'BACKLASH':>12}{joint.upper():>12}\n"
    values = enumerate(zip(line, down - up, up, strict=True))
    rows = [f"{k:<4}{x:>+14.4f}{back:>+12.5f}{d:>+12.5f}\n" for k, (x, back, d) in values]
    return head + "".join(rows) + "[END]\n"


def _mesh(compensator: Compensator, mechanism: Mechanism) -> tuple[str, str]:
    """What is added to z over x and y in the middle of the heights [mm], and a sentence on what a mesh leaves."""
    (x0, y0, z0), (x1, y1, z1) = (v.tolist() for v in mechanism.bounds)
    box = torch.stack([compensator.domain.low, compensator.domain.high])[:, : len(mechanism.joints)]
    share = torch.rand(_CHECKED, box.shape[1], generator=torch.Generator().manual_seed(0), dtype=box.dtype)
    heights = mechanism.forward_kinematics(box[0] + (box[1] - box[0]) * share)[:, 2]
    heights = heights[heights.isfinite()]
    # Of the box of the machine what was measured.
    z0, z1 = max(z0, float(heights.min())), min(z1, float(heights.max()))
    xs, ys = np.linspace(x0, x1, _MESH), np.linspace(y0, y1, _MESH)
    gap = _missed(compensator, mechanism, xs, ys, (z0 + z1) / 2)
    other = _missed(compensator, mechanism, xs, ys, z0)
    points = "\n".join("    " + ", ".join(f"{-v * 1e3:.6f}" for v in row) for row in gap[..., 2])
    keys = {"x_count": _MESH, "y_count": _MESH, "mesh_x_pps": 2, "mesh_y_pps": 2, "algo": "bicubic", "tension": 0.2}
    keys |= {"min_x": x0 * 1e3, "max_x": x1 * 1e3, "min_y": y0 * 1e3, "max_y": y1 * 1e3}
    text = f"[bed_mesh ccnn]\nversion = 1\npoints =\n{points}\n" + "".join(f"{k} = {v}\n" for k, v in keys.items())
    aside, change = _rms(gap[..., :2]) * 1e3, _rms(other[..., 2] - gap[..., 2]) * 1e3
    return text, (
        f"`klipper_mesh.cfg`: error of z over x and y at z = {(z0 + z1) / 2 * 1e3:.6g} mm. It leaves those of x and y "
        f"({aside:.3g} mm RMS), and at z = {z0 * 1e3:.6g} mm the error of z is another by {change:.3g} mm RMS."
    )


def _missed(compensator: Compensator, mechanism: Mechanism, xs: Array, ys: Array, z: float) -> Array:
    """Position error of the uncompensated machine, `y x x x 3` [m]; 0 where it cannot go."""
    pose = torch.tensor([[x, y, z] for y in ys for x in xs], dtype=torch.float64)
    joints = mechanism.solve_inverse(pose)
    middle = compensator.domain.centre[joints.shape[1] :]
    off = torch.from_numpy(_deviation(compensator, joints.nan_to_num().numpy(), middle))
    reached = mechanism.forward_kinematics(joints + off)
    return (reached - pose).nan_to_num().numpy().reshape(len(ys), len(xs), 3)
