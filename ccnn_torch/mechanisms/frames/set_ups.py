"""An arm that was measured in several set-ups: by group of rows another place of the measuring device, another tool."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import product

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, unflatten

from ccnn_torch.coordinates import Coordinate, Parameter
from ccnn_torch.mechanisms.frames.fit import groups_of
from ccnn_torch.mechanisms.machines.serial import SerialArm
from ccnn_torch.mechanisms.mechanism import Mechanism
from ccnn_torch.mechanisms.pose import Frame


class SetUps(Mechanism):
    """An arm with a base frame for each group of `frame_per`, and a tool frame for each of `tool_per`.

    Its joints are those of the arm and, as the last column, the number of the row's set-up (`numbers`). Its parameters
    in order: the base frames, the arm's links, the tool frames, named as the arm's with the group behind,
    `base_x station 2`; a frame that all rows share is named as the arm's.

    Attributes:
        arm: with one base and one tool frame.
    """

    def __init__(self, arm: SerialArm, bases: Sequence[str], tools: Sequence[str]) -> None:
        """bases, tools: what each group is called; one each where all rows share a frame."""
        self._counts = len(bases), len(tools)

        def of(part: Sequence[Parameter], groups: Sequence[str], named: bool) -> list[Parameter]:
            each = product(groups, part)
            return [Parameter(f"{p.name} {g}" if named else p.name, p.unit, p.nominal) for g, p in each]

        base, links, tool = arm.geometry[:6], arm.geometry[6:-6], arm.geometry[-6:]
        super().__init__(
            name=arm.name,
            joints=[*arm.joints, Coordinate("set-up", "1")],
            pose=arm.pose,
            geometry=[*of(base, bases, bool(arm.frame_per)), *links, *of(tool, tools, bool(arm.tool_per))],
            low=arm.low.tolist(),
            high=arm.high.tolist(),
            home_pose=arm.home_pose.tolist(),
            home_joints=[*arm.home_joints.tolist(), 0.0],
        )
        self.arm = arm
        self.orientations = arm.orientations
        # Declared values are not the nominal ones of an arm whose frames were found before.
        every = torch.arange(len(bases) * len(tools))
        self.nominal.copy_(self.parameters_of(arm.nominal.expand(len(every), -1), every))

    def parameters_of(self, values: Tensor, numbers: Tensor) -> Tensor:
        """All parameters `K` of those of the arm in rows of every group, `s x k`; numbers: of their set-ups, `s`."""
        bases, tools = self._counts
        base = [values[numbers // tools == b][0, :6] for b in range(bases)]
        tool = [values[numbers % tools == t][0, -6:] for t in range(tools)]
        return torch.cat([*base, values[0, 6:-6], *tool])

    def of_rows(self, numbers: Tensor, parameters: Tensor | None = None) -> Tensor:
        """The arm's parameters in set-ups `... x s`, `... x s x k`; parameters: `... x 1 x K` or alike."""
        values, (bases, tools) = self.resolve(parameters), self._counts
        number = numbers.detach().round().long()
        base, tool = (
            (torch.nn.functional.one_hot(which, count).to(values.dtype).unsqueeze(-2) @ part).squeeze(-2)
            for which, count, part in (
                (number // tools, bases, unflatten(values[..., : 6 * bases], -1, (bases, 6))),
                (number % tools, tools, unflatten(values[..., -6 * tools :], -1, (tools, 6))),
            )
        )
        links = values[..., 6 * bases : -6 * tools].expand(*base.shape[:-1], -1)
        return torch.cat([base, links, tool], -1)

    def one(self, parameters: Tensor) -> SerialArm:
        """The arm in the first set-up, of parameters `K`."""
        arm = self.arm.with_nominal(self.of_rows(torch.zeros(()), parameters))
        assert isinstance(arm, SerialArm)
        return arm

    def forward_frame(self, joints: Tensor, parameters: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """As of the arm, each row in its set-up."""
        return self.arm.forward_frame(joints[..., :-1], self.of_rows(joints[..., -1], parameters))

    def forward_kinematics(
        self, joints: Tensor, parameters: Tensor | None = None, guess: Tensor | None = None
    ) -> Tensor:
        """As of the arm, each row in its set-up."""
        return self.arm.forward_kinematics(joints[..., :-1], self.of_rows(joints[..., -1], parameters), guess)

    def frame(self, pose: Tensor) -> Frame:
        """As of the arm."""
        return self.arm.frame(pose)


def set_ups(
    arm: SerialArm, columns: Mapping[str, NDArray[np.float64]], rows: int
) -> tuple[SetUps, Tensor, list[tuple[str, Tensor]]]:
    """The arm in the set-ups of its rows, the number of each row's, `s`, and the rows of each group, by its name.

    Args:
        columns: of the records, `s` each; those of `frame_per` and `tool_per` are among them.
        rows: their number.

    Raises:
        InputError: a column that is not there.
    """
    base_of, bases = groups_of(arm, "frame_per", arm.frame_per, columns, rows)
    tool_of, tools = groups_of(arm, "tool_per", arm.tool_per, columns, rows)
    groups = [(n, of == i) for of, names in ((base_of, bases), (tool_of, tools)) for i, n in enumerate(names)]
    return SetUps(arm, bases, tools), base_of * len(tools) + tool_of, groups
