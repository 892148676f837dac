"""The records that ship with the experiments, and the script that chose them."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import numpy as np
import pytest
from test_records import Arm

from ccnn_torch.coordinates import Coordinate
from ccnn_torch.records import check_rows, load_records, read_table, write_table
from ccnn_torch.records.splits import split_rows

DATA = Path(__file__).parent.parent / "experiments" / "data"
UR10 = Arm("ur10", tuple(Coordinate(f"q{k}", "rad") for k in range(1, 7)), reach=1.684)
GOAL = ("goal_x", "goal_y", "goal_z", "goal_rx", "goal_ry", "goal_rz")


def test_shipped_records_load() -> None:
    records = load_records(DATA / "ur10_b_500.csv", UR10)
    check_rows(records, UR10)
    assert records.joints.shape == (500, 6) and records.pose.shape == (500, 6)
    assert records.orientation == "rotation_vector"
    assert [c.name for c in records.covariate_coordinates] == ["temperature"]
    assert (np.diff(records.columns["row"]) > 0).all()
    assert 290 < float(records.covariates.min()) < float(records.covariates.max()) < 300
    assert (DATA / "LICENSE.md").read_text().startswith("MIT License")


def test_readme_tells_the_truth_about_the_group_split() -> None:
    records = load_records(DATA / "ur10_b_500.csv", UR10)
    goals = np.unique(np.stack([records.columns[name] for name in GOAL], 1).round(4), axis=0, return_inverse=True)[1]
    goals = goals.reshape(-1)
    sizes = np.bincount(goals)
    assert set(sizes) <= {1, 2, 3, 4} and (sizes > 1).mean() > 0.98
    cells = split_rows(records.positions, "group", columns=records.columns)
    held, others = set(goals[cells.test]), set(goals[cells.train]) | set(goals[cells.validation])
    assert f"{len(held & others)} of the {len(held)} held-out goals" in " ".join(
        (DATA / "README.md").read_text().split()
    )
    whole = split_rows(records.positions, "group", "goal_*", records.columns)
    assert not set(goals[whole.test]) & (set(goals[whole.train]) | set(goals[whole.validation]))


def test_script_takes_whole_goals_in_order(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    spec = importlib.util.spec_from_file_location("choose_rows", DATA / "choose_rows.py")
    assert spec is not None and spec.loader is not None
    script = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(script)
    rng = np.random.default_rng(0)
    goal = rng.permutation(np.repeat(np.arange(20), 3))
    columns = {"row[1]": np.arange(60), **{f"{name}[{'rad' if 'r' in name else 'm'}]": goal * 1.0 for name in GOAL}}
    write_table(tmp_path / "all.csv", columns)
    script.choose_rows(tmp_path / "all.csv", tmp_path / "some.csv", rows=20)
    script.choose_rows(tmp_path / "all.csv", tmp_path / "again.csv", rows=20)
    assert (tmp_path / "some.csv").read_bytes() == (tmp_path / "again.csv").read_bytes()
    chosen = read_table(tmp_path / "some.csv").raw("row").astype(int)
    assert len(chosen) == 21 and (np.diff(chosen) > 0).all()
    assert set(np.flatnonzero(np.isin(goal, goal[chosen]))) == set(chosen)
    assert set((tmp_path / "some.csv").read_text().splitlines()) <= set((tmp_path / "all.csv").read_text().splitlines())


def test_directions_are_those_of_the_way_to_each_pose(tmp_path: Path) -> None:
    spec = importlib.util.spec_from_file_location("add_directions", DATA / "add_directions.py")
    assert spec is not None and spec.loader is not None
    script = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(script)
    # Rows of two sets, mixed; a joint that stands still keeps its direction.
    columns = {
        "set[1]": [1, 0, 0, 0, 1],
        "step[1]": [0, 2, 0, 1, 1],
        "q1[deg]": [9, 3, 5, 3, 7],
        "q2[deg]": [1, 2, 3, 4, 2],
    }
    write_table(tmp_path / "all.csv", {**columns, **{f"{axis}[mm]": [0, 1, 2, 3, 4] for axis in "xyz"}})
    script.add_directions(tmp_path / "all.csv", tmp_path / "some.csv")
    made = read_table(tmp_path / "some.csv")
    assert made.raw("x").tolist() == [2, 3, 1, 0, 4]
    assert made.raw("direction1").tolist() == [1, -1, -1, 1, -1]
    assert made.raw("direction2").tolist() == [1, 1, -1, 1, 1]
