"""A simulator in the place of closed forms: what it is asked, what follows from its answers, and bad ones."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from ccnn_torch.coordinates import Condition, Coordinate, Parameter
from ccnn_torch.errors import InputError
from ccnn_torch.mechanisms import (
    BlackBox,
    FiveBar,
    Joint,
    Simulator,
    load_mechanism,
    mechanism_from_description,
    rowwise,
    simulated_rows,
)
from ccnn_torch.numerics.least_squares import jacobian_of
from ccnn_torch.testing import check_mechanism

EXAMPLES = Path(__file__).parents[2] / "experiments"
PRESS = f"{EXAMPLES / 'my_simulator.py'}:PRESS"
ARM = Path(__file__).parents[1] / "effects" / "arm.yaml"


def _slider(**changes: object) -> Simulator:
    """A carriage on a spring: x = q1 + load_x / stiffness, y = q2."""

    def simulate(commands: np.ndarray, covariates: dict[str, np.ndarray], parameters: np.ndarray) -> np.ndarray:
        return np.stack([commands[:, 0] + covariates["load_x"] / parameters[:, 0], commands[:, 1]], -1)

    slider = Simulator(
        "slider",
        [Joint("q1", "m", 0.0, 1.0), Joint("q2", "m", -1.0, 1.0)],
        ("x", "y"),
        simulate,
        [Parameter("stiffness", "N/m", 1e5, scale=1e4, low=1e5)],
        ("load_x",),
    )
    return replace(slider, **changes)


def test_the_docs_show_the_file() -> None:
    text = (EXAMPLES / "my_simulator.py").read_text(encoding="utf-8")
    assert text in (EXAMPLES.parent / "docs" / "how_to" / "mechanisms.md").read_text(encoding="utf-8")


def test_it_is_a_mechanism() -> None:
    check_mechanism(load_mechanism(PRESS))


def test_without_load_the_example_is_the_five_bar() -> None:
    press, bar = load_mechanism(PRESS), FiveBar()
    joints = press.sample_joints(50, torch.Generator().manual_seed(0))
    torch.testing.assert_close(press.forward_kinematics(joints), bar.forward_kinematics(joints), rtol=0, atol=1e-12)
    torch.testing.assert_close(press.jacobian(joints), bar.jacobian(joints), rtol=0, atol=1e-6)


def test_derivatives_of_a_rotating_pose_are_those_of_the_closed_form() -> None:
    arm = load_mechanism(str(ARM))
    asked: list[int] = []

    def simulate(commands: torch.Tensor, covariates: object, parameters: torch.Tensor) -> torch.Tensor:
        asked.append(len(commands))
        return arm.forward_kinematics(commands, parameters)

    n, k = len(arm.joints), len(arm.geometry)
    joints = [Joint(j.name, j.unit, -1.0, 1.0) for j in arm.joints]
    parameters = [replace(p, cause="geometry") for p in arm.geometry]
    home = [0.3] * n
    box = BlackBox(Simulator("arm", joints, arm.pose, simulate, parameters, home=home, tensors=True))
    rows = arm.sample_joints(7, torch.Generator().manual_seed(1))
    asked.clear()
    torch.testing.assert_close(box.jacobian(rows), arm.jacobian(rows), rtol=0, atol=1e-6)
    assert asked == [7 * 2 * n]
    asked.clear()
    torch.testing.assert_close(box.parameter_jacobian(rows), arm.parameter_jacobian(rows), rtol=0, atol=1e-6)
    assert asked == [7 * 2 * k]
    # Through the pose's own coordinates, as fits differentiate: by rows, and by the transpose of the transpose.
    few = torch.eye(n, dtype=torch.float64)[:, :2]
    for move in (torch.eye(n, dtype=torch.float64), few):
        start = torch.zeros(7, move.shape[1], dtype=torch.float64)

        def moved(step: torch.Tensor, m=box, move=move) -> torch.Tensor:
            return m.forward_kinematics(rows + step @ move.mT)

        expected = jacobian_of(lambda step, moved=moved: moved(step, arm), start)[1]
        torch.testing.assert_close(jacobian_of(moved, start)[1], expected, rtol=0, atol=1e-5)


def test_conditions_reach_it_and_its_inverse() -> None:
    slider = BlackBox(_slider())
    joints = torch.tensor([[0.2, 0.1], [0.4, -0.3], [0.6, 0.0]], dtype=torch.float64)
    load = torch.tensor([0.0, 100.0, -300.0], dtype=torch.float64)
    pushed = slider.under({"load_x": load, "temperature": load})
    pose = pushed.forward_kinematics(joints)
    torch.testing.assert_close(pose[:, 0] - joints[:, 0], load / 1e5)
    torch.testing.assert_close(slider.forward_kinematics(joints), joints)
    torch.testing.assert_close(pushed.solve_inverse(pose), joints, rtol=0, atol=1e-9)
    assert slider.under({"temperature": load}) is slider
    assert slider.lacking([]) and not slider.lacking(["load_x"]) and not pushed.lacking([])
    seen = load_mechanism("framed", mechanism=PRESS).under({"load_y": load})
    bent = seen.forward_kinematics(joints * 0 + torch.tensor([2.0, 1.1], dtype=torch.float64))
    assert float((bent[2] - bent[0]).norm()) > 1e-3


def test_a_parameter_is_never_asked_beyond_its_bound() -> None:
    least: list[float] = []
    whole = _slider()

    def simulate(commands: np.ndarray, covariates: dict[str, np.ndarray], parameters: np.ndarray) -> np.ndarray:
        least.append(float(parameters.min()))
        return np.asarray(whole.simulate(commands, covariates, parameters))

    box = BlackBox(replace(whole, simulate=simulate)).under({"load_x": torch.tensor(1000.0)})
    joints = torch.zeros(3, 2, dtype=torch.float64)
    slope = box.parameter_jacobian(joints, torch.tensor([9e4], dtype=torch.float64))
    # One-sided about the bound: (1000 / (1e5 + 1e3) - 1000 / 1e5) / 1e3.
    torch.testing.assert_close(slope[:, 0, 0], torch.full((3,), -1e-7 / 1.01, dtype=torch.float64), rtol=1e-9, atol=0)
    assert min(least) == 1e5


def test_phi_turns_about_the_axis_without_a_length() -> None:
    for pose, axis in ((("x", "y", "phi"), 2), (("y", "z", "phi"), 0), (("phi", "x", "z"), 1)):
        joints = [Joint(f"q{i}", "rad", -0.5, 0.5) for i in (1, 2, 3)]
        box = BlackBox(Simulator("free", joints, pose, lambda commands, *others: commands))
        q = torch.tensor([[0.1, 0.2, 0.3]], dtype=torch.float64)
        turn = box.jacobian(q)[0, 3:, pose.index("phi")]
        torch.testing.assert_close(turn, torch.eye(3, dtype=torch.float64)[axis], rtol=0, atol=1e-9)


def test_fewer_joints_than_coordinates_give_the_closest_pose() -> None:
    def simulate(commands: np.ndarray, *others: object) -> np.ndarray:
        q = commands[:, 0]
        return np.stack([np.cos(q), np.sin(q)], -1)

    box = BlackBox(Simulator("crank", [Joint("q1", "rad", 0.0, 1.5)], ("x", "y"), simulate))
    found = box.solve_inverse(torch.tensor([[2.0, 2.0], [0.0, 3.0]], dtype=torch.float64))
    torch.testing.assert_close(found[:, 0], torch.tensor([torch.pi / 4, torch.pi / 2], dtype=torch.float64))


def test_out_of_reach_has_no_joints() -> None:
    press = load_mechanism(PRESS)
    pose = torch.stack([press.home_pose, torch.tensor([9.0, 9.0], dtype=torch.float64)])
    assert press.reachable(pose).tolist() == [True, False]


def test_row_by_row_is_the_same_and_what_comes_again_is_looked_up() -> None:
    rows: list[int] = []

    def one(commands: np.ndarray, covariates: dict[str, float], parameters: np.ndarray) -> list[float]:
        rows.append(1)
        return [commands[0] + covariates["load_x"] / parameters[0], commands[1]]

    slow = BlackBox(_slider(simulate=rowwise(one), remember=True))
    fast = BlackBox(_slider())
    joints = slow.sample_joints(20, torch.Generator().manual_seed(3))
    load = {"load_x": torch.linspace(1, 50, 20, dtype=torch.float64)}
    told: list[int] = []
    with simulated_rows(told.append):
        first = slow.under(load).forward_kinematics(joints)
    torch.testing.assert_close(first, fast.under(load).forward_kinematics(joints))
    assert told == [20]
    count = len(rows)
    torch.testing.assert_close(slow.under(load).forward_kinematics(joints), first)
    assert len(rows) == count


def _noisy(commands: np.ndarray, *others: object) -> np.ndarray:
    return commands + 1e-3 * np.random.default_rng().standard_normal(commands.shape)


def _coupled(commands: np.ndarray, *others: object) -> np.ndarray:
    return commands + 0.1 * commands[0]


def _failing(commands: np.ndarray, *others: object) -> np.ndarray:
    return commands + np.zeros(7)


def _islands(commands: np.ndarray, covariates: object, parameters: np.ndarray) -> np.ndarray:
    return np.where(parameters == 1e5, commands, np.nan)


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        (
            {"simulate": lambda c, *o: c * np.nan},
            "returns NaN at its home configuration, q1 = 0.5 m, q2 = 0 m; set home",
        ),
        ({"simulate": lambda c, *o: c[:, :1]}, r"returned shape \(1, 1\) for 1 row, expected \(1, 2\).*of x, y; wrap"),
        ({"simulate": lambda c, *o: None}, r"returned shape \(\) for 1 row"),
        ({"simulate": lambda c, *o: c * 0}, "no joint changes the pose"),
        ({"simulate": _noisy}, "not deterministic: evaluated twice at q1 = .*seed its random numbers"),
        ({"simulate": _coupled}, "not deterministic.*let no row depend on others"),
        ({"simulate": _failing}, r"simulate on 1 row fails at line \d+ of .*test_black_box.py: ValueError: operands"),
        ({"pose": ("x", "theta")}, "pose: 'theta' is none of x, y, z.*frame"),
        ({"pose": ("x", "phi")}, "phi needs two of x, y, z"),
        ({"covariates": ("payload",)}, r"'payload' is none of load_x.*Condition\(name, unit"),
        ({"covariates": (Condition("q1", "m"),)}, "'q1' is a joint or a pose coordinate already"),
        ({"joints": [Joint("q1", "m", 1.0, 0.0)]}, "joint q1: low must be below high"),
        ({"home": [0.0]}, "home: gives 1 commands for 2 joints"),
        ({"step": 0.0}, "step: a share of half a joint's workspace"),
        ({"parameters": [Parameter("stiffness", "N/m", 1e5)]}, "'stiffness' has the unit 'N/m': give it a scale"),
        ({"parameters": [Parameter("k", "N/m", 1e5, scale=1.0, high=9.0)]}, "'k': its nominal value 100000 must lie"),
        ({"parameters": [Parameter("k", "N/m", 1e5, scale=0.0)]}, "'k': scale must be above 0"),
        ({"frame": lambda pose: (pose, None), "pose": (Coordinate("x", "m"), "u")}, "pose: 'u' is none of"),
    ],
)
def test_a_bad_simulator_is_one_sentence(changes: dict[str, object], sentence: str) -> None:
    with pytest.raises(InputError, match=f"^simulator 'slider'|^parameter.*{sentence}") as told:
        BlackBox(_slider(**changes))
    told.match(sentence)


def test_a_parameter_without_neighbours_is_named() -> None:
    box = BlackBox(_slider(simulate=_islands, parameters=[Parameter("stiffness", "N/m", 1e5, scale=1e4)]))
    with pytest.raises(InputError, match="returns NaN with stiffness = 101000 and 99000, and a pose between them"):
        box.parameter_jacobian(box.home_joints)


def test_a_row_at_the_edge_is_differentiated_to_the_side_that_has_a_pose() -> None:
    def simulate(commands: np.ndarray, *others: object) -> np.ndarray:
        return np.where(commands[:, :1] <= 0.9, commands, np.nan)

    box = BlackBox(_slider(simulate=simulate))
    edge = torch.tensor([[0.9, 0.0]], dtype=torch.float64)
    torch.testing.assert_close(box.jacobian(edge)[0, :2], torch.eye(2, dtype=torch.float64))
    assert bool(torch.isnan(box.jacobian(edge + 0.05)).any())


def test_what_a_file_calls_by_another_name_is_told(tmp_path: Path) -> None:
    file = tmp_path / "mine.py"
    file.write_text((EXAMPLES / "my_simulator.py").read_text(encoding="utf-8"), encoding="utf-8")
    with pytest.raises(InputError, match=r"has no class 'PRES'; it has PRESS"):
        load_mechanism(f"{file}:PRES")
    with pytest.raises(InputError, match=r"write .*mine.py:PRESS"):
        load_mechanism(str(file))
    factory = """
def soft(spring):
    import dataclasses
    weak = dataclasses.replace(PRESS.parameters[3], nominal=spring)
    return dataclasses.replace(PRESS, parameters=[*PRESS.parameters[:3], weak, PRESS.parameters[4]])
"""
    file.write_text(file.read_text(encoding="utf-8") + factory, encoding="utf-8")
    soft = load_mechanism(f"{file}:soft", spring=2e4)
    assert soft.nominal.tolist()[3:] == [2e4, 4e4]
    assert mechanism_from_description(soft.describe(), allow_code=True).nominal.tolist() == soft.nominal.tolist()
    with pytest.raises(InputError, match="it takes spring"):
        load_mechanism(f"{file}:soft", sprung=1.0)
    file.write_text("def make(stiff=1.0):\n    return stiff\n", encoding="utf-8")
    with pytest.raises(InputError, match="make a Simulator"):
        load_mechanism(f"{file}:make")
