"""Tables, CSV, HTML, and TensorBoard, read back and compared with the numbers they came from."""

from __future__ import annotations

import csv
import io
import re
from html.parser import HTMLParser
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from PIL import Image
from report_runs import arm_run, tripod_run
from rich.console import Console
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from ccnn_torch.calibration.callbacks import EventFile, TensorBoardCallback, tags_of
from ccnn_torch.calibration.job import write_report
from ccnn_torch.calibration.page import long_table, pays, result_tables, run_page, verdict, worse_text
from ccnn_torch.calibration.statistics import spread
from ccnn_torch.errors import InputError
from ccnn_torch.report.json_files import write_json
from ccnn_torch.report.results.run import RmsMax, RunResults


def renamed(results: RunResults, name: str, **changes: object) -> RunResults:
    return results.model_copy(update={"name": name, **changes})


def test_the_report_folder(report_folder: Path) -> None:
    names = {p.name for p in report_folder.iterdir()}
    assert {"results.csv", "results.md", "report.html", "plots"} <= names
    plots = {p.name for p in (report_folder / "plots").iterdir()}
    stems = ("pose_error", "workspace", "joint_errors")
    assert plots == {f"{stem}.svg" for stem in stems}


def test_a_folder_with_numbers_only_still_gets_its_tables(tmp_path: Path) -> None:
    write_json(tmp_path / "results.json", arm_run()[0])
    page = write_report(tmp_path, RunResults.read(tmp_path / "results.json")).read_text()
    assert "<svg" not in page and "µrad" in page and "held-out rows, 4 not trained on" in page
    with pytest.raises(InputError, match=r"results\.json: there is no such file"):
        RunResults.read(tmp_path / "plots" / "results.json")


class Page(HTMLParser):
    """Collects tags, texts and addresses, and checks that tags are closed in order."""

    VOID = frozenset({"meta", "link", "br", "img", "hr", "input"})

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.count: dict[str, int] = {}
        self.addresses: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.count[tag] = self.count.get(tag, 0) + 1
        self.addresses += [v or "" for k, v in attrs if k in ("href", "src", "xlink:href", "action")]
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.handle_starttag(tag, attrs)
        self.handle_endtag(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag


def test_the_page_is_whole_and_fetches_nothing(report_folder: Path) -> None:
    text = (report_folder / "report.html").read_text(encoding="utf-8")
    page = Page()
    page.feed(text)
    page.close()
    assert page.open == []
    assert page.count["svg"] == 3 == page.count["figcaption"] and page.count["table"] == 5
    assert "script" not in page.count and "link" not in page.count
    outside = [a for a in page.addresses if not a.startswith(("#", "data:"))]
    assert set(outside) == {"results.json", "results.csv", "config.yaml"}
    # The only addresses left are the names of XML's namespaces, which nothing fetches.
    assert set(re.findall(r"https?://[^\s\"'<>]+", text)) <= {
        "http://www.w3.org/2000/svg",
        "http://www.w3.org/1999/xlink",
    }
    assert "@import" not in text and not re.search(r"url\((?!#)", text)


def test_text_from_outside_is_escaped(results: RunResults) -> None:
    text = run_page(renamed(results, "<script>alert(1)</script>", notes=["a & b"])).html(config="x: <b>")
    assert "<script>" not in text and "&lt;script&gt;" in text and "a &amp; b" in text and "x: &lt;b&gt;" in text


def test_a_network_that_makes_it_worse_is_said_with_the_remedy(results: RunResults) -> None:
    position = results.pose.position
    after = position.after.rms.median
    assert after is not None
    assert worse_text(results) == "" and "makes it worse" not in run_page(results).html()
    assert '<p class="verdict">' in run_page(results).html()
    best = results.best_method
    for alone, share, said in (("geometry", 0.995, ""), ("geometry", 0.8, "geometry"), ("effects", 0.7, "geometry + ")):
        alike = spread([share * after])
        setattr(position, alone, RmsMax(rms=alike, max=alike))
        told = worse_text(results)
        assert told.startswith(f"On held-out rows {best} makes it worse than {said}") if said else told == ""
    left, right = (float(x) for x in re.findall(r"\(([\d.]+) → ([\d.]+) ", told)[0])
    assert left / right == pytest.approx(0.7, rel=0.01) and "than geometry + effects alone (" in told
    assert told.endswith("methods=constant leaves the network out, methods=auto chooses by cross-validation.")
    assert told in run_page(results).markdown() and told in run_page(results).html()
    assert '<p class="verdict worse">' in run_page(results).html()
    screen = io.StringIO()
    run_page(results).show(Console(file=screen, width=500))
    assert told in screen.getvalue()
    # Nobody is sent to correct by a model that makes it worse, and where the effects do they are left out.
    folder = Path("runs/r")
    results.records = results.records or SimpleNamespace()  # type: ignore[assignment]
    assert not pays(results) and "correct targets by this model" not in run_page(results, (), folder).markdown()
    assert "leave this model unused" in run_page(results, (), folder).markdown()
    position.effects = RmsMax(rms=spread([0.9 * after]), max=alike)
    assert "makes it worse than geometry alone" in worse_text(results) and "effects=none" in worse_text(results)
    position.effects = RmsMax(rms=alike, max=alike)
    # What the model itself leaves of the rows is no more than what the parts leave: the file's commands are the cause.
    position.explained = RmsMax(rms=alike, max=alike)
    assert "the model is right, but its file holds commands back" in worse_text(results)
    position.explained = None
    results.best_method = "constant"
    assert "methods=constant" not in worse_text(results)
    position.geometry = position.effects = None
    position.before.rms.median = 0.9 * after
    assert "than no correction at all (" in worse_text(results)


def test_verdict(results: RunResults) -> None:
    position = results.pose.position
    before, after = position.before, position.after
    removed = 100 * (1 - after.rms.median / before.rms.median)
    text = verdict(results)
    assert text.startswith(f"On 25 held-out rows ccnn removes {removed:.1f} %")
    assert "times the noise floor" in text
    position.geometry = after
    assert " geometry + ccnn removes " in verdict(results)
    position.before, position.after = after, before
    assert "ccnn adds" in verdict(results)


def test_tables_hold_the_numbers_and_the_papers(results: RunResults) -> None:
    before, mse, mae, _, pose = result_tables(results)
    assert before.rows[0][0] == "q1 [µm]" and before.rows[0][-2:] == ("150.5", "168.5")
    assert mse.columns[1] == "q1 [1e-10 m²]"
    by_name = {row[0]: row for row in mse.rows}
    median = results["methods"]["ccnn"]["test"]["all"]["mse"]["median"]
    assert float(by_name["ccnn"][4].split(" [")[0]) == pytest.approx(median * 1e10, rel=1e-3)
    assert by_name["ccnn, paper's Table II"][4] == "1.091"
    assert by_name["enn"][1:] == ("–",) * 6
    assert {"constant", "noise floor, realised", "noise floor, expected"} <= set(by_name)
    assert mae.columns[-1] == "all joints [µm]"
    assert [row[0] for row in pose.rows] == ["position [µm]", "rotation [µrad]", "energy E (eq. 5) [µm]"]


def test_real_data_tables_have_no_floor_and_no_paper() -> None:
    tables = result_tables(arm_run()[0])
    assert [row[0] for row in tables[1].rows] == ["ccnn", "constant"]
    assert "ratio to floor [1]" not in tables[1].columns
    assert not any("paper" in column for table in tables for column in table.columns)


def test_markdown_has_whole_tables(results: RunResults) -> None:
    lines = run_page(renamed(results, "a|b")).markdown().splitlines()
    tables = "\n".join(lines).split("## ")[1:]
    for table in tables:
        widths = {line.count("|") for line in table.splitlines() if line.startswith("|")}
        assert len(widths) == 1
    assert any("enn failed: ENN ran out" in line for line in lines)


def test_the_screen_shows_title_and_failure(results: RunResults) -> None:
    screen = io.StringIO()
    run_page(results).show(Console(file=screen, width=120))
    text = screen.getvalue()
    assert (
        "Joint error before calibration" in text and "[1e-10 m²]" in text and "enn failed" in text and "goal_x" in text
    )


def test_csv_is_tidy_and_exact(report_folder: Path) -> None:
    results = tripod_run()[0]
    with (report_folder / "results.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert set(rows[0]) == {"method", "split", "quantity", "joint", "unit", "median", "low", "high"}
    found = {(r["method"], r["split"], r["quantity"], r["joint"]): r for r in rows}
    assert len(found) == len(rows)
    row = found["ccnn", "test", "mse", "all"]
    assert float(row["median"]) == results["methods"]["ccnn"]["test"]["all"]["mse"]["median"] and row["unit"] == "m^2"
    assert found["before", "train", "mean", "q1"]["unit"] == "m"
    pose, floor = results["pose"]["position"]["before"], results["floor"]["realised"]
    assert float(found["before", "test", "position_rms", ""]["median"]) == pose["rms"]["median"]
    assert float(found["floor_realised", "test", "mse", "q2"]["high"]) == floor["q2"]["mse"]["high"]
    assert not [r for r in long_table(arm_run()[0]) if r[0].startswith("floor")]


def test_tags() -> None:
    three = torch.tensor([1.0, 5.0, 3.0])
    assert tags_of("fitness_best", three) == {"fitness/best": 3.0, "repeat_0/fitness/best": 1.0}
    assert tags_of("heldout_mse_q1", torch.tensor([2.0])) == {"heldout/mse_q1": 2.0}
    density = tags_of("density", torch.tensor([[0.1, 0.2], [0.3, 0.4]], dtype=torch.float64))
    assert density["density/subpopulation_1"] == pytest.approx(0.2)
    assert density["repeat_0/density/subpopulation_2"] == 0.2
    assert tags_of("evaluations", 480) == {"training/evaluations": 480.0}
    assert tags_of("error_train", torch.tensor([float("nan"), 2.0])) == {"error/train": 2.0}


def test_a_resumed_run_shows_no_step_twice(tmp_path: Path) -> None:
    def steps(first: int, last: int, offset: float) -> None:
        callback = TensorBoardCallback(tmp_path)
        callback.on_start(SimpleNamespace(genome=lambda _: ([torch.eye(3, 2, dtype=torch.bool)], [])), None, 0)
        for step in range(first, last + 1):
            callback.on_step(step, {"fitness_best": torch.tensor([step + offset, step + offset])})
        callback.on_end()

    steps(1, 7, 0.0)
    # Killed at step 7 with the last checkpoint at step 5: the trainer goes on with step 6.
    steps(6, 9, 0.5)
    events = EventAccumulator(str(tmp_path), size_guidance={"scalars": 0, "images": 0}).Reload()
    scalars = events.Scalars("fitness/best")
    assert [s.step for s in scalars] == list(range(1, 10))
    assert [s.value for s in scalars] == [1, 2, 3, 4, 5, 6.5, 7.5, 8.5, 9.5]
    images = events.Images("masks/layer_1")
    assert [i.step for i in images] == [1]
    with Image.open(io.BytesIO(images[0].encoded_image_string)) as picture_of_mask:
        pixels = np.asarray(picture_of_mask.convert("L"))
    assert np.array_equal(pixels[8::16, 8::16] > 0, np.eye(3, 2, dtype=bool))


def test_event_files_of_one_second_sort_in_the_order_they_were_opened(tmp_path: Path) -> None:
    opened = []
    for _ in range(12):
        EventFile(tmp_path).close()
        opened += [path.name for path in tmp_path.iterdir() if path.name not in opened]
    assert sorted(opened) == opened


def test_errors_stand_against_the_time_too_and_outlive_a_resume(tmp_path: Path) -> None:
    error = torch.linspace(2, 1, 40, dtype=torch.float64).view(20, 2)
    clock = 0.05 * torch.arange(1, 21, dtype=torch.float64)

    def steps(first: int, last: int) -> None:
        callback = TensorBoardCallback(tmp_path)
        callback.on_start(None, None, first - 1)
        for i in range(first - 1, last):
            callback.on_step(i + 1, {"heldout_mse_all": error[i], "seconds": clock[i].expand(2)})
        callback.on_end()

    steps(1, 15)
    # Killed after step 15, the last checkpoint at step 12.
    steps(13, 20)
    events = EventAccumulator(str(tmp_path), size_guidance={"scalars": 0}).Reload()
    found = events.Scalars("heldout/mse_all")
    assert [s.step for s in found] == list(range(1, 21))
    assert [s.value for s in found] == pytest.approx(error.mean(1).tolist(), rel=1e-6)
    assert found[19].wall_time - found[12].wall_time == pytest.approx(0.35, abs=1e-3)
