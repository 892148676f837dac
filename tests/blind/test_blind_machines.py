"""Blind machines: exact strengths, every cause on every machine, the same draw for the same seed, and no help from the
effects library."""

from __future__ import annotations

import ast
from collections import Counter
from pathlib import Path

import ccnn_validation.blind
import numpy as np
import pytest
import torch
from ccnn_validation.blind.case import gap
from ccnn_validation.blind.machines import MACHINES
from ccnn_validation.blind.mujoco_five_bar import Servo, settled
from ccnn_validation.blind.plan import CAUSES, KINDS, STRENGTHS, CasePlan, causes_of, plan_cases
from ccnn_validation.blind.simulate import simulate

from ccnn_torch.errors import InputError
from ccnn_torch.mechanisms import FiveBar

FOLDER = Path(ccnn_validation.blind.__file__).parent
JUDGING = {"explain.py", "judge.py", "generator.py", "check.py"}


def planned(machine: str, kind: str, *causes: str, number: int = 0, rows: int = 60) -> CasePlan:
    return CasePlan(
        number=number,
        kind=kind,
        machine=machine,
        causes=causes,
        shares=(1.0, 0.5)[: len(causes)],
        strength=10.0 if causes else 0.0,
        rows=rows,
        noise=1e-5,
        noise_told=True,
        moving="latency" in causes,
        disturbance="",
    )


@pytest.mark.parametrize("machine", ["five_bar", "machine_tool", "arm"])
def test_every_cause_has_the_strength_asked_for(machine: str) -> None:
    plans = [planned(machine, "single", c, number=i) for i, c in enumerate(causes_of(machine)) if c != "outlier"]
    plans.append(planned(machine, "pair", "backlash", "drift", number=50))
    plans += [planned(machine, "outside", d, number=60 + i) for i, d in enumerate(("workspace", "load", "time"))]
    plans.append(planned(machine, "none", number=70))
    for case in simulate(plans, 3):
        off = gap(case.machine, case.true, case.pose) / case.sd
        assert off.square().mean().sqrt() == pytest.approx(case.plan.strength, rel=1e-6, abs=1e-9), case.plan
        noise = gap(case.machine, case.measured, case.true) / case.sd
        assert noise.square().mean().sqrt() == pytest.approx(1.0, abs=0.25)
        assert all(torch.isfinite(values).all() for values in case.columns.values())


def test_causes_follow_what_drives_them() -> None:
    causes = ("drift", "compliance", "backlash")
    drift, load, slack = simulate([planned("stewart", "single", c, number=i) for i, c in enumerate(causes)], 5)
    columns = {c.name: values for c, values in drift.columns.items()}
    still = drift.machine.mechanism.solve_inverse(drift.true) - drift.joints
    assert float(still[0].abs().max()) < 1e-9
    late = columns["time"] > 0.5 * columns["time"][-1]
    assert float(still[late].abs().amax()) > 2 * float(still[columns["time"] < 900].abs().amax())
    force = torch.stack([v for c, v in load.columns.items() if c.name.startswith("load_")]).abs().sum(0)
    given = (load.machine.mechanism.solve_inverse(load.true) - load.joints).abs().sum(-1)
    assert np.corrcoef(force.numpy(), given.numpy())[0, 1] > 0.6
    direction = torch.stack([v for c, v in slack.columns.items() if c.name.startswith("direction")], -1)
    trailing = slack.machine.mechanism.solve_inverse(slack.true) - slack.joints
    assert float((trailing * direction).sum()) < 0
    assert slack.drivers[0] and all(d.startswith("direction ") for d in slack.drivers[0])


def test_a_seed_decides_everything() -> None:
    plans = [planned("delta", "single", "thermal"), planned("delta", "single", "outlier", number=1)]
    first, again, other = simulate(plans, 1), simulate(plans, 1), simulate(plans, 2)
    for a, b, c in zip(first, again, other, strict=True):
        assert torch.equal(a.measured, b.measured) and a.bad == b.bad
        assert not torch.equal(a.measured, c.measured)
    outside = gap(first[1].machine, first[1].measured, first[1].true) / first[1].sd
    far = outside.square().mean(-1).sqrt() > 10
    assert tuple(torch.nonzero(far)[:, 0].tolist()) == first[1].bad


def test_plans_are_even() -> None:
    plans = plan_cases(320, 0, MACHINES, tuple(KINDS))
    kinds = Counter(p.kind for p in plans)
    assert kinds == {"single": 144, "pair": 80, "none": 48, "outside": 48}
    machines = Counter(p.machine for p in plans)
    assert max(machines.values()) - min(machines.values()) <= 4
    single = [p for p in plans if p.kind == "single"]
    assert set(Counter(p.causes[0] for p in single)) == set(CAUSES)
    assert {p.strength for p in single if p.causes != ("outlier",)} == set(STRENGTHS)
    assert all(c in causes_of(p.machine) for p in plans if p.kind in ("single", "pair") for c in p.causes)
    assert all(len(set(p.causes)) == 2 and "outlier" not in p.causes for p in plans if p.kind == "pair")
    assert plans == plan_cases(320, 0, MACHINES, tuple(KINDS))


def test_the_simulator_of_others_has_nothing_outside_the_library() -> None:
    plans = plan_cases(60, 0, ("mujoco_five_bar", "tripod"), tuple(KINDS))
    assert {p.machine for p in plans if p.kind == "outside"} == {"tripod"}
    assert {p.kind for p in plan_cases(20, 0, ("mujoco_five_bar",), tuple(KINDS))} == {"single", "pair", "none"}
    with pytest.raises(InputError, match="kinds: mujoco_five_bar has nothing outside the library"):
        plan_cases(20, 0, ("mujoco_five_bar",), ("outside",))


@pytest.mark.parametrize(
    ("count", "machines", "kinds", "said"),
    [
        (0, MACHINES, tuple(KINDS), "at least 1 case"),
        (3, ("crane",), tuple(KINDS), "'crane' is not there; known: five_bar"),
        (3, MACHINES, ("many",), "known: single, pair"),
        (3, ("arm", "arm"), tuple(KINDS), "are repeated"),
    ],
)
def test_bad_plans_are_one_sentence(count: int, machines: tuple[str, ...], kinds: tuple[str, ...], said: str) -> None:
    with pytest.raises(InputError, match=said):
        plan_cases(count, 0, machines, kinds)


def test_blind_machines_do_not_know_the_library() -> None:
    """The formulas must be their own: nothing that makes a case imports the effects, the diagnosis, or their judges."""
    makers = [path for path in FOLDER.glob("*.py") if path.name not in JUDGING]
    assert len(makers) > 10
    for path in makers:
        for node in ast.walk(ast.parse(path.read_text())):
            names = [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            names += [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            for name in names:
                assert not name.startswith(("ccnn_torch.effects", "ccnn_torch.diagnosis", "ccnn_torch.simulation")), (
                    path
                )
                assert name.rpartition(".")[2] + ".py" not in JUDGING, path


def test_mujoco_closes_the_loop_as_the_closed_form_does() -> None:
    machine = FiveBar()
    pose = machine.home_pose + 0.25 * torch.tensor([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.5], [0.3, -1.0]])
    command = machine.solve_inverse(pose)
    direction = torch.tensor([[1.0, -1.0], [1.0, 1.0], [-1.0, -1.0], [-1.0, 1.0]], dtype=torch.float64)
    still = torch.zeros(4, 2, dtype=torch.float64)
    force = torch.tensor([[30.0, 0.0], [0.0, -40.0], [20.0, 20.0], [-25.0, 10.0]], dtype=torch.float64)
    built = machine.nominal.clone()
    built[[0, 7, 8]] += torch.tensor([2e-4, -3e-4, 1e-4], dtype=torch.float64)
    plain = settled(Servo(), machine.nominal, command, direction, still)
    pulled = settled(Servo(), built, command, direction, force)
    rubbed = settled(Servo(friction=(5.0, 5.0)), machine.nominal, command, direction, still)
    sunk = settled(Servo(weight=True), machine.nominal, command, direction, still)
    assert float((plain[0] - pose).norm(dim=-1).max()) < 1e-6
    for (tool, cranks), lengths in ((pulled, built), (rubbed, machine.nominal), (sunk, machine.nominal)):
        assert float((machine.forward_kinematics(cranks, lengths) - tool).norm(dim=-1).max()) < 1e-6
    # A servo gives way by torque over stiffness, here to the first order in the displacement.
    torque = (machine.jacobian(command)[:, :2].mT @ force[..., None])[..., 0]
    assert torch.allclose(pulled[1] - command, torque / 1e5, rtol=0.1, atol=1e-5)
    # Friction holds the cranks back on the side that they come from, and the weight pulls the tool down.
    assert bool((((rubbed[1] - command) * direction) < 0).all())
    assert float((rubbed[1] - command).abs().max()) <= 5.0 / 1e5 * 1.001
    assert bool((sunk[0][:, 1] < pose[:, 1]).all())
