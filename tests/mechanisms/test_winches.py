"""A point on three cables of a user's own: more drives than coordinates, and winches of many turns."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from ccnn_torch.compensation import build_machine
from ccnn_torch.coordinates import Coordinate, Parameter
from ccnn_torch.errors import MethodFailedError
from ccnn_torch.mechanisms import Mechanism
from ccnn_torch.testing import check_mechanism

DRUM = 0.02
EXITS = torch.tensor([[-1.0, 1.0], [1.0, 1.0], [0.0, -1.0]], dtype=torch.float64)


class Cables(Mechanism):
    """Angles of three winches, 0 with the point in the middle."""

    def __init__(self) -> None:
        super().__init__(
            name="cables",
            joints=[Coordinate(f"q{k}", "rad") for k in (1, 2, 3)],
            pose=[Coordinate("x", "m"), Coordinate("y", "m")],
            geometry=[Parameter(f"length{k}", "m", float(EXITS[k - 1].norm()), k) for k in (1, 2, 3)],
            low=(-0.6, -0.6),
            high=(0.6, 0.6),
        )

    def solve_inverse(self, pose: Tensor, parameters: Tensor | None = None) -> Tensor:  # type: ignore[override]
        lengths = torch.linalg.vector_norm(pose[..., None, :] - EXITS, dim=-1)
        return (lengths - self.resolve(parameters)) / DRUM


def test_the_pose_is_found_many_turns_from_the_middle() -> None:
    check_mechanism(Cables())
    machine = Cables()
    pose = torch.cartesian_prod(*[torch.linspace(-0.6, 0.6, 5, dtype=torch.float64)] * 2)
    joints = machine.solve_inverse(pose)
    assert joints.abs().max() > 4 * torch.pi
    torch.testing.assert_close(machine.forward_kinematics(joints), pose, rtol=0, atol=1e-9)
    # What no pose fits is fitted best.
    off = machine.closure(machine.forward_kinematics(joints + 0.01), joints + 0.01)
    assert 1e-4 < off.square().mean().sqrt() < 0.01


def test_no_model_file_holds_it_and_a_sentence_says_how_to_tell_it() -> None:
    machine = Cables()
    pose = torch.rand(50, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(0)) - 0.5
    with pytest.raises(MethodFailedError, match=r"3 joints and 2 pose coordinates.*commanded pose for its joints"):
        build_machine(machine, machine.nominal, None, machine.solve_inverse(pose), 0.1)
