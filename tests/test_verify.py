"""`ccnn verify`: a model on new rows, against what its held-out rows promised."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import jsonschema
import numpy as np
import pytest
import torch
from frozen import frozen

import ccnn_torch
from ccnn_torch import calibrate
from ccnn_torch.calibration.config import RunConfig
from ccnn_torch.compensation import load_compensation, new_key_pair, sign_model
from ccnn_torch.errors import InputError
from ccnn_torch.mechanisms import PoseError, load_mechanism
from ccnn_torch.numerics.rotations import rotation_vector_to_matrix
from ccnn_torch.records import write_table
from ccnn_torch.report.json_files import plain
from ccnn_torch.verification.job import pseudoerror_settings
from ccnn_torch.verification.promise import configurations, paired_gain, promise_block, promised, repeated

# Its figures are looked at.
DRAWN = True

Cli = Callable[..., tuple[int, str, str]]
NOTHING = {"geometry": "none", "effects": "none"}
DELTA = "delta"
NOISE = 2e-5
OFFSET = torch.tensor([2e-3, -1e-3, 1.5e-3], dtype=torch.float64)
# Of a run whose records have other headers, one with the blank of a German export.
COLUMNS = {"Achse 1 [rad]": "q1[rad]", "Achse 2 [rad]": "q2[rad]", "Achse 3 [rad]": "q3", "X": "x[m]"}


def delta_rows(
    path: Path, seed: int, rows: int = 80, noise: float = NOISE, joints: torch.Tensor | None = None,
    command: torch.Tensor | None = None, moved: bool = False,
) -> Path:  # fmt: skip
    """Rows of a delta robot whose joints are off by OFFSET; `command` goes to the machine where it is not `joints`."""
    machine = load_mechanism(DELTA)
    generator = torch.Generator().manual_seed(seed)
    joints = wanted(seed, rows) if joints is None else joints
    pose = machine.forward_kinematics((joints if command is None else command) + OFFSET)
    pose = pose + noise * torch.randn(pose.shape, generator=generator, dtype=torch.float64)
    if moved:
        turn = rotation_vector_to_matrix(torch.tensor([0.02, -0.01, 0.03], dtype=torch.float64))
        pose = pose @ turn.mT + torch.tensor([0.05, -0.02, 0.01], dtype=torch.float64)
    names = [c.header for c in (*machine.joints, *machine.pose)]
    write_table(path, dict(zip(names, torch.cat([joints, pose], -1).mT.numpy(), strict=True)))
    return path


def renamed(path: Path) -> Path:
    """The same rows under the headers of COLUMNS, where the pose has x alone renamed."""
    header, rows = path.read_text().split("\n", 1)
    for theirs, ours in COLUMNS.items():
        header = header.replace(ours if "[" in ours else f"{ours}[rad]", theirs if "[" in theirs else f"{theirs}[m]")
    out = path.with_stem(f"{path.stem}_renamed")
    out.write_text(f"{header}\n{rows}")
    return out


def wanted(seed: int, rows: int) -> torch.Tensor:
    machine = load_mechanism(DELTA)
    pose = machine.sample_workspace(rows, torch.Generator().manual_seed(100 + seed))
    return machine.solve_inverse(pose)


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("model")
    rows = renamed(delta_rows(folder / "rows.csv", seed=0))
    found = calibrate(records=str(rows), mechanism=DELTA, methods=["constant"], **NOTHING, columns=COLUMNS)
    found.save(folder, forms=())
    return folder / "model.safetensors"


def read(folder: Path) -> dict:
    found = json.loads((folder / "verify.json").read_text())
    jsonschema.validate(found, frozen("verify"))
    return found


def test_a_promise_is_kept_on_rows_of_the_same_machine(model: Path, tmp_path: Path, cli: Cli) -> None:
    code, out, err = cli("verify", model, delta_rows(tmp_path / "new.csv", seed=1, rows=60), "--out", tmp_path / "v")
    assert code == 0, err
    found = read(tmp_path / "v")
    position = found["position"]
    assert found["kept"] and not found["compensated"] and found["rows"] == 60 and found["rotation"] is None
    assert position["before"]["rms"] > 5 * position["after"]["rms"]
    # Three directions of noise, and nothing else, are left.
    assert position["after"]["rms"] == pytest.approx(3**0.5 * NOISE, rel=0.2)
    assert position["promised"]["low"] < position["promised"]["rms"] < position["promised"]["high"]
    assert found["joints"]["q1"]["before"] == pytest.approx(2e-3, rel=0.05)
    assert found["joints"]["q1"]["after"] < 2e-4
    page = (tmp_path / "v" / "verify.html").read_text()
    assert found["text"] in page and page.count("<svg") == 2 and "<script" not in page
    assert "The promise is kept" in out
    assert plain(ccnn_torch.verify(model, tmp_path / "new.csv").position) == position


def test_a_public_key_takes_signed_models_alone(model: Path, tmp_path: Path, cli: Cli) -> None:
    new = delta_rows(tmp_path / "new.csv", seed=1, rows=60)
    folder = shutil.copytree(model.parent, tmp_path / "model")
    private, public = new_key_pair(tmp_path / "ours")
    words = ("verify", folder / model.name, new, "--out", tmp_path / "v", "--public-key", public)
    code, out, err = cli(*words)
    assert (code, out) == (2, "") and "has no signature model.safetensors.sig beside it" in err
    assert not (tmp_path / "v").exists()
    with pytest.raises(InputError, match="has no signature"):
        ccnn_torch.verify(folder / model.name, new, public_key=public)
    sign_model(folder / model.name, private)
    assert cli(*words)[0] == 0
    assert ccnn_torch.verify(folder / model.name, new, public_key=public)["kept"]


def test_rows_that_it_was_made_from_are_no_test(model: Path, tmp_path: Path) -> None:
    found = ccnn_torch.verify(model, model.parent / "rows.csv", mechanism=DELTA)
    assert found["text"].startswith("These are the rows that the model was made from, so this is no test.")


def test_a_machine_that_has_changed_is_told_by_exit_code_1(model: Path, tmp_path: Path, cli: Cli) -> None:
    rows = delta_rows(tmp_path / "new.csv", seed=2, noise=4 * NOISE)
    code, out, _ = cli("verify", model, rows, "--out", tmp_path / "v")
    assert code == 1 and "not kept" in out
    found = read(tmp_path / "v")
    assert not found["kept"] and found["position"]["after"]["rms"] > found["position"]["promised"]["high"]


@pytest.mark.parametrize("form", ["network", "identified"])
def test_headers_that_the_run_mapped_are_mapped_alike(model: Path, tmp_path: Path, cli: Cli, form: str) -> None:
    """For a network and an identified machine, by verify and compensate; OUT has the headers of IN."""
    new = delta_rows(tmp_path / "new.csv", seed=9, rows=20)
    if form == "identified":
        rows = renamed(delta_rows(tmp_path / "rows.csv", seed=7))
        found = ccnn_torch.identify(
            mechanism=DELTA, records=str(rows), methods=["lm"], save_report=False, columns=COLUMNS
        )
        found.save(tmp_path)
        model = tmp_path / "identified.yaml"
    assert ccnn_torch.verify(model, renamed(new))["position"] == ccnn_torch.verify(model, new)["position"]
    for name, rows in (("plain.csv", new), ("mapped.csv", renamed(new))):
        assert cli("compensate", model, rows, tmp_path / name)[0] == 0
    plain, mapped = ((tmp_path / name).read_text().split("\n", 1) for name in ("plain.csv", "mapped.csv"))
    assert mapped[1] == plain[1] and mapped[0].startswith("Achse 1[rad],") and ",command_q1[rad]," in mapped[0]


def test_rows_measured_with_the_compensator_on(model: Path, tmp_path: Path) -> None:
    joints = wanted(3, 50)
    command = torch.from_numpy(ccnn_torch.load_model(model)(joints.numpy())["command"])
    rows = delta_rows(tmp_path / "on.csv", seed=3, joints=joints, command=command)
    found = ccnn_torch.verify(model, rows, compensated=True)
    assert found["kept"] and found["compensated"]
    assert found["position"]["before"]["rms"] > 5 * found["position"]["after"]["rms"]
    assert found["position"]["after"]["rms"] == pytest.approx(3**0.5 * NOISE, rel=0.2)
    # Were the compensator off, the same rows would keep nothing.
    off = delta_rows(tmp_path / "off.csv", seed=3, joints=joints)
    assert not ccnn_torch.verify(model, off, compensated=True)["kept"]


def test_a_tracker_that_was_moved(model: Path, tmp_path: Path) -> None:
    rows = delta_rows(tmp_path / "moved.csv", seed=4, moved=True)
    found = ccnn_torch.verify(model, rows)
    assert not found["kept"] and "seems to have moved" in " ".join(found["notes"])
    found = ccnn_torch.verify(model, rows, refit_frames=True)
    assert found["kept"] and found["frames"] == "fitted again" and "moved" not in " ".join(found["notes"])
    assert found["position"]["after"]["rms"] == pytest.approx(3**0.5 * NOISE, rel=0.2)


def test_a_row_where_the_way_back_is_damped_is_not_judged(
    model: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rows = delta_rows(tmp_path / "new.csv", seed=1)
    whole, found = ccnn_torch.verify(model, rows), ccnn_torch.verification.job._found

    def damped(*given: object) -> dict[str, np.ndarray]:
        told = {name: np.array(value) for name, value in found(*given).items()}
        told["ideal_status"][3], told["ideal"][3] = 3, told["ideal"][3] + 0.02
        return told

    monkeypatch.setattr(ccnn_torch.verification.job, "_found", damped)
    held = ccnn_torch.verify(model, rows)
    assert any(note.startswith("1 row next to a singular pose") for note in held["notes"])
    assert held["position"]["after"]["rms"] == pytest.approx(whole["position"]["after"]["rms"], rel=0.02)
    assert held["rows"] == whole["rows"] and not any("singular" in note for note in whole["notes"])


@pytest.mark.parametrize(("swapped", "said"), [(("x[m]", "y[m]"), "x and y"), (("q1[rad]", "q3[rad]"), "q1 and q3")])
def test_rows_with_swapped_columns_are_refused(
    model: Path, tmp_path: Path, cli: Cli, swapped: tuple[str, str], said: str
) -> None:
    rows = delta_rows(tmp_path / "new.csv", seed=5)
    header, rest = rows.read_text().split("\n", 1)
    first, second = swapped
    mixed = header.replace(first, "?").replace(second, first).replace("?", second)
    rows.write_text(f"{mixed}\n{rest}")
    code, _, err = cli("verify", model, rows, "--out", tmp_path / "v")
    assert code == 2 and "new.csv: the usual pose is not where delta has it" in err and said in err, err


def test_a_machine_in_a_trackers_frame(tmp_path: Path) -> None:
    """Its base is fitted to the training rows before anything is learned, and is in the model."""
    rows, new = (delta_rows(tmp_path / f"{seed}.csv", seed, moved=True) for seed in (0, 1))
    keys = {"mechanism": DELTA, "keys": {"rod": 0.55}}
    found = calibrate(records=str(rows), mechanism="framed", mechanism_keys=keys, methods=["constant"], **NOTHING)
    found.save(tmp_path, forms=())
    told = ccnn_torch.verify(tmp_path / "model.safetensors", new)
    # A constant is not all that the frame leaves of the offset, and the frame not all of it.
    assert told["kept"] and told["position"]["after"]["rms"] < 1e-4


def test_what_cannot_be_verified(model: Path, tmp_path: Path, cli: Cli) -> None:
    rows = delta_rows(tmp_path / "new.csv", seed=5, rows=20)
    code, _, err = cli("verify", model, rows, "--mechanism", "tripod", "--out", tmp_path / "v")
    assert code == 2 and "made for delta" in err and not (tmp_path / "v").exists()
    assert cli("verify", model, tmp_path / "none.csv", "--out", tmp_path / "v")[0] == 2
    with pytest.raises(InputError, match="too few to fit a frame"):
        ccnn_torch.verify(model, delta_rows(tmp_path / "few.csv", seed=6, rows=3), refit_frames=True)


def test_an_identified_machine(tmp_path: Path) -> None:
    rows = delta_rows(tmp_path / "rows.csv", seed=7)
    found = ccnn_torch.identify(mechanism=DELTA, records=str(rows), methods=["lm"], save_report=False)
    found.save(tmp_path)
    new = delta_rows(tmp_path / "new.csv", seed=8)
    told = ccnn_torch.verify(tmp_path / "identified.yaml", new)
    assert told["kept"] and told["position"]["promised"] is not None
    assert told["position"]["after"]["rms"] < 0.2 * told["position"]["before"]["rms"]
    # Without the figures beside it there is no promise: the error must have fallen.
    (tmp_path / "identified.json").unlink()
    told = ccnn_torch.verify(tmp_path / "identified.yaml", new)
    assert told["kept"] and told["position"]["promised"] is None and "promises no figure" in told["text"]
    # Nor a card: joint deviations are found as a run finds them.
    settings = pseudoerror_settings(load_compensation(tmp_path / "identified.yaml"), load_mechanism(DELTA))
    assert settings["rotation_weight"] == RunConfig.model_fields["rotation_weight"].default


def test_a_diagnosis_promises_what_its_rows_left_under_fits_to_others(tmp_path: Path, cli: Cli) -> None:
    """A machine that had been hit passed with exit code 0: its diagnosis.json promised no figure."""
    rows, out = delta_rows(tmp_path / "rows.csv", seed=7), tmp_path / "d"
    words = (rows, "--mechanism", DELTA, "--effects", "joint_offset", "--out", out)
    assert cli("diagnose", *words)[0] == 0
    promise = json.loads((out / "diagnosis.json").read_text())["promise"]
    assert promise["position"]["rms"] == pytest.approx(3**0.5 * NOISE, rel=0.2) and promise["rows"] == 80
    same, hit = (
        delta_rows(tmp_path / f"{seed}.csv", seed=seed, command=None if size is None else wanted(seed, 80) + size)
        for seed, size in ((8, None), (9, torch.tensor([0.0, 4e-4, 0.0], dtype=torch.float64)))
    )
    code, said, err = cli("verify", out / "diagnosis.json", same, "--out", tmp_path / "v")
    assert code == 0 and "The promise is kept" in said, err
    assert cli("verify", out / "diagnosis.json", hit, "--out", tmp_path / "v")[0] == 1
    said = ccnn_torch.since(out / "diagnosis.json", hit)
    assert [told.name for told in said.changed] == ["joint_offset q2"], said.text


def test_a_coordinate_that_the_new_rows_lack_is_named(tmp_path: Path) -> None:
    """A header of another spelling was left out, and the promise kept by y and z alone, without a word."""
    for name, seed, header in (("rows", 1, "X Ist"), ("new", 2, "X_Ist")):
        path = delta_rows(tmp_path / f"{name}.csv", seed=seed)
        path.write_text(path.read_text().replace("x[m]", f"{header}[m]"))
    keys = {"columns": {"X Ist[m]": "x[m]"}, "save_report": False}
    ccnn_torch.identify(mechanism=DELTA, records=str(tmp_path / "rows.csv"), **keys).save(tmp_path)
    (note,) = ccnn_torch.verify(tmp_path / "identified.yaml", tmp_path / "new.csv").notes
    assert note.startswith("x ('X Ist' in the model's records) is not among these rows, which are judged by y, z alone")
    assert "column 'X_Ist'" in note


def test_the_limit_is_passed_once_in_twenty() -> None:
    generator = torch.Generator().manual_seed(0)
    groups = torch.arange(30)

    def error(rows: int) -> PoseError:
        return PoseError(torch.randn(rows, 3, generator=generator, dtype=torch.float64).norm(dim=-1), None)

    passed, below = 0, 0
    for _ in range(400):
        block = promise_block(error(30), error(30), groups)
        assert block is not None
        limits, new = promised(block, "position", 20), error(20).position.square().mean().sqrt()
        assert limits is not None
        passed += float(new) > limits["high"]
        below += float(new) < limits["low"]
    assert 0.025 < passed / 400 < 0.085 and 0.025 < below / 400 < 0.085


def test_a_mistyped_row_is_no_part_of_the_promise() -> None:
    groups, generator = torch.arange(40), torch.Generator().manual_seed(0)
    before, after = (s * torch.rand(40, generator=generator, dtype=torch.float64) + s for s in (1e-3, 4e-5))
    plain = promise_block(PoseError(before[1:], None), PoseError(after[1:], None), groups[1:] - 1)
    # One cell is off by 27 mm; and one row the model alone has wrong, which new rows may meet again.
    after[1] = 1e-3
    wrong = promise_block(PoseError(before[1:], None), PoseError(after[1:], None), groups[1:] - 1)
    before[0] = after[0] = 0.027
    mistyped = promise_block(PoseError(before, None), PoseError(after, None), groups)
    assert plain is not None and wrong is not None and wrong == mistyped and mistyped["configurations"] == 39
    assert wrong["position"]["rms"] > 1.5 * plain["position"]["rms"]


def test_rows_at_one_configuration_count_once() -> None:
    joints = torch.from_numpy(np.repeat(np.random.default_rng(0).uniform(-1, 1, (5, 3)), 30, axis=0))
    groups = configurations(joints, load_mechanism(DELTA).joints)
    assert int(groups.max()) == 4
    generator = torch.Generator().manual_seed(0)
    of_place = torch.rand(5, generator=generator, dtype=torch.float64)[groups]
    block = promise_block(PoseError(of_place, None), PoseError(of_place, None), groups)
    assert block is not None and block["configurations"] == 5 and block["rows"] == 150
    assert not paired_gain(of_place, 0.999 * of_place[torch.randperm(150, generator=generator)], groups)
    assert paired_gain(of_place, 0.1 * of_place, groups)


def test_targets_that_were_reached_again_have_accuracy_and_repeatability() -> None:
    """Against the formulas of ISO 9283:1998, 7.2.1 and 7.2.2, target by target."""
    rng = np.random.default_rng(0)
    groups = np.repeat([0, 1, 2], [30, 20, 2])
    off = np.array([[3e-4, 0, 0], [0, 4e-4, 0], [0, 0, 9e-4]])
    gap = off[groups] + 2e-5 * rng.standard_normal((52, 3))
    place = rng.standard_normal((3, 3))[groups] + gap
    tensors = [torch.from_numpy(v) for v in (place, gap, gap - off[groups], groups)]
    found = repeated(*tensors)
    assert found is not None and (found.targets, found.cycles) == (2, 20)
    expected = []
    for k in (0, 1):
        mine = place[groups == k]
        length = np.sqrt(((mine - mine.mean(0)) ** 2).sum(1))
        expected.append(length.mean() + 3 * np.sqrt(((length - length.mean()) ** 2).sum() / (len(mine) - 1)))
    assert found.repeatability.max == pytest.approx(max(expected), rel=1e-12)
    assert found.accuracy.max == pytest.approx(4e-4, rel=0.03)
    assert found.accuracy.median == pytest.approx(3.5e-4, rel=0.03)
    assert found.accuracy_after.max < 1.5e-5
    assert repeated(*(t[50:] for t in tensors[:3]), torch.zeros(2, dtype=torch.int64)) is None


def test_verify_tells_the_repeatability_of_repeated_targets(tmp_path: Path, model: Path, cli: Cli) -> None:
    joints = wanted(5, 6).repeat(5, 1)
    records = delta_rows(tmp_path / "cycles.csv", 5, joints=joints)
    code, _, err = cli("verify", model, records, "--mechanism", DELTA, "--out", tmp_path / "v")
    assert code in (0, 1), err
    again = json.loads((tmp_path / "v" / "verify.json").read_text())["repeated"]
    assert (again["targets"], again["cycles"]) == (6, 5)
    # Chi with three degrees: 1.60 + 3 x 0.67 times the noise of a coordinate; fewer for means of five.
    assert 1.5 * NOISE < again["repeatability"]["median"] < 5 * NOISE
    assert again["accuracy_after"]["median"] < 0.1 * again["accuracy"]["median"]
    assert "Targets that were reached again" in (tmp_path / "v" / "verify.html").read_text()
