"""Methods side by side in one run: curves on one axis, effort to the same error, tables that fit a terminal."""

from __future__ import annotations

import io
from pathlib import Path

import jsonschema
import numpy as np
import pytest
from frozen import frozen
from rich.console import Console
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from test_run import short

from ccnn_torch.calibration.job import RUN
from ccnn_torch.calibration.page import long_table, result_tables, run_page
from ccnn_torch.calibration.statistics import reach_block
from ccnn_torch.report.arrays import load_tensors
from ccnn_torch.report.json_files import plain
from ccnn_torch.report.results.run import RunResults
from ccnn_torch.report.table import fitting_columns

COUNTING = """
import importlib.util
import torch

spec = importlib.util.spec_from_file_location("toy_for_comparison", {toy!r})
toy = importlib.util.module_from_spec(spec)
spec.loader.exec_module(toy)


class Line(toy.Descent):
    '''A line by descent, one pass of the rows a step.'''

    def step(self):
        found = super().step()
        return found | {{"evaluations": torch.full_like(found["error_train"], int(self._step))}}
"""


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of three methods, to be read only."""
    folder = tmp_path_factory.mktemp("comparison")
    learner = folder / "line.py"
    learner.write_text(COUNTING.format(toy=str(Path(__file__).parent / "toy.py")))
    methods = ["ccnn", f"{learner}:Line", "constant"]
    made = short(out=str(folder / "run"), repeats=3, methods=methods, save_models=False)
    return RUN.start(made, quiet=True).path


@pytest.fixture
def results(run: Path) -> RunResults:
    return RunResults.read(run / "results.json")


def test_every_methods_folder_has_the_same_tags_for_what_is_compared(run: Path) -> None:
    for method in ("ccnn", "Line"):
        events = EventAccumulator(str(run / "tensorboard" / method), size_guidance={"scalars": 0}).Reload()
        history = load_tensors(run / f"history-{method}.safetensors")[0]
        tags = events.Tags()["scalars"]
        for tag in ("heldout/mse_all", "error/train", "training/evaluations", "training/seconds"):
            assert tag in tags, (method, tag)
        curve = np.median(history["heldout_mse_all"], axis=1)
        held = events.Scalars("heldout/mse_all")
        assert [s.value for s in held] == pytest.approx(list(curve), rel=1e-6)
        seconds = history["seconds"].sum(axis=1)
        assert [s.wall_time - held[0].wall_time for s in held] == pytest.approx(list(seconds - seconds[0]), abs=1e-3)
    constant = EventAccumulator(str(run / "tensorboard" / "constant")).Reload().Tags()["scalars"]
    assert {"heldout/mse_all", "training/seconds"} <= set(constant)


def test_results_hold_the_schema_and_tell_the_effort(run: Path, results: RunResults) -> None:
    jsonschema.validate(plain(results), frozen("results"))
    reach = results["reach"]
    assert set(reach["methods"]) == {"ccnn", "Line", "constant"} and reach["set_by"] in ("ccnn", "Line")
    # The lowest point of the worse of the two, found again in its curve.
    curves = {
        name: np.median(load_tensors(run / f"history-{name}.safetensors")[0]["heldout_mse_all"], axis=1)
        for name in ("ccnn", "Line")
    }
    assert reach["level"] == max(curve.min() for curve in curves.values())
    for name, curve in curves.items():
        step = reach["methods"][name]["step"]
        assert curve[step - 1] <= reach["level"] and (curve[: step - 1] > reach["level"]).all()
        assert reach["methods"][name]["seconds"] > 0
    assert reach["methods"]["constant"] is None
    for name in ("ccnn", "Line", "constant"):
        block = results["methods"][name]
        assert block["pose"]["position"]["unit"] == "m" and block["pose"]["rotation"]["rms"]["median"] > 0
    best = results["best_method"]
    assert results["methods"][best]["pose"]["position"]["rms"] == results["pose"]["position"]["after"]["rms"]
    assert "Effort to reach the same held-out error" in (run / "results.md").read_text()


def history(errors: list[float], seconds: float, evaluations: float | None) -> dict[str, np.ndarray]:
    """Three repeats about a median curve."""
    steps = np.arange(1.0, len(errors) + 1)[:, None]
    curve = np.array(errors)[:, None] * np.array([[0.5, 1.0, 3.0]])
    found = {"heldout_mse_all": curve, "seconds": steps * seconds * np.ones(3)}
    return found if evaluations is None else found | {"evaluations": steps * evaluations * np.ones(3)}


def test_the_effort_of_made_up_curves() -> None:
    found = reach_block(
        {
            "quick": history([9, 3, 2, 4], 0.1, 10),
            "good": history([9, 8, 7, 2, 1], 1.0, 100),
            "worst": history([8, 5, 4, 2.5], 2.0, None),
            "constant": history([2.6], 0.01, 1),
        }
    )
    assert found is not None and (found["level"], found["set_by"]) == (2.5, "worst")
    assert plain(found["methods"]["quick"]) == {"step": 3, "seconds": pytest.approx(0.3), "evaluations": 30}
    assert plain(found["methods"]["good"]) == {"step": 4, "seconds": 4.0, "evaluations": 400}
    assert plain(found["methods"]["worst"]) == {"step": 4, "seconds": 8.0, "evaluations": None}
    assert found["methods"]["constant"] is None
    assert reach_block({"constant": history([1], 1, 1)}) is None
    assert reach_block({"ccnn": history([1], 1, 1)}) is None
    assert reach_block({"ccnn": {"seconds": np.ones((1, 1))}, "enn": {"seconds": np.ones((1, 1))}}) is None


def test_the_effort_of_made_up_curves_as_a_table(results: RunResults) -> None:
    made = reach_block(
        {"ccnn": history([9, 3], 0.25, 10), "Line": history([5, 4], 2.0, None), "constant": history([6], 1, 1)}
    )
    table = next(t for t in result_tables(results.model_copy(update={"reach": made})) if t.title.startswith("Effort"))
    assert tuple(table.rows) == (("ccnn", "2", "0.500", "20"), ("Line", "2", "4.00", "–"), ("constant", *["never"] * 3))
    assert "4.000 m² or less, the lowest that Line reaches" in table.note


@pytest.mark.parametrize("width", [80, 110])
def test_tables_fit_the_terminal_without_folding_numbers(results: RunResults, width: int) -> None:
    screen = io.StringIO()
    run_page(results).show(Console(file=screen, width=width, force_terminal=True, color_system=None))
    lines = screen.getvalue().splitlines()
    assert max(len(line) for line in lines) <= width
    mse = next(table for table in result_tables(results) if table.title.startswith("Mean squared"))
    text = " ".join(lines)
    kept = fitting_columns(mse, width)
    assert any(mse.columns[i].startswith("all joints") for i in kept)
    for row in mse.rows:
        for i in kept[1:]:
            for part in row[i].replace(" [", "\n[").split("\n"):
                assert part in text, part


def test_the_main_table_has_papers_figures_beside_and_one_constant(results: RunResults) -> None:
    mse = next(table for table in result_tables(results) if table.title.startswith("Mean squared"))
    names = [row[0] for row in mse.rows]
    assert names[:2] == ["ccnn", "ccnn, paper's Table II"] and names.count("constant") == 1
    assert mse.columns[-3:] == ("ratio to floor [1]", "coverage of 95 % [1]", "time [s]")
    rows = {(row[0], row[2], row[3]) for row in long_table(results)}
    assert {("Line", "sd", "q1"), ("Line", "coverage", ""), ("constant", "seconds", "")} <= rows
    keys = [row[:4] for row in long_table(results)]
    assert len(set(keys)) == len(keys)
