"""`geometry: auto`: what cross-validation in the training rows prefers, and what it says of it."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
import torch
from fitted import fitted_geometry
from mechanisms.catalogue import make

from ccnn_torch import calibrate
from ccnn_torch.calibration.choice import Candidate, by_fold, simplest_of_best
from ccnn_torch.calibration.config import RunConfig
from ccnn_torch.calibration.prepare import Prepared, prepare
from ccnn_torch.mechanisms import fit_frames, load_mechanism
from ccnn_torch.numerics.rotations import matrix_to_rotation_vector, nearest_rotation
from ccnn_torch.records import write_table


def _prepared(folder: Path, geometry_error: float, wave: float, rows: int = 120, **keys: object) -> Prepared:
    """A tripod with errors of its parameters, a wave of its joints that no parameter has, and 5 µm of noise [m]."""
    tripod = load_mechanism("tripod")
    generator = torch.Generator().manual_seed(3)
    truth = tripod.nominal + geometry_error
    low = torch.tensor([-0.15, 0.45, -0.2], dtype=torch.float64)
    high = torch.tensor([0.15, 0.65, 0.2], dtype=torch.float64)
    wanted = low + (high - low) * torch.rand(rows, 3, generator=generator, dtype=torch.float64)
    joints = tripod.solve_inverse(wanted)
    pose = tripod.forward_kinematics(joints + wave * torch.sin(20 * joints.roll(1, -1)), truth, wanted)
    pose = pose + 5e-6 * torch.randn(pose.shape, generator=generator, dtype=torch.float64)
    names = [c.header for c in (*tripod.joints, *tripod.pose)]
    write_table(folder / "rows.csv", dict(zip(names, torch.cat([joints, pose], -1).mT.numpy(), strict=True)))
    return prepare(RunConfig.from_keys(records=str(folder / "rows.csv"), mechanism="tripod", **keys))


def test_wrong_parameters_alone_need_no_learner(tmp_path: Path) -> None:
    _prepared(tmp_path, 3e-4, 0.0, effects="none", geometry="none")
    calibrated = calibrate(records=str(tmp_path / "rows.csv"), mechanism="tripod", effects="none")
    found, results = calibrated.prepared, calibrated.results
    assert found.physics is not None and found.default_method == "constant"
    assert found.choice is not None and found.choice.why.startswith("Identified geometry: the simplest of the best")
    assert results["geometry"] == found.choice.block and list(results["methods"]) == ["constant"]
    assert results["pose"]["position"]["after"]["rms"]["median"] < 1e-5
    assert results["chosen_by"] == "folds"
    assert found.choice.why in results["notes"]


def test_what_geometry_leaves_is_learned(tmp_path: Path) -> None:
    found = _prepared(tmp_path, 3e-4, 1e-4, effects="none")
    assert found.physics is not None and found.default_method == "gp"
    assert "identified geometry + learner" in found.choice.why


def test_held_out_rows_do_not_choose(tmp_path: Path) -> None:
    """The figures of the choice are the same whatever the test rows hold."""
    keys = {"effects": ["joint_gain"]}
    first = _prepared(tmp_path, 3e-4, 1e-4, rows=40, **keys)
    lines = (tmp_path / "rows.csv").read_text().splitlines()
    for row in first.dataset.splits[0].test.tolist():
        cells = lines[row + 1].split(",")
        cells[3] = repr(float(cells[3]) + 1e-3)
        lines[row + 1] = ",".join(cells)
    (tmp_path / "rows.csv").write_text("\n".join(lines))
    again = prepare(RunConfig.from_keys(records=str(tmp_path / "rows.csv"), mechanism="tripod", **keys))
    assert again.choice == first.choice and again.choice.by == "folds"


def test_an_explicit_word_is_kept(tmp_path: Path) -> None:
    for word in ("none", "identify"):
        found = _prepared(tmp_path, 3e-4, 0.0, geometry=word, effects="none")
        assert (found.physics is not None) == (word == "identify")
        assert found.default_method == ("constant" if word == "identify" else "ccnn")
        assert found.choice.block["chosen"] == word
        assert found.choice.block["why"].startswith(f"geometry={word} was asked for.")
    assert calibrate(case="tripod", methods=["constant"]).results["geometry"]["chosen"] == "none"


@pytest.mark.parametrize("name", ["ur10_positions", "panda_positions"])
def test_positions_alone_turn_no_joint_that_they_do_not_show(name: str, tmp_path: Path) -> None:
    """With links of 1 mrad and a tool of 90 mm the identified orientation is no worse than the nominal one."""
    kind = name.partition("_")[0]
    arm = make(kind, tmp_path)
    seen = type(arm)(**{**arm.recipe["keys"], "unknown_frames": ["base", "tool"]})
    blind = seen.with_orientation("none")
    generator = torch.Generator().manual_seed(2)
    truth = seen.nominal.clone()
    truth[-6:-3] = torch.tensor([0.0, 0.0, 0.09], dtype=torch.float64)
    truth[6:-6] += 1e-3 * torch.randn(len(truth) - 12, generator=generator, dtype=torch.float64)
    joints = seen.sample_joints(150, generator)
    position, rotation = seen.forward_frame(joints, truth.expand(150, -1))
    position = position + 3e-5 * torch.randn(position.shape, generator=generator, dtype=torch.float64)
    frames = fit_frames(blind, joints[:100], position[:100])
    links = fitted_geometry(blind, joints[:100], position[:100], frames)

    def turned(values: torch.Tensor) -> float:
        """Of the held-out rows, once the tool's rotation, which no position shows, is taken out [rad]."""
        gap = rotation[100:].mT @ blind.forward_frame(joints[100:], values.expand(50, -1))[1]
        left = matrix_to_rotation_vector(gap @ nearest_rotation(gap.mean(0)).mT)
        return math.sqrt(float(left.square().sum(-1).mean()))

    assert turned(links) < 1.1 * turned(frames)


@pytest.mark.parametrize(
    ("left", "learner"),
    [((0.99, 0.97, 1.01, 0.98, 1.0), False), ((0.98, 0.97, 0.99, 0.98, 0.98), True), ((0.5, 0.4, 0.6, 0.5, 0.5), True)],
)
def test_a_larger_model_has_to_be_better_by_two_standard_errors(left: tuple[float, ...], learner: bool) -> None:
    """Gains of 1.4 and more standard errors over five folds, one of which has a row that errs 30 times as much."""
    simple, larger = Candidate(True, False, False), Candidate(True, False, True)
    before = torch.tensor([1.0, 1.0, 1.0, 1.0, 1e3], dtype=torch.float64)
    found = simplest_of_best({simple: before, larger: before * torch.tensor(left)}, "")
    assert found.identify and (found.method == "gp") is learner


def test_rows_at_the_edge_that_err_under_all_candidates_do_not_decide() -> None:
    """Of a real UR10 some rows of a hundred err by ten times the usual, and hid that a learner halves the others."""
    generator = torch.Generator().manual_seed(0)
    noise = torch.randn(100, 3, generator=generator, dtype=torch.float64).square().sum(-1)
    effects, learner = Candidate(True, True, False), Candidate(True, False, True)
    rows = {effects: (1e-4) ** 2 * noise, learner: (6e-5) ** 2 * noise}
    for k in range(5):
        rows[effects][k], rows[learner][k] = (k + 1) * 1e-6, (5 - k) * 1e-6
    held = torch.nn.functional.one_hot(torch.arange(100) % 5).mT.double()
    errors = by_fold({c: r.expand(5, -1) for c, r in rows.items()}, held)
    assert simplest_of_best(errors, "").effects is False
    plain = {c: (r * held).sum(-1) / held.sum(-1) for c, r in rows.items()}
    assert simplest_of_best(plain, "").effects is True


def test_the_least_safe_model_has_to_beat_all_that_are_simpler() -> None:
    """A learner on the nominal machine beat the effects, but not what is learned beside them, and was taken."""
    geometry, effects = Candidate(True, False, False), Candidate(True, True, False)
    both, nominal = Candidate(True, True, True), Candidate(False, False, True)
    errors = {
        geometry: torch.full((5,), 149.0),
        effects: torch.tensor([41.0, 42.0, 42.0, 41.0, 43.0]),
        both: torch.tensor([20.0, 42.0, 33.0, 45.0, 28.0]),
        nominal: torch.tensor([32.0, 33.0, 32.5, 32.0, 33.5]),
    }
    found = simplest_of_best(errors, "")
    assert found.identify and found.effects and found.method == "gp"
