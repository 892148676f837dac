"""Recordings of ROS 2 as logs of a motion; written here by rosbags, an implementation of both storages."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from scipy.interpolate import CubicHermiteSpline

from ccnn_torch.errors import InputError
from ccnn_torch.motion import load_logs
from ccnn_torch.records import read_table

Cli = Callable[..., tuple[int, str, str]]
Array = NDArray[np.float64]
NAMES = ["shoulder", "elbow"]
STATES, COMMANDS, CONTROLLER = "/joint_states", "/arm/joint_trajectory", "/arm/controller_state"
# When the recording began [ns].
BEGIN = 1_700_000_000_000_000_000
STORE = get_typestore(Stores.ROS2_JAZZY)
# A part of the whole message of github.com/ros-controls/control_msgs, where more follows what is read.
STORE.register(
    get_types_from_msg(
        "std_msgs/Header header\nstring[] joint_names\n"
        + "".join(f"trajectory_msgs/JointTrajectoryPoint {n}\n" for n in ("reference", "feedback", "error", "output"))
        + "string[] multi_dof_joint_names",
        "control_msgs/msg/JointTrajectoryControllerState",
    )
)
Said = tuple[float, str, Any]


def made(kind: str, **fields: Any) -> Any:
    return STORE.types[kind](**fields)


def header(time: float | None) -> Any:
    ns = 0 if time is None else BEGIN + round(time * 1e9)
    stamp = made("builtin_interfaces/msg/Time", sec=ns // 10**9, nanosec=ns % 10**9)
    return made("std_msgs/msg/Header", stamp=stamp, frame_id="base")


def point(at: Array, speed: Array | None = None, after: float = 0.0) -> Any:
    ns, none = round(after * 1e9), np.zeros(0)
    duration = made("builtin_interfaces/msg/Duration", sec=ns // 10**9, nanosec=ns % 10**9)
    speeds = none if speed is None else np.ascontiguousarray(speed)
    fields = {"velocities": speeds, "accelerations": none, "effort": none, "time_from_start": duration}
    return made("trajectory_msgs/msg/JointTrajectoryPoint", positions=np.ascontiguousarray(at), **fields)


def state(time: float, at: Array, names: Sequence[str] = NAMES) -> Said:
    message = made("sensor_msgs/msg/JointState", header=header(time), name=[*names], position=np.ascontiguousarray(at),
                   velocity=np.zeros(0), effort=np.zeros(0))  # fmt: skip
    return time + 1e-4, STATES, message


def trajectory(time: float, points: list[Any], stamped: bool = True, topic: str = COMMANDS) -> Said:
    message = made("trajectory_msgs/msg/JointTrajectory", header=header(time if stamped else None),
                   joint_names=NAMES, points=points)  # fmt: skip
    # With a stamp it is known some time before it begins.
    return time - 0.02 if stamped else time + 1e-4, topic, message


def write(path: Path, said: list[Said], storage: StoragePlugin = StoragePlugin.MCAP) -> Path:
    with Writer(path, version=9, storage_plugin=storage) as writer:
        connections: dict[str, Any] = {}
        for time, topic, message in sorted(said, key=lambda one: one[0]):
            kind = message.__msgtype__
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=STORE)
            writer.write(connections[topic], BEGIN + round(time * 1e9), STORE.serialize_cdr(message, kind))
    return path


TIME = np.arange(0.0, 8.0, 0.02)
NODES = np.arange(0.0, 8.01, 0.5)
PLACES = np.stack([0.5 * np.sin(NODES), 0.3 * np.cos(1.3 * NODES)], -1)
SPEEDS = np.stack([0.5 * np.cos(NODES), -0.39 * np.sin(1.3 * NODES)], -1)
WANTED = CubicHermiteSpline(NODES, PLACES, SPEEDS)


def played(stamped: bool = True) -> list[Said]:
    """Four trajectories of 2 s, each going on from the one before; positions of both joints and of a wheel."""
    found = []
    for k in range(4):
        own = range(4 * k + (k > 0), 4 * k + 5)
        points = [point(PLACES[i], SPEEDS[i], float(NODES[i] - NODES[4 * k])) for i in own]
        found.append(trajectory(2.0 * k + 0.1, points, stamped))
    at = WANTED(np.maximum(TIME - 0.05, 0))
    rows = [state(t + 0.1, np.r_[9.0, q[::-1]], ["wheel", *NAMES[::-1]]) for t, q in zip(TIME, at, strict=True)]
    # Before the first command, one time twice, and what has no position.
    first = state(0.05, np.r_[9.0, PLACES[0, ::-1]], ["wheel", *NAMES[::-1]])
    return [*found, *rows, rows[7], first, state(1.001, np.zeros(0))]


@pytest.mark.parametrize("stamped", [True, False])
def test_trajectories_are_executed_as_their_controller_does(tmp_path: Path, stamped: bool) -> None:
    tables = [read_table(write(tmp_path / s.name, played(stamped), s)) for s in StoragePlugin]
    tables.append(read_table(tmp_path / "MCAP" / "MCAP.mcap"))
    for table in tables:
        np.testing.assert_array_equal(table.values, tables[0].values)
    assert "q1 is shoulder, q2 is elbow" in tables[0].notes[0]
    assert any("before the first command were left out" in note for note in tables[0].notes)
    assert any("1 positions with the time of another one" in note for note in tables[0].notes)
    (log,) = load_logs([tmp_path / "MCAP"])
    assert log.units == ("rad", "rad")
    # A trajectory without a stamp begins when it was recorded, as late as the positions were.
    np.testing.assert_allclose(log.command, WANTED(TIME), atol=1e-9)
    np.testing.assert_allclose(log.position, WANTED(np.maximum(TIME - 0.05, 0)), atol=1e-9)


def test_a_trajectory_begins_where_the_one_before_was(tmp_path: Path) -> None:
    target = np.array([1.0, -1.0])
    said = [
        # Positions alone: straight lines from what was measured at the start.
        trajectory(0.0, [point(target, None, 1.0)]),
        # Half-way it turns round; then a jump, and a stop by an empty trajectory.
        trajectory(0.5, [point(0 * target, None, 1.0)]),
        trajectory(2.0, [point(3 * target)]),
        trajectory(3.0, []),
    ]
    times = np.arange(0.0, 4.0, 0.01)
    (log,) = load_logs([write(tmp_path / "bag", [*said, *(state(t, 0.2 * target + 0.01 * np.sin(t)) for t in times)])])
    told = np.interp(times, [0, 0.5, 1.5, 1.9999, 2.0, 4], [0.2, 0.6, 0, 0, 3, 3])
    np.testing.assert_allclose(log.command, told[:, None] * target, atol=1e-9)


def controller(time: float, wanted: Array, at: Array, topic: str = CONTROLLER) -> Said:
    points = {"reference": point(wanted), "feedback": point(at), "error": point(wanted - at), "output": point(wanted)}
    message = made("control_msgs/msg/JointTrajectoryControllerState", header=header(time), joint_names=NAMES, **points,
                   multi_dof_joint_names=["none"])  # fmt: skip
    return time, topic, message


def test_what_a_controller_tells_comes_before_trajectories_and_topics_can_be_named(tmp_path: Path) -> None:
    pairs = [(t, WANTED(t), WANTED(max(t - 0.1, 0))) for t in TIME]
    told = [controller(*one) for one in pairs]
    path = write(tmp_path / "bag", [*told, *played()])
    (log,) = load_logs([path])
    np.testing.assert_allclose(log.command, [u for _, u, _ in pairs], atol=1e-12)
    np.testing.assert_allclose(log.position, [q for _, _, q in pairs], atol=1e-12)
    (other,) = load_logs([path], keys={"command": COMMANDS, "units": {"elbow": "m"}, "joints": ["elbow"]})
    assert other.units == ("m",)
    np.testing.assert_allclose(other.command[:, 0], WANTED(other.time - other.time[0])[:, 1], atol=1e-9)
    # Any topic of joint states may hold the commands.
    (own,) = load_logs([path], keys={"command": STATES, "state": CONTROLLER, "samples": 300})
    assert len(own.time) < 300 and any("the first 300 positions were read" in note for note in own.notes)
    for keys, part in (
        ({"command": "/arm"}, "command: "),
        ({"state": "/imu"}, "has no such topic '/imu'"),
        ({"samples": 0}, "samples: write how many"),
        ({"joints": ["wheel"]}, "has no joint 'wheel'; there are shoulder, elbow"),
    ):
        with pytest.raises(InputError, match=r"^motion_keys: ") as caught:
            load_logs([path], keys=keys)
        assert part in str(caught.value)
    twice = [*told, *(controller(t, u, q, "/left") for t, u, q in pairs)]
    with pytest.raises(
        InputError, match=r"several topics for this: /arm/controller_state, /left; name one: motion_keys"
    ):
        load_logs([write(tmp_path / "twice", twice)])


def _cut(path: Path) -> None:
    file = path / "bag.mcap"
    file.write_bytes(file.read_bytes()[:3000])


def _spoilt(path: Path) -> None:
    """A message whose text does not end."""
    file = path / "bag.mcap"
    file.write_bytes(file.read_bytes().replace(b"shoulder\0", b"shoulder\1"))


@pytest.mark.parametrize(
    ("said", "damage", "part"),
    [
        (played()[4:], None, "has no commands; record one of control_msgs/msg/JointTrajectoryControllerState"),
        (played()[:4], None, "has no measured positions; record one of sensor_msgs/msg/JointState"),
        ([], None, "it has no messages"),
        (played(), _cut, "is no whole recording of ROS 2"),
        (played(), lambda path: (path / "bag.mcap").write_bytes(b""), "is no whole recording of ROS 2"),
        (played(), _spoilt, "is no whole recording of ROS 2: Missing string terminator"),
        (played(), lambda path: (path / "metadata.yaml").unlink(), "is no whole recording of ROS 2: Expected metadata"),
        ([*played()[:4], state(0.3, np.array([1e300, 1.0]))], None, "larger than anything that is measured"),
        ([*played()[:4], state(0.3, np.zeros(2), ["a", "b"])], None, "no joint has a position and a command"),
        ([trajectory(9.0, [point(np.zeros(2))]), *played()[4:]], None, "every command is later"),
    ],
)
def test_what_is_refused(
    tmp_path: Path, cli: Cli, said: list[Said], damage: Callable[[Path], Any] | None, part: str
) -> None:
    path = write(tmp_path / "bag", said)
    if damage is not None:
        damage(path)
    code, _, error = cli("diagnose", "--motion", path, "--mechanism", "servo", "--out", tmp_path / "out")
    assert code == 2 and part in error and error.count("\n") == 1, error


def test_a_config_for_a_recording(tmp_path: Path, cli: Cli) -> None:
    path = write(tmp_path / "bag", played())
    code, out, error = cli("new", path / "bag.mcap", "--out", tmp_path / "arm.yaml")
    assert code == 0, error
    assert "ccnn diagnose --config" in out and 'motion: "bag/bag.mcap"' in (tmp_path / "arm.yaml").read_text()


def test_a_bag_of_the_first_ros_is_to_be_converted(tmp_path: Path) -> None:
    (tmp_path / "old.bag").write_bytes(b"#ROSBAG V2.0\n")
    with pytest.raises(InputError, match=r"is a bag of ROS 1; convert it with rosbags-convert --src old.bag"):
        load_logs([tmp_path / "old.bag"])


def test_without_rosbags(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import sys

    path = write(tmp_path / "bag", played())
    monkeypatch.setitem(sys.modules, "rosbags.rosbag2", None)
    with pytest.raises(InputError, match=r"needs rosbags; install it with pip install 'ccnn-torch\[ros\]'"):
        load_logs([path])


def test_the_shipped_recording_is_read() -> None:
    (log,) = load_logs([Path(__file__).parent.parent / "experiments" / "data" / "ros_arm.mcap"])
    assert len(log.time) == len(TIME)
