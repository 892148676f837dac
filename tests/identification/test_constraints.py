"""Identification from what holds the tool instead of measuring it: sockets, distances, planes."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor

from ccnn_torch.errors import InputError
from ccnn_torch.identification import (
    ParameterChoice,
    Problem,
    forward_problem,
    solve_lm,
    tool_points,
    what_is_known,
)
from ccnn_torch.identification.judge import scatter
from ccnn_torch.identification.problems.sockets import Sockets
from ccnn_torch.mechanisms import Instrument, SerialArm
from ccnn_torch.mechanisms.frames.part import Part
from ccnn_torch.mechanisms.frames.readings import Between, Dial, Reading, Wire
from ccnn_torch.numerics.rotations import rotation_vector_to_matrix

HALF = math.pi / 2
LINKS = [[0.05, HALF, 0.4, 0], [-0.5, 0, 0, 0], [-0.05, HALF, 0.1, 0], [0, -HALF, 0.4, 0], [0, HALF, 0, 0]]
LINKS += [[0.08, 0, 0.1, 0]]
LINK_NAMES = [f"{p}{i}" for i in range(1, 7) for p in ("a", "alpha", "d", "theta")]
CHOICE = ParameterChoice(
    free=[*LINK_NAMES, "tool_x", "tool_y", "tool_z"], prior={**dict.fromkeys(LINK_NAMES, 1e-3), "tool_*": 0.02}
)


def machine() -> tuple[SerialArm, Tensor]:
    """An arm with a ball, and what it really is: 0.3 mm and 0.3 mrad off, the ball 2 mm."""
    arm = SerialArm("arm", "standard", LINKS, orientation="none", tool=[0.0, 0.02, 0.12, 0, 0, 0])
    draw = torch.randn(arm.nominal.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    truth = arm.nominal + 3e-4 * draw
    truth[:6], truth[-3:] = arm.nominal[:6], arm.nominal[-3:]
    truth[-6:-3] += 2e-3 * draw[-6:-3]
    return arm, truth


def seats(arm: SerialArm, truth: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Joints with the ball in one of two sockets 50 mm apart on three placements of a plate, 20 a socket."""
    generator = torch.Generator().manual_seed(3)
    places = torch.tensor([[0.45, 0.1, 0.3], [0.3, -0.45, 0.5], [-0.1, 0.5, 0.2]], dtype=torch.float64)
    turns = torch.tensor([[0.1, 0.2, 0.3], [0.5, -0.4, 1.5], [-0.3, 0.2, -2.0]], dtype=torch.float64)
    placement = torch.arange(3).repeat_interleave(40).to(torch.float64)
    points = torch.zeros(120, 3, dtype=torch.float64)
    points[1::2, 0] = 0.05
    wanted = (rotation_vector_to_matrix(turns)[placement.long()] @ points[..., None])[..., 0]
    wanted = wanted + places[placement.long()]
    near = arm.nearest_joints(places, truth, torch.tensor([0.3, 0.6, 0.9, 0.2, 0.8, 0.1], dtype=torch.float64), 1.0)
    guess = near[placement.long()] + 0.8 * torch.randn(120, 6, generator=generator, dtype=torch.float64)
    joints = arm.nearest_joints(wanted, truth, guess, 1.0)
    assert float((tool_points(arm, joints, truth) - wanted).abs().max()) < 1e-9
    return joints, placement, points


def identified(arm: SerialArm, problem: Problem) -> Tensor:
    fit = solve_lm(problem)
    assert fit.message == ""
    values = dict(zip([p.name for p in problem.parameters], fit.values[0], strict=True))
    return torch.stack([values.get(p.name, torch.tensor(p.nominal)) for p in arm.geometry]).to(torch.float64)


def read(
    arm: SerialArm,
    reading: Reading,
    joints: Tensor,
    rows: Tensor,
    weights: Tensor | None = None,
    noise: float = 1e-7,
    choice: ParameterChoice = CHOICE,
) -> Problem:
    """What an instrument reads, its own unknowns fitted first."""
    seen = Instrument(arm, Part(reading))
    seen = seen.with_nominal(seen.fitted(joints, rows, weights))  # type: ignore[assignment]
    choice = replace(choice, free=[*(choice.free or ()), *(p.name for p in reading.parameters)])
    if reading.parameters and reading.parameters[-1].name == "plate_scale":
        choice = replace(choice, prior={**choice.prior, "plate_scale": reading.parameters[-1].scale})
    problem = forward_problem(seen, joints, rows, None, choice, [noise] * len(seen.pose))
    return problem if weights is None else replace(problem, weights=weights[None])


def in_sockets(
    arm: SerialArm, joints: Tensor, placement: Tensor, points: Tensor, noise: float, tolerance: float = 0.0, **more: Any
) -> Problem:
    reading = Sockets(placement, points, tool_points(arm, joints), tolerance)
    return read(arm, reading, joints, torch.cat([points, placement[:, None], points], -1), noise=noise, **more)


@pytest.mark.parametrize("noise", [2e-6, 5e-5])
def test_sockets_make_the_ball_meet_itself(noise: float) -> None:
    arm, truth = machine()
    joints, placement, points = seats(arm, truth)
    seen = joints + noise * torch.randn(joints.shape, generator=torch.Generator().manual_seed(5), dtype=torch.float64)
    weights = (torch.arange(120) % 4 != 3).to(torch.float64)
    problem = in_sockets(arm, seen, placement, points, noise, weights=weights)
    names = [p.name for p in problem.parameters]
    assert names[-5:] == ["plate2_x", "plate2_y", "plate2_z", "plate2_turn1", "plate2_turn2"]
    group = 2 * placement + (points[:, 0] > 0)
    held = weights == 0
    before = scatter(tool_points(arm, seen), group, weights)[held].square().mean().sqrt()
    after = scatter(tool_points(arm, seen, identified(arm, problem)), group, weights)[held].square().mean().sqrt()
    assert float(before) > 1e-3
    assert float(after) < 3 * noise


def test_the_known_distance_of_the_sockets_gives_the_scale() -> None:
    """The arm is 0.1 % larger than nominal in everything: points that only meet themselves could not tell."""
    arm, _ = machine()
    truth = arm.nominal.clone()
    lengths = [i for i, p in enumerate(arm.geometry) if p.unit == "m" and not p.name.startswith("base")]
    truth[lengths] = truth[lengths] * 1.001
    joints, placement, points = seats(arm, truth)
    found = identified(arm, in_sockets(arm, joints, placement, points, 2e-6))
    apart = tool_points(arm, joints[:40], found)
    width = torch.linalg.vector_norm(apart[1::2].mean(0) - apart[::2].mean(0))
    assert float(width) == pytest.approx(0.05, abs=1e-6)
    far = torch.stack([tool_points(arm, joints, values)[::40] for values in (truth, found, arm.nominal)])
    real, seen, assumed = torch.linalg.vector_norm(far[:, 0] - far[:, 1], dim=-1)
    assert abs(float(seen - real)) < 2e-5 < 2e-4 < abs(float(assumed - real))


def test_a_plate_that_was_printed_inexactly_has_its_own_scale() -> None:
    arm, truth = machine()
    joints, placement, points = seats(arm, truth)
    printed = points * 1.002
    problem = in_sockets(arm, joints, placement, printed, 2e-6, 2e-4 / 0.05)
    assert problem.parameters[-1].name == "plate_scale"
    found = solve_lm(problem).values[0, -1]
    assert float(found) == pytest.approx(1 / 1.002, abs=1e-3)
    assert float(found) < 0.9995


def test_distances_from_an_unknown_anchor() -> None:
    arm, truth = machine()
    joints = arm.sample_joints(240, torch.Generator().manual_seed(2))
    anchors = torch.tensor([[1.0, 0.2, 0.1], [-0.3, 1.2, 0.4]], dtype=torch.float64)
    which = (torch.arange(240) % 2).to(torch.float64)
    distance = torch.linalg.vector_norm(tool_points(arm, joints, truth) - anchors[which.long()], dim=-1)
    weights = (torch.arange(240) < 200).to(torch.float64)
    problem = read(arm, Wire([0, 1], zero=0.0), joints, torch.stack([distance, which], -1), weights)
    fit = solve_lm(problem)
    held = problem.residual(fit.values[:, None], *problem.data)[0, 200:, 0] * 1e-7
    start = problem.residual(problem.start[:, None], *problem.data)[0, 200:, 0] * 1e-7
    assert float(held.abs().max()) < 5e-6 < 1e-3 < float(start.abs().max())
    assert [p.name for p in problem.parameters[-3:]] == ["anchor1_x", "anchor1_y", "anchor1_z"]


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_readings_above_an_unknown_plane(sign: float) -> None:
    arm, truth = machine()
    joints = arm.sample_joints(300, torch.Generator().manual_seed(4))
    normal = torch.tensor([0.1, -0.2, 0.9], dtype=torch.float64)
    normal = sign * normal / normal.norm()
    points = tool_points(arm, joints, truth)
    near = (points @ normal).abs().argsort()[:160]
    joints, reading = joints[near], points[near] @ normal - 0.02
    rows = torch.stack([reading, torch.zeros_like(reading)], -1)
    problem = read(arm, Dial([normal.tolist()], [0]), joints, rows)
    fit = solve_lm(problem)
    left = problem.residual(fit.values[:, None], *problem.data) * 1e-7
    begin = problem.residual(problem.start[:, None], *problem.data) * 1e-7
    assert float(left.abs().max()) < 1e-6 < 1e-3 < float(begin.abs().max())
    assert float(fit.values[0, -3]) == pytest.approx(0.02, abs=1e-3)


def test_distances_of_places_that_the_arm_reached_itself() -> None:
    arm, truth = machine()
    joints = arm.sample_joints(480, torch.Generator().manual_seed(2)).reshape(240, 2, 6)
    ends = tool_points(arm, joints, truth)
    rows = torch.cat([torch.linalg.vector_norm(ends[:, 0] - ends[:, 1], dim=-1)[:, None], joints[:, 1]], -1)
    weights = (torch.arange(240) < 200).to(torch.float64)
    problem = read(arm, Between(arm), joints[:, 0], rows, weights)
    assert [p.name for p in problem.parameters] == CHOICE.free
    fit = solve_lm(problem)
    held, start = (problem.residual(v[:, None], *problem.data)[0, 200:, 0] * 1e-7 for v in (fit.values, problem.start))
    assert float(held.abs().max()) < 5e-6 < 1e-3 < float(start.abs().max())


def test_what_a_point_cannot_tell_is_said() -> None:
    """A single socket, without a prior: the base may not move, yet the scale of everything is open."""
    arm, truth = machine()
    joints, placement, points = seats(arm, truth)
    one = points[:, 0] == 0
    free = ParameterChoice(free=["a2", "d1", "d4", "tool_x", "tool_y", "tool_z", "base_x"])
    problem = in_sockets(arm, joints[one], placement[one], points[one], 1e-5, choice=free)
    known = what_is_known(problem, problem.start)
    names = [p.name for p in known.parameters]
    assert not bool(known.identifiable[0, names.index("base_x")])
    assert bool(known.identifiable[0, names.index("a2")])
    assert names[-3:] == ["plate2_x", "plate2_y", "plate2_z"]


def test_bad_input_is_one_sentence() -> None:
    arm, truth = machine()
    joints, placement, points = seats(arm, truth)
    rows = torch.stack([points[:3, 0], placement[:3]], -1)
    for reading, name in ((Wire([0], zero=0.0), "anchor"), (Dial([[0, 0, 1]], [0]), "plane")):
        with pytest.raises(InputError, match=f"{name} 0: needs at least 4 rows that count, got 3"):
            read(arm, reading, joints[:3], rows)
    with pytest.raises(InputError, match="no row that counts"):
        scatter(points, placement, torch.zeros(120, dtype=torch.float64))
