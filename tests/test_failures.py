"""A learner that fails, or does not converge, is told by name and never takes the run down."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import jsonschema
import pytest
from frozen import frozen
from test_run import short

from ccnn_torch.calibration.calibrate import calibrate
from ccnn_torch.calibration.job import RUN
from ccnn_torch.calibration.page import failures, run_page
from ccnn_torch.errors import MethodFailedError
from ccnn_torch.report.json_files import plain
from ccnn_torch.report.results.run import ModelFiles, RunResults

LEARNERS = '''
import torch
from ccnn_torch.errors import MethodFailedError
from ccnn_torch.learners.constant import Constant


class GivesUp(Constant):
    """Cannot go on."""

    def step(self):
        raise MethodFailedError("the curvature is not finite")


class Singular(Constant):
    """Meets a singular matrix."""

    def step(self):
        torch.linalg.inv(torch.zeros(2, 2))


class NotANumber(Constant):
    """Ends in numbers that are not finite, in its second repeat."""

    def predict(self, inputs):
        found = super().predict(inputs).clone()
        found[1:] = torch.nan
        return found


class Descending(Constant):
    """Says that two of its repeats have not converged."""

    @property
    def converged(self):
        return torch.arange(len(self._value)) > 1


class Bug(Constant):
    """Has a plain mistake."""

    def step(self):
        return self.nothing
'''


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "mine.py"
    path.write_text(LEARNERS)
    return path


def run(file: Path, *names: str, **keys: Any) -> RunResults:
    return calibrate(short(methods=[f"{file}:{name}" for name in names] + ["constant"], repeats=3, **keys)).results


@pytest.mark.parametrize(
    "keys",
    [{}, {"training": {"early_stop": True}, "split": {"test": 0.2, "validation": 0.2}}, {"training": {"folds": 3}}],
)
def test_what_fails_is_told_and_the_others_go_on(file: Path, keys: dict[str, Any]) -> None:
    results = run(file, "GivesUp", "Singular", "NotANumber", **keys)
    methods = results["methods"]
    assert plain(methods["GivesUp"]) == {"test": None, "failed": "the curvature is not finite"}
    assert methods["Singular"]["failed"].startswith("constant met a matrix that cannot be factorised in step 1 (inv: ")
    assert "not finite" in methods["NotANumber"]["failed"]
    assert methods["constant"]["test"]["all"]["mse"]["median"] > 0
    assert len(failures(results)) == 3
    jsonschema.validate(plain(results), frozen("results"))


def test_when_all_fail_the_run_says_why(file: Path) -> None:
    with pytest.raises(MethodFailedError, match="GivesUp: the curvature is not finite; Singular: "):
        calibrate(short(methods=[f"{file}:GivesUp", f"{file}:Singular"]))


def test_a_mistake_in_a_learner_is_not_hidden(file: Path) -> None:
    with pytest.raises(AttributeError, match="nothing"):
        run(file, "Bug")


def test_what_did_not_converge_is_marked_in_the_tables(file: Path) -> None:
    results = run(file, "Descending")
    assert results["methods"]["Descending"]["converged"]["values"] == [0.0, 0.0, 1.0]
    assert results["methods"]["constant"]["converged"] is None
    text = run_page(results).markdown()
    assert "| Descending (2 of 3 repeats not converged) |" in text and "| constant |" in text


STEEP = '''
import torch
from ccnn_torch.compensation import register_network
from ccnn_torch.learners.constant import Constant, ConstantNetwork


class Steep(Constant):
    """Has the constant's score and a network that no command can be solved for."""

    def network(self, repeat):
        return Waves(super().network(repeat))


class Waves(torch.nn.Module):
    def __init__(self, level):
        super().__init__()
        self.level = level

    def forward(self, inputs):
        return self.level(inputs) + 100 * torch.sin(1e3 * inputs[..., :1])

    def describe(self):
        return {**self.level.describe(), "kind": "waves"}

    @classmethod
    def from_description(cls, description):
        return cls(ConstantNetwork.from_description(description))


register_network("waves", Waves)
'''


def test_model_files_are_those_of_the_best_method_that_has_some(tmp_path: Path) -> None:
    path = tmp_path / "mine.py"
    path.write_text(STEEP)
    config = short(methods=[f"{path}:Steep", "constant"], out=str(tmp_path / "run"), save_models=True, save_report=True)
    folder = RUN.start(config, quiet=True).path
    results = json.loads((folder / "results.json").read_text())
    jsonschema.validate(results, frozen("results"))
    assert results["best_method"] == "Steep" and results["model"]["method"] == "constant"
    assert {"model.safetensors", "model.onnx", "card.json"} <= {p.name for p in folder.iterdir()}
    assert json.loads((folder / "card.json").read_text())["method"] == "constant"
    sentence = "The model files model.* and card.json are of constant, not of Steep: the learned deviation changes by"
    assert (folder / "results.md").read_text().split("\n\n")[2].startswith(sentence)
    page = (folder / "report.html").read_text()
    assert page.index(sentence) < page.index("<table>")


def test_no_method_with_a_model_file_is_said(file: Path) -> None:
    results = run(file, "Descending")
    results.model = ModelFiles(method=None, without={"gp": "too steep", "ccnn": "not finite"})
    assert failures(results) == ["No model file of gp: too steep.", "No model file of ccnn: not finite."]
