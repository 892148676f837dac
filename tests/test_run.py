"""`ccnn run` from a config to a run folder: its files, its figures, and going on after a kill."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np
import pytest
import torch
from frozen import frozen
from safetensors.torch import load_file
from test_cli import tripod_records

from ccnn_torch.calibration.calibrate import calibrate
from ccnn_torch.calibration.config import RunConfig
from ccnn_torch.calibration.job import RUN
from ccnn_torch.errors import InputError
from ccnn_torch.files.yaml_file import read_yaml
from ccnn_torch.identification.config import IdentifyConfig
from ccnn_torch.report.json_files import plain
from ccnn_torch.run_folder.folder import RunFolder
from ccnn_torch.study.suite import load_suite
from ccnn_torch.training.trainer import save_checkpoint

Cli = Callable[..., tuple[int, str, str]]
ROOT = Path(__file__).parent.parent
TRIPOD = ROOT / "experiments" / "tripod.yaml"
SHORT = {
    "hidden": [4],
    "rival_hidden": [],
    "population": 12,
    "generations": 10,
    "members": 2,
    "kept": 2,
    "waves": 2,
    "wave_searches": 1,
    "refinement_iterations": 8,
}
FILES = (
    "config.yaml",
    "results.json",
    "results.csv",
    "results.md",
    "card.json",
    "model.safetensors",
    "model.onnx",
    "report.html",
)


def short(**keys: Any) -> RunConfig:
    """Case one with a small CCNN, and whatever a test changes."""
    base: dict[str, Any] = {
        "case": "tripod",
        "split": {"test": 0.2, "validation": 0.0},
        "training": {"early_stop": False, "checkpoint_every": 4},
        "ccnn": SHORT,
    }
    return RunConfig.from_keys(**(base | keys))


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> RunFolder:
    """A finished run of two methods with everything that it writes, to be read only."""
    out = tmp_path_factory.mktemp("finished") / "run"
    return RUN.start(short(out=str(out), repeats=3, methods=["ccnn", "constant"]), quiet=True)


def test_the_folder_of_a_run_holds_what_others_rely_on(finished: RunFolder) -> None:
    folder = finished
    for name in FILES:
        assert (folder.path / name).is_file(), name
    assert (folder.path / "models" / "constant.card.json").is_file()
    assert list((folder.path / "checkpoints").glob("*.safetensors"))
    assert list((folder.path / "tensorboard").rglob("events.*"))
    drawn = {plot.stem for plot in (folder.path / "plots").glob("*.svg")}
    assert drawn == {"joint_errors", "pose_error", "machine"}
    results = json.loads(folder.results.read_text())
    jsonschema.validate(results, frozen("results"))
    jsonschema.validate(json.loads((folder.path / "card.json").read_text()), frozen("card"))
    assert results["rows"]["train"] == 100 and results["rows"]["test"] == 25
    assert results["repeats"] == 3
    for method in ("ccnn", "constant"):
        assert len(results["methods"][method]["test"]["q1"]["mse"]["values"]) == 3
    # A learner of that name and the trivial baseline beside it are the same thing, found in two ways.
    found, beside = results["methods"]["constant"]["test"], results["constant"]["test"]
    assert found["all"]["mse"]["values"] == pytest.approx(beside["all"]["mse"]["values"], rel=1e-9)
    # In the machine: what is left after the constant is about the noise, and a tenth of what was there.
    position = results["pose"]["position"]
    assert position["after"]["rms"]["median"] < 0.5 * position["before"]["rms"]["median"]


def test_repeat_k_has_the_noise_split_and_start_of_seed_plus_k() -> None:
    many = calibrate(short(repeats=3, seed=5))
    alone = calibrate(short(seed=7))
    assert torch.equal(many.prepared.noise[2], alone.prepared.noise[0])  # type: ignore[index]
    assert torch.equal(many.prepared.dataset.splits[2].test, alone.prepared.dataset.splits[0].test)
    together = many.results["methods"]["ccnn"]["test"]["all"]["mse"]["values"][2]
    assert alone.results["methods"]["ccnn"]["test"]["all"]["mse"]["values"] == pytest.approx([together], rel=1e-9)


def test_the_same_seed_gives_the_same_model_file_byte_by_byte(tmp_path: Path) -> None:
    files = []
    for name in ("a", "b"):
        calibrate(short(seed=3)).save(tmp_path / name, forms=["safetensors"])
        files.append((tmp_path / name / "model.safetensors").read_bytes())
    assert files[0] == files[1]


def test_early_stopping_holds_validation_rows_out_and_refits_on_all() -> None:
    config = short(split={"test": 0.2, "validation": 0.2}, training={"early_stop": True})
    calibration = calibrate(config)
    fitted = calibration.outcomes["ccnn"].fitted
    assert plain(calibration.results.rows) == {"train": 80, "validation": 20, "test": 25, "not_trained_on": 0}
    assert fitted.choice is not None
    assert torch.equal(fitted.training.best_step, fitted.choice.best_step)
    assert torch.equal(fitted.score, fitted.choice.best_validation)


def test_figures_are_those_of_the_held_out_rows() -> None:
    calibration = calibrate(short())
    prepared = calibration.prepared
    test = prepared.dataset.splits[0].test
    error = (calibration.outcomes["ccnn"].deviation - prepared.dataset.deviation)[0, test]
    mse = calibration.results["methods"]["ccnn"]["test"]["all"]["mse"]["median"]
    assert mse == pytest.approx(float(error.square().mean()), rel=1e-12)
    noise = prepared.noise
    assert noise is not None
    floor = calibration.results["floor"]["realised"]["all"]["mse"]["median"]
    assert floor == pytest.approx(float(noise[0, test].square().mean()), rel=1e-12)
    # What is exported predicts what was judged, to the last digits.
    exported = calibration.compensator().deviation(prepared.joints[0, test])
    assert float((exported - calibration.outcomes["ccnn"].deviation[0, test]).abs().max()) < 1e-15


def test_time_as_a_covariate_reaches_learner_and_card(tmp_path: Path) -> None:
    calibration = calibrate(short(covariates=["t"]))
    assert calibration.prepared.dataset.inputs.shape == (1, 125, 4)
    calibration.save(tmp_path, forms=["safetensors"])
    card = json.loads((tmp_path / "card.json").read_text())
    assert [c["name"] for c in card["covariates"]] == ["t"]


def test_the_limit_of_the_config_holds_for_every_joint() -> None:
    calibration = calibrate(short(compensation={"limit": 5e-5}))
    deviation = calibration.compensator().deviation(calibration.prepared.joints[0])
    # The constant part alone is 1e-4 m, so the limit is what is met.
    assert torch.equal(deviation.abs().amax(0), torch.full((3,), 5e-5, dtype=torch.float64))
    with pytest.raises(InputError, match=r"compensation\.limit has 2 numbers"):
        calibrate(short(compensation={"limit": [1e-4, 1e-4]}))


def test_a_taken_folder_is_not_written_into(tmp_path: Path) -> None:
    (tmp_path / "note.txt").write_text("mine")
    # There is no run to resume, so that no hint says how.
    with pytest.raises(InputError, match=r"holds files already; give another folder with out=…$"):
        # Before records are read, which may take a minute.
        replace(RUN, prepare=lambda config: pytest.fail("read")).start(short(out=str(tmp_path)), quiet=True)
    assert [p.name for p in tmp_path.iterdir()] == ["note.txt"]


def test_resuming_a_finished_run_changes_nothing(finished: RunFolder) -> None:
    before = {p: p.stat().st_mtime_ns for p in finished.path.rglob("*")}
    RUN.resume(finished.path, quiet=True)
    assert {p: p.stat().st_mtime_ns for p in finished.path.rglob("*")} == before


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("seed: 0", "seed: 3", r"config\.yaml: seed is 3, the checkpoint was made with seed 0"),
        ("test: 0.2", "test: 0.3", r"config\.yaml: split\.test is 0\.3, the checkpoint was made with split\.test 0\.2"),
        ("- constant", "- bp_lm", r'config\.yaml: methods is \["ccnn", "bp_lm"\], the checkpoint'),
    ],
)
def test_a_config_changed_between_kill_and_resume_is_refused(
    finished: RunFolder, tmp_path: Path, old: str, new: str, message: str
) -> None:
    run = tmp_path / "run"
    shutil.copytree(finished.path, run)
    (run / "results.json").unlink()
    before = (run / "config.yaml").read_text()
    assert old in before
    (run / "config.yaml").write_text(before.replace(old, new, 1))
    with pytest.raises(InputError, match=message):
        RUN.resume(run, quiet=True)


def test_records_changed_between_kill_and_resume_are_refused(tmp_path: Path) -> None:
    records = tripod_records(tmp_path / "rows.csv")
    run = tmp_path / "run"
    base = {"case": None, "records": str(records), "mechanism": "tripod", "methods": ["constant"]}
    RUN.start(
        short(**base, geometry="none", effects="none", out=str(run), save_models=False, save_report=False), quiet=True
    )
    (run / "results.json").unlink()
    lines = records.read_text().splitlines()
    # A row held out from training: no checkpoint would miss it.
    records.write_text("\n".join([*lines[:-1], lines[-1].replace("1", "2", 1)]) + "\n")
    with pytest.raises(InputError, match="is of other data than the config's; the records were changed"):
        RUN.resume(run, quiet=True)


ENVIRONMENT = os.environ | {"OMP_NUM_THREADS": "1"}


def command(*words: str) -> list[str]:
    return [sys.executable, "-m", "ccnn_torch", "run", *words]


def killed(out: Path, keys: list[str]) -> None:
    """Start a run and kill it shortly after its first checkpoint."""
    words = command(str(TRIPOD), *keys, f"out={out}")
    process = subprocess.Popen(words, env=ENVIRONMENT, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    deadline = time.monotonic() + 60
    while not list(out.glob("checkpoints/*.safetensors")) and time.monotonic() < deadline:
        time.sleep(0.005)
    time.sleep(0.05)
    process.kill()
    assert process.wait() == -signal.SIGKILL and not (out / "results.json").exists()


SHORT_SEARCH = ["ccnn.refinement_iterations=3", "ccnn.waves=2", "ccnn.wave_searches=1"]


STOPPED = ["ccnn.generations=16", "ccnn.population=20", "training.checkpoint_every=4", "seed=2", *SHORT_SEARCH]
STOPPED += ["training.early_stop=true", "split.validation=0.2", "save_models=false", "save_report=false"]


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run that nothing stops."""
    path = tmp_path_factory.mktemp("whole") / "out"
    RUN.start(RunConfig.from_file(TRIPOD, [*STOPPED, f"out={path}"]), quiet=True)
    return path


@pytest.mark.parametrize("how", ["interrupted", "killed"])
def test_an_interrupted_or_killed_run_resumes_to_identical_results(
    cli: Cli, tmp_path: Path, whole: Path, how: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    stopped = tmp_path / "stopped"
    if how == "killed":
        killed(stopped, STOPPED)
    else:

        def interrupt(path: Path, *about: Any) -> None:
            save_checkpoint(path, *about)
            if about[1]["step"] == 8:
                signal.raise_signal(signal.SIGINT)

        # Under nohup it is ignored.
        before = signal.signal(signal.SIGINT, signal.default_int_handler)
        with monkeypatch.context() as patch:
            patch.setattr("ccnn_torch.training.trainer.save_checkpoint", interrupt)
            code, _, told = cli("run", TRIPOD, *STOPPED, f"out={stopped}")
        signal.signal(signal.SIGINT, before)
        assert code == 130 and told.strip() == "interrupted; what was written so far is kept"
        assert not (stopped / "results.json").exists()
    assert cli("run", "--resume", stopped)[0] == 0
    for path in (whole / "checkpoints").iterdir():
        again = load_file(stopped / "checkpoints" / path.name)
        for name, tensor in load_file(path).items():
            assert torch.equal(tensor, again[name]), (path.name, name)
    one, other = (json.loads((run / "results.json").read_text()) for run in (whole, stopped))
    for results in (one, other):
        for method in results["methods"].values():
            del method["seconds"]
    assert one == other


def test_every_key_of_the_shipped_configs_is_known() -> None:
    for path in sorted((ROOT / "experiments").glob("*.yaml")):
        if "cases" in read_yaml(path):
            assert load_suite(path).name == path.stem
            continue
        # Of `ccnn identify`.
        if {"simulate", "constraint", "noise"} & set(read_yaml(path)):
            assert IdentifyConfig.from_file(path).name == path.stem
            continue
        overrides = ["records=x.csv", "mechanism=tripod"] if path.name == "records.yaml" else []
        assert RunConfig.from_file(path, overrides).name == path.stem


def test_shuffled_order_leaves_nothing_to_learn() -> None:
    raster = calibrate(short(methods=["constant"], repeats=20)).results
    shuffled = calibrate(short(methods=["constant"], repeats=20, order="shuffled")).results
    ratios = [r["constant"]["ratio_to_floor"]["median"] for r in (raster, shuffled)]
    assert np.allclose(ratios, 1.55, atol=0.15)


def test_what_is_stopped_while_rows_are_read_can_be_resumed(tmp_path: Path, cli: Cli) -> None:
    def stopped(config: RunConfig) -> Any:
        raise KeyboardInterrupt

    def wrong(config: RunConfig) -> Any:
        raise InputError("no such rows")

    config = RunConfig.from_file(TRIPOD, [f"out={tmp_path / 'run'}", "methods=constant", "save_report=false"])
    with pytest.raises(InputError):
        replace(RUN, prepare=wrong).start(config, quiet=True)
    assert not (tmp_path / "run").exists()
    with pytest.raises(KeyboardInterrupt):
        replace(RUN, prepare=stopped).start(config, quiet=True)
    assert cli("run", "--resume", tmp_path / "run", "--quiet")[0] == 0
    assert (tmp_path / "run" / "results.json").is_file()
    code, out, _ = cli("run", "--resume", tmp_path / "run")
    assert code == 0 and "is finished; nothing to do" in out
