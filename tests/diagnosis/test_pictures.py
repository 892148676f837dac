"""The arrays behind the pictures: rows add up, and what gives an effect away is found."""

from __future__ import annotations

import torch
from _machines import NOISE, measured, rows_of

from ccnn_torch.diagnosis import diagnose_rows
from ccnn_torch.diagnosis.page.arrays import picture_arrays
from ccnn_torch.effects import pose_residual


def test_two_causes_are_drawn_against_what_drives_each() -> None:
    rows = rows_of("five_bar", 160, 0)
    poses = measured(rows, {"compliance": 10.0, "backlash": 8.0}, 1)
    found = diagnose_rows(rows, poses)
    arrays, labels = picture_arrays(found)
    assert set(labels) == {"compliance", "backlash"} == set(found.verdict["effects"])
    assert all(value.dtype == torch.float64 and bool(value.isfinite().all()) for value in arrays.values())
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
