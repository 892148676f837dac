"""Recordings of ROS 2: MCAP files, and rosbag2 folders with sqlite3 or MCAP in them; ROS is not needed.

What is read are three messages alone, by definitions of our own, whatever definitions a recording brings:
sensor_msgs/JointState, trajectory_msgs/JointTrajectory, and of control_msgs/JointTrajectoryControllerState the begin,
which is the same in all distributions: the set point and then the measured state (github.com/ros-controls/control_msgs;
desired and actual in older ones). Trajectories count as ros2_control's joint_trajectory_controller executes them.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ccnn_torch.display import visible
from ccnn_torch.errors import InputError
from ccnn_torch.records.formats.joints import chosen_joints, motion_table
from ccnn_torch.records.table import Table

Array = NDArray[np.float64]
_STATE = "sensor_msgs/msg/JointState"
_TRAJECTORY = "trajectory_msgs/msg/JointTrajectory"
_CONTROLLER = "control_msgs/msg/JointTrajectoryControllerState"
_BEGIN = """
std_msgs/Header header
string[] joint_names
trajectory_msgs/JointTrajectoryPoint reference
trajectory_msgs/JointTrajectoryPoint feedback
"""
# Measured states that are read where nothing is said: 8 minutes at 100 Hz.
_SAMPLES = 50_000
# What rosbags raises on a damaged file beside its own errors; a length in it may be larger than any memory.
_DAMAGED = (
    *(AssertionError, AttributeError, EOFError, IndexError, KeyError, OSError, OverflowError, RuntimeError, TypeError),
    *(ValueError, MemoryError, struct.error),
)


class _Message(NamedTuple):
    """Measured positions of some joints, at a time [ns, 0 = not told], and when they were recorded [ns]."""

    names: tuple[str, ...]
    stamp: int
    recorded: int
    position: Array


class _Plan(NamedTuple):
    """A trajectory: times [s] from its start [ns, 0 = at once], and position, velocity … there, `k x d x n`."""

    names: tuple[str, ...]
    stamp: int
    recorded: int
    times: Array
    states: Array


def read(path: Path, keys: Mapping[str, Any]) -> Table:
    """The commands at the times of the measured positions: `time`, `command1` … and `q1` …, one run.

    Args:
        path: of the recording.
        keys: `command` and `state`, the topics; `samples`, how many states; `joints`, `units` as in `chosen_joints`.

    Raises:
        InputError: it is damaged, has no commands or no positions, or several topics of them.
    """
    if path.suffix.lower() == ".bag":
        raise InputError(f"{path}: is a bag of ROS 1; convert it with rosbags-convert --src {path.name} --dst FOLDER")
    most = keys.get("samples", _SAMPLES)
    if isinstance(most, bool) or not isinstance(most, int) or most < 1:
        raise InputError(f"motion_keys: samples: write how many, e.g. 50000, not {visible(str(most))}")
    measured, commanded, notes = _messages(path, keys, most)
    if not measured or not commanded:
        lacking = "measured positions" if not measured else "commands"
        raise InputError(f"{path}: its topic of {lacking} has no message; record the motion again")
    there, moved = (list(dict.fromkeys(n for one in own for n in one.names)) for own in (measured, commanded))
    joints, said = chosen_joints(there, moved, keys, path)
    measured = [one for one in measured if {*joints.names} <= {*one.names}]
    commanded = [one for one in commanded if {*joints.names} <= {*one.names}]
    if not measured or not commanded:
        raise InputError(
            f"{path}: no single message has all of {', '.join(joints.names)}; name joints that are told together with "
            "motion_keys={joints: […]}"
        )
    recorded = np.array([one.recorded for one in measured])
    stamps = np.array([one.stamp for one in measured])
    stamps = stamps if stamps.all() else recorded
    # The clock of the stamps may be that of a simulation, or of another computer.
    shift, first = int(np.median(stamps - recorded)), int(stamps.min())
    time, kept = np.unique(1e-9 * (stamps - first), return_index=True)
    if len(kept) < len(measured):
        notes = [*notes, f"{len(measured) - len(kept)} positions with the time of another one were left out"]
    position = np.array([one.position[[one.names.index(n) for n in joints.names]] for one in measured])[kept]
    starts = np.array([1e-9 * ((one.stamp or one.recorded + shift) - first) for one in commanded])
    command = _executed(commanded, starts, joints.names, time, position)
    known = ~np.isnan(command).any(1)
    if not known.any():
        raise InputError(f"{path}: every command is later than the last measured position; check the clocks of both")
    if not known.all():
        notes = [*notes, f"{time[known][0]:.3g} s before the first command were left out"]
    units = ["rad"] * len(joints.names) if joints.units is None else joints.units
    run = np.zeros(int(known.sum()))
    return motion_table(path, joints, units, time[known], command[known], position[known], run, [*notes, *said])


def _messages(path: Path, keys: Mapping[str, Any], most: int) -> tuple[list[_Message], list[_Plan], list[str]]:
    """Measured positions and commands, in the order of the recording, and what was left out."""
    try:
        from apsw import Error as DatabaseError
        from rosbags.rosbag2 import Reader, ReaderError
        from rosbags.serde import SerdeError
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore
    except ImportError:
        raise InputError(
            f"{path}: reading a recording of ROS needs rosbags; install it with pip install 'ccnn-torch[ros]'"
        ) from None
    store = get_typestore(Stores.ROS2_HUMBLE)
    store.register(get_types_from_msg(_BEGIN, _CONTROLLER))

    def decoded(raw: bytes, kind: str) -> Any:
        about = store.get_msgdef(kind)
        read = about.deserialize_cdr_le if raw[1] else about.deserialize_cdr_be
        # Not by the store's own method, which refuses what follows the begin of a message.
        return read(raw[4:], 0, about.cls, store)[0]

    measured: list[_Message] = []
    commanded: list[_Plan] = []
    try:
        with Reader(path) as reader:
            kinds = {c.topic: c.msgtype for c in reader.connections if c.msgcount}
            command, state = _topics(kinds, keys, path)
            wanted = [c for c in reader.connections if c.topic in (command, state)]
            for connection, recorded, raw in reader.messages(wanted):
                message = decoded(raw, connection.msgtype)
                if connection.topic == state:
                    measured.append(_position(message, recorded, "feedback"))
                if connection.topic == command and connection.msgtype == _TRAJECTORY:
                    commanded.append(_plan(message, recorded))
                elif connection.topic == command:
                    # It is held until the next one.
                    one = _position(message, recorded, "reference")
                    commanded.append(_Plan(one.names, one.stamp, recorded, np.zeros(1), one.position[None, None]))
                if len(measured) >= most:
                    break
    except (ReaderError, SerdeError, DatabaseError, *_DAMAGED) as reason:
        said = visible((str(reason).splitlines() or [""])[0], 120)
        raise InputError(f"{path}: is no whole recording of ROS 2: {said or type(reason).__name__}") from None
    cut = [f"the first {most} positions were read; motion_keys={{samples: {10 * most}}} reads more"]
    return measured, commanded, cut if len(measured) >= most else []


def _topics(kinds: Mapping[str, str], keys: Mapping[str, Any], path: Path) -> tuple[str, str]:
    """Topics of commands and of measured positions."""

    def only(key: str, ways: Sequence[Sequence[str]], but: str, lacking: str) -> str:
        given = keys.get(key)
        if given is not None:
            if kinds.get(str(given)) in (_STATE, _TRAJECTORY, _CONTROLLER):
                return str(given)
            raise InputError(f"motion_keys: {key}: {path} has no such topic '{visible(str(given))}'; {told(ways)}")
        found: list[str] = next(
            filter(None, ([t for t, k in kinds.items() if k in way and t != but] for way in ways)), []
        )
        if len(found) == 1:
            return found[0]
        if not found:
            raise InputError(f"{path}: has no {lacking}; {told(ways)}")
        raise InputError(
            f"{path}: has several topics for this: {', '.join(found)}; name one: motion_keys={{{key}: {found[0]}}}"
        )

    def told(ways: Sequence[Sequence[str]]) -> str:
        here = [f"{t} ({k})" for t, k in kinds.items()]
        some = ", ".join(here[:8]) + (f" and {len(here) - 8} more" if len(here) > 8 else "")
        return f"record one of {', '.join(k for way in ways for k in way)}; it has {visible(some) or 'no messages'}"

    plans = [[_CONTROLLER], [_TRAJECTORY]]
    command = only("command", plans, "", "commands")
    if kinds[command] == _CONTROLLER and "state" not in keys:
        return command, command
    return command, only("state", [[_STATE]], command, "measured positions")


def _stamp(message: Any) -> int:
    return int(message.header.stamp.sec) * 10**9 + int(message.header.stamp.nanosec)


def _position(message: Any, recorded: int, part: str) -> _Message:
    """Of a JointState, or of one part of a controller's state."""
    named = hasattr(message, "joint_names")
    names, at = (message.joint_names, getattr(message, part).positions) if named else (message.name, message.position)
    # Of joints that have only a velocity or an effort there is no position.
    return _Message(tuple(names) if len(names) == len(at) else (), _stamp(message), recorded, np.asarray(at))


def _plan(message: Any, recorded: int) -> _Plan:
    names, points = tuple(message.joint_names), message.points
    times = np.array([p.time_from_start.sec + 1e-9 * p.time_from_start.nanosec for p in points])
    each = [[p.positions, p.velocities, p.accelerations] for p in points]
    told = next((d for d in range(3) if any(len(own[d]) != len(names) for own in each)), 3)
    if told == 0:
        # Speeds alone command no position.
        names, points, times = (), [], times[:0]
    states = np.array([own[:told] for own in each]) if points else np.zeros((0, 1, len(names)))
    return _Plan(names, _stamp(message), recorded, times, states)


def _executed(plans: Sequence[_Plan], starts: Array, names: Sequence[str], time: Array, at: Array) -> Array:
    """Commanded positions, `s x n`; NaN before the first one.

    A trajectory takes the place of the one before at its start; up to its first point it goes on from where that was.

    Args:
        plans: trajectories.
        starts: of each [s].
        names: of the joints.
        time: `s` [s].
        at: measured positions, `s x n`.
    """
    command = np.full(at.shape, np.nan)
    order = np.argsort(starts, kind="stable")
    first = np.r_[np.searchsorted(time, starts[order]), len(time)]
    state: Callable[[Array], Array] | None = None
    for i, k in enumerate(order):
        plan, start = plans[k], float(starts[k])
        places = [plan.names.index(name) for name in names]
        if state is None:
            here = np.array([np.interp(start, time, own) for own in at.T])
            before = np.stack([here, np.zeros_like(here)])
        else:
            before = state(np.array([start]))[:, 0]
        state = _spline(start, plan.times, plan.states[:, :, places], before)
        rows = slice(first[i], first[i + 1])
        command[rows] = state(time[rows])[0]
    return command


def _spline(start: float, times: Array, states: Array, before: Array) -> Callable[[Array], Array]:
    """Position and velocity of a trajectory at times [s], `2 x s x n`: linear, cubic or quintic, as its points tell.

    Args:
        start: of it [s].
        times: of its points, `k` from the start [s].
        states: position, velocity, acceleration there as far as they are told, `k x d x n`.
        before: position and velocity at its start, `2 x n`.
    """
    from scipy.interpolate import BPoly

    rising = np.r_[True, np.diff(times) > 0] if len(times) else np.zeros(0, dtype=bool)
    nodes, values = list(start + times[rising]), list(states[rising])
    if not nodes or times[0] > 0:
        begin = np.zeros((states.shape[1], before.shape[1]))
        begin[: min(2, len(begin))] = before[: min(2, len(begin))]
        nodes, values = [start, *nodes], [begin, *values]
    last = values[-1][0]
    curve = BPoly.from_derivatives(nodes, values) if len(nodes) > 1 else None

    def state(at: Array) -> Array:
        moving = (at <= nodes[-1] + 1e-9)[:, None]
        if curve is None:
            held = np.broadcast_to(last, (len(at), len(last)))
            return np.stack([held, np.zeros_like(held)])
        inside = np.clip(at, nodes[0], nodes[-1])
        return np.stack([np.where(moving, curve(inside), last), np.where(moving, curve(inside, 1), 0.0)])

    return state
