"""The interface of a simulated machine to a run, for the case studies and for realistic machines."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ccnn_torch.errors import InputError
from ccnn_torch.mechanisms import Mechanism, PoseError, load_mechanism

CASES = ("tripod", "machine_tool")
VARIANTS = ("printed", "tabulated")


@dataclass(frozen=True)
class Simulation:
    """A machine with known true behaviour.

    Attributes:
        pose: poses wanted, `r x s x p` [SI].
        noise: what noise adds to the joint deviations as they are learned, `r x s x n` [SI].
        noise_variance: its variance, `r x s x n` [SI²].
        pose_errors: distance from the poses wanted to those that the machine reaches under a command `r x s x n` [SI],
            `r x s` each: as it is, and without the scatter of the machine itself. A machine whose noise is all in the
            measurement has none, and both are one.
        unlearnable: part of the signal that no function of the inputs can follow, `r x s x n` [SI], or None.
    """

    pose: Tensor
    noise: Tensor
    noise_variance: Tensor
    pose_errors: Callable[[Tensor], tuple[PoseError, PoseError]]
    unlearnable: Tensor | None = None


@dataclass(frozen=True)
class CaseStudy:
    """One case: rows in the order of t = 1..s.

    Attributes:
        pose: ideal poses, `s x p` [SI].
        joints: ideal joints, `s x n` [m].
        time: the paper's t, `s` [1].
        learnable: the error without noise and without the part that no function of the joints can follow, `s x n` [m].
        unlearnable: that part (the chirp of eq. 19), `s x n` [m].
        sigma: standard deviation of the noise, `n` [m].
    """

    name: str
    mechanism: Mechanism
    pose: Tensor
    joints: Tensor
    time: Tensor
    learnable: Tensor
    unlearnable: Tensor
    sigma: Tensor

    def noise(self, seeds: list[int]) -> Tensor:
        """Noise of each repeat, from its own seed; `r x s x n` [m]."""
        draws = [np.random.default_rng([seed, 1]).standard_normal(tuple(self.joints.shape)) for seed in seeds]
        return torch.as_tensor(np.stack(draws)) * self.sigma

    def measured(self, noise: Tensor) -> Tensor:
        """Poses that the machine reaches with this noise. noise: `r x s x n` [m]; returns `r x s x p` [SI]."""
        joints = self.joints + self.learnable + self.unlearnable + noise
        return self.mechanism.forward_kinematics(joints, guess=self.pose.expand(*noise.shape[:-1], -1))

    def pose_error(self, command: Tensor, noise: Tensor | float = 0.0) -> PoseError:
        """Distance from the ideal poses to those that the machine reaches. command: `... x s x n` [m]; `... x s`."""
        ideal = self.pose.expand(*command.shape[:-1], -1)
        reached = self.mechanism.forward_kinematics(command + self.learnable + self.unlearnable + noise, guess=ideal)
        return self.mechanism.pose_error(reached, ideal)

    def simulated(self, noise: Tensor) -> Simulation:
        """The case with the noise of each repeat, `r x s x n` [m], which is scatter of the machine itself."""
        chirp = self.unlearnable.expand(noise.shape) if bool(self.unlearnable.any()) else None
        pose, variance = self.pose.expand(len(noise), -1, -1), self.sigma.square().expand(noise.shape)
        return Simulation(pose, noise, variance, lambda q: (self.pose_error(q, noise), self.pose_error(q)), chirp)


def build_case(name: str, variant: str = "printed", order: Literal["raster", "shuffled"] = "raster") -> CaseStudy:
    """Build a case study.

    Args:
        name: `tripod` (case one, eq. 15 and 17) or `machine_tool` (case two, eq. 18 and 19).
        variant: case two only. `printed` has the standard deviations of eq. 19; `tabulated` those that the spread of
            Table III implies (about 4e-6, 2.1e-5 and 3.6e-6 m), since the two contradict each other.
        order: `raster` visits the grid in order, so that a function of t is also one of the joints; `shuffled` visits
            the same poses in a fixed random order, so that only a constant can be learned.

    Raises:
        InputError: unknown name, variant or order.
    """
    _one_of("case", name, CASES)
    _one_of("variant", variant, VARIANTS)
    _one_of("order", order, ("raster", "shuffled"))
    mechanism = load_mechanism(name)
    grid = _tripod_poses() if name == "tripod" else _machine_tool_poses()
    if order == "shuffled":
        grid = np.random.default_rng(0).permutation(grid)
    t = np.arange(1, len(grid) + 1, dtype=np.float64)
    learnable, unlearnable, sigma = _tripod_errors(t) if name == "tripod" else _machine_tool_errors(t, variant)
    pose = torch.as_tensor(grid)
    return CaseStudy(
        name=name,
        mechanism=mechanism,
        pose=pose,
        joints=mechanism.solve_inverse(pose),
        time=torch.as_tensor(t),
        learnable=torch.as_tensor(learnable),
        unlearnable=torch.as_tensor(unlearnable),
        sigma=torch.as_tensor(sigma),
    )


_Errors = tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]


def _tripod_poses() -> NDArray[np.float64]:
    """125 poses (y, z, phi) in raster order, y slowest: condition number at most 11.5, one assembly mode."""
    axes = (np.linspace(-0.2, 0.2, 5), np.linspace(0.4, 0.7, 5), np.linspace(-0.3, 0.3, 5))
    return _raster(*axes)


def _tripod_errors(t: NDArray[np.float64]) -> _Errors:
    """Eq. 17."""
    phase = np.deg2rad(0.5 * t)
    errors = np.stack(
        [
            -1e-4 + 1e-5 * np.sin(phase),
            1e-4 - 1e-5 * np.cos(phase),
            1.2e-4 + 5e-5 * np.sin(phase) + 5e-6 * np.cos(phase),
        ],
        axis=-1,
    )
    return errors, np.zeros_like(errors), np.full(3, 1e-5)


def _machine_tool_poses() -> NDArray[np.float64]:
    """152 = 5³ + 3³ poses (theta_x, theta_y, z), theta_x slowest."""
    tilt = np.deg2rad(np.linspace(-15.0, 15.0, 5))
    coarse = _raster(tilt, tilt, np.linspace(0.5, 0.7, 5))
    fine_tilt = np.deg2rad(np.array([-11.0, 1.0, 12.0]))
    return np.concatenate([coarse, _raster(fine_tilt, fine_tilt, np.array([0.53, 0.61, 0.68]))])


def _machine_tool_errors(t: NDArray[np.float64], variant: str) -> _Errors:
    """Eq. 19, its third time term read as 1e-5 / (1 + exp(-t))."""
    learnable = np.stack(
        [np.full_like(t, 6e-4), 3e-4 + 1e-5 * np.cos(t) * np.exp(-t), 4.8e-4 + 1e-5 / (1 + np.exp(-t))], axis=-1
    )
    chirp = np.zeros_like(learnable)
    chirp[:, 0] = 1e-5 * np.sin(t) * np.sin(t**2 / np.pi)
    sigma = (2e-5, 5e-4, 2.5e-5) if variant == "printed" else (4e-6, 2.1e-5, 3.6e-6)
    return learnable, chirp, np.array(sigma)


def _raster(*axes: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, len(axes))


def _one_of(key: str, value: str, known: tuple[str, ...]) -> None:
    if value not in known:
        raise InputError(f"{key}={value!r} is unknown; write one of {', '.join(known)}")
