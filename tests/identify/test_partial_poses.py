"""Machines of whose pose a part was measured: heights of a probed bed, a reflector, fewer coordinates than joints."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from ccnn_torch.api import identify
from ccnn_torch.errors import InputError
from ccnn_torch.identification.problems.poses import compares_poses
from ccnn_torch.mechanisms import Mechanism, Partial, load_mechanism
from ccnn_torch.records import write_table

KEYS: dict[str, Any] = {"base": 0.18, "platform": 0.05, "rod": 0.25}
NOISE = 5e-6


def _printer() -> tuple[Mechanism, Tensor]:
    """The nominal linear delta, and one whose rods, radii and endstops are off."""
    nominal = load_mechanism("delta_linear", **KEYS)
    truth = nominal.nominal.clone()
    names = [p.name for p in nominal.geometry]
    for name, error in {
        "rod1": 4e-4,
        "rod2": -3e-4,
        "rod3": 6e-4,
        "base1": 5e-4,
        "base2": -7e-4,
        "offset3": 3e-4,
    }.items():
        truth[names.index(name)] += error
    return nominal, truth


def _bed(count: int, seed: int) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    radius = 0.09 * torch.rand(count, generator=generator, dtype=torch.float64).sqrt()
    angle = 2 * torch.pi * torch.rand(count, generator=generator, dtype=torch.float64)
    return torch.stack([radius * torch.cos(angle), radius * torch.sin(angle), torch.zeros_like(radius)], -1)


def test_heights_of_a_bed_alone_make_it_flat_where_no_probe_was(tmp_path: Path) -> None:
    """Probed at z = 0: what the machine must command at its x, y to touch the bed. x and y are not measured."""
    nominal, truth = _printer()
    joints = nominal.solve_inverse(_bed(200, 0), truth)
    noise = NOISE * torch.randn(200, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    columns = {f"q{k + 1}[m]": joints[:, k].numpy() for k in range(3)}
    write_table(tmp_path / "bed.csv", columns | {"z[m]": noise.numpy()})
    keys = {"records": str(tmp_path / "bed.csv"), "mechanism": "delta_linear", "mechanism_keys": KEYS}
    found = identify(**keys, noise="5 um", seed=0)
    values = found.mechanism().nominal
    elsewhere = nominal.solve_inverse(_bed(200, 7), truth)
    before, after = (nominal.forward_kinematics(elsewhere, v)[:, 2] for v in (nominal.nominal, values))
    assert float(before.std()) > 3e-5
    # Twenty-one numbers from 140 rows.
    assert float(after.square().mean().sqrt()) < 0.7 * NOISE


def test_poses_are_compared_where_the_joints_of_a_pose_are_not_unique() -> None:
    delta = load_mechanism("delta_linear")
    assert not compares_poses(delta) and compares_poses(Partial(delta, ["z"]))


def test_the_default_tolerance_fits_machines_without_angles(tmp_path: Path) -> None:
    stewart = load_mechanism("stewart")
    joints = stewart.sample_joints(12, torch.Generator().manual_seed(0))
    columns = {f"q{k + 1}[m]": joints[:, k].numpy() for k in range(6)}
    write_table(tmp_path / "few.csv", columns | {"anchor[1]": 0 * columns["q1[m]"], "distance[m]": columns["q1[m]"]})
    with pytest.raises(InputError, match="rows of 1 equations cannot determine"):
        identify(mechanism="stewart", records=str(tmp_path / "few.csv"), constraint={"kind": "distances"})
