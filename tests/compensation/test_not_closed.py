"""A machine whose parts do not meet at some joints: its commands there are numbers all the same."""

from __future__ import annotations

import torch
from machines import around, near, with_effects
from torch import Tensor

from ccnn_torch.compensation import expand_effects
from ccnn_torch.coordinates import Coordinate, Parameter
from ccnn_torch.effects import Acting, Situation, default_gravity, make_effect
from ccnn_torch.mechanisms import Mechanism, SerialArm


class _Cranks(Mechanism):
    """Two cranks at x = -0.25 and 0.25 m, and couplers that do not meet where the cranks point away from each other."""

    closed_form = "forward"

    def __init__(self) -> None:
        super().__init__(
            name="cranks",
            joints=[Coordinate("q1", "rad"), Coordinate("q2", "rad")],
            pose=[Coordinate("x", "m"), Coordinate("y", "m")],
            geometry=[Parameter("crank", "m", 0.4), Parameter("coupler", "m", 0.6)],
            low=(-0.15, 0.55),
            high=(0.15, 0.75),
            home_joints=(2.2, 0.94),
        )

    def forward_kinematics(self, joints: Tensor, parameters: Tensor | None = None) -> Tensor:
        crank, coupler = self.resolve(parameters)[..., None].unbind(-2)
        x, y = crank * torch.cos(joints) + joints.new_tensor([-0.25, 0.25]), crank * torch.sin(joints)
        apart = torch.stack([x[..., 1] - x[..., 0], y[..., 1] - y[..., 0]], -1)
        height = torch.sqrt(coupler**2 / apart.square().sum(-1, keepdim=True) - 0.25)
        across = torch.stack([-apart[..., 1], apart[..., 0]], -1)
        return torch.stack([x.mean(-1), y.mean(-1)], -1) + height * across


def test_a_machine_that_does_not_close_somewhere_has_a_command_there() -> None:
    """Its derivatives there are out of all proportion, and effects of 1e9 m gave no number."""
    rows = around([2.2, 0.94], 0.2)
    machine = with_effects(near(_Cranks(), 1e-4, rows), ("compliance", "gravity"), ("load_x", "load_y"))
    made = machine.compensator()
    covariates = machine.inputs[:, 2:]
    apart_joints = torch.tensor([[3.1, 0.0], [3.0, 0.05]], dtype=torch.float64)
    assert made.machine is not None and made.machine.effects is not None
    for change in made.machine.effects.changes(apart_joints, covariates[:2]):
        assert change is None or not bool(change.any())
    assert bool(made.machine.effects.changes(rows, covariates)[0].any())
    found = made.solve(apart_joints, covariates[:2])
    assert bool(torch.isfinite(found.command).all()) and not bool(found.inside_domain.any())


def test_a_winch_may_be_some_turns_off() -> None:
    """A gain of 1 % of a motor that goes 300 rad is 3 rad, and no sign of a machine that does not close."""
    rows = around([300.0, 250.0], 20.0)
    effect = make_effect("joint_gain")
    winch = SerialArm("winch", "standard", [[0.4, 0.0, 0.3, 0.0], [0.3, 0.0, 0.0, 0.0]])
    situation = Situation(winch, rows, {}, default_gravity(winch))
    count = len(effect.coefficients(situation))
    one = Acting(effect, torch.zeros(0, dtype=torch.float64), torch.full((count,), 1e-2, dtype=torch.float64))
    moved, _ = expand_effects(situation, [one], [], 0.1).changes(rows, rows[:, :0])
    assert moved is not None and torch.allclose(moved, one.change(situation)) and float(moved.abs().max()) > 2.0
