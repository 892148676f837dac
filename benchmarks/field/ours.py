"""ccnn_torch with its defaults: `calibrate`, and predictions of the written model file."""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np
import torch

from benchmarks.field.protocol import Fit, Floats, Rows
from ccnn_torch import api
from ccnn_torch.compensation import load_model
from ccnn_torch.files.yaml_file import dump_yaml, read_yaml
from ccnn_torch.mechanisms import Mechanism
from ccnn_torch.records import write_table
from ccnn_torch.verification.job import nominal_mechanism

_UNIT = {"t": "degC", "d": "1"}
# Numbers of changes by the benchmark's names.
_NAMES = {("geometry", n): n for n in ("a", "alpha", "d")} | {
    ("geometry", "theta"): "zero",
    ("joint_offset", ""): "zero",
    ("joint_gain", ""): "gain",
    ("joint_gain", "zero"): "zero",
}


def write(rows: Rows, path: Path) -> str:
    """The rows as a file of ours; its path."""
    columns = {f"q{k + 1}[rad]": q for k, q in enumerate(rows.joints.T)}
    names = ("x[m]", "y[m]", "z[m]", "rx[rad]", "ry[rad]", "rz[rad]")
    columns |= dict(zip(names, rows.poses.T, strict=False))
    columns |= {f"{n}[{_UNIT[n[0]]}]": c for n, c in zip(rows.names, rows.covariates.T, strict=True)}
    if rows.several:
        columns["placement[1]"] = rows.frame.astype(np.float64)
    write_table(path, columns)
    return str(path)


def machine_file(rows: Rows, folder: Path) -> str:
    """The maker's table as it stands; the rows are of one arm, with a base frame for each measuring frame."""
    content = {k: v for k, v in read_yaml(rows.nominal).items() if k not in ("frame_per", "tool_per")}
    if rows.several:
        content |= {"base_frame": "unknown", "frame_per": ["placement"]}
    path = folder / "machine.yaml"
    path.write_text(dump_yaml(content), "utf-8")
    return str(path)


def ours(rows: Rows) -> Fit:
    """The best of geometry, effects and network by cross-validation on the training rows."""
    with tempfile.TemporaryDirectory() as folder:
        file, nominal = write(rows, Path(folder) / "rows.csv"), machine_file(rows, Path(folder))
        api.calibrate(records=file, mechanism=nominal).save(folder, forms=())
        model = load_model(Path(folder) / "model.safetensors")
    machine = nominal_mechanism(model, None, allow_code=False)
    used = [rows.names.index(c.name) for c in model.covariates]

    def said(joints: Floats, covariates: Floats) -> dict[str, Floats]:
        return model(joints, covariates[:, used] if used else None)

    def predict(joints: Floats, covariates: Floats) -> Floats:
        return _poses(machine, torch.from_numpy(np.asarray(said(joints, covariates)["ideal"])))

    def half_width(joints: Floats, covariates: Floats) -> Floats:
        sd = np.asarray(said(joints, covariates)["deviation_sd"])
        middle, step = torch.from_numpy(joints), 1e-6
        squares = np.zeros((len(joints), rows.poses.shape[1]))
        for k in range(joints.shape[1]):
            beside = middle.clone()
            beside[:, k] += step
            squares += ((_poses(machine, beside) - _poses(machine, middle)) / step * sd[:, k : k + 1]) ** 2
        return 1.96 * np.sqrt(squares)

    return Fit(predict, half_width)


def _poses(machine: Mechanism, joints: torch.Tensor) -> Floats:
    with torch.no_grad():
        return machine.forward_kinematics(joints).numpy()


def changed(before: Rows, after: Rows) -> dict[str, float]:
    """`identify` of the first rows, and what `since` says of the second."""
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder)
        machine = api.identify(records=write(before, place / "before.csv"), mechanism=machine_file(before, place))
        machine.save(place)
        said = api.since(place / "identified.yaml", write(after, place / "after.csv"))
    found: dict[str, float] = {}
    for told in said.changed:
        effect, joint = told.name.split(" q")[0], told.name.rpartition("q")[2]
        for number in told.numbers:
            name = _NAMES.get((effect, number.name.removeprefix(f"q{joint}").removesuffix(joint).strip()), effect)
            # Of what is no geometry the largest number counts.
            other = found.get(f"{name} {joint}", 0.0)
            found[f"{name} {joint}"] = number.value if abs(number.value) > abs(other) else other
    return found
