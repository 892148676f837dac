"""docs/results.md and the README's table show what the data files hold, and rows can be taken from run folders."""

from __future__ import annotations

import importlib.util
import json
import shutil
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).parent.parent


@pytest.fixture
def maker() -> ModuleType:
    spec = importlib.util.spec_from_file_location("make_results", ROOT / "docs" / "make_results.py")
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_page_and_the_readme_show_the_data_files(maker: ModuleType) -> None:
    assert maker.PAGE.read_text() == maker.render_page()
    readme = maker.README.read_text()
    assert f"\n{maker.render_readme_table()}\n" in readme
    assert len(maker.render_readme_table().splitlines()) == 2 + 6
    assert len(readme.splitlines()) <= 150


def test_every_table_has_its_origin_and_is_shown(maker: ModuleType) -> None:
    tables = maker.read_tables()
    assert {path.stem for path in maker.DATA.glob("*.csv")} == set(tables)
    assert "{{" not in maker.render_page()
    for name, about in tables.items():
        assert about["command"] and about["repeats"] and about["date"], name
        assert f"**{about['title']}**" in maker.render_page()
        assert len({len(row) for row in maker.read_rows(name)}) == 1, name


def test_rows_are_taken_from_a_run_folder(
    maker: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(maker, "DATA", Path(shutil.copytree(maker.DATA, tmp_path / "results")))

    def error(value: float) -> dict[str, dict[str, float]]:
        return {"rms": {"median": value}}

    position = {"before": error(1e-3), "geometry": error(5e-4), "after": error(1e-4)}
    run = {
        "name": "UR5",
        "best_method": "gp",
        "geometry": {"chosen": "identify"},
        "pose": {"position": position, "rotation": position},
        "methods": {"gp": {"pose": {"position": error(1e-4), "rotation": error(2e-4)}}},
    }
    (tmp_path / "results.json").write_text(json.dumps(run))
    maker.refresh("trackers", [str(tmp_path)])
    rows = {row[0]: row for row in maker.read_rows("trackers")}
    assert rows["UR5"][2:5] == ["1.00", "0.500", "0.100"]
    assert rows["WAM"][2] == "4.68"
    maker.refresh("measured_robots", [str(tmp_path)])
    head, *body = maker.read_rows("measured_robots")
    added = dict(zip(head, body[-1], strict=True))
    assert added["mm / mrad"] == "UR5" and added["frames"] == "1.000 / 1.00" and added["ccnn"] == "–"
    assert added["geometry + gp"] == "0.100 / 0.20"
    with pytest.raises(SystemExit, match="suite is not taken from run folders; these tables are: trackers"):
        maker.refresh("suite", [str(tmp_path)])
