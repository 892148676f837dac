"""`ccnn compensate MODEL program.src out.src`: a program with corrected positions, every other byte as it was."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Protocol

import numpy as np
import torch

from ccnn_torch.compensation.job import ROWS
from ccnn_torch.compensation.model_files.load import LoadedModel
from ccnn_torch.compensation.outputs import DAMPED
from ccnn_torch.compensation.programs import G_CODE
from ccnn_torch.compensation.programs.gcode import GCode
from ccnn_torch.compensation.programs.literals import Array, Krl, Point, Rapid
from ccnn_torch.compensation.wanted import frames_of, nearest_measured, nearest_turns
from ccnn_torch.display import plain
from ccnn_torch.errors import FallbackWarning, InputError
from ccnn_torch.files.read import read_bytes
from ccnn_torch.files.write import write_whole
from ccnn_torch.mechanisms import SerialArm
from ccnn_torch.mechanisms.branches import ROUNDED, arrives, follow
from ccnn_torch.numerics.rotations import homogeneous, matrix_to_rotation_vector
from ccnn_torch.records.joint_map import read_joint_map

_LARGEST = 100_000_000
# By what share of their travel joints may be beyond random ones in it.
_EDGE = 0.005
# Lines that a sentence names at most.
_NAMED = 10


class Program(Protocol):
    """A text with positions in it."""

    points: list[Point]
    notes: list[str]

    def written(self, changed: Sequence[Array | None]) -> tuple[str, list[Array | None]]: ...


class Corrections:
    """New positions in the place of those of a program, as its controller has them."""

    def __init__(
        self,
        loaded: LoadedModel,
        allow_code: bool = False,
        tool: Sequence[float] | None = None,
        base: Sequence[float] | None = None,
    ) -> None:
        """Take the machine that the model was made for.

        Args:
            loaded: the model.
            allow_code: run the Python file that the model names as its mechanism.
            tool: of an arm, the tool of the positions from the end of the last link, x, y, z and rotation vector
                [m, rad]; that of the machine's file when None.
            base: the frame of the positions in the machine's own base; that itself when None.

        Raises:
            InputError: `tool` of a machine that is no arm.
        """
        measured = loaded.mechanism(allow_code)
        machine = measured.controlled()
        if isinstance(machine, SerialArm):
            keys = machine.recipe["keys"] | ({} if tool is None else {"tool": list(tool)})
            slides = len(machine.joints) <= 3
            machine = SerialArm(**keys | ({"orientation": "none"} if slides else {}))
        elif tool is not None:
            raise InputError(f"--tool: {loaded.path} was made for {machine.name}, which is no arm; leave it out")
        self._loaded, self._machine = loaded, machine
        self._base = np.eye(4) if base is None else frames_of(torch.tensor([*base], dtype=torch.float64)).numpy()
        self._counted = read_joint_map(loaded.joint_map, loaded.joints, loaded.columns)
        # Geometry alone holds as far as the joints go, measured or not.
        self._region = None
        if loaded.machine is not None and not len(loaded.machine.joints):
            low, high = loaded.region.T
            self._region = (low + high) / 2, (0.5 + _EDGE) * (high - low)
        self.turns = len(machine.joints) > 3 and machine.frame(machine.home_pose)[1] is not None
        # Where no orientation was measured the model does not know how the tool is turned.
        self.unseen = self.turns and getattr(measured, "orientation", "") == "none"

    def require(self, path: Path) -> None:
        """Refuse a machine whose positions are no x, y, z, with or without orientation."""
        machine = self._machine
        names, joints = [c.name for c in machine.pose], len(machine.joints)
        turned = path.suffix.lower() in G_CODE and 3 < joints < 6
        if names[:3] != ["x", "y", "z"] or len(names) not in (3, 6) or joints > 6 or turned:
            raise InputError(
                f"{path}: a program of {machine.name} ({joints} joints, pose {', '.join(names)}) has no positions x, "
                "y, z with or without a whole orientation; compensate a table of its joints"
            )

    def of(self, points: Sequence[Point]) -> tuple[list[Array | None], list[str], int]:
        """New frames or joints (None of those that stay), why each stays, and how many are damped."""
        ideal, reasons = self._ideal(points)
        centre = _middle(self._loaded)
        parts = []
        with warnings.catch_warnings():
            # Said for each position.
            warnings.simplefilter("ignore", FallbackWarning)
            for k in range(0, len(points), ROWS):
                rows = np.nan_to_num(ideal[k : k + ROWS])
                given = np.broadcast_to(centre, (len(rows), len(centre))) if len(centre) else None
                parts.append(self._loaded(rows, given, ("command",)))
        found = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
        inside = found["inside_domain"]
        if self._region is not None:
            inside = (np.abs(ideal - self._region[0]) <= self._region[1]).all(-1)
        frames = self._frames(found["command"])
        if not self.turns or self.unseen:
            # What a machine does not turn stays as it is written.
            for frame, point in zip(frames, points, strict=True):
                frame[:3, :3] = np.eye(3) if point.frame is None else point.frame[:3, :3]
        changed: list[Array | None] = []
        for k, point in enumerate(points):
            if not reasons[k]:
                if found["fallback"][k]:
                    reasons[k] = "the correction is above the limit of the model"
                elif not inside[k]:
                    reasons[k] = "outside what was measured"
                elif point.frame is not None and not np.isfinite(frames[k]).all():
                    reasons[k] = "the corrected pose is none of the machine"
            changed.append(
                None if reasons[k] else frames[k] if point.frame is not None else self._shown(found["command"][k])
            )
        damped = sum(not reason and status == DAMPED for reason, status in zip(reasons, found["status"], strict=True))
        return changed, reasons, damped

    def apart(self, points: Sequence[Point], stands: Sequence[Array | None]) -> Array:
        """Distance [m] and angle [rad] between positions and what stands in their place, where that is another."""
        pairs = [(p, there) for p, there in zip(points, stands, strict=True) if there is not None]
        frames = np.zeros((len(pairs), 2, 4, 4))
        turned = [k for k, (point, _) in enumerate(pairs) if point.frame is None]
        for k, (point, there) in enumerate(pairs):
            frames[k] = 0 if point.frame is None else np.stack([point.frame, there])
        if turned:
            joints = np.stack([[self._own(pairs[k][0].joints), self._own(pairs[k][1])] for k in turned])  # type: ignore[arg-type]
            frames[turned] = self._frames(joints.reshape(-1, joints.shape[-1])).reshape(-1, 2, 4, 4)
        was, now = torch.from_numpy(frames).unbind(1)
        turn = matrix_to_rotation_vector(now[:, :3, :3] @ was[:, :3, :3].mT).norm(dim=-1)
        return torch.stack([(now - was)[:, :3, 3].norm(dim=-1), turn], -1).numpy()

    def _ideal(self, points: Sequence[Point]) -> tuple[Array, list[str]]:
        """Joints of all positions, `s x n` [SI], and why there are none."""
        machine, reasons = self._machine, [point.left for point in points]
        joints, guess = np.full((len(points), len(machine.joints)), np.nan), None
        frames = [k for k, point in enumerate(points) if point.frame is not None]
        poses = torch.zeros(0, len(machine.pose), dtype=torch.float64)
        if frames:
            whole = torch.from_numpy(np.stack([self._base @ points[k].frame for k in frames]))  # type: ignore[operator]
            poses = whole[:, :3, 3]
            if len(machine.pose) == 6:
                poses = torch.cat([poses, matrix_to_rotation_vector(whole[:, :3, :3])], -1)
        # One branch alone, of any number of positions at once.
        one = not machine.orientations or (isinstance(machine, SerialArm) and not bool(machine.revolute.any()))
        solved = machine.solve_inverse(poses) if one and frames else None
        there = None if solved is None else arrives(machine, solved, poses, ROUNDED)
        at = {k: i for i, k in enumerate(frames)}
        for k, point in enumerate(points):
            if point.joints is not None:
                if len(point.joints) != len(machine.joints):
                    reasons[k] = f"has {len(point.joints)} axes, and the machine {len(machine.joints)}"
                    continue
                joints[k] = self._own(point.joints)
                guess = torch.from_numpy(joints[k])
            elif point.frame is not None:
                pose = poses[at[k]]
                if solved is None or there is None:
                    if guess is None:
                        guess = nearest_measured(machine, torch.from_numpy(self._loaded.measured), pose)
                    row = nearest_turns(machine, follow(machine, pose[None], guess, ROUNDED)[0], guess)
                    reached = bool(arrives(machine, row, pose, ROUNDED))
                else:
                    row, reached = solved[at[k]], bool(there[at[k]])
                if reached:
                    joints[k], guess = row.numpy(), row
                else:
                    reasons[k] = "out of reach"
        return joints, reasons

    def _frames(self, joints: Array) -> Array:
        """Of the nominal machine, in the frame of the program, `s x 4 x 4`."""
        pose = self._machine.forward_kinematics(torch.from_numpy(np.asarray(joints)))
        position, rotation = self._machine.frame(pose)
        turned = torch.eye(3, dtype=position.dtype).expand(len(joints), 3, 3) if rotation is None else rotation
        return np.asarray(np.linalg.inv(self._base) @ homogeneous(turned, position).numpy())

    def _own(self, joints: Array) -> Array:
        return joints if self._counted is None else self._counted.of_shown(joints)

    def _shown(self, joints: Array) -> Array:
        return joints if self._counted is None else self._counted.shown(joints)


def compensate_program(
    loaded: LoadedModel,
    input: Path,
    output: Path,
    allow_code: bool = False,
    tool: Sequence[float] | None = None,
    base: Sequence[float] | None = None,
) -> tuple[list[str], str]:
    """Write a program with the positions to command; all else stays, byte by byte.

    Args:
        loaded: as `load_compensation` gives it.
        input, output: programs of G-code, KRL or RAPID; by the ending of their names.
        allow_code, tool, base: as of `Corrections`.

    Returns:
        Sentences on what was changed; and one on the positions that were left, else empty.

    Raises:
        InputError: the program cannot be read, or has what its positions do not follow; nothing is written then.
    """
    corrections = Corrections(loaded, allow_code, tool, base)
    corrections.require(input)
    # Every byte is a letter of this code, and comes back as it was.
    text = read_bytes(input, _LARGEST, "give the path of a program").decode("latin-1")
    if "\0" in text:
        raise InputError(f"{input}: is no text of one byte a letter; save it as UTF-8 or ANSI")
    try:
        program = _reader(input.suffix.lower())(text, corrections.turns)
    except InputError as reason:
        raise InputError(f"{input}: {reason}") from None
    if not program.points:
        raise InputError(f"{input}: has no position that a correction could be made of")
    changed, reasons, damped = corrections.of(program.points)
    found, stands = program.written(changed)
    write_whole(output, found.encode("latin-1"))
    moved = corrections.apart(program.points, stands)
    said = [f"{output}: {len(moved)} of {len(program.points)} positions corrected{_by(moved, corrections.turns)}."]
    if damped:
        said.append(
            f"{damped} of them near a singular pose or at a limit of the joints (key limits of the machine's file), "
            "with the nearest safe command."
        )
    if loaded.covariates:
        at = ", ".join(f"{plain(c.name)} = {v:.4g}" for c, v in zip(loaded.covariates, _middle(loaded), strict=True))
        said.append(f"A program does not say the covariates; they stand in the middle of what was measured: {at}.")
    if corrections.unseen:
        said.append(
            "Orientations stay as written: none was measured, so the model does not know how the tool is turned."
        )
    if base is None and corrections.turns:
        said.append(
            "Positions were taken in the machine's own base, of an arm for the tool of its file; give --base and "
            "--tool where the program has others."
        )
    early = [point.line for point in program.points if point.early]
    if early and len(moved):
        said.append(f"Left as they are, since not all axes are known yet: {_at(early)}.")
        reasons = ["" if p.early else why for p, why in zip(program.points, reasons, strict=True)]
    return [*said, *program.notes], _refused(input, output, program.points, reasons)


def _reader(ending: str) -> Callable[[str, bool], Program]:
    if ending in G_CODE:
        return GCode
    return (lambda text, _: Krl(text)) if ending in (".src", ".dat") else (lambda text, _: Rapid(text))


def _middle(loaded: LoadedModel) -> Array:
    """Covariates in the middle of what was measured, `m` [SI]."""
    if loaded.machine is not None:
        return loaded.machine.edges.mean(-1).numpy()
    edges = [loaded.facts["domain"]["inputs"][c.name] for c in loaded.covariates]
    return np.array([(edge["low"] + edge["high"]) / 2 for edge in edges])


def _by(moved: Array, turns: bool) -> str:
    if not len(moved):
        return ""
    (most, turned), (half, half_turned) = moved.max(0), np.median(moved, 0)
    if not turns:
        return f", by {1e3 * most:.3g} mm at most, {1e3 * half:.3g} mm in the median"
    return (
        f", by {1e3 * most:.3g} mm and {np.degrees(turned):.3g} deg at most, {1e3 * half:.3g} mm and "
        f"{np.degrees(half_turned):.3g} deg in the median"
    )


def _refused(input: Path, output: Path, points: Sequence[Point], reasons: Sequence[str]) -> str:
    """What is left as it was, by reason; empty where nothing is."""
    lines: dict[str, list[int]] = {}
    for point, reason in zip(points, reasons, strict=True):
        if reason:
            lines.setdefault(reason, []).append(point.line)
    if not lines:
        return ""
    told = "; ".join(f"{reason}: {_at(at)}" for reason, at in lines.items())
    return (
        f"{output}: {sum(map(len, lines.values()))} of {len(points)} positions of {input} were left without any "
        f"correction ({told}); look at them before you run it"
    )


def _at(lines: Sequence[int]) -> str:
    return f"line{'s' * (len(lines) > 1)} {', '.join(map(str, lines[:_NAMED]))}{' …' * (len(lines) > _NAMED)}"
