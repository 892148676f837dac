"""A measuring frame that moves while the rows are measured: made-up arms with kinematics of their own, and a delta."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from arm_text import ALPHA, A, D, arm_text
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ccnn_torch.compensation import load_compensation
from ccnn_torch.diagnosis import diagnose
from ccnn_torch.diagnosis.engine import diagnose_rows
from ccnn_torch.diagnosis.verdict.findings import findings
from ccnn_torch.effects import Situation, default_gravity
from ccnn_torch.mechanisms import load_mechanism
from ccnn_torch.records import load_records
from ccnn_torch.simulation.job import simulate_records

Array = NDArray[np.float64]
Cli = Callable[..., tuple[int, str, str]]
ARM = arm_text()
NOISE, TURN_NOISE = 2e-5, 3e-5


class Arm:
    """An arm with errors of its geometry, measured from a frame that moves by `way` of a shift and a turn."""

    def __init__(self, seed: int, way: Callable[[Array], Array], rows: int = 100, sort: int | None = None) -> None:
        draw = np.random.default_rng(seed)
        self.joints = draw.uniform(-1.6, 1.6, (rows, 6))
        if sort is not None:
            self.joints = self.joints[np.argsort(self.joints[:, sort])]
        self.errors = draw.normal(0, 1, (4, 6)) * np.array([[4e-4], [4e-4], [5e-4], [5e-4]])
        self.time = np.linspace(0, 4 * 3600.0, rows)
        self.twist = np.concatenate([draw.normal(0, 2.5e-4, 3), draw.normal(0, 1e-4, 3)])
        poses = []
        for q, share in zip(self.joints, way(self.time / self.time[-1]), strict=True):
            moved = _frame(share * self.twist) @ self.reached(q)
            turned = Rotation.from_rotvec(draw.normal(0, TURN_NOISE, 3)) * Rotation.from_matrix(moved[:3, :3])
            poses.append([*(moved[:3, 3] + draw.normal(0, NOISE, 3)), *turned.as_rotvec()])
        self.poses = np.array(poses)

    def reached(self, joints: Array) -> Array:
        """Frame of the tool, seen from where the measuring device stood at first."""
        at = _frame(np.array([1.5, -2, 0.4, 0.1, -0.05, 0.7]))
        for q, a, d, alpha, e in zip(joints, A, D, ALPHA, self.errors.T, strict=True):
            c, s, ca, sa = np.cos(q + e[0]), np.sin(q + e[0]), np.cos(alpha + e[3]), np.sin(alpha + e[3])
            x, z = a + e[2], d + e[1]
            link = [[c, -s * ca, s * sa, x * c], [s, c * ca, -c * sa, x * s], [0, sa, ca, z], [0, 0, 0, 1]]
            at = at @ np.array(link)
        return np.asarray(at @ _frame(np.array([0.02, 0.03, 0.12, 0, 0, 0])))

    def write(self, folder: Path, timed: bool = True) -> tuple[str, str]:
        """Records and the machine's file."""
        names = [f"q{i + 1}[rad]" for i in range(6)] + ["x[m]", "y[m]", "z[m]", "rx[rad]", "ry[rad]", "rz[rad]"]
        columns = [self.joints, self.poses] + ([self.time[:, None]] if timed else [])
        header = ",".join(names + (["time[s]"] if timed else []))
        np.savetxt(folder / "r.csv", np.hstack(columns), "%.17g", ",", header=header, comments="")
        (folder / "arm.yaml").write_text(ARM)
        return str(folder / "r.csv"), str(folder / "arm.yaml")


def _frame(twist: Array) -> Array:
    at = np.eye(4)
    at[:3, :3], at[:3, 3] = Rotation.from_rotvec(twist[3:]).as_matrix(), twist[:3]
    return at


def _row_of(text: str) -> int:
    return int(text.partition("(from row ")[2].split()[0])


def _creeping(share: Array) -> Array:
    return share


def _settling(share: Array) -> Array:
    return np.asarray(1 - np.exp(-share / 0.15))


def _touched(share: Array) -> Array:
    return np.asarray((share >= 0.55) * 1.0)


_CASES = [
    (_creeping, 2, True),
    (_touched, None, False),
]


def test_a_drift_of_the_frame_is_named_beside_geometry_with_its_numbers(tmp_path: Path) -> None:
    for seed, (way, sort, timed) in enumerate(_CASES):
        arm = Arm(seed, way, 70, sort)
        records, file = arm.write(tmp_path, timed)
        mechanism = load_mechanism(file)
        few = ["geometry", "frame_drift", "joint_offset", *(["drift"] if timed else ["backlash"])]
        said = diagnose(load_records(records, mechanism), mechanism, effects=few)
        assert set(said.verdict["effects"]) == {"geometry", "frame_drift"} and not said.verdict["outside_library"]
        assert said.verdict["probability"] > 0.9 if timed else bool(said.inferred)
        found = next(e for e in said.content["effects"] if e["name"] == "frame_drift")["parameters"]
        turn = [found[name]["value"] for name in ("rx", "ry", "rz")]
        assert np.allclose(turn, arm.twist[3:], atol=3e-5), (way.__name__, turn, arm.twist)
        if way is _touched:
            # Between the last row before and the first one after, or a neighbour of these.
            moments = arm.time if timed else np.arange(len(arm.time), dtype=np.float64)
            first = int(np.argmax(_touched(arm.time / arm.time[-1])))
            assert moments[first - 2] <= found["begin"]["value"] <= moments[first + 1]
            assert found["settling"]["value"] < moments[2]
            text = next(f.text for f in findings(said.content) if f.effect == "frame_drift")
            assert "after the first row on" in text if timed else abs(_row_of(text) - (first + 1)) <= 1


def test_a_frame_that_drifts_is_named_on_a_parallel_machine() -> None:
    made = simulate_records("delta", ["geometry", "frame_drift:size=4"], 80, 1e-5, seed=0)
    rows = Situation(made.mechanism, made.joints, made.covariates, default_gravity(made.mechanism), None, made.pose)
    assert set(diagnose_rows(rows, made.pose).verdict["effects"]) == {"geometry", "frame_drift"}


@pytest.mark.parametrize(
    ("seed", "effects"),
    [(3, ["backlash"]), (8, ["geometry", "drift"])],
)
def test_no_drift_of_the_frame_is_named_where_there_is_none(seed: int, effects: list[str]) -> None:
    made = simulate_records("five_bar", effects, 80, 1e-5, seed=seed)
    # The rows in an order in which a joint grows with the time.
    order = made.joints[:, 0].argsort()
    beside = {n: v if n == "time" else v[order] for n, v in made.covariates.items() if n != "time" or seed % 2}
    if "drift" in effects or "thermal" in effects:
        order, beside = torch.arange(80), made.covariates
    joints, pose = made.joints[order], made.pose[order]
    said = diagnose_rows(Situation(made.mechanism, joints, beside, default_gravity(made.mechanism), None, pose), pose)
    assert "frame_drift" not in said.verdict["effects"], (effects, said.verdict)


def test_what_follows_the_time_comes_before_a_joint_that_was_moved_with_it(tmp_path: Path) -> None:
    records, file = Arm(1, lambda share: np.asarray(np.sin(np.pi * share)), 70, 2).write(tmp_path)
    mechanism = load_mechanism(file)
    noise = {**dict.fromkeys("xyz", NOISE), **dict.fromkeys(("rx", "ry", "rz"), TURN_NOISE)}
    effects = ["geometry", "frame_drift", "joint_gain"]
    said = diagnose(load_records(records, mechanism), mechanism, noise=noise, effects=effects)
    assert said.verdict["outside_library"] and said.verdict["driver"] == "time"


def test_commands_are_not_corrected_for_a_frame_that_moved(cli: Cli, tmp_path: Path) -> None:
    arm = Arm(7, _settling, 80)
    records, file = arm.write(tmp_path)
    words = ("--records", records, "--mechanism", file, "--out", str(tmp_path / "d"), "--no-network", "--quiet")
    words += ("--effects", "geometry,frame_drift,drift")
    assert cli("diagnose", *words)[0] == 0
    said = json.loads((tmp_path / "d" / "diagnosis.json").read_text())
    assert set(said["verdict"]["effects"]) == {"geometry", "frame_drift"}
    machine = load_compensation(str(tmp_path / "d" / "diagnosis.json")).machine
    assert machine is not None and not machine.acting
    joints = np.random.default_rng(8).uniform(-1.5, 1.5, (40, 6))
    position = machine.identified.forward_kinematics(torch.from_numpy(joints))[:, :3].numpy()
    wanted = np.array([arm.reached(q)[:3, 3] for q in joints])
    moved = np.linalg.norm(arm.twist[:3])
    assert np.sqrt(np.mean(np.sum((position - wanted) ** 2, -1))) < min(3e-5, 0.2 * moved)

    about = [f"records={records}", f"mechanism={file}", "repeats=1", "methods=constant", "--quiet"]
    about += ["geometry=identify", "save_models=false", "save_report=false"]
    code, _, told = cli("run", *about, "effects=[frame_drift,drift]", f"out={tmp_path / 'r'}")
    assert code == 0, told
    results = json.loads((tmp_path / "r" / "results.json").read_text())
    assert any("no error of the machine" in n for n in results["notes"])
    noise = np.sqrt(3) * NOISE
    assert results["pose"]["position"]["explained"]["rms"]["median"] < 1.3 * noise < 0.5 * moved
