"""The mechanism that the docs show gets everything else for nothing: kinematics, singularities, identification."""

from pathlib import Path

import pytest
import torch
from catalogue import OWN_MECHANISM

from ccnn_torch.coordinates import Coordinate, Parameter, plausible_error
from ccnn_torch.errors import InputError
from ccnn_torch.mechanisms import Mechanism, load_mechanism
from ccnn_torch.mechanisms.pose import frame_jacobian
from ccnn_torch.numerics.least_squares import levenberg_marquardt

DOCS = Path(__file__).parents[2] / "docs" / "how_to" / "mechanisms.md"


def _mechanism():
    return load_mechanism(f"{OWN_MECHANISM}:Planar3RRR")


def test_the_docs_show_the_file():
    text = OWN_MECHANISM.read_text()
    assert len(text.splitlines()) < 60
    assert text in DOCS.read_text()


def test_its_geometry_is_identified_leg_by_leg():
    """60 noisy poses of a disturbed machine; joints that the nominal model misses by milliradians are met."""
    mechanism = _mechanism()
    generator = torch.Generator().manual_seed(0)
    scale = torch.tensor([plausible_error(g) for g in mechanism.geometry], dtype=torch.float64)
    truth = mechanism.nominal + scale * torch.randn(21, generator=generator, dtype=torch.float64)
    commanded = mechanism.sample_joints(90, generator)
    pose = mechanism.forward_kinematics(commanded, truth)
    measured = pose + 1e-6 * torch.randn(pose.shape, generator=generator, dtype=torch.float64)
    found = mechanism.nominal.clone()
    for leg in (1, 2, 3):
        own = torch.tensor([g.leg == leg for g in mechanism.geometry])

        def residual(free, own=own, leg=leg):
            values = mechanism.nominal.expand(60, -1).masked_scatter(own, free.expand(60, -1))
            return (mechanism.solve_inverse(measured[:60], values) - commanded[:60])[:, leg - 1]

        found[own] = levenberg_marquardt(residual, mechanism.nominal[own]).value
    assert float((truth - mechanism.nominal).abs().max()) > 1e-3
    assert float((found - truth).abs().max()) < 1e-4
    held_out = mechanism.forward_kinematics(commanded[60:], found) - pose[60:]
    before = mechanism.forward_kinematics(commanded[60:]) - pose[60:]
    # The mean error is that of the noise; the worst of 90 coordinates lies at the edge of the box.
    assert float(held_out.square().mean().sqrt()) < 2e-6 and float(held_out.abs().max()) < 2e-5
    assert float(before.square().mean().sqrt()) > 1e-3


def test_singularity_measure_tells_both_kinds():
    five_bar = load_mechanism("five_bar")
    centre, radius = five_bar.maximal_inscribed_circle()
    down = torch.tensor([0.0, -1.0], dtype=torch.float64)
    # Towards the bottom the couplers come into line: the tool gains a freedom (second kind).
    steps = torch.tensor([1e-1, 1e-2, 1e-3, 1e-4, 1e-5], dtype=torch.float64)[:, None]
    falling = five_bar.solve_inverse(centre + (1 - steps) * radius * down)
    values = five_bar.singular_values(falling)
    assert (values[1:, 0] > 2 * values[:-1, 0]).all()
    # Towards a leg's reach it loses one (first kind); between the couplers no line is near there.
    foot = torch.tensor([-0.5, 0.0], dtype=torch.float64)
    out = (centre - foot) / (centre - foot).norm()
    reaching = five_bar.solve_inverse(centre + (1 - steps) * radius * out)
    lost = five_bar.singular_values(reaching)
    assert (lost[1:, -1] < 0.5 * lost[:-1, -1]).all() and float(lost[:, 0].max()) < 10
    for joints in (falling, reaching):
        measure = 1 / five_bar.condition_number(joints)
        assert (measure[1:] < measure[:-1]).all() and float(measure[-1]) < 1e-2
    jammed = torch.tensor([torch.pi, 0.0], dtype=torch.float64)
    assert float(1 / five_bar.condition_number(jammed)) == 0 and torch.isnan(five_bar.singular_values(jammed)).all()


def test_singularity_measure_does_not_depend_on_the_closures_form():
    mechanism = _mechanism()
    joints = mechanism.sample_joints(10, torch.Generator().manual_seed(1))
    squared = type(mechanism)()
    plain = squared.closure
    squared.closure = lambda pose, q, v=None: plain(pose, q, v) * (3 + plain(pose, q, v)) * torch.tensor([1.0, 5, 0.1])
    torch.testing.assert_close(squared.condition_number(joints), mechanism.condition_number(joints), rtol=1e-9, atol=0)


def test_plausible_errors():
    assert plausible_error(Parameter("l", "m", 1.0)) == 1e-3
    assert plausible_error(Parameter("q", "rad", 0.0)) == plausible_error(Parameter("k", "1", 1.0)) == 2e-3
    assert plausible_error(Parameter("l", "m", 1.0, 2, 5e-3)) == 5e-3
    with pytest.raises(InputError, match="'stiff' has the unit 'N/m': give it a scale"):
        plausible_error(Parameter("stiff", "N/m", 1.0))


@pytest.mark.parametrize("name", ["h", "z", "phi"])
def test_the_slope_of_a_frame_by_name_is_that_of_the_frame(name):
    """A length of another name does not move the frame; an angle of another name says what to do."""

    class Slides(Mechanism):
        def __init__(self):
            unit = "rad" if name == "phi" else "m"
            joints, pose = (
                (Coordinate("q1", "m"), Coordinate("q2", unit)),
                (Coordinate("x", "m"), Coordinate(name, unit)),
            )
            super().__init__("slides", joints, pose, [], (-1, -1), (1, 1))

        def solve_inverse(self, pose, parameters=None, guess=None):
            return pose

    slides, pose = Slides(), torch.zeros(3, 2, dtype=torch.float64)
    if name == "phi":
        with pytest.raises(InputError, match="pose angle 'phi': override frame"):
            slides.frame_slope(pose)
    else:
        assert torch.equal(slides.frame_slope(pose), frame_jacobian(slides.frame, pose))


class _SliderArm(Mechanism):
    """A slider along x, tilted, that carries two links; only its forward kinematics is written, without a guess."""

    def __init__(self):
        super().__init__(
            name="slider_arm",
            joints=[Coordinate("q1", "m"), Coordinate("q2", "rad"), Coordinate("q3", "rad")],
            pose=[Coordinate("x", "m"), Coordinate("y", "m"), Coordinate("phi", "rad")],
            geometry=[Parameter("length", "m", 0.3), Parameter("hand", "m", 0.1), Parameter("tilt", "rad", 0.0)],
            low=(0.2, 0.1, 2.9),
            high=(0.5, 0.25, 3.4),  # across the angle pi
            home_joints=[0.1, 0.6, 2.5],
        )

    def forward_kinematics(self, joints, parameters=None):
        length, hand, tilt = self.values(parameters)
        q1, q2, q3 = joints.unbind(-1)
        turn = q2 + q3
        x = q1 * torch.cos(tilt) + length * torch.cos(q2) + hand * torch.cos(turn)
        y = q1 * torch.sin(tilt) + length * torch.sin(q2) + hand * torch.sin(turn)
        return torch.stack([x, y, torch.atan2(torch.sin(turn), torch.cos(turn))], -1)

    def frame(self, pose):
        x, y, phi = pose.unbind(-1)
        nought, one = torch.zeros_like(x), torch.ones_like(x)
        rows = [torch.cos(phi), -torch.sin(phi), nought, torch.sin(phi), torch.cos(phi), nought, nought, nought, one]
        return torch.stack([x, y, nought], -1), torch.stack(rows, -1).unflatten(-1, (3, 3))


def test_forward_kinematics_alone_suffices():
    mechanism = _SliderArm()
    joints = mechanism.sample_joints(50, torch.Generator().manual_seed(0))
    assert torch.isfinite(joints).all()
    longer = mechanism.nominal + torch.tensor([1e-3, 0.0, 2e-3])
    pose = mechanism.forward_kinematics(joints, longer)
    torch.testing.assert_close(mechanism.solve_inverse(pose, longer, joints), joints, rtol=0, atol=1e-9)
    assert mechanism.closure(pose, joints, longer).abs().max() < 1e-12
    # The derivative of the root: by the implicit function theorem the inverse of the Jacobian.
    there = mechanism.forward_kinematics(joints)
    jacobian = torch.autograd.functional.jacobian
    step = jacobian(lambda x: mechanism.solve_inverse(x, None, joints).sum(0), there).movedim(0, 1)
    slope = jacobian(lambda q: mechanism.forward_kinematics(q).sum(0), joints).movedim(0, 1)
    torch.testing.assert_close(step @ slope, torch.eye(3).double().expand(50, -1, -1), rtol=0, atol=1e-8)
    with pytest.raises(InputError, match="must define closure, solve_inverse or forward_kinematics"):
        type("Nothing", (Mechanism,), {})("nothing", [], [], [], [], [])
