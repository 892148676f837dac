"""Machines of whose pose a part was measured: heights of a probed bed, a reflector, fewer coordinates than joints."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from ccnn_torch import diagnose
from ccnn_torch.api import identify
from ccnn_torch.errors import InputError
from ccnn_torch.identification.problems.poses import compares_poses
from ccnn_torch.mechanisms import Mechanism, Partial, load_mechanism
from ccnn_torch.records import load_records, write_table

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
    values, held_out = found.mechanism().nominal, found.results["test"]["position"]
    assert 0.7 * NOISE < held_out["after"] < 1.5 * NOISE < 3e-5 < held_out["before"]
    elsewhere = nominal.solve_inverse(_bed(200, 7), truth)
    before, after = (nominal.forward_kinematics(elsewhere, v)[:, 2] for v in (nominal.nominal, values))
    assert float(before.std()) > 3e-5
    # Twenty-one numbers from 140 rows.
    assert float(after.square().mean().sqrt()) < 0.7 * NOISE


@pytest.mark.parametrize("seed", [1, 2])
def test_wrong_lengths_are_found_in_the_heights_of_a_bed(tmp_path: Path, seed: int) -> None:
    """All rows are at one height: that which was measured is their noise, and nothing that an error could follow."""
    nominal, truth = _printer()
    joints = nominal.solve_inverse(_bed(60, 10 + seed), truth)
    noise = NOISE * torch.randn(60, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    columns = {f"q{k + 1}[m]": joints[:, k].numpy() for k in range(3)}
    write_table(tmp_path / "bed.csv", columns | {"z[m]": noise.numpy()})
    said = diagnose(
        load_records(tmp_path / "bed.csv", nominal), nominal, effects=["geometry", "joint_offset", "gravity"]
    )
    assert said.verdict["effects"] == ["geometry"] and not said.verdict["outside_library"], said.verdict
    assert said.verdict["probability"] > 0.8 and said.verdict["shrink"] > 0.99


def test_commands_of_a_verdict_about_heights_alone_go_to_x_and_y_as_well(
    cli: Callable[..., tuple[int, str, str]], tmp_path: Path
) -> None:
    nominal, _ = _printer()
    truth = nominal.nominal.clone()
    truth[[p.name for p in nominal.geometry].index("rod1")] += 2e-3
    joints = nominal.solve_inverse(_bed(80, 0), truth)
    noise = NOISE * torch.randn(80, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    table = {f"q{k + 1}[m]": joints[:, k].numpy() for k in range(3)} | {"z[m]": noise.numpy()}
    write_table(tmp_path / "bed.csv", table)
    config = f"records: {tmp_path / 'bed.csv'}\nmechanism: delta_linear\nmechanism_keys: {KEYS}\n"
    (tmp_path / "c.yaml").write_text(config)
    said = cli("diagnose", "--config", tmp_path / "c.yaml", "--no-network", "--out", tmp_path / "d")
    assert said[0] == 0, said
    wanted = _bed(20, 3)
    write_table(tmp_path / "t.csv", dict(zip(("x[m]", "y[m]", "z[m]"), wanted.T.numpy(), strict=True)))
    made = cli("compensate", tmp_path / "d/diagnosis.json", tmp_path / "t.csv", tmp_path / "c.csv", "--pose")
    assert made[0] == 0, made
    sent = np.genfromtxt(tmp_path / "c.csv", delimiter=",", names=True, deletechars="")
    commands = torch.tensor(np.stack([sent[f"command_q{k}[m]"] for k in (1, 2, 3)], -1))
    before, after = (nominal.forward_kinematics(q, truth) - wanted for q in (nominal.solve_inverse(wanted), commands))
    # Heights show less of x and y; commands once went to the middle of the bed, whatever was wanted.
    assert float(after[:, :2].abs().max()) < 4e-3
    assert float(after[:, 2].square().mean()) < 0.2**2 * float(before[:, 2].square().mean())


def test_poses_are_compared_where_the_joints_of_a_pose_are_not_unique() -> None:
    delta = load_mechanism("delta_linear")
    assert not compares_poses(delta) and compares_poses(Partial(delta, ["z"]))


def test_the_default_tolerance_fits_machines_without_angles(tmp_path: Path) -> None:
    joints = load_mechanism("tripod").sample_joints(12, torch.Generator().manual_seed(0))
    columns = {f"q{k + 1}[m]": joints[:, k].numpy() for k in range(3)}
    write_table(tmp_path / "few.csv", columns | {"anchor[1]": 0 * columns["q1[m]"], "distance[m]": columns["q1[m]"]})
    found = identify(
        mechanism="tripod", records=str(tmp_path / "few.csv"), constraint={"kind": "distances"}, refit=False
    )
    assert found.results["constraint"]["kind"] == "distances"


def _marks(machine: Mechanism, truth: Tensor, seed: int) -> tuple[Tensor, Tensor]:
    """Joints that the controller sends to marks on the bed, and where the true machine then is."""
    joints = machine.solve_inverse(_bed(8, seed))
    return joints, machine.forward_kinematics(joints, truth)


def test_heights_and_distances_in_one_fit_make_the_bed_flat_and_parts_of_the_right_size(tmp_path: Path) -> None:
    """Forty heights of the bed and eight distances between places that the machine printed itself."""
    nominal, truth = _printer()
    generator = torch.Generator().manual_seed(5)
    probed = nominal.solve_inverse(_bed(40, 2), truth)
    (one, here), (two, there) = _marks(nominal, truth, 3), _marks(nominal, truth, 4)
    noise = torch.randn(48, generator=generator, dtype=torch.float64)
    heights = {f"q{k + 1}[m]": probed[:, k].numpy() for k in range(3)} | {"z[m]": 1e-5 * noise[:40].numpy()}
    pairs = {f"q{k + 1}{end}[m]": q[:, k].numpy() for end, q in (("", one), ("_b", two)) for k in range(3)}
    pairs["distance[m]"] = ((here - there).norm(dim=-1) + 2e-5 * noise[40:]).numpy()
    write_table(tmp_path / "bed.csv", heights)
    write_table(tmp_path / "marks.csv", pairs)
    keys = {"records": str(tmp_path / "marks.csv"), "mechanism": "delta_linear", "mechanism_keys": KEYS}
    beside = [{"kind": "pose", "records": str(tmp_path / "bed.csv"), "noise": "10 um"}]
    constraint = {"kind": "distances", "tolerance": {"m": "1 mm", "rad": "5 mrad"}, "beside": beside}
    found = identify(**keys, noise="20 um", split={"test": 0.2}, constraint=constraint)
    with pytest.raises(InputError, match="has distances between two places, q1_b …, which no anchor"):
        identify(**keys, constraint={"kind": "distances", "by": ["q1"]})
    block = found.results["constraint"]["readings"]["z"]
    assert block["rows"] == 40 and block["noise_known"] and block["after"] < 1.5e-5 < 1e-4 < block["before"]
    assert found.results["constraint"]["beside"][0]["after"] == block["after"]
    assert found.results["rows"] == {"train": 46, "per_leg": {}, "test": 2}
    found.save(tmp_path / "out")
    told = (tmp_path / "out" / "identified.md").read_text()
    assert "| z [µm] | 40 |" in told and "| given |" in told
    elsewhere = _bed(60, 9)

    def made(machine: Mechanism) -> tuple[float, float]:
        """Spread of the heights, and RMS of what distances are off by, where this machine's commands lead."""
        reached = nominal.forward_kinematics(machine.solve_inverse(elsewhere), truth)
        apart, wanted = ((p[:30] - p[30:]).norm(dim=-1) for p in (reached, elsewhere))
        return float(reached[:, 2].std()), float((apart - wanted).square().mean().sqrt())

    before, after = made(nominal), made(found.mechanism())
    assert after[0] < 1e-5 < 3e-5 < before[0]
    assert after[1] < 6e-5 < 1.2e-4 < before[1], (before, after)
