"""Every effect on every kind of mechanism, and what the check says of effects that break a promise."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import pytest
import torch
from torch import Tensor

from ccnn_torch.effects import EFFECTS, OUTLIER, Coefficient, Kind, Shape, Situation, make_effect
from ccnn_torch.errors import InputError
from ccnn_torch.mechanisms import Mechanism, SerialArm, load_mechanism
from ccnn_torch.testing import check_effect

ROOT = Path(__file__).parents[2]
ARM = Path(__file__).parent / "arm.yaml"
# Iterative forward kinematics are slow; what is told by five_bar and arm is not asked of all of them again.
ON = {
    "five_bar": [name for name in EFFECTS if name not in ("tool", "flexure", "bending", "error_motion")],
    "arm": [name for name in EFFECTS if name not in ("flexure", "error_motion")],
    "gantry": ["error_motion"],
    "mount": ["geometry", "joint_offset", "drift", "flexure"],
    "stewart": ["geometry", "compliance", "thermal", "gravity", "frame", "instrument"],
    "tripod": ["geometry", "thermal", "tool", "instrument"],
}


def make(name: str) -> Mechanism:
    if name == "mount":
        links = [[0.0, torch.pi / 2, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0]]
        return SerialArm("mount", "standard", links, tool_offset=[0.0, 0.0, 0.0], orientation="direction")
    return load_mechanism(str(ARM.with_name(f"{name}.yaml")) if name in ("arm", "gantry") else name)


@pytest.mark.parametrize(("mechanism", "effect"), [(m, e) for m, effects in ON.items() for e in effects])
def test_every_effect_keeps_what_the_rest_relies_on(mechanism: str, effect: str) -> None:
    check_effect(effect, make(mechanism))


def test_the_example_of_an_own_effect_keeps_it_too() -> None:
    check_effect(f"{ROOT / 'experiments' / 'my_effect.py'}:HosePull", "five_bar")


def test_the_library_has_its_order_and_a_line_for_people() -> None:
    assert list(EFFECTS) == [
        *("tool", "geometry", "joint_offset", "joint_gain", "transmission", "backlash", "friction", "compliance"),
        *(
            "thermal_compliance",
            "sag",
            "gravity",
            "bending",
            "thermal",
            "drift",
            "homing",
            "frame",
            "coupling",
            "error_motion",
            "latency",
            "frame_drift",
        ),
        *("flexure", "instrument"),
    ]
    assert OUTLIER not in EFFECTS
    for name in EFFECTS:
        effect = make_effect(name)
        assert effect.name == name and effect.description[0].islower() and not effect.description.endswith(".")


@pytest.mark.parametrize(
    ("effect", "sentence"),
    [
        ("backlash", "direction1"),
        ("friction", "direction1"),
        ("compliance", "load_x[N] or load_y[N]"),
        ("sag", "torque_q1[N*m]"),
        ("thermal", "temperature[degC]"),
        ("thermal_compliance", "temperature[degC]"),
        ("drift", "time[s]"),
        ("latency", "speed1[rad/s]"),
        ("tool", "a platform that turns"),
    ],
)
def test_what_is_missing_is_said_with_its_column(effect: str, sentence: str) -> None:
    assert sentence in make_effect(effect).missing(load_mechanism("five_bar"), [])


def test_an_arm_whose_frames_are_fitted_anyhow_has_no_effect_of_them(tmp_path: Path) -> None:
    file = tmp_path / "arm.yaml"
    file.write_text(ARM.read_text().replace("base_frame: identity", "base_frame: unknown"))
    mechanism = load_mechanism(str(file))
    assert "fitted" in make_effect("frame").missing(mechanism, []) and not make_effect("tool").missing(mechanism, [])


def test_a_name_that_is_none_and_a_file_that_has_none(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="did you mean 'backlash'"):
        make_effect("back_lash")
    file = tmp_path / "half.py"
    file.write_text("class Half:\n    name = 'half'\n    kind = 'joint'\n")
    with pytest.raises(InputError, match="it lacks missing, coefficients, shapes, basis, description, kind"):
        make_effect(f"{file}:Half")


class Good:
    """Δq = c; the broken ones below differ in one point."""

    name = "good"
    kind: Kind = "joints"
    description = "for the check"
    ordered = False
    unit, scale, column, grid = "rad", 1e-3, "", (0.5, 1.0)

    def missing(self, mechanism: Mechanism, covariates: Sequence[str]) -> str:
        return ""

    def coefficients(self, situation: Situation) -> tuple[Coefficient, ...]:
        return tuple(Coefficient(j.name, self.unit, self.scale) for j in situation.mechanism.joints)

    def shapes(self, situation: Situation) -> tuple[Shape, ...]:
        return (Shape("power", "1", self.grid),)

    def basis(self, situation: Situation, shape: Tensor) -> Tensor:
        if self.column:
            column = situation.covariates[self.column][..., None]
            return torch.diag_embed(situation.joints * column * shape.unsqueeze(-2))
        return torch.diag_embed(situation.joints.abs().clamp_max(9.0) ** shape.unsqueeze(-2))


class BadUnit(Good):
    unit = "bogon"


class NotSi(Good):
    unit = "mrad"


class NoScale(Good):
    scale = 0.0


class Unsaid(Good):
    column = "time"


class Descending(Good):
    grid = (1.0, 0.5)


class Infinite(Good):
    def shapes(self, situation: Situation) -> tuple[Shape, ...]:
        return ()

    def basis(self, situation: Situation, shape: Tensor) -> Tensor:
        return torch.diag_embed(situation.joints / (situation.joints.abs() < 50))


class OneShape(Good):
    def basis(self, situation: Situation, shape: Tensor) -> Tensor:
        return torch.diag_embed(situation.joints.abs().clamp_max(9.0) ** shape.flatten()[0])


class OneSet(Good):
    def basis(self, situation: Situation, shape: Tensor) -> Tensor:
        basis = super().basis(situation, shape)
        return basis - basis.mean((0, -2, -1), keepdim=True).mean(-3, keepdim=True)


class Ordered(Good):
    def basis(self, situation: Situation, shape: Tensor) -> Tensor:
        basis = super().basis(situation, shape)
        return basis - basis[..., :1, :, :]


class Idle(Good):
    def basis(self, situation: Situation, shape: Tensor) -> Tensor:
        return 0 * super().basis(situation, shape)


class Random(Good):
    def basis(self, situation: Situation, shape: Tensor) -> Tensor:
        return super().basis(situation, shape) * torch.rand(1, dtype=torch.float64)


@pytest.mark.parametrize(
    ("broken", "sentence"),
    [
        (BadUnit, "the unit of 'q1' is none"),
        (NotSi, "'mrad' of 'q1' is no SI unit"),
        (NoScale, "the scale 0.0, expected more than 0"),
        (Unsaid, "needs the column 'time', which missing"),
        (Descending, "the grid of shape 'power' does not ascend"),
        (Infinite, "not finite in 1 of 8 rows"),
        (OneShape, r"expected \(3, 8, 2, 2\): sets of shapes, rows, joints"),
        (OneSet, "differs from single calls"),
        (Ordered, "depends on the order of the rows"),
        (Idle, "does nothing to mechanism 'five_bar'"),
        (Random, "gives other values when called again"),
    ],
)
def test_the_check_names_a_broken_promise(broken: type[Good], sentence: str) -> None:
    check_effect(Good)
    with pytest.raises(AssertionError, match=sentence):
        check_effect(broken)
