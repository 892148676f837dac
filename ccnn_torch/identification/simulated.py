"""Simulated machines: parameters drawn, poses chosen (random, even or planned), joints and measurements with noise.

A pose X is given and the machine with the parameters θ takes it with the joints g(X; θ): what a controller would have
to command, and what the encoders then say. A serial arm is given joints and takes the pose f(q; θ).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ccnn_torch.config.sizes import Size, size, sizes_by_name, sizes_of_joints, sizes_of_pose
from ccnn_torch.coordinates import Coordinate, plausible_error
from ccnn_torch.errors import InputError
from ccnn_torch.identification.config import IdentifyConfig, SimulateConfig, base_method
from ccnn_torch.identification.judge import commanded, figures
from ccnn_torch.identification.measured import Kinematics, Measured, Rows, make_kinematics
from ccnn_torch.identification.solve import QUICK, Outcome, leg_of, pieces_of, run_method, select
from ccnn_torch.mechanisms import Framed, Mechanism, SerialArm
from ccnn_torch.planning import choose_poses


def generator_of(*seeds: int) -> torch.Generator:
    """A generator of its own for each tuple of seeds; numpy's hashing makes neighbouring seeds independent."""
    state = np.random.SeedSequence(seeds).generate_state(1, np.uint64)[0]
    return torch.Generator().manual_seed(int(state >> np.uint64(1)))


def normal_draws(shape: Sequence[int], seeds: Sequence[int], *stream: int) -> Tensor:
    """Standard normal numbers, `r x shape`; machine k's depend on its own seed alone."""
    draws = [torch.randn(tuple(shape), generator=generator_of(s, *stream), dtype=torch.float64) for s in seeds]
    return torch.stack(draws)


def seen_by(mechanism: Mechanism, points: Sequence[tuple[Size, Size, Size]] | None) -> Mechanism:
    """The mechanism with what is measured as its pose: itself, or three points on the platform.

    Raises:
        InputError: points lie on one line, or the mechanism's inverse kinematics takes no measured frame.
    """
    if points is None:
        return mechanism
    place = torch.tensor([[size(v, "m", "simulate.points") for v in p] for p in points], dtype=torch.float64)
    if float(torch.linalg.cross(place[0] - place[1], place[2] - place[1]).norm()) < 1e-9:
        raise InputError("simulate.points: the three points lie on one line, which shows no rotation about it")
    if not (hasattr(mechanism, "joints_of_frame") and hasattr(mechanism, "pose_near")):
        raise InputError(
            f"simulate.points: {mechanism.name} takes no measured rotation matrix; measure its pose (remove points)"
        )
    return PointsView(mechanism, place)


class PointsView(Mechanism):
    """A mechanism of which three points P1, P2, P3 on the platform are measured; pose p1_x, p1_y, …, p3_z [m].

    The rotation follows from them as in Sun et al. 2018, eq. 16 (u along P2P1, w normal to the plane, v = w x u), and
    the platform's position from their middle. Parameters and joints are the mechanism's own.
    """

    def __init__(self, mechanism: Mechanism, points: Tensor) -> None:
        """points: in the platform's frame, `3 x 3` [m]."""
        # In a tuple, so that the mechanism is not registered as a submodule.
        self._inner: Any = (mechanism,)
        self._turn = _triad(points)
        self._points = points
        home = self.seen(*mechanism.frame(mechanism.home_pose))
        super().__init__(
            name=f"{mechanism.name} by three points",
            joints=mechanism.joints,
            pose=[Coordinate(f"p{i + 1}_{c}", "m") for i in range(3) for c in "xyz"],
            geometry=mechanism.geometry,
            low=home.tolist(),
            high=home.tolist(),
            home_pose=home.tolist(),
            home_joints=mechanism.home_joints.tolist(),
        )
        self.nominal.copy_(mechanism.nominal)

    def seen(self, position: Tensor, rotation: Tensor | None) -> Tensor:
        """The points of a platform; position `... x 3` [m], rotation `... x 3 x 3`; returns `... x 9` [m]."""
        assert rotation is not None
        return (position[..., None, :] + self._points @ rotation.mT).flatten(-2)

    def pose_of(self, observed: Tensor) -> Tensor:
        """The mechanism's pose that is nearest to the measured frame; `... x 9` [m] -> `... x p` [SI]."""
        pose: Tensor = self._inner[0].pose_near(*self.frame(observed))
        return pose

    def frame(self, pose: Tensor) -> tuple[Tensor, Tensor]:
        """Position `... x 3` [m] and rotation `... x 3 x 3` from the points, `... x 9` [m]."""
        seen = pose.reshape(*pose.shape[:-1], 3, 3)
        rotation = _triad(seen) @ self._turn.mT
        return seen.mean(-2) - (rotation @ self._points.mean(0)), rotation

    def solve_inverse(self, pose: Tensor, parameters: Tensor | None = None, guess: Tensor | None = None) -> Tensor:
        """Joints of measured points, by the mechanism's real inverse kinematics; see `Mechanism.solve_inverse`."""
        position, rotation = self.frame(pose)
        joints: Tensor = self._inner[0].joints_of_frame(position, rotation, parameters)
        return joints


def _triad(points: Tensor) -> Tensor:
    """Eq. 16: columns u, v, w from three points; `... x 3 x 3` (a row each) -> `... x 3 x 3`."""
    first, second, third = points.unbind(-2)
    u = first - second
    u = u / torch.linalg.vector_norm(u, dim=-1, keepdim=True)
    w = torch.linalg.cross(u, third - second, dim=-1)
    w = w / torch.linalg.vector_norm(w, dim=-1, keepdim=True)
    return torch.stack([u, torch.linalg.cross(w, u, dim=-1), w], dim=-1)


# Rounds of drawing before a box counts as out of reach.
_ROUNDS = 50


class Places:
    """A box of places, and what machines with given parameters do there.

    A place is a pose, `p` [SI]; of a serial arm, whose poses are hard to reach with all joints inside their limits, it
    is a joint vector, `n` [SI]; of a mechanism seen from a measuring frame it is a pose of the mechanism itself.
    """

    def __init__(self, mechanism: Mechanism, truth: Tensor, box: Mapping[str, tuple[Size, Size]], circle: bool) -> None:
        """Set the box.

        Args:
            mechanism: with its nominal parameters.
            truth: parameters of the machines, `r x K` [SI]; a place is one that all of them reach.
            box: ranges in place of the mechanism's own, by coordinate.
            circle: only poses inside the maximal inscribed circle.

        Raises:
            InputError: a range names no coordinate or is empty, or the mechanism has no inscribed circle.
        """
        self.mechanism, self.truth = mechanism, truth
        own = mechanism.mechanism if isinstance(mechanism, Framed) else mechanism
        self._own = own
        coordinates = own.joints if isinstance(own, SerialArm) else own.pose
        edges = own.limits.T if isinstance(own, SerialArm) else torch.stack(own.bounds)
        self.low, self.high = (edge.clone() for edge in edges)
        names = [c.name for c in coordinates]
        self.circle: tuple[Tensor, Tensor] | None = None
        if circle:
            self.circle = self._inscribed(own)
            centre, radius = self.circle
            self.low, self.high = centre - radius, centre + radius
        for name, pair in box.items():
            if name not in names:
                raise InputError(f"simulate.box.{name}: there is no such coordinate; there are {', '.join(names)}")
            i = names.index(name)
            low, high = (size(v, coordinates[i].unit, f"simulate.box.{name}") for v in pair)
            if not low < high:
                raise InputError(f"simulate.box.{name}: must be [low, high] with low below high, got {list(pair)}")
            self.low[i], self.high[i] = low, high

    @staticmethod
    def _inscribed(mechanism: Mechanism) -> tuple[Tensor, Tensor]:
        find: Any = getattr(mechanism, "maximal_inscribed_circle", None)
        if find is None:
            raise InputError(
                f"simulate.circle: {mechanism.name} has no maximal inscribed circle; give the range as simulate.box"
            )
        centre, radius = find()
        return torch.as_tensor(centre, dtype=torch.float64), torch.as_tensor(radius, dtype=torch.float64)

    def taken(self, place: Tensor) -> tuple[Tensor, Tensor]:
        """Joints `r x s x n` and pose `r x s x p` of every machine at places `s x .` or `r x s x .`."""
        parameters = self.truth[:, None]
        if self._own is not self.mechanism or isinstance(self._own, SerialArm):
            joints, near = self.nominal(place)
            joints = joints.expand(len(self.truth), *joints.shape[-2:])
            return joints, self.mechanism.forward_kinematics(joints, parameters, near)
        pose = place.expand(len(self.truth), *place.shape[-2:])
        near = self.mechanism.solve_inverse(place)
        return self.mechanism.solve_inverse(pose, parameters, near.expand(len(self.truth), *near.shape[-2:])), pose

    def nominal(self, place: Tensor) -> tuple[Tensor, Tensor]:
        """Joints and pose of the nominal machine at places `... x .`."""
        if isinstance(self._own, SerialArm):
            return place, self.mechanism.forward_kinematics(place)
        joints = self._own.solve_inverse(place)
        return joints, place if self._own is self.mechanism else self.mechanism.forward_kinematics(joints)

    def usable(self, place: Tensor) -> Tensor:
        """Which places `s x .` every machine reaches, inside the circle where there is one; `s`, bool."""
        inside = torch.ones(len(place), dtype=torch.bool)
        if self.circle is not None:
            centre, radius = self.circle
            inside = torch.linalg.vector_norm(place - centre, dim=-1) <= radius
        if not isinstance(self._own, SerialArm):
            inside = inside & self._own.reachable(place)
        joints, pose = self.taken(place)
        usable: Tensor = inside & torch.isfinite(joints).all(-1).all(0) & torch.isfinite(pose).all(-1).all(0)
        return usable

    def even(self, count: int) -> Tensor:
        """Places of low discrepancy, `count x .`: a Halton sequence in the box, without unreachable places."""
        # Only here: scipy.stats takes half a second to load.
        from scipy.stats import qmc

        sequence = qmc.Halton(len(self.low), scramble=False)
        sequence.fast_forward(1)  # its first point is a corner
        return self._filled(count, lambda number: torch.from_numpy(sequence.random(number)))

    def random(self, count: int, generator: torch.Generator) -> Tensor:
        """Uniform places, `count x .`."""
        width = len(self.low)
        return self._filled(count, lambda number: torch.rand(number, width, generator=generator, dtype=torch.float64))

    def _filled(self, count: int, draw: Any) -> Tensor:
        found: list[Tensor] = []
        for _ in range(_ROUNDS):
            place = self.low + (self.high - self.low) * draw(2 * count)
            found.append(place[self.usable(place)])
            if sum(map(len, found)) >= count:
                return torch.cat(found)[:count]
        raise InputError(
            f"simulate: hardly any pose of the box of {self.mechanism.name} can be reached by all machines; give a "
            "smaller range in simulate.box, or smaller simulate.errors"
        )


MAX_CONDITION = 50.0
"""Of the Jacobian at a planned pose."""
# Stream of the candidates, beside the seed of the first machine.
_CANDIDATES = 7


def choose_places(config: IdentifyConfig, places: Places, count: int, seeds: Sequence[int], stream: int) -> Tensor:
    """Places that need no plan, `s x .` (even, shared by the machines) or `r x s x .` (random, each its own)."""
    assert config.simulate is not None
    if config.simulate.design == "random":
        return torch.stack([places.random(count, generator_of(seed, stream)) for seed in seeds])
    return places.even(count)


def plan_places(
    config: IdentifyConfig,
    places: Places,
    view: Mechanism,
    count: int,
    pose_noise: Tensor,
    joint_noise: Tensor | None,
) -> tuple[Tensor, dict[int, Tensor]]:
    """The most informative places for all parameters, `s x .`, and for each leg alone (`planned_per_leg`), by leg.

    Chosen at the nominal geometry, since no better one is known before measuring.
    """
    about, mechanism = config.simulate, places.mechanism
    assert about is not None
    candidates = places.random(about.candidates, generator_of(config.seed, _CANDIDATES))
    joints, pose = places.nominal(candidates)
    # The most informative poses of all are next to singular ones, where noise is no longer small.
    regular = mechanism.condition_number(joints, guess=pose) <= MAX_CONDITION
    candidates, joints, pose = candidates[regular], joints[regular], pose[regular]
    observed = view.seen(*mechanism.frame(pose)) if isinstance(view, PointsView) else pose
    rows = Rows(joints[None], observed[None])
    nominal = Measured(
        mechanism=mechanism,
        kinematics=Kinematics(mechanism),
        view=view,
        rows=rows,
        test=rows,
        start=mechanism.nominal[None],
        pose_noise=pose_noise,
        joint_noise=joint_noise,
    )
    one = torch.arange(1)
    whole = pieces_of(nominal, config, False, one)[0]
    common = candidates[choose_poses(whole, count).chosen]
    if about.design != "planned_per_leg":
        return common, {}
    legs = pieces_of(nominal, config, True, one)
    each = count // len(legs)
    if each * len(legs) != count:
        raise InputError(
            f"simulate.poses: {count} poses cannot be dealt to {len(legs)} legs; write a multiple of {len(legs)}"
        )
    return common, {leg_of(leg): candidates[choose_poses(leg, each).chosen] for leg in legs}


# Streams of random numbers of a machine, so that more poses do not change its errors.
_ERRORS, _ROWS, _TEST, _PLACES, _LEGS = 0, 1, 2, 3, 10


def simulate(config: IdentifyConfig, mechanism: Mechanism, poses: int | None = None) -> Measured:
    """Simulate the machines of a config.

    Args:
        poses: how many to measure of each machine, in place of `simulate.poses`.
    """
    about = config.simulate
    assert about is not None
    seeds = [config.seed + k for k in range(about.machines)]
    truth = mechanism.nominal + _errors(mechanism, about, seeds)
    view = seen_by(mechanism, about.points)
    noise = sizes_of_pose(about.noise, view.pose, "simulate.noise")
    joint_sd = sizes_of_joints(about.joint_noise, mechanism.joints, "simulate.joint_noise")
    joint_noise = joint_sd if bool((joint_sd > 0).any()) else None
    places = Places(mechanism, truth, about.box, about.circle)
    count = about.poses if poses is None else poses
    of_legs: dict[int, Tensor] = {}
    if about.design.startswith("planned"):
        common, of_legs = plan_places(config, places, view, count, noise, joint_noise)
    else:
        common = choose_places(config, places, count, seeds, _PLACES)

    kinematics = make_kinematics(mechanism, about.as_built)

    def measure(joints: Tensor, pose: Tensor, stream: int) -> Rows:
        observed = pose
        if isinstance(view, PointsView):
            observed = view.seen(*kinematics.frame(joints, truth[:, None], pose))
        return Rows(
            joints + joint_sd * normal_draws(joints.shape[1:], seeds, stream, 1),
            observed + noise * normal_draws(observed.shape[1:], seeds, stream, 0),
        )

    test = places.random(about.test_poses, generator_of(config.seed, _TEST, 2))
    wanted_joints, wanted = places.taken(test)
    held_out = measure(wanted_joints, wanted, _TEST)
    if isinstance(view, PointsView):
        held_out = Rows(held_out.joints, view.pose_of(held_out.observed))
    return Measured(
        mechanism=mechanism,
        kinematics=kinematics,
        view=view,
        rows=measure(*places.taken(common), _ROWS),
        leg_rows={leg: measure(*places.taken(place), _LEGS + leg) for leg, place in of_legs.items()},
        test=held_out,
        start=mechanism.nominal.expand(len(seeds), -1).clone(),
        truth=truth,
        wanted=wanted,
        wanted_joints=wanted_joints,
        reached=kinematics.reached(wanted_joints, truth[:, None], wanted) if about.as_built else wanted,
        pose_noise=noise,
        joint_noise=joint_noise,
    )


def _errors(mechanism: Mechanism, about: SimulateConfig, seeds: list[int]) -> Tensor:
    """Parameter errors, `r x K` [SI]: the given ones beside normal draws."""
    geometry = mechanism.geometry
    usual = [0.0 if p.held else plausible_error(p) for p in geometry]
    given = about.errors
    if isinstance(given, dict):
        sd = sizes_by_name(given, geometry, "simulate.errors", [0.0] * len(usual) if about.values else usual)
    else:
        sd = size(given, "1", "simulate.errors") * torch.tensor(usual, dtype=torch.float64)
    fixed = sizes_by_name(about.values, geometry, "simulate.values", [0.0] * len(geometry))
    return fixed + sd * normal_draws(sd.shape, seeds, _ERRORS, 0)


def count_study(config: IdentifyConfig, mechanism: Mechanism) -> list[dict[str, Any]]:
    """For each number of poses and each quick method: pose error under its exact commands, and parameter deviations."""
    if config.simulate is None:
        return []
    answer = []
    for poses in config.simulate.counts:
        measured = simulate(config, mechanism, poses)
        block: dict[str, Any] = {"poses": poses, "methods": {}}
        for method in (m for m in config.methods if base_method(m) in QUICK):
            outcome: Outcome = run_method(method, measured, config)
            found = commanded(measured, outcome.values, outcome.machines)
            assert found is not None and measured.truth is not None
            gap = select(measured, config).free(outcome.values - measured.truth[outcome.machines])
            block["methods"][method] = figures(
                {"position": found.exact.position.square().mean(-1).sqrt(), "deviation": gap.abs().mean(-1)}
            )
        answer.append(block)
    return answer
