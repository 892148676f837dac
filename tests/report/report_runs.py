"""Made-up runs that look like the real ones: a simulated tripod of three sliders and a measured six-joint arm."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ccnn_torch.calibration.statistics import (
    before_block,
    constant_errors,
    floor_block,
    joint_errors,
    pose_block,
    ratio_to_floor,
    spread,
)
from ccnn_torch.coordinates import Coordinate
from ccnn_torch.report.arrays import RunArrays, save_arrays, save_history
from ccnn_torch.report.json_files import write_json
from ccnn_torch.report.results.run import RunResults


def tripod_run(repeats: int = 5) -> tuple[RunResults, RunArrays, dict[str, np.ndarray]]:
    """Results, arrays and training curves of a tripod-like run: eq. 17's errors, a model near the noise floor."""
    generator = np.random.default_rng(7)
    joints = tuple(Coordinate(f"q{i}", "m") for i in (1, 2, 3))
    t = np.arange(1, 126) * np.pi / 360
    y, z, phi = (
        g.ravel()
        for g in np.meshgrid(
            np.linspace(-0.2, 0.2, 5), np.linspace(0.4, 0.7, 5), np.linspace(-0.3, 0.3, 5), indexing="ij"
        )
    )
    signal = np.stack(
        [
            -1e-4 + 1e-5 * np.sin(t),
            1e-4 - 1e-5 * np.cos(t),
            1.2e-4 + 5e-5 * np.sin(t) + 5e-6 * np.cos(t),
        ],
        axis=1,
    )
    noise = generator.normal(0, 1e-5, (repeats, 125, 3))
    measured = signal + noise
    predicted = signal + generator.normal(0, 3e-6, measured.shape)
    rows = np.stack([generator.permutation(125) for _ in range(repeats)])
    test, train = rows[:, :25], rows[:, 25:]

    def pick(values: np.ndarray, chosen: np.ndarray) -> np.ndarray:
        return np.take_along_axis(values, chosen[..., None], axis=1)

    before = np.linalg.norm(measured, axis=-1) * (1.2 + 0.6 * (z - 0.4))
    after = np.linalg.norm(measured - predicted, axis=-1) * (1.2 + 0.6 * (z - 0.4))
    floor = floor_block(pick(noise, test), None, joints, np.full(3, 1e-10))
    methods: dict[str, Any] = {}
    for name, factor, seconds in (("ccnn", 1.0, 0.8), ("bp_lm", 1.3, 0.3), ("grnn", 1.6, 0.02)):
        guess = signal + factor * (predicted - signal) * (1 if name == "ccnn" else 2)
        errors = joint_errors(pick(guess, test), pick(measured, test), None, joints)
        methods[name] = {
            "test": errors,
            "ratio_to_floor": ratio_to_floor(errors, floor),
            "seconds": spread(np.full(repeats, seconds)),
        }
    methods["enn"] = {"test": None, "failed": "ENN ran out of its budget of 3 s before the first generation ended."}
    constant = constant_errors(pick(measured, train), pick(measured, test), None, None, joints)
    results = {
        "name": "tripod",
        "seed": 0,
        "repeats": repeats,
        "case": "tripod",
        "joints": [{"name": j.name, "unit": j.unit} for j in joints],
        "best_method": "ccnn",
        "rows": {"train": 100, "validation": 0, "test": 25},
        "before": before_block(pick(measured, test), None, joints),
        "before_train": before_block(pick(measured, train), None, joints),
        "methods": methods,
        "constant": {"test": constant, "ratio_to_floor": ratio_to_floor(constant, floor)},
        "floor": floor,
        "pose": pose_block(
            *((held, held * 0.8) for held in (np.take_along_axis(error, test, 1) for error in (before, after))),
            rotation_weight=0.04,
        ),
        "notes": ["Column 'goal_x' is ignored: it is not listed under covariates."],
        "versions": {"ccnn_torch": "0.1.0", "torch": "2.13.0"},
    }
    held = np.zeros(125, dtype=bool)
    held[test[0]] = True
    grid_y, grid_z = (g.ravel() for g in np.meshgrid(np.linspace(-0.2, 0.2, 25), np.linspace(0.4, 0.7, 25)))
    smooth = 1e-4 * (1.8 + 0.8 * np.sin(6 * grid_y) + 1.5 * (grid_z - 0.4))
    arrays = RunArrays(
        joints=joints,
        commanded=np.stack([y, z, phi], axis=1),
        measured=measured[0],
        predicted=predicted[0],
        noise=noise[0],
        test=held,
        place=np.stack([np.zeros(125), y, z], axis=1),
        position_before=before[0],
        position_after=after[0],
        rotation_before=before[0] * 0.8,
        rotation_after=after[0] * 0.8,
        map_place=np.stack([np.zeros(625), grid_y, grid_z], axis=1),
        map_before=smooth,
        map_after=smooth * 0.06 * (1 + 0.3 * np.cos(20 * grid_z)),
        labels={"method": "ccnn", "repeat": "0", "mechanism": "tripod"},
    )
    steps = np.arange(1, 121)
    decay = np.exp(-steps / 25)[:, None]
    own = generator.normal(1, 0.05, (1, repeats))
    history = {
        "step": steps,
        "fitness_best": own * (1.6 - 1.1 * decay),
        "fitness_mean": own * (1.1 - 0.9 * decay),
        "heldout_mse_all": own * 1e-10 * (1.1 + 12 * decay**2),
        "density": np.clip(0.55 + 0.2 * decay[..., None] * generator.normal(1, 0.2, (1, repeats, 3)), 0, 1),
        "diversity": np.clip(0.9 * decay[..., None] * generator.normal(1, 0.1, (1, repeats, 3)), 0, 1),
    }
    return RunResults.model_validate(results), arrays, history


def arm_run(rows: int = 500) -> tuple[RunResults, RunArrays]:
    """Results and arrays of a run on records of a six-joint arm: no floor known, orientation in mrad, one repeat."""
    generator = np.random.default_rng(11)
    joints = tuple(Coordinate(f"q{i}", "rad") for i in range(1, 7))
    commanded = generator.uniform(-2.5, 2.5, (rows, 6))
    signal = 4e-4 * np.stack([np.sin(commanded[:, i] + i) for i in range(6)], axis=1)
    measured = signal + generator.normal(0, 6e-5, signal.shape)
    predicted = signal + generator.normal(0, 8e-5, signal.shape)
    reach = generator.uniform(0.5, 1.2, rows)
    position = np.stack(
        [reach * np.cos(commanded[:, 0]), reach * np.sin(commanded[:, 0]), generator.uniform(0, 1, rows)], axis=1
    )
    before, after = 1.2 * np.linalg.norm(measured, axis=1), 0.9 * np.linalg.norm(measured - predicted, axis=1)
    held = generator.random(rows) < 0.3
    errors = joint_errors(predicted[None, held], measured[None, held], None, joints)
    results = {
        "name": "ur10",
        "seed": 1,
        "repeats": 1,
        "case": None,
        "joints": [{"name": j.name, "unit": j.unit} for j in joints],
        "best_method": "ccnn",
        "rows": {"train": int((~held).sum()), "validation": 70, "test": int(held.sum()), "not_trained_on": 4},
        "before": before_block(measured[None, held], None, joints),
        "methods": {"ccnn": {"test": errors, "ratio_to_floor": None, "seconds": spread([3.4])}},
        "constant": {"test": constant_errors(measured[None, ~held], measured[None, held], None, None, joints)},
        "floor": None,
        "pose": pose_block(*((error[None, held], error[None, held]) for error in (before, after))),
    }
    arrays = RunArrays(
        joints=joints,
        commanded=commanded,
        measured=measured,
        predicted=predicted,
        test=held,
        place=position,
        position_before=before,
        position_after=after,
        rotation_before=before,
        rotation_after=after,
        labels={"method": "ccnn", "repeat": "0", "mechanism": "ur10"},
    )
    return RunResults.model_validate(results), arrays


def fill(folder: Path) -> Path:
    """Write what the runner leaves in a run folder before the report is made."""
    found, drawn, curves = tripod_run()
    write_json(folder / "results.json", found)
    save_arrays(folder, drawn)
    save_history(folder, "ccnn", curves)
    (folder / "config.yaml").write_text("name: tripod\nseed: 0\nmethods: [ccnn, bp_lm, grnn, enn]\n")
    return folder
