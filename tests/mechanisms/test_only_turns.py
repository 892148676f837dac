"""A machine that only turns is told by its angles: where the position never moves, no sentence is about its error."""

import json

from typer.testing import CliRunner

from ccnn_torch.cli.application import app

WRIST = """\
import torch
from ccnn_torch.coordinates import Coordinate, Parameter
from ccnn_torch.mechanisms import Mechanism
from ccnn_torch.numerics.rotations import rotation_vector_to_matrix


class Wrist(Mechanism):
    def __init__(self):
        super().__init__(
            name="wrist",
            joints=[Coordinate("q1", "rad"), Coordinate("q2", "rad")],
            pose=[Coordinate("pitch", "rad"), Coordinate("roll", "rad")],
            geometry=[Parameter("lever", "m", 0.1, scale=1e-3), Parameter("zero", "rad", 0.0, scale=1e-3)],
            low=(-0.5, -0.4),
            high=(0.5, 0.4),
        )

    def frame(self, pose):
        nothing = torch.zeros_like(pose[..., 0])
        tilt = torch.stack([nothing, pose[..., 0], nothing], -1)
        lean = torch.stack([pose[..., 1], nothing, nothing], -1)
        return torch.zeros_like(tilt), rotation_vector_to_matrix(tilt) @ rotation_vector_to_matrix(lean)

    def pose_near(self, position, rotation):
        pitch = torch.atan2(-rotation[..., 2, 0], rotation[..., 2, 1].hypot(rotation[..., 2, 2]))
        return torch.stack([pitch, torch.atan2(rotation[..., 2, 1], rotation[..., 2, 2])], -1)

    def closure(self, pose, joints, parameters=None):
        lever, zero = self.resolve(parameters).unbind(-1)
        first = pose[..., 0] + 2 * lever * pose[..., 1].sin() + zero - joints[..., 0]
        return torch.stack([first, pose[..., 1] - 3 * lever * pose[..., 0].sin() - joints[..., 1]], -1)
"""


def _said(*words):
    done = CliRunner().invoke(app, words)
    assert done.exit_code == 0, done.output
    return done.output


def test_a_wrist_is_told_by_its_angles(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "wrist.py").write_text(WRIST)
    machine = ["--mechanism", "wrist.py:Wrist"]
    rows = [*machine, "--noise", "rad=2e-5", "--rows", "90"]
    rows += ["--effect", "joint_offset:q1=3mrad", "--effect", "geometry:lever=0.3mm", "--out"]
    said = _said("simulate", *rows, "rows.csv")
    assert "RMS error of the rotation" in said and "µrad" in said and "µm" not in said
    # Its own names of coordinates are known, and the config may run its code.
    _said("new", "rows.csv", *machine, "--out", "wrist.yaml")
    said = _said("run", "wrist.yaml", "out=run")
    assert "of the RMS rotation error" in said and "RMS position" not in said and "nm" not in said
    chosen = json.loads((tmp_path / "run" / "results.json").read_text())
    assert chosen["pose"]["rotation"]["after"]["rms"]["median"] < 4e-5
    assert "mrad" in chosen["geometry"]["why"] and " mm" not in chosen["geometry"]["why"]
    _said("simulate", *rows, "new.csv", "--seed", "1")
    said = _said("verify", "run/model.safetensors", "new.csv", "--out", "verified", "--allow-code")
    assert "The promise is kept" in said and "rotation" in said and "position" not in said
    assert "RMS rotation error" in _said("compare", "run")
