"""A small compensator of every kind that the project can make, quickly."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise

import torch
from machines import MACHINES, compensated, known, near
from stand_ins import Sigmoids, arm_compensator, tripod_compensator, tripod_joints
from test_learned_models import LEARNERS
from torch import Tensor

from ccnn_torch.compensation import Compensator, build_machine, fit_compensator
from ccnn_torch.coordinates import Coordinate
from ccnn_torch.evolution.masked_network import MaskedNetwork
from ccnn_torch.evolution.waves import Harmonics, Waves
from ccnn_torch.learners import TrainingData
from ccnn_torch.mechanisms import SerialArm
from ccnn_torch.training import Scaling, train


def learned(name: str) -> Compensator:
    """A learner on 60 rows of the tripod."""
    joints = tripod_joints(60)
    generator = torch.Generator().manual_seed(4)
    deviations = 1e-4 * torch.sin(8 * joints) + 1e-5 * torch.randn(joints.shape, generator=generator).double()
    rows = torch.ones(1, len(joints), dtype=torch.float64)
    scaling = Scaling.fit(joints[None], deviations[None], rows, torch.zeros(3, dtype=torch.bool))
    data = TrainingData(
        scaling.features(joints[None]), scaling.standardise(deviations[None]), rows, torch.arange(1000, 1001)
    )
    learner = LEARNERS[name]()
    train(learner, data)
    names = [Coordinate(f"q{i}", "m") for i in (1, 2, 3)]
    return fit_compensator(learner.network(0), scaling.repeat(0), joints, deviations, names)


def masks(sizes: Sequence[int], density: float, seed: int, extra: int = 0) -> tuple[list[Tensor], list[Tensor]]:
    """Connections and weights of a network; `extra` columns of the last layer are for periodic nodes."""
    generator = torch.Generator().manual_seed(seed)
    found, weights = [], []
    for k, (i, o) in enumerate(pairwise(sizes)):
        width = i + (extra if k == len(sizes) - 2 else 0)
        found.append(torch.rand(o, width, generator=generator) < density)
        weights.append(torch.randn(o, width + 1, generator=generator, dtype=torch.float64))
    return found, weights


def masked(density: float = 0.4) -> Compensator:
    """The tripod's network of the paper's size, with connections left out."""
    joints = tripod_joints()
    network = MaskedNetwork(*masks([3, 6, 6, 3], density, 5))
    blank = torch.ones(1, len(joints), dtype=torch.float64)
    scaling = Scaling.fit(joints[None], torch.zeros_like(joints)[None], blank, torch.zeros(3, dtype=torch.bool))
    one = scaling.repeat(0)
    one.deviation.fill_(1e-4)
    with torch.no_grad():
        deviations = one.restore(network(one.features(joints)))
    return fit_compensator(network, one, joints, deviations, [Coordinate(f"q{i}", "m") for i in (1, 2, 3)])


def six_joints(harmonics: int = 6, links: bool = True) -> Compensator:
    """An arm with identified links; masked network, periodic nodes and harmonics of its gears on what they leave."""
    arm = known("arm")
    joints = arm.joints
    machine = build_machine(arm.mechanism, arm.identified, None, joints, 0.1) if links else None
    generator = torch.Generator().manual_seed(8)
    blank, turning = torch.ones(1, len(joints), dtype=torch.float64), torch.ones(6, dtype=torch.bool)
    scaling = Scaling.fit(joints[None], torch.zeros_like(joints)[None], blank, turning, angles=True).repeat(0)
    scaling.deviation.fill_(1e-6)
    waves = Waves(torch.tensor([12, 14]), torch.tensor([3.0, 5.0], dtype=torch.float64))

    def draw(*shape: int) -> Tensor:
        return 0.3 * torch.randn(*shape, generator=generator, dtype=torch.float64)

    step, amplitude = scaling.angle_step, draw(6, 2 * harmonics)
    gears = Harmonics(step, amplitude, draw(6, 2 * harmonics, 3), torch.eye(6, dtype=torch.float64))
    own_masks, weights = masks([18, 8, 6], 0.4, 2, extra=4)
    network = MaskedNetwork(own_masks, weights, draw(6, 2, 13), 1 + draw(6).abs(), waves, 18, gears)
    with torch.no_grad():
        deviations = scaling.restore(network(scaling.features(joints)))
    return fit_compensator(network, scaling, joints, deviations, arm.mechanism.joints, machine=machine)


def little(joints: int, covariates: int, nodes: int, turning: bool) -> Compensator:
    """A few nodes: a parser of Structured Text takes a second for twenty lines."""
    generator, width = torch.Generator().manual_seed(6), joints + covariates
    inputs = torch.rand(100, width, generator=generator, dtype=torch.float64) + 0.5
    periodic = torch.tensor([turning] * joints + [False] * covariates)
    blank, still = torch.ones(1, 100, dtype=torch.float64), torch.zeros(1, 100, joints, dtype=torch.float64)
    scaling = Scaling.fit(inputs[None], still, blank, periodic).repeat(0)
    scaling.deviation.fill_(1e-3)
    network = Sigmoids([width + turning * joints, nodes, joints], seed=7, gain=0.5)
    with torch.no_grad():
        deviations = scaling.restore(network(scaling.features(inputs)))
    names = [Coordinate(f"q{i + 1}", "rad") for i in range(joints)]
    return fit_compensator(network, scaling, inputs, deviations, names, [Coordinate("time", "s")] * covariates)


def little_arm() -> Compensator:
    """One link that slides between limits just outside of what was measured: the fewest operations of a machine."""
    links, limits = [[0.4, 0.0, 0.0, 0.0]], [[-0.1, 1.1]]
    arm = SerialArm("one", "standard", links, joint_types=["prismatic"], limits=limits, orientation="none")
    joints = torch.rand(60, 1, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    return near(arm, 1e-4, joints).compensator()


# Of these the others hold everything that a form has; to trace them again takes time.
_EAGER_ALONE = ("arm", "arm with effects", "arm by positions", "five axes", "tripod")
KINDS: dict[str, Callable[[], Compensator]] = {
    "tripod": tripod_compensator,
    "covariates": arm_compensator,
    "masked": masked,
    "steep": lambda: tripod_compensator(gain=2.0, size=2e-2),
    "six joints": six_joints,
    **{name: (lambda name=name: compensated(name)) for name in MACHINES if name not in _EAGER_ALONE},
    **{name: (lambda name=name: learned(name)) for name in LEARNERS},
}
