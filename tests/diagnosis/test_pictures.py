"""The arrays behind the pictures: rows add up, and what gives an effect away is found."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from _machines import NOISE, measured, rows_of

from ccnn_torch.diagnosis import diagnose_rows
from ccnn_torch.diagnosis.page.outputs import picture_arrays
from ccnn_torch.effects import Situation, default_gravity, pose_residual, reached
from ccnn_torch.mechanisms import load_mechanism

ARM = Path(__file__).parents[1] / "effects" / "arm.yaml"


def test_two_causes_are_drawn_against_what_drives_each() -> None:
    rows = rows_of("five_bar", 160, 0)
    poses = measured(rows, {"compliance": 10.0, "backlash": 8.0}, 1)
    found = diagnose_rows(rows, poses, None, ["geometry", "joint_offset", "compliance", "backlash"])
    arrays, labels = picture_arrays(found)
    assert set(labels) == {"compliance", "backlash"} == set(found.verdict["effects"])
    assert all(value.dtype == torch.float64 for value in arrays.values())
    assert all(bool(value.isfinite().all()) for name, value in arrays.items() if name != "drawn.place")
    assert labels["compliance"]["x"]["name"].startswith("torque of the load on q")
    assert labels["backlash"]["x"]["name"].startswith("direction")
    assert labels["backlash"]["y"]["unit"] == "rad"
    kept = arrays["held_out"] > 0
    assert torch.equal(arrays["residual"][kept], pose_residual(rows, poses)[kept])
    # What is left is the noise, in both coordinates that the machine moves in, and nothing in the third.
    left = arrays["remainder"][kept]
    assert bool((left[:, 2] == 0).all()) and 0.8 * NOISE < float(left[:, :2].square().mean().sqrt()) < 1.4 * NOISE
    for name in labels:
        y, fit = (arrays[f"signature.{name}.{part}"][kept] for part in ("y", "fit"))
        assert float(torch.corrcoef(torch.stack([y, fit]))[0, 1]) > (0.9 if name == "backlash" else 0.6)


def test_a_driver_outside_the_library_is_drawn_and_no_effect() -> None:
    rows = rows_of("five_bar", 200, 0)
    found = diagnose_rows(rows, measured(rows, {"thermal": 12.0}, 1), None, ["geometry", "compliance", "backlash"])
    arrays, labels = picture_arrays(found)
    assert found.verdict["outside_library"] and set(labels) == {"temperature"}
    assert labels["temperature"]["x"] == {"name": "temperature", "unit": "K"}
    assert torch.equal(arrays["signature.temperature.x"], rows.covariates["temperature"])
    # Nothing that the library has is taken off, so all of the gap is left.
    assert torch.allclose(arrays["remainder"], arrays["residual"])


def test_an_arm_is_drawn_in_its_own_frame_wherever_the_measuring_device_stands() -> None:
    arm = load_mechanism(str(ARM)).with_orientation("none")
    values = arm.nominal.clone()
    values[:6] = torch.tensor([2.0, -1.0, 0.4, 0.0, 0.0, 1.2], dtype=torch.float64)
    joints = arm.sample_joints(60, torch.Generator().manual_seed(0))
    away = Situation(arm, joints, {}, default_gravity(arm), values)
    nearby = Situation(arm, joints, {}, default_gravity(arm))
    off = torch.zeros_like(joints)
    off[:, 1] = 4e-4
    drawn = []
    for rows in (away, nearby):
        noise = torch.randn(60, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
        found = diagnose_rows(
            rows, reached(replace(rows, joints=joints + off), [])[:, :3] + 1e-6 * noise, None, ["joint_offset"]
        )
        drawn.append((found, picture_arrays(found)[0]))
    (there, far), (here, near) = drawn
    assert torch.allclose(far["place"], near["place"], atol=2e-5)
    assert torch.allclose(far["residual"], near["residual"], atol=2e-5)
    assert torch.equal(far["drawn.line.link 2"], near["drawn.line.link 2"]) and "drawn.line.tool" in far
    for one, other in zip(there.where["regions"], here.where["regions"], strict=True):
        assert one["center"] == pytest.approx(other["center"], abs=1e-4) and one["rows"] == other["rows"]
