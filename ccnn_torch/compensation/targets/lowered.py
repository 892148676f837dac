"""From an identified machine to the parameters that a stack's model has, and what is left over."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ccnn_torch.compensation.fit import ROWS, rows_of
from ccnn_torch.compensation.machine import RULE, ForwardMachine
from ccnn_torch.compensation.model_files.load import LoadedModel
from ccnn_torch.display import number_text, plain
from ccnn_torch.effects import Situation, measured_pose, reached
from ccnn_torch.errors import MethodFailedError
from ccnn_torch.mechanisms import Mechanism, SerialArm
from ccnn_torch.mechanisms.frames.framed import Framed
from ccnn_torch.mechanisms.mechanism_file import chain_of
from ccnn_torch.mechanisms.pose import frame_gap
from ccnn_torch.numerics.least_squares import levenberg_marquardt
from ccnn_torch.numerics.rotations import (
    euler_zyx_to_matrix,
    matrix_to_euler_zyx,
    matrix_to_rotation_vector,
    rotation_vector_to_matrix,
)

Array = NDArray[np.float64]


@dataclass
class Found:
    """What is known of a real machine, and rows all over the domain of the model.

    Attributes:
        model: as loaded.
        current: the user's own file of the stack, None where none was given.
        allow_code: run the Python file that the model names as its mechanism.
    """

    model: LoadedModel
    current: Path | None = None
    allow_code: bool = False

    @cached_property
    def nominal(self) -> Mechanism:
        """The machine as it was taken to be, in the frames that were identified."""
        machine, found = self._known
        values = machine.nominal.clone()
        if isinstance(machine, SerialArm):
            values[:6], values[-6:] = found[:6], found[-6:]
        return machine.with_nominal(values)

    @cached_property
    def identified(self) -> Mechanism:
        """The geometry that alone comes nearest to the whole model: where nothing acts beside it, the identified one.

        What was identified beside effects is of no use without them.
        """
        machine, values = self._known
        start = machine.with_nominal(values)
        return nearest_geometry(start, self.rows.joints, self.truth) if self.beside else start

    @cached_property
    def _known(self) -> tuple[Mechanism, Tensor]:
        """The nominal machine, and all identified parameters."""
        compensator = self.model.compensator if self.model.machine is None else None
        made = None if compensator is None else compensator.machine
        # Of an arm measured by positions alone it turns the tool as well.
        if isinstance(made, ForwardMachine) and isinstance(made.mechanism, SerialArm):
            return made.mechanism, made.identified
        return self.model.mechanism(self.allow_code), self.model.identified(self.allow_code).nominal

    @cached_property
    def rows(self) -> Situation:
        """Commanded joints and covariates, `s x n`, of which all have a pose."""
        machine = self.model.machine
        if machine is not None:
            rows = rows_of(machine)
        else:
            low, high = torch.from_numpy(self.model.region).unbind(-1)
            share = torch.rand(ROWS, len(low), generator=torch.Generator().manual_seed(0), dtype=torch.float64)
            rows = Situation(self.nominal, low + (high - low) * share, {}, torch.zeros(3, dtype=torch.float64))
        there = torch.isfinite(self.nominal.with_nominal(self._known[1]).forward_kinematics(rows.joints)).all(-1)
        given = {name: value[there] for name, value in rows.covariates.items()}
        return Situation(rows.mechanism, rows.joints[there], given, rows.gravity, travel=rows.travel)

    @cached_property
    def truth(self) -> Tensor:
        """Poses of the real machine at the rows, effects and what was learned included, `s x p` [SI]."""
        if self.model.machine is not None:
            machine = self.model.machine
            return measured_pose(self.rows, reached(self.rows, machine.acting, machine.values))
        compensator, joints = self.model.compensator, self.rows.joints
        assert compensator is not None
        centre = compensator.domain.centre[joints.shape[1] :].expand(len(joints), -1)
        given = centre if compensator.covariates else None
        with torch.no_grad():
            if compensator.machine is not None and isinstance(self.nominal, SerialArm):
                there = compensator.machine.reached(joints + compensator.learned(joints, given), centre)
                turns = [] if there.rotation is None else [matrix_to_rotation_vector(there.rotation)]
                return torch.cat([there.position, *turns], -1)
            # The ideal joints are those at which the nominal machine is where the real one is.
            ideal = compensator.back(joints, given)
        made_for = self.model.mechanism(self.allow_code)
        return made_for.forward_kinematics(ideal)

    @property
    def beside(self) -> str:
        """What acts beside the geometry."""
        if self.model.machine is not None:
            return ", ".join(one.effect.name for one in self.model.machine.acting)
        compensator = self.model.compensator
        if compensator is not None and compensator.machine is not None:
            if compensator.machine.effects:
                return "effects, and what was learned"
            return "what was learned" if bool(compensator.limit.any()) else ""
        return "what was learned"


class Stack(NamedTuple):
    """What a stack reads.

    Attributes:
        files: contents by name.
        held: the machine that the numbers of the files describe, as the stack computes it.
        load: how to load the files, as Markdown.
    """

    files: dict[str, str]
    held: Mechanism
    load: str


def with_readme(stack: Stack, found: Found, title: str) -> tuple[dict[str, str], str]:
    """Files with a README.md that says how to load them and what they leave; and that sentence.

    Raises:
        MethodFailedError: they leave more than the nominal machine does.
    """
    said = left_over(stack.held, found)
    if _weighed(stack.held, found) > _weighed(found.nominal, found) + _NONE:
        raise MethodFailedError(
            f"numbers of this form would leave {_told(rms(stack.held, found))}, more than the "
            f"{_told(rms(found.nominal, found))} of the nominal machine; export c99, st or onnx, which hold the whole "
            "model"
        )
    return stack.files | {"README.md": f"# {title}\n\n{stack.load}\n\n{said}\n"}, said


# What files lose by the digits that they write [m].
_NONE = 1e-7


def _weighed(machine: Mechanism, found: Found) -> float:
    """`rms` of position and rotation as one length [m]."""
    return math.hypot(*(w * e for w, e in zip((1.0, RULE.rotation_weight), rms(machine, found), strict=False)))


# A parameter that moves by 10 mm or 10 mrad counts as much as 1 um of all rows: what these hardly see stays.
_STAYS = 1e-4


def nearest_geometry(start: Mechanism, joints: Tensor, poses: Tensor) -> Mechanism:
    """The machine with the parameters by which it comes nearest to poses, position and weighted rotation.

    Args:
        start: with the parameters to begin from; those that are known stay.
        joints: `s x n` [SI].
        poses: `s x p` [SI]; rows that lack something (NaN) are left out.
    """
    fine = torch.isfinite(poses).all(-1)
    joints, poses = joints[fine], poses[fine]
    there = start.frame(poses)
    free = torch.tensor([not p.held for p in start.geometry])
    stays = _STAYS * math.sqrt(len(joints)) * torch.eye(int(free.sum()), dtype=torch.float64)

    def both(change: Tensor) -> tuple[Tensor, Tensor]:
        values = start.nominal.clone()
        values[free] += change
        here = start.frame(start.forward_kinematics(joints, values, poses))
        slope = start.parameter_jacobian(joints, values, poses)[..., free]
        slope[:, 3:] *= RULE.rotation_weight
        gap = frame_gap(here, there, RULE.rotation_weight)
        return torch.cat([gap.flatten(), stays @ change]), torch.cat([slope.flatten(0, 1), stays])

    change = levenberg_marquardt(lambda c: both(c)[0], torch.zeros(len(stays), dtype=torch.float64), both=both).value
    values = start.nominal.clone()
    values[free] += change
    return start.with_nominal(values)


def left_over(held: Mechanism, found: Found) -> str:
    """How far the machine of a stack is from the real one over the domain, as a sentence."""

    most = [float(error.max()) for error in _errors(held, found)]
    said = (
        f"Over {len(found.rows.joints)} random joints of the domain of the model this leaves {_told(rms(held, found))} "
        f"(RMS), {_told(most)} at most, of {_told(rms(found.nominal, found))} of the nominal machine."
    )
    if found.beside:
        said += (
            f" Numbers of a geometry hold nothing of {plain(found.beside)}; those that come nearest to the whole model "
            f"leave {_told(rms(found.identified, found))}."
        )
    return said


def rms(machine: Mechanism, found: Found) -> list[float]:
    """How far a machine is from the real one: position [m] and, where there is an orientation, rotation [rad]."""
    return [float(error.square().mean().sqrt()) for error in _errors(machine, found)]


def _errors(machine: Mechanism, found: Found) -> list[Tensor]:
    pose = machine.forward_kinematics(found.rows.joints, guess=found.truth)
    return [e[torch.isfinite(e)] for e in machine.pose_error(pose, found.truth) if e is not None]


def _told(values: Sequence[float]) -> str:
    return " and ".join(f"{_short(1e6 * v)} {unit}" for v, unit in zip(values, ("um", "urad"), strict=False))


def _short(value: float) -> str:
    return number_text(value, 3) if value >= 1e-3 else "less than 0.001"


class Chain(NamedTuple):
    """An arm as transforms `4 x 4` [m] at joints of zero, each joint turning about or moving along its frame's z.

    base · origins[0] · joint 1 · origins[1] · joint 2 … joint n · last
    """

    base: Array
    origins: list[Array]
    last: Array

    @property
    def frames(self) -> list[Array]:
        """Of the joints in the arm's own base."""
        found = [self.origins[0]]
        for origin in self.origins[1:]:
            found.append(found[-1] @ origin)
        return found

    def through(self, start: Array, frames: Sequence[Array]) -> Chain:
        """The same arm with other frames on the same axes, and its own base elsewhere."""
        before = [start, *frames[:-1]]
        end = self.frames[-1] @ self.last
        origins = [np.linalg.inv(a) @ b for a, b in zip(before, frames, strict=True)]
        return Chain(self.base @ start, origins, np.linalg.inv(frames[-1]) @ end)


def chain(arm: SerialArm) -> Chain:
    """The nominal parameters of an arm.

    Raises:
        MethodFailedError: its drives have leads or couplings, which no chain has.
    """
    if arm.drives:
        raise MethodFailedError(
            f"this format has no key for the leads and couplings of '{arm.name}'; export c99, st or onnx"
        )
    base, origins, last = chain_of(arm)
    turns = [_z_to(v) for v in (arm.axes * arm.signs[:, None]).numpy()]
    moved = [matrix(*origin) @ turn for origin, turn in zip(origins, turns, strict=True)]
    for k, turn in enumerate(turns[:-1]):
        moved[k + 1] = turn.T @ moved[k + 1]
    return Chain(matrix(*base), moved, turns[-1].T @ matrix(*last))


def arm_of(made: Chain, like: SerialArm, offsets: Sequence[float] | None = None) -> SerialArm:
    """A chain as an arm; offsets: what joints are beyond what they show [SI]."""
    shifts = offsets or [0.0] * len(made.origins)
    moved = [
        origin @ screw(*((0.0, o) if turns else (o, 0.0)))
        for origin, o, turns in zip(made.origins, shifts, like.revolute.tolist(), strict=True)
    ]
    return links_of(made, like, "urdf", [[*place_of(m), *rpy(m)] for m in moved])


def links_of(made: Chain, like: SerialArm, convention: str, links: list[list[float]]) -> SerialArm:
    """An arm of links in a convention, between the frames of a chain."""
    types = ["revolute" if turns else "prismatic" for turns in like.revolute.tolist()]
    keys = {key: like.recipe["keys"][key] for key in ("name", "limits", "orientation", "rotation_weight")}
    return SerialArm(
        convention=convention, links=links, joint_types=types, base=pose_of(made.base), tool=pose_of(made.last), **keys
    )


def matrix(rotation: Any, place: Any) -> Array:
    """`4 x 4` of a rotation `3 x 3` and a place `3`."""
    found = np.eye(4)
    found[:3, :3], found[:3, 3] = rotation, place
    return found


def screw(along: float, about: float) -> Array:
    """`4 x 4` of a shift along z [m] and a turn about it [rad]."""
    s, c = np.sin(about), np.cos(about)
    return matrix([[c, -s, 0], [s, c, 0], [0, 0, 1]], [0, 0, along])


def rpy(frame: Array) -> list[float]:
    """Roll, pitch and yaw of a `4 x 4` [rad]."""
    found: list[float] = matrix_to_euler_zyx(torch.from_numpy(frame[:3, :3].copy())).flip(-1).tolist()
    return found


def of_rpy(xyz: Sequence[float], angles: Sequence[float]) -> Array:
    """`4 x 4` of a place [m] and roll, pitch, yaw [rad]."""
    turned = torch.tensor(list(angles), dtype=torch.float64).flip(-1)
    return matrix(euler_zyx_to_matrix(turned).numpy(), xyz)


def written(value: float) -> str:
    """A number [m or rad] without an exponent, which readers of YAML 1.1 take for text without a point."""
    return f"{value:.15f}"


def place_of(frame: Array) -> list[float]:
    """x, y, z [m]."""
    found: list[float] = frame[:3, 3].tolist()
    return found


def pose_of(frame: Array) -> list[float]:
    """x, y, z and rotation vector [m, rad]."""
    return [*place_of(frame), *matrix_to_rotation_vector(torch.from_numpy(frame[:3, :3].copy())).tolist()]


def nearest_on(axis: Array, wanted: Array) -> Array:
    """The frame on the z axis of one that is nearest to another, `4 x 4` each."""
    gap = np.linalg.inv(axis) @ wanted
    return axis @ screw(gap[2, 3], np.arctan2(gap[1, 0] - gap[0, 1], gap[0, 0] + gap[1, 1]))


def told_frame(frame: Array) -> str:
    """A frame for people: x, y, z [m] and roll, pitch, yaw [rad]."""
    return f"xyz {' '.join(f'{v:.12f}' for v in place_of(frame))}, rpy {' '.join(f'{v:.12f}' for v in rpy(frame))}"


_NOTHING = 1.03


def zeros_of(found: Found, arm: SerialArm) -> list[float]:
    """What the joints are beyond what they show [SI], by which the nominal arm comes nearest to the real one.

    0 of those without which the rest is the same but for a few percent: nothing was found at these.
    """
    nominal, joints = found.nominal, found.rows.joints
    offsets = torch.zeros(len(arm.joints), dtype=torch.float64)
    for _ in range(5):
        moved = joints + offsets
        here = nominal.frame(nominal.forward_kinematics(moved))
        gap = frame_gap(nominal.frame(found.truth), here, arm.rotation_weight)
        slope = nominal.jacobian(moved)
        slope[:, 3:] *= arm.rotation_weight
        step = torch.linalg.lstsq(slope.flatten(0, 1), gap.flatten()[:, None]).solution[:, 0]
        offsets = offsets + step
    values: list[float] = offsets.tolist()
    whole = sum(rms(arm_of(chain(arm), arm, values), found))
    for k in range(len(values)):
        without = [*values[:k], 0.0, *values[k + 1 :]]
        if sum(rms(arm_of(chain(arm), arm, without), found)) <= _NOTHING * whole:
            values = without
    return values


def _z_to(axis: Array) -> Array:
    """The smallest turn that brings z to an axis, `4 x 4`."""
    cross, z = np.array([-axis[1], axis[0], 0.0]), axis[2]
    size = float(np.hypot(cross[0], cross[1]))
    about = np.array([1.0, 0, 0]) if size < 1e-12 else cross / size
    turn = torch.from_numpy(about * np.arctan2(size, z))
    return matrix(rotation_vector_to_matrix(turn).numpy(), np.zeros(3))


def inner_of(machine: Mechanism) -> tuple[Mechanism, Callable[[Tensor], Mechanism]]:
    """The machine that a firmware knows, and what makes the whole one, measuring frames included, of its parameters."""
    if not isinstance(machine, Framed):
        return machine, machine.with_nominal
    inner, first = machine.mechanism, 6 * machine.base

    def seen(values: Tensor) -> Mechanism:
        whole = machine.nominal.clone()
        whole[first : first + len(values)] = values
        return machine.with_nominal(whole)

    return inner, seen
