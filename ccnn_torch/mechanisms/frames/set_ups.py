"""A machine in several set-ups: by group of rows another place of the measuring device, another tool."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from itertools import product

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, unflatten

from ccnn_torch.coordinates import Coordinate, Parameter, force_of, per_force, torque_of
from ccnn_torch.mechanisms.frames.fit import check_rows_of, groups_of, whole_rows
from ccnn_torch.mechanisms.frames.framed import Framed
from ccnn_torch.mechanisms.machines.serial import SerialArm
from ccnn_torch.mechanisms.mechanism import Mechanism
from ccnn_torch.mechanisms.pose import Frame, frame_gap
from ccnn_torch.numerics.least_squares import levenberg_marquardt
from ccnn_torch.numerics.outliers import inlying

GIVE = {"m": 1e-7, "rad": 2e-6}
"""Plausible compliance of a drive: 1e-7 m/N (10 N/µm), 2e-6 rad/(N·m)."""


class _Columned(Mechanism, ABC):
    """A machine with further columns behind its joints, and other parameters; its poses are the machine's."""

    def __init__(self, machine: Mechanism, more: Sequence[Coordinate], geometry: Sequence[Parameter]) -> None:
        super().__init__(
            name=machine.name,
            joints=[*machine.joints, *more],
            pose=machine.pose,
            geometry=geometry,
            low=machine.low.tolist(),
            high=machine.high.tolist(),
            home_pose=machine.home_pose.tolist(),
            home_joints=[*machine.home_joints.tolist(), *(0.0 for _ in more)],
        )
        self.machine, self.orientations = machine, machine.orientations

    @abstractmethod
    def inside(self, joints: Tensor, parameters: Tensor | None) -> tuple[Tensor, Tensor]:
        """Joints of the machine, and its parameters there."""

    def forward_frame(self, joints: Tensor, parameters: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """As of an arm."""
        assert isinstance(self.machine, SerialArm | SetUps)
        return self.machine.forward_frame(*self.inside(joints, parameters))

    def forward_kinematics(
        self, joints: Tensor, parameters: Tensor | None = None, guess: Tensor | None = None
    ) -> Tensor:
        """As of the machine."""
        return self.machine.forward_kinematics(*self.inside(joints, parameters), guess)

    def frame(self, pose: Tensor) -> Frame:
        """As of the machine."""
        return self.machine.frame(pose)


class Giving(_Columned):
    """A machine with the compliance of some joints as parameters behind its own, `compliance q2`.

    Its joints are those of the machine and, as the last columns, the force or torque of each of these drives: joint i
    is at q_i + c_i τ_i.

    Attributes:
        machine: stiff.
    """

    def __init__(self, machine: Mechanism, giving: Sequence[int]) -> None:
        """giving: numbers of the joints that give, from 0."""
        joints = [machine.joints[i] for i in giving]
        own = [Parameter(f"compliance {j.name}", per_force(j.unit), 0.0, scale=GIVE[j.unit]) for j in joints]
        torques = [Coordinate(torque_of(j), force_of(j.unit)) for j in joints]
        super().__init__(machine, torques, [*machine.geometry, *own])
        self._moves = torch.eye(len(machine.joints), dtype=torch.float64)[list(giving)]

    def one(self, parameters: Tensor) -> Mechanism:
        """The stiff machine, of parameters `K`, in the first set-up where it was in several."""
        values = parameters[: len(self.machine.geometry)]
        return self.machine.one(values) if isinstance(self.machine, SetUps) else self.machine.with_nominal(values)

    def inside(self, joints: Tensor, parameters: Tensor | None) -> tuple[Tensor, Tensor]:
        """Joints where they are, and the parameters of the stiff machine."""
        values, n, k = self.resolve(parameters), len(self.machine.joints), len(self.machine.geometry)
        return joints[..., :n] + (values[..., k:] * joints[..., n:]) @ self._moves, values[..., :k]


class SetUps(_Columned):
    """An arm or a framed machine with a base frame for each group of `frame_per`, a tool frame for each of `tool_per`.

    Its joints are those of the machine and, as the last column, the number of the row's set-up. Its parameters
    in order: the base frames, the machine's own, the tool frames, named as the machine's with the group behind,
    `base_x station 2`; a frame that all rows share is named as the machine's.

    Attributes:
        machine: with one base and one tool frame.
    """

    def __init__(self, machine: SerialArm | Framed, bases: Sequence[str], tools: Sequence[str]) -> None:
        """bases, tools: what each group is called; one each where all rows share a frame."""
        self._counts = len(bases), len(tools)
        base, tool = (True, True) if isinstance(machine, SerialArm) else (machine.base, machine.tool)
        # Of a base frame and of a tool frame.
        self._sizes: tuple[int, int] = 6 * base, 6 * tool

        def of(part: Sequence[Parameter], groups: Sequence[str], named: bool) -> list[Parameter]:
            each = product(groups, part)
            return [Parameter(f"{p.name} {g}" if named else p.name, p.unit, p.nominal) for g, p in each]

        first, last = self._sizes[0], len(machine.geometry) - self._sizes[1]
        own = [
            *of(machine.geometry[:first], bases, bool(machine.frame_per)),
            *machine.geometry[first:last],
            *of(machine.geometry[last:], tools, bool(machine.tool_per)),
        ]
        super().__init__(machine, [Coordinate("set-up", "1")], own)
        # Declared values are not the nominal ones of an arm whose frames were found before.
        every = torch.arange(len(bases) * len(tools))
        self.nominal.copy_(self.parameters_of(machine.nominal.expand(len(every), -1), every))

    def parameters_of(self, values: Tensor, numbers: Tensor) -> Tensor:
        """All parameters `... x K` of the machine's in rows of every group, `... x s x k`; numbers: of set-ups, `s`."""
        (bases, tools), first, last = self._counts, self._sizes[0], values.shape[-1] - self._sizes[1]
        base = [values[..., numbers // tools == b, :first][..., 0, :] for b in range(bases)]
        tool = [values[..., numbers % tools == t, last:][..., 0, :] for t in range(tools)]
        return torch.cat([*base, values[..., 0, first:last], *tool], -1)

    def of_rows(self, numbers: Tensor, parameters: Tensor | None = None) -> Tensor:
        """The machine's parameters in set-ups `... x s`, `... x s x k`; parameters: `... x 1 x K` or alike."""
        values, (bases, tools) = self.resolve(parameters), self._counts
        number = numbers.detach().round().long()
        of_base, of_tool = self._sizes
        first, last = bases * of_base, values.shape[-1] - tools * of_tool
        base, tool = (
            (torch.nn.functional.one_hot(which, count).to(values.dtype).unsqueeze(-2) @ part).squeeze(-2)
            for which, count, part in (
                (number // tools, bases, unflatten(values[..., :first], -1, (bases, of_base))),
                (number % tools, tools, unflatten(values[..., last:], -1, (tools, of_tool))),
            )
        )
        own = values[..., first:last].expand(*base.shape[:-1], -1)
        return torch.cat([base, own, tool], -1)

    def one(self, parameters: Tensor) -> Mechanism:
        """The machine in the first set-up, of parameters `K`."""
        return self.machine.with_nominal(self.of_rows(torch.zeros(()), parameters))

    def inside(self, joints: Tensor, parameters: Tensor | None) -> tuple[Tensor, Tensor]:
        """Joints of the machine, and the parameters of each row's set-up."""
        return joints[..., :-1], self.of_rows(joints[..., -1], parameters)


def set_ups(
    machine: SerialArm | Framed, columns: Mapping[str, NDArray[np.float64]] | None, rows: int
) -> tuple[SetUps, Tensor, list[tuple[str, Tensor]]]:
    """The machine in the set-ups of its rows, the number of each row's, `s`, and the rows of each group, by its name.

    Args:
        columns: of the records, `s` each; those of `frame_per` and `tool_per` are among them.
        rows: their number.

    Raises:
        InputError: a column that is not there.
    """
    base_of, bases = groups_of(machine, "frame_per", machine.frame_per, columns, rows)
    tool_of, tools = groups_of(machine, "tool_per", machine.tool_per, columns, rows)
    groups = [(n, of == i) for of, names in ((base_of, bases), (tool_of, tools)) for i, n in enumerate(names)]
    return SetUps(machine, bases, tools), base_of * len(tools) + tool_of, groups


# Rounds in which gross outliers are left out.
_ROUNDS = 3


def fit_set_ups(
    machine: Framed,
    joints: Tensor,
    pose: Tensor,
    weights: Tensor | None = None,
    columns: Mapping[str, NDArray[np.float64]] | None = None,
) -> Tensor:
    """All parameters of a framed machine in every row with the frames of its group fitted, `... x s x k`.

    Closed forms for each set-up alone; where set-ups have a frame in common, least squares from there.

    Args:
        joints, pose: `s x n`, `s x p` [SI]; a row that lacks a part of its pose (NaN) is left out.
        weights: `... x s`; 0 leaves a row out.
        columns: of the records, `s` each.

    Raises:
        InputError: a column that is not there, or a group with fewer than three rows.
    """
    twin, number, groups = set_ups(machine, columns, len(joints))
    weights, pose = whole_rows(pose, weights)
    for name, rows in groups:
        check_rows_of(machine.name, name, weights[..., rows], 3)
    count = int(number.max()) + 1
    shares = weights[..., None, :] * (number == torch.arange(count)[:, None])
    values = machine.inlying_frames(joints, pose, shares)[..., number, :]
    if not (machine.base and machine.tool):
        return values
    # A frame in common starts as in the set-up with most rows.
    order = torch.argsort(torch.bincount(number)[number], descending=True, stable=True)
    start = twin.parameters_of(values[..., order, :], number[order])
    inner, measured = machine.mechanism.pose_near(*machine.unseen(pose, values)), machine.frame(pose)
    inner = machine.mechanism.forward_kinematics(joints, machine.own_values(machine.nominal), inner)
    free = [k for k, p in enumerate(twin.geometry) if p.name.startswith(("base_", "tool_"))]
    spread = torch.eye(len(twin.geometry), dtype=start.dtype)[free]

    def gap(change: Tensor) -> Tensor:
        whole = twin.of_rows(number, (start + change @ spread)[..., None, :])
        return frame_gap(machine.frame(machine.seen(inner, whole)), measured, machine.rotation_weight)

    change, fine = start.new_zeros(*start.shape[:-1], len(free)), weights
    for _ in range(_ROUNDS):
        kept = fine
        change = levenberg_marquardt(lambda x, kept=kept: (kept[..., None] * gap(x)).flatten(-2), change).value
        length = torch.linalg.vector_norm(gap(change), dim=-1).nan_to_num(nan=torch.inf)
        fine = weights * inlying(length, weights > 0, len(machine.pose), len(free))
    return twin.of_rows(number, (start + change @ spread)[..., None, :])
