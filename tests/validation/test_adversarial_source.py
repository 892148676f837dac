"""The adversarial source: cases are repeatable, finite, of the strength stated, and their truths are consistent."""

import dataclasses

import numpy as np
import pytest
import torch
from ccnn_validation.sources.adversarial import FAMILIES, make
from ccnn_validation.sources.adversarial.data_families import DATA_FAMILIES
from ccnn_validation.sources.adversarial.effect import absorbed, measured, scaled, strength_of
from ccnn_validation.sources.adversarial.machine import ARM, machine_of
from ccnn_validation.sources.adversarial.ordinary import ORDINARY, ordinary
from ccnn_validation.sources.adversarial.rig import ALL, draw_rig

from ccnn_torch.effects import EFFECTS, OUTLIER, Situation, pose_residual, signature
from ccnn_torch.effects.situation import default_gravity

_NAMES = {*EFFECTS, OUTLIER}
_KINDS = {"none", "single", "pair", "several", "outside", "data"}


@pytest.mark.parametrize("family", FAMILIES)
def test_case(family):
    case, again = make(family, 1), make(family, 1)
    assert case.family == family
    machine = machine_of(case.mechanism if case.mechanism in ALL else ARM)
    joints = [f"{j.name}[{j.unit}]" for j in machine.model.joints]
    poses = [f"{c.name}[{c.unit}]" for c in machine.model.pose]
    assert list(case.columns)[: len(joints) + len(poses)] == [*joints, *poses]
    assert list(case.clean) == poses
    rows = {len(v) for v in (*case.columns.values(), *case.clean.values())}
    assert len(rows) == 1 and 35 <= rows.pop() <= 5000
    for header, values in case.columns.items():
        assert np.isfinite(values).all()
        np.testing.assert_array_equal(values, again.columns[header])
    assert dataclasses.replace(case, columns={}, clean=None) == dataclasses.replace(again, columns={}, clean=None)
    if case.noise is not None:
        assert set(case.noise) == set(machine.pose_units) and min(case.noise.values()) > 0
    _check_truth(case.truth, case.columns, machine)
    if case.truth.kind == "outside" and case.truth.outside is None:
        # Only what looks like more noise, and only where nobody has said how much there is, may go without a word.
        assert case.noise is None
    if case.truth.kind == "data":
        return
    nominal = machine.forward(np.stack([case.columns[h] for h in joints], -1))
    gap = machine.twist(np.stack([case.clean[h] for h in poses], -1), nominal)
    size = np.sqrt(np.mean(gap**2))
    assert size < 1e-9 if case.truth.kind == "none" and family != "quantised_commands" else 1e-7 < size < 0.05


def _check_truth(truth, columns, machine):
    names = {h.split("[")[0] for h in columns}
    assert truth.kind in _KINDS and truth.accepted
    assert set().union(*truth.accepted) <= _NAMES
    assert set(truth.enough) <= set(truth.accepted) - {frozenset()}
    assert set(truth.drivers) <= names | {"position", "direction", "time"}
    if truth.kind in ("none", "outside"):
        assert frozenset() in truth.accepted
    if truth.kind == "none":
        assert truth.outside is not True and not truth.causes
    if truth.kind in ("single", "pair", "several"):
        assert frozenset(truth.causes) in truth.accepted and truth.outside is not True
    assert (truth.kind == "data") == bool(truth.mention)


def test_a_mistake_is_not_told_by_words_of_any_verdict():
    said = (
        "compliance of joints 1 and 2, calculated over all rows in the order measured; the noise of a row has a "
        "correlation of 0.3 with that of the row before; what is left follows direction 1, shifted along the axis, in "
        "units of the noise; record direction2[1] (the sign of each joint's last motion), in this design of zero load"
    )
    for family in DATA_FAMILIES:
        assert not any(word in said for word in make(family, 3).truth.mention), family


@pytest.mark.parametrize("name", [*ORDINARY, "geometry"])
@pytest.mark.parametrize("machine", ALL)
def test_strength(machine, name):
    rig = draw_rig(np.random.default_rng(3), [machine], (40, 40))
    effect = scaled(rig, ordinary(rig, name), 30.0)
    assert strength_of(rig, measured(rig, effect)) == pytest.approx(30.0, rel=1e-3)


def test_geometry_is_absorbed_by_geometry_and_a_transmission_is_not():
    rig = draw_rig(np.random.default_rng(4), ["delta"])
    assert absorbed(rig, ordinary(rig, "geometry"), ("geometry",)) < 1e-4
    assert absorbed(rig, ordinary(rig, "transmission"), ("joint_gain", "geometry")) > 0.9


def test_noise_is_of_the_size_given():
    case = make("decoys_transmission", 2)
    for seed in range(3, 9):
        case = case if case.noise is not None else make("decoys_transmission", seed)
    header = next(h for h in case.clean if h.endswith("[m]"))
    spread = np.std(case.columns[header] - case.clean[header])
    assert spread == pytest.approx(case.noise["m"], rel=0.3)


@pytest.mark.parametrize("name", ALL)
def test_derivatives_are_those_of_the_forward_kinematics(name):
    rig = draw_rig(np.random.default_rng(5), [name], (20, 20))
    machine, rng = rig.machine, np.random.default_rng(6)
    change = 1e-6 * rng.normal(size=machine.count)
    moved = machine.twist(machine.forward(rig.joints + change, near=rig.pose), rig.pose)
    np.testing.assert_allclose(moved, rig.jacobian @ change, atol=1e-9)
    which = machine.parameters_like()
    sizes = 1e-6 * rng.normal(size=len(which))
    parameters = np.array(machine.nominal)
    parameters[which] += sizes
    moved = machine.twist(machine.forward(rig.joints, parameters, rig.pose), rig.pose)
    np.testing.assert_allclose(moved, machine.parameter_jacobian(rig.joints, rig.pose, which) @ sizes, atol=1e-9)


def _rows(case):
    """The rows as the library has them, and what the machine does in them without noise."""
    machine = machine_of(case.mechanism if case.mechanism in ALL else ARM)
    own = [j.name for j in machine.model.joints]
    columns = {h.split("[")[0]: torch.as_tensor(np.asarray(v)) for h, v in case.columns.items()}
    clean = torch.stack([torch.as_tensor(np.asarray(v)) for v in case.clean.values()], -1)
    covariates = {n: v for n, v in columns.items() if n not in (*own, *machine.pose_names)}
    if "temperature" in covariates:
        covariates["temperature"] = covariates["temperature"] + 273.15
    joints = torch.stack([columns[n] for n in own], -1)
    rows = Situation(machine.model, joints, covariates, default_gravity(machine.model), guess=clean)
    return rows, pose_residual(rows, clean)


def _left(case, *named):
    """Share (RMS) of what the machine does that effects of the library leave at the given shapes."""
    rows, gap = _rows(case)
    parts = [signature(rows, EFFECTS[name](), torch.tensor(shape, dtype=torch.float64)) for name, shape in named]
    basis = torch.cat(parts, -1).flatten(0, 1).numpy()
    size = np.linalg.norm(basis, axis=0)
    basis, gap = basis[:, size > 0] / size[size > 0], gap.flatten().numpy()
    rest = gap - basis @ np.linalg.lstsq(basis, gap, rcond=1e-10)[0]
    return np.linalg.norm(rest) / np.linalg.norm(gap)


def _jump(case):
    """Times of the first row of another machine, and of the row before it."""
    rows, gap = _rows(case)
    first = int(torch.nonzero(gap.abs().amax(1) > 1e-8)[0])
    return float(rows.covariates["time"][first]), float(rows.covariates["time"][first - 1])


@pytest.mark.parametrize("seed", range(3))
def test_names_that_are_right_are_of_the_form_that_is_simulated(seed):
    case = make("temperature_dependent_stiffness", seed)
    # A hexapod deflects so far that its second order shows.
    assert _left(case, ("compliance", ()), ("thermal_compliance", ())) < 0.05 < _left(case, ("compliance", ()))
    assert _left(make("second_order_eccentricity", seed), ("transmission", [1.0] * 6)) < 5e-3
    assert _left(make("thermal_two_lags", seed), ("thermal", (600.0, 10800.0))) < 5e-3
    case = make("jump_of_one_joint", seed)
    assert _left(case, ("homing", (_jump(case)[0],))) < 5e-3
    case = make("jump_of_frame", seed)
    assert _left(case, ("frame_drift", (_jump(case)[1], 0.0))) < 5e-3


def test_a_payload_that_nobody_wrote_down_is_gravity_and_no_compliance():
    cases = [make("wrong_payload", seed) for seed in range(12)]
    unknown = [c for c in cases if c.truth.causes == ("gravity",)]
    assert {c.mechanism in ALL for c in unknown} == {True, False}
    for case in unknown:
        assert case.truth.accepted == (frozenset({"gravity"}),) and _left(case, ("gravity", ())) < 5e-3
        if any(h.startswith("load") for h in case.columns):
            assert _left(case, ("compliance", ())) > 0.5


def test_a_frame_moves_as_the_first_joint_of_an_arm_and_as_no_other_joint():
    seen = set()
    for seed in range(60):
        case = make("jump_of_one_joint", seed)
        both = frozenset({"frame_drift"}) in case.truth.accepted
        if both or (case.mechanism not in ALL and False not in seen):
            seen.add(both)
            assert (_left(case, ("frame_drift", (_jump(case)[1], 0.0))) < 5e-3) == both
    assert seen == {True, False}
