"""LeRobot data sets as logs of a motion; written here by the form's public definition (lerobot-dataset-v3.mdx)."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from logged_arm import BACKLASH, DELAY, JOINTS, LAG, run
from numpy.typing import NDArray

from ccnn_torch.diagnosis.config import DiagnoseConfig
from ccnn_torch.errors import InputError
from ccnn_torch.motion import load_logs
from ccnn_torch.motion.log import Log
from ccnn_torch.records import read_table

Cli = Callable[..., tuple[int, str, str]]
Array = NDArray[np.float64]
Episode = tuple[Array, Array, Array]
RATE = 30.0


@pytest.fixture(scope="module")
def episodes() -> list[Episode]:
    return [run(k, 4.0, RATE) for k in range(4)]


def write(root: Path, episodes: list[Episode], version: str = "v3.0", **features: Any) -> Path:
    tables = []
    for number, (time, command, position) in enumerate(episodes):
        rows = len(time)
        lists = {
            name: pa.array(values.astype("f4").tolist(), _list(values.shape[1], version))
            for name, values in (("action", command), ("observation.state", position))
        }
        numbers = {"frame_index": range(rows), "episode_index": [number] * rows, "task_index": [0] * rows}
        tables.append(pa.table({**lists, "timestamp": pa.array(time, pa.float32()), **numbers}))
    folder = root / "data" / "chunk-000"
    folder.mkdir(parents=True)
    if version.startswith("v2"):
        for number, table in enumerate(tables):
            pq.write_table(table, folder / f"episode_{number:06d}.parquet")
    else:
        # Several episodes in a file, and several files.
        pq.write_table(pa.concat_tables(tables[:3]), folder / "file-000.parquet")
        pq.write_table(pa.concat_tables([*tables[3:], tables[0].slice(0, 0)]), folder / "file-001.parquet")
    feature = {"dtype": "float32", "shape": [len(JOINTS)], "names": [f"{name}.pos" for name in JOINTS]}
    info: dict[str, Any] = {"codebase_version": version, "robot_type": "so101_follower", "fps": RATE}
    info["features"] = {"action": feature, "observation.state": feature, **features}
    (root / "meta").mkdir()
    (root / "meta" / "info.json").write_text(json.dumps(info))
    return root


def _list(width: int, version: str) -> pa.DataType:
    """Of a fixed length in the older files, of any in the newer ones."""
    return pa.list_(pa.float32(), width) if version.startswith("v2") else pa.list_(pa.float32())


def refused(path: Path, *parts: str, **keys: Any) -> None:
    with pytest.raises(InputError) as caught:
        load_logs([path], keys=keys)
    assert all(part in str(caught.value) for part in parts) and "\n" not in str(caught.value), str(caught.value)


def same(first: list[Log], second: list[Log]) -> None:
    for one, two in zip(first, second, strict=True):
        for name in ("time", "command", "position"):
            np.testing.assert_array_equal(getattr(one, name), getattr(two, name))


def test_both_versions_are_the_same_logs(tmp_path: Path, episodes: list[Episode]) -> None:
    logs = load_logs([write(tmp_path / "v3", episodes)], keys={"units": "deg"})
    same(logs, load_logs([write(tmp_path / "v2", episodes, "v2.1")], keys={"units": "deg"}))
    assert [log.name for log in logs] == [f"{tmp_path / 'v3'} run {k}" for k in range(4)]
    assert logs[0].units == ("rad", "rad") and "q1 is shoulder_pan, q2 is elbow_flex" in logs[0].notes[0]
    assert any("gripper left out" in note for note in logs[0].notes)
    for log, (time, command, position) in zip(logs, episodes, strict=True):
        np.testing.assert_allclose(log.time, time, atol=1e-6)
        np.testing.assert_allclose(log.command, np.radians(command[:, :2]), atol=1e-6)
        np.testing.assert_allclose(log.position, np.radians(position[:, :2]), atol=1e-6)


def test_which_episodes_and_joints(tmp_path: Path, episodes: list[Episode]) -> None:
    root = write(tmp_path / "set", episodes)
    logs = load_logs([root], keys={"units": "deg", "episodes": 2, "joints": ["gripper", "elbow_flex"]})
    assert [log.name.rpartition(" ")[2] for log in logs] == ["0", "3"]
    assert any("2 of 4 episodes were read" in note for note in logs[0].notes)
    np.testing.assert_allclose(logs[1].command, np.radians(episodes[3][1][:, [2, 1]]), atol=1e-6)
    same(logs, load_logs([root], keys={"units": "deg", "episodes": [3, 0], "joints": ["gripper", "elbow_flex"]}))
    refused(root, "no episode 7; it has 0 to 3", units="deg", episodes=[7])
    refused(root, "episodes: write how many", units="deg", episodes="all")
    refused(root, "has no joint 'elbow'; did you mean 'elbow_flex'?", units="deg", joints=["elbow"])
    refused(root, "'episode' says nothing of", "did you mean 'episodes'?", episode=3)


def test_names_are_optional(tmp_path: Path, episodes: list[Episode]) -> None:
    shape = {"shape": [len(JOINTS)], "names": None}
    nested = {"shape": [len(JOINTS)], "names": [["d", "e", "f"]]}
    grouped = {"shape": [len(JOINTS)], "names": {"motors": ["a", "b", "c"]}}
    for own, names in (
        (shape, "q1 is joint_1, q2 is joint_2"),
        (grouped, "q1 is a, q2 is b, q3 is c"),
        (nested, "q1 is d, q2 is e"),
    ):
        # Of both kinds the order tells which belong together.
        root = write(tmp_path / names[6:9].strip(), episodes, **{"observation.state": own})
        (log, *_) = load_logs([root], keys={"units": "deg"})
        assert names in log.notes[0] and log.command.shape[1] == len(JOINTS)


def test_efforts_and_velocities_are_read_where_their_unit_is_said(tmp_path: Path, episodes: list[Episode]) -> None:
    feature = {"dtype": "float32", "shape": [len(JOINTS)], "names": None}
    root = write(tmp_path / "set", episodes, **{"observation.effort": feature})
    for file in root.glob("data/*/*"):
        table = pq.read_table(file)
        pq.write_table(table.append_column("observation.effort", table["action"]), file)
    (log, *_) = load_logs([root], keys={"units": "deg"})
    assert any("observation.effort left out; motion_keys={effort: UNIT}" in note for note in log.notes)
    (log, *_) = load_logs([root], keys={"units": "deg", "effort": "mA"})
    np.testing.assert_allclose(log.beside["current2"], 1e-3 * episodes[0][1][:, 1], atol=1e-7)
    refused(root, "effort: write one of N*m, A, mA, 1, not Nm", units="deg", effort="Nm")
    refused(root, "velocity: ", "has no observation.velocity", units="deg", velocity="deg/s")


def test_units_are_told_by_the_values_or_by_the_user(tmp_path: Path, episodes: list[Episode]) -> None:
    root = write(tmp_path / "doubt", episodes)
    refused(root, "may be degrees or shares of a range", "motion_keys={units: deg}", "calibration: FILE.json")
    refused(root, "normalised values", "calibration: FILE.json", units="normalised")
    # Beyond 100 nothing is a share of a range, and within a turn nothing is in degrees.
    far = [(t, 2 * u, 2 * q) for t, u, q in episodes]
    assert any("in deg" in note for note in load_logs([write(tmp_path / "far", far)])[0].notes)
    near = [(t, np.radians(u), np.radians(q)) for t, u, q in episodes]
    np.testing.assert_allclose(
        load_logs([write(tmp_path / "near", near)])[0].command, np.radians(episodes[0][1][:, :2]), atol=1e-6
    )
    own = load_logs([root], keys={"units": {"elbow_flex": "mrad", "shoulder_pan": "deg"}})
    np.testing.assert_allclose(own[0].command, episodes[0][1][:, :2] * [np.pi / 180, 1e-3], atol=1e-6)


def test_normalised_values_become_angles_by_the_calibration(tmp_path: Path, episodes: list[Episode]) -> None:
    root = write(tmp_path / "set", episodes)
    motors = {name: {"id": k, "drive_mode": k, "range_min": 1000, "range_max": 3000} for k, name in enumerate(JOINTS)}
    file = tmp_path / "arm.json"
    file.write_text(json.dumps(motors))
    wide = np.radians(2000 * 360 / 4095)
    logs = load_logs([root], keys={"calibration": str(file), "joints": list(JOINTS)})
    factors = wide * np.array([1 / 200, -1 / 200, -1 / 100])
    np.testing.assert_allclose(logs[0].position, episodes[0][2] * factors, atol=1e-6)
    file.write_text(json.dumps({"shoulder_pan": motors["shoulder_pan"]}))
    refused(root, "arm.json: has no range_min and range_max of 'elbow_flex'", calibration=str(file))


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda root: (root / "meta" / "info.json").unlink(), "meta/info.json: there is no such file"),
        (lambda root: _info(root, codebase_version="v1.6"), "codebase_version is v1.6, and v2.0 to v3 are read"),
        (lambda root: _info(root, features={}), "has no feature 'observation.state'"),
        (lambda root: _info(root, features=7), "has no feature 'observation.state'"),
        (lambda root: [f.unlink() for f in root.glob("data/*/*")], "has no data/*/*.parquet"),
        (lambda root: [f.write_bytes(b"PAR1") for f in root.glob("data/*/*")], "file-000.parquet: is no data file"),
        (lambda root: _change(root, lambda t: t.drop_columns(["action"])), "file-000.parquet: is no data file"),
        (lambda root: _change(root, lambda t: t.slice(0, 0)), "has no frame"),
        (lambda root: _change(root, lambda t: _replaced(t, "action", [[1e30] * 3])), "larger than anything"),
        (lambda root: _change(root, lambda t: _replaced(t, "action", [[float("nan")] * 3])), "column 'command1' has"),
        (lambda root: _change(root, lambda t: _replaced(t, "action", [[1.0] * 2])), "has not 3 numbers in each row"),
    ],
)
def test_what_is_refused(
    tmp_path: Path, cli: Cli, episodes: list[Episode], change: Callable[[Path], Any], said: str
) -> None:
    root = write(tmp_path / "set", episodes)
    change(root)
    code, _, error = cli(
        "diagnose", "--motion", root, "--mechanism", "servo", "--out", tmp_path / "out", "motion_keys={units: deg}"
    )
    assert code == 2 and said in error and error.count("\n") == 1, error


def _info(root: Path, **changes: Any) -> None:
    file = root / "meta" / "info.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | changes))


def _change(root: Path, change: Callable[[pa.Table], pa.Table]) -> None:
    for file in root.glob("data/*/*"):
        pq.write_table(change(pq.read_table(file)), file)


def _replaced(table: pa.Table, name: str, first: list[list[float]]) -> pa.Table:
    rows = [*first, *table[name].to_pylist()[1:]] if len(table) else []
    return table.set_column(table.column_names.index(name), name, pa.array(rows, pa.list_(pa.float32())))


def test_a_stranger_comes_to_the_right_verdict(tmp_path: Path, cli: Cli, episodes: list[Episode]) -> None:
    (tmp_path / "here").mkdir()
    write(tmp_path / "here" / "set", [run(k, 2.6, RATE) for k in range(2)])
    config = tmp_path / "here" / "arm.yaml"
    code, out, error = cli("new", tmp_path / "here" / "set", "--units", "deg", "--out", config)
    assert code == 0, error
    assert f"ccnn diagnose --config {config} --out runs/arm" in out
    assert 'motion: "set"' in config.read_text() and "# q1 is shoulder_pan, q2 is elbow_flex." in config.read_text()
    effects = "delay,servo_gain,backlash"
    code, _, error = cli("diagnose", "--config", config, "--effects", effects, "--out", tmp_path / "out", "--quiet")
    assert code == 0, error
    found: Mapping[str, Any] = json.loads((tmp_path / "out" / "diagnosis.json").read_text())
    assert [joint["word"] for joint in found["joints"]] == ["shoulder_pan", "elbow_flex"]
    assert [sorted(joint["effects"]) for joint in found["joints"]] == [
        ["servo_gain"],
        ["backlash", "delay", "servo_gain"],
    ]
    numbers = {name: p["value"] for e in found["effects"] for name, p in e["parameters"].items()}
    assert numbers["q2 delay"] == pytest.approx(DELAY, abs=0.01)
    assert numbers["q2 backlash"] == pytest.approx(np.radians(BACKLASH), rel=0.1)
    assert [numbers[f"q{k} lag"] for k in (1, 2)] == pytest.approx([LAG, LAG], abs=0.01)


def test_without_pyarrow(tmp_path: Path, episodes: list[Episode], monkeypatch: pytest.MonkeyPatch) -> None:
    import sys

    root = write(tmp_path / "set", episodes)
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    refused(root, "needs pyarrow", "pip install 'ccnn-torch[lerobot]'")


def test_a_folder_that_is_nothing_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="is a folder and no file, nor a LeRobot data set, nor a recording of ROS 2"):
        read_table(tmp_path)
    (tmp_path / "log.csv").write_text("time[s]\n1\n")
    with pytest.raises(InputError, match=r"'episodes' says nothing of .*log.csv, a table; leave it out"):
        read_table(tmp_path / "log.csv", keys={"episodes": 3})


def test_the_shipped_data_set_is_read() -> None:
    logs = load_logs([Path(__file__).parent.parent / "experiments" / "data" / "lerobot_arm"], keys={"units": "deg"})
    assert [len(log.time) for log in logs] == [300] * 4


def test_paths_of_logs_in_a_config_start_from_its_folder(tmp_path: Path) -> None:
    config = tmp_path / "arm.yaml"
    config.write_text("motion: [set, more.csv]\nmotion_keys: {calibration: arm.json, episodes: 3}\nmechanism: servo\n")
    given = DiagnoseConfig.from_file(config)
    assert given.motion == [str(tmp_path / "set"), str(tmp_path / "more.csv")]
    assert given.motion_keys == {"calibration": str(tmp_path / "arm.json"), "episodes": 3}
