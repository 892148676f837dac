"""Identified machines of every kind, small, and the compensators that command them; each is made once for all tests."""

from __future__ import annotations

import math
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import torch
from stand_ins import Sigmoids
from torch import Tensor

from ccnn_torch.compensation import Compensator, build_machine, expand_effects, fit_compensator
from ccnn_torch.coordinates import Coordinate
from ccnn_torch.effects import Acting, Situation, default_gravity, make_effect, reached
from ccnn_torch.effects.covariates import covariate_units, draw_covariates
from ccnn_torch.mechanisms import Framed, Mechanism, SerialArm, load_mechanism, read_urdf
from ccnn_torch.training import Scaling

HALF = math.pi / 2
SIX = [[0.1, HALF, 0.4, 0], [-0.5, 0, 0, 0], [-0.4, 0, 0, 0], [0, HALF, 0.12, 0], [0, -HALF, 0.1, 0], [0, 0, 0.09, 0]]
AROUND = torch.tensor([0.3, -1.2, 1.4, 0.5, 1.2, 0.4], dtype=torch.float64)


@dataclass(frozen=True)
class Known:
    """A machine of which everything is known.

    Attributes:
        mechanism: with the nominal parameters.
        identified: all parameters, `k` [SI].
        joints: commanded, in the order measured, `s x n` [SI].
        covariates: by name, `s` each [SI].
        acting: effects with their numbers.
    """

    mechanism: Mechanism
    identified: Tensor
    joints: Tensor
    covariates: dict[str, Tensor]
    acting: list[Acting]

    @property
    def inputs(self) -> Tensor:
        """Joints and covariates of all rows, `s x (n + m)` [SI]."""
        return torch.cat([self.joints, *(v.unsqueeze(-1) for v in self.covariates.values())], -1)

    def situation(self, joints: Tensor, covariates: Tensor) -> Situation:
        """Rows `s x n`, `s x m` on the nominal machine."""
        given = dict(zip(self.covariates, covariates.unbind(-1), strict=True))
        return Situation(self.mechanism, joints, given, default_gravity(self.mechanism))

    def frame(self, moved: Tensor, covariates: Tensor) -> Tensor:
        """Position and rotation vector of the true machine at command and what was learned there, `s x c` [m, rad]."""
        return reached(self.situation(moved, covariates), self.acting, self.identified)

    def compensator(self, size: float = 1e-5, ends: Mapping[str, tuple[float, float]] | None = None) -> Compensator:
        """What commands it; `size` is what was learned beside it [SI], 0 for nothing; `ends` as a machine has them."""
        joints, inputs = self.joints, self.inputs
        names, units = [*self.covariates], covariate_units(self.mechanism)
        situation = self.situation(joints, inputs[:, joints.shape[1] :])
        effects = expand_effects(situation, self.acting, names, 0.1) if self.acting else None
        machine = build_machine(self.mechanism, self.identified, effects, joints, 0.1)
        machine.ends.update(ends or {})
        network, scaling, deviations = small_network(inputs, size, joints.shape[1])
        columns = [Coordinate(name, units[name]) for name in names]
        about = (network, scaling, inputs, deviations, self.mechanism.joints, columns)
        return fit_compensator(*about, machine=machine)


def small_network(inputs: Tensor, size: float = 1e-4, outputs: int | None = None) -> tuple[Sigmoids, Scaling, Tensor]:
    """A network, its scaling, and the deviations `size` [SI] that it gives at the inputs."""
    d = inputs.shape[-1]
    n = d if outputs is None else outputs
    network = Sigmoids([d, 4, n], seed=1, gain=0.5)
    blank, flat = torch.ones(1, len(inputs), dtype=torch.float64), torch.zeros(d, dtype=torch.bool)
    scaling = Scaling.fit(inputs[None], inputs.new_zeros(1, len(inputs), n), blank, flat).repeat(0)
    scaling.deviation.fill_(size)
    with torch.no_grad():
        return network, scaling, scaling.restore(network(scaling.features(inputs)))


def near(mechanism: Mechanism, error: float, joints: Tensor, seed: int = 4) -> Known:
    """Parameters off by `error` [SI]."""
    draw = torch.randn(mechanism.nominal.shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return Known(mechanism, mechanism.nominal + error * draw, joints, {}, [])


def around(middle: Sequence[float] | Tensor, half: float | Tensor, count: int = 120, seed: int = 9) -> Tensor:
    middle = torch.as_tensor(middle, dtype=torch.float64)
    draw = torch.rand(count, len(middle), generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return middle + half * (2 * draw - 1)


def with_effects(known: Known, names: Sequence[str], columns: Sequence[str], share: float = 0.3) -> Known:
    """The machine with effects of a share of their usual size, and the columns that they look at."""
    drawn = draw_covariates(known.mechanism, known.joints, torch.Generator().manual_seed(2))
    known = replace(known, covariates={name: drawn[name] for name in columns})
    situation = known.situation(known.joints, known.inputs[:, known.joints.shape[1] :])
    acting = []
    for effect in map(make_effect, names):
        shape = [s.grid[len(s.grid) // 2] if s.usual is None else s.usual for s in effect.shapes(situation)]
        sizes = [0.0 if c.secondary else share * c.scale for c in effect.coefficients(situation)]
        acting.append(Acting(effect, *(torch.tensor(v, dtype=torch.float64) for v in (shape, sizes))))
    return replace(known, acting=acting)


def arm(orientation: str = "rotation_vector") -> Known:
    """Six joints in a region without singular poses, 50 um and 50 urad off."""
    return near(SerialArm("six", "standard", SIX, orientation=orientation), 5e-5, around(AROUND, 0.3))


def wrist() -> Known:
    """The same arm where its wrist is straight in the middle, 0.2 mm and 0.2 mrad off."""
    middle = AROUND.clone()
    middle[4] = 0.0
    return near(SerialArm("six", "standard", SIX), 2e-4, around(middle, 0.5, 300))


def sliding_arm() -> Known:
    """An arm that turns, turns and slides, measured by its position: fewer operations to trace."""
    links = [[0.4, 0.0, 0.3, 0.0], [0.3, math.pi, 0.0, 0.0], [0.0, 0.0, 0.1, 0.0]]
    types = ["revolute", "revolute", "prismatic"]
    made = SerialArm("slider", "standard", links, joint_types=types, joint_sign=[1, -1, 1], orientation="none")
    return near(made, 1e-5, around([0.2, -1.3, 0.1], torch.tensor([0.5, 0.3, 0.05], dtype=torch.float64)))


def scara() -> Known:
    """Four joints and six coordinates."""
    links = [[0.4, 0.0, 0.3, 0.0], [0.3, math.pi, 0.0, 0.0], [0.0, 0.0, 0.1, 0.0], [0.0, 0.0, 0.05, 0.0]]
    made = SerialArm("scara", "standard", links, joint_types=["revolute", "revolute", "prismatic", "revolute"])
    return near(made, 1e-4, around([0.2, -1.3, 0.1, 0.4], torch.tensor([0.5, 0.3, 0.05, 0.5], dtype=torch.float64)))


def five_axis() -> Known:
    """Three sliding and two turning axes, as of a milling machine."""
    links = [[0, -HALF, 0, -HALF], [0, -HALF, 0, -HALF], [0, HALF, 0.2, 0], [0, -HALF, 0.1, 0], [0, 0, 0.15, 0]]
    types = ["prismatic"] * 3 + ["revolute"] * 2
    half = torch.tensor([0.3, 0.3, 0.2, 0.8, 1.5], dtype=torch.float64)
    return near(SerialArm("mill", "standard", links, joint_types=types), 5e-5, around([0.4, 0.4, 0.3, 0.9, 0.2], half))


SEVEN_TURNS = ((0, 0, 1), (0, 1, 0), (0, 0, 1), (0, -1, 0), (0, 0, 1), (0, 1, 0), (0, 0, 1))
SEVEN_LENGTHS = (0.15, 0.19, 0.21, 0.19, 0.21, 0.19, 0.08)
SEVEN_HOME = (0.4, 0.7, -0.3, -1.4, 0.5, 1.0, 0.2)
# Of the fourth joint; the others turn farther.
SEVEN_HIGH = -1.2


@cache
def seven_arm() -> SerialArm:
    """Of a URDF: seven turning joints, the first without limits, the fourth with narrow ones."""
    links = "".join(f'<link name="l{i}"/>' for i in range(8))
    for i, (axis, length) in enumerate(zip(SEVEN_TURNS, SEVEN_LENGTHS, strict=True)):
        low, high = (-1.7, SEVEN_HIGH) if i == 3 else (-2.9, 2.9)
        limit = f'<limit lower="{low}" upper="{high}"/>' if i else ""
        links += (
            f'<joint name="j{i}" type="{"revolute" if i else "continuous"}"><parent link="l{i}"/>'
            f'<child link="l{i + 1}"/><origin xyz="0.01 0 {length}"/><axis xyz="{" ".join(map(str, axis))}"/>'
            f"{limit}</joint>"
        )
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "seven.urdf"
        path.write_text(f'<robot name="seven">{links}</robot>')
        return read_urdf(str(path))


def seven() -> Known:
    """Seven joints for six coordinates, away from the limits."""
    return near(seven_arm(), 1e-4, around(SEVEN_HOME, 0.15))


def parallel(name: str, error: float, most: float = 30.0) -> Known:
    """A machine of the library with closed forms of one direction."""
    mechanism = load_mechanism(name)
    joints = mechanism.sample_joints(400, torch.Generator().manual_seed(3))
    joints = joints[torch.isfinite(mechanism.forward_kinematics(joints)).all(-1)]
    regular = mechanism.condition_number(joints, 0.3) < most
    return near(mechanism, error, joints[regular][:150], 2)


def framed(name: str, tool: bool, effects: Sequence[str] = ()) -> Known:
    """A machine of the library seen by a tracker that stands 3 m off and turned, frames off as well."""
    bare = parallel(name, 2e-4)
    machine = Framed(bare.mechanism, base=True, tool=tool)
    values = machine.nominal.clone()
    values[:6] = torch.tensor([3.0, 1.0, 0.5, 0.1, -0.2, 2.9])
    if tool:
        values[-6:] = torch.tensor([0.05, -0.02, 0.1, 0.4, 0.1, -0.3])
    # Where what effects see is a polynomial; effects on poses count to first order, and these are small.
    joints = 0.6 * bare.mechanism.home_joints + 0.4 * bare.joints
    return with_effects(near(machine.with_nominal(values), 2e-4, joints), effects, (), 0.02)


def overconstrained() -> Known:
    """A machine without closed forms, in polynomials of the joints, 0.1 mm and 0.1 mrad off."""
    mechanism = load_mechanism("overconstrained_2dof")
    joints = around(mechanism.home_joints, 0.2)
    return with_effects(near(mechanism, 1e-4, joints), ("joint_gain", "frame"), ())


MACHINES: dict[str, Callable[[], Known]] = {
    "arm": arm,
    "arm with effects": lambda: with_effects(arm(), ("joint_gain", "compliance"), ("load_x", "load_z")),
    "arm by positions": lambda: arm("none"),
    "sliding arm": sliding_arm,
    "sliding arm with effects": lambda: with_effects(
        sliding_arm(),
        ("joint_gain", "thermal", "bending", "error_motion", "frame"),
        ("temperature", "load_x", "load_z"),
    ),
    "scara": scara,
    "five axes": five_axis,
    "seven joints": seven,
    "delta": lambda: parallel("delta", 2e-4),
    "five-bar with effects": lambda: with_effects(
        parallel("five_bar", 2e-4, 8.0), ("compliance", "backlash"), ("load_x", "load_y", "direction1", "direction2")
    ),
    "stewart": lambda: parallel("stewart", 2e-4),
    "framed stewart with effects": lambda: framed("stewart", True, ("joint_gain", "frame")),
    "framed delta": lambda: framed("delta", False),
    "polynomials": overconstrained,
    "tripod": lambda: parallel("tripod", 2e-4),
    "tripod with effects": lambda: with_effects(parallel("tripod", 2e-4), ("joint_gain", "frame"), ()),
}


@cache
def known(name: str) -> Known:
    return MACHINES[name]()


@cache
def compensated(name: str) -> Compensator:
    """Do not change it: all tests share it."""
    return known(name).compensator()
