"""`methods=auto`: what is compared, what is chosen, and that a resumed run keeps to its decision."""

from __future__ import annotations

import sys
import time
from pathlib import Path
from typing import Any

import jsonschema
import pytest
import torch
from frozen import frozen
from safetensors.torch import load_file
from test_run import short
from test_uncertainty import linear_dataset
from toy import Descent

from ccnn_torch.calibration.calibrate import calibrate
from ccnn_torch.calibration.dataset import Dataset
from ccnn_torch.calibration.early_stop import Plan
from ccnn_torch.calibration.fitting import Comparison, compare
from ccnn_torch.calibration.page import run_page
from ccnn_torch.errors import MethodFailedError
from ccnn_torch.learners.constant import Constant
from ccnn_torch.report.json_files import plain
from ccnn_torch.run_folder.folder import RunFolder

# The package has a function of the module's name.
CALIBRATE: Any = sys.modules["ccnn_torch.calibration.calibrate"]
PLAN = Plan(True, None, 5, folds=5)


def noise_only(repeats: int = 3) -> Dataset:
    dataset = linear_dataset(repeats)
    generator = torch.Generator().manual_seed(9)
    noise = torch.randn(dataset.deviation.shape, generator=generator, dtype=torch.float64)
    object.__setattr__(dataset, "deviation", 1e-4 + 1e-5 * noise)
    return dataset


def compared(dataset: Dataset, budget: float = 100.0, folder: RunFolder | None = None, **more: Any) -> Comparison:
    makers: dict[str, Any] = {"constant": Constant, "descent": Descent, **more}
    return compare(makers, dataset, PLAN, budget, folder, lambda name: lambda *_: [])


def test_pure_noise_leaves_the_constant() -> None:
    for repeats in (1, 3):
        comparison = compared(noise_only(repeats))
        assert comparison.order == ["constant", "descent"]


def test_what_can_be_learned_is_learned() -> None:
    comparison = compared(linear_dataset(3))
    assert comparison.order == ["descent", "constant"]
    assert comparison.error("descent") < 0.5 * comparison.error("constant")
    assert comparison.error("constant") == pytest.approx(1, abs=0.1)
    assert comparison.why().startswith("descent is chosen: ")


def test_the_constant_is_taken_within_one_standard_error() -> None:
    comparison = compared(linear_dataset(3))
    slightly = comparison.compared["descent"]
    worse = slightly.errors + 0.5 * comparison.standard_error("descent")
    comparison.compared["constant"] = type(slightly)(**{**vars(comparison.compared["constant"]), "errors": worse})
    assert comparison.order == ["constant", "descent"]
    assert "within one standard error of the best (descent" in comparison.why()
    worse = slightly.errors + 1.5 * comparison.standard_error("descent")
    comparison.compared["constant"] = type(slightly)(**{**vars(comparison.compared["constant"]), "errors": worse})
    assert comparison.order == ["descent", "constant"]


class Slow(Descent):
    """A second for its thirty steps."""

    def step(self) -> dict[str, torch.Tensor]:
        time.sleep(1 / 30)
        return super().step()


def test_a_budget_ends_the_comparison_and_says_so() -> None:
    makers = {"constant": Constant, "slow": Slow, "late": Descent}
    comparison = compare(makers, linear_dataset(2), PLAN, 0.25, None, lambda name: lambda *_: [])
    assert comparison.skipped == {"late": "the budget of 0.25 s was spent before it began"}
    # Compared with what it has: its best step so far.
    slow = comparison.compared["slow"]
    assert not slow.ended and 1 <= int(slow.best_step.max()) <= slow.step < 10
    assert comparison.compared["constant"].ended
    block = comparison.block("slow")
    assert block["compared"]["slow"]["stopped"] and not block["compared"]["constant"]["stopped"]
    with pytest.raises(MethodFailedError, match="constant: the budget of 1e-09 s was spent before its first step"):
        compared(linear_dataset(2), 1e-9)


class GivesUp(Constant):
    def step(self) -> dict[str, torch.Tensor]:
        raise MethodFailedError("the curvature is not finite")


def test_what_fails_is_skipped_with_its_sentence() -> None:
    comparison = compared(linear_dataset(2), broken=GivesUp)
    assert comparison.skipped == {"broken": "the curvature is not finite"}


def test_a_decision_is_made_again_from_the_checkpoints(tmp_path: Path) -> None:
    folder = RunFolder(tmp_path)
    first, again = (compared(linear_dataset(2), 0.25, folder, slow=Slow) for _ in range(2))
    assert again.order == first.order and again.spent == first.spent and not again.compared["slow"].ended
    for name, choice in first.compared.items():
        for key, value in vars(choice).items():
            other = getattr(again.compared[name], key)
            assert torch.equal(other, value) if isinstance(value, torch.Tensor) else other == value, key


def config(out: Path, **keys: Any) -> Any:
    base = {
        "out": str(out),
        "methods": "auto",
        "auto": {"methods": ["constant", f"{Path(__file__).parent / 'toy.py'}:Descent"]},
        "training": {"early_stop": True, "checkpoint_every": 4},
        "covariates": ["t"],
        "repeats": 2,
        "save_models": False,
    }
    return short(**(base | keys))


class Killed(Exception):
    pass


@pytest.mark.parametrize("moment", ["comparing", "between"])
def test_a_run_killed_on_its_way_resumes_to_the_same_result(
    tmp_path: Path, moment: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    chosen = config(tmp_path)
    whole = RunFolder(tmp_path / "whole")
    results = calibrate(chosen, whole).results
    jsonschema.validate(plain(results), frozen("results"))
    auto = results["auto"]
    assert auto["chosen"] == "Descent" == results["best_method"] and list(results["methods"]) == ["Descent"]
    assert set(auto["compared"]) == {"constant", "Descent"} and auto["folds"] == 5 and auto["skipped"] == {}
    assert plain(results["rows"]) == {"train": 100, "validation": 0, "test": 25, "not_trained_on": 0}

    def kill(*_: Any, **__: Any) -> None:
        raise Killed

    with monkeypatch.context() as patched:
        if moment == "between":
            patched.setattr(CALIBRATE, "refit", kill)
        else:
            patched.setattr("ccnn_torch.calibration.early_stop.sd_scale", kill)
        with pytest.raises(Killed):
            calibrate(chosen, RunFolder(tmp_path / "killed"))
    killed = RunFolder(tmp_path / "killed")
    other = calibrate(chosen, killed).results
    text = run_page(other).markdown()
    assert "## Methods compared by cross-validation" in text and "Descent is chosen" in text
    for found in (results, other):
        for entry in (*found["auto"]["compared"].values(), *found["methods"].values()):
            entry.seconds = None
    assert results == other
    for path in (whole.path / "checkpoints").iterdir():
        again = load_file(killed.path / "checkpoints" / path.name)
        assert all(torch.equal(tensor, again[name]) for name, tensor in load_file(path).items())


def test_where_the_refit_fails_the_next_best_is_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    refit = CALIBRATE.refit

    def fails(name: str, *rest: Any) -> Any:
        if name == "Descent":
            raise MethodFailedError("the refit is not finite")
        return refit(name, *rest)

    monkeypatch.setattr(CALIBRATE, "refit", fails)
    results = calibrate(config(Path("unused"))).results
    assert results["best_method"] == results["auto"]["chosen"] == "constant"
    assert results["methods"]["Descent"]["failed"] == "the refit is not finite"
    jsonschema.validate(plain(results), frozen("results"))
    assert "the refit is not finite" in run_page(results).markdown()
