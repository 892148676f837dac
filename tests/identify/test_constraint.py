"""`ccnn identify` without a measuring device: sockets, distances, planes; and what it refuses."""

import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np
import pytest
import torch
from frozen import frozen

from ccnn_torch.cli import main
from ccnn_torch.compensation import load_compensation
from ccnn_torch.config.keys import list_keys
from ccnn_torch.errors import InputError
from ccnn_torch.identification import tool_points
from ccnn_torch.identification.config import IdentifyConfig
from ccnn_torch.identification.identify import Identification, identify
from ccnn_torch.mechanisms import load_mechanism
from ccnn_torch.records import read_table, write_table

EXPERIMENTS = Path(__file__).parents[2] / "experiments"
SOCKETS, DATA, ARM = (EXPERIMENTS / n for n in ("sockets.yaml", "data/sockets.csv", "data/sockets_arm.yaml"))
NOISE = 2e-5
"""Of each coordinate of the rows in `sockets.csv`, as its description says."""


def joints_of(path: Path) -> torch.Tensor:
    table = read_table(path)
    return torch.stack([torch.from_numpy(table.column(f"q{i}", "rad")) for i in range(1, 7)], dim=-1)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished folder of the shipped example, made by the command."""
    path = tmp_path_factory.mktemp("sockets") / "out"
    with pytest.MonkeyPatch.context() as patch, pytest.raises(SystemExit) as ended:
        patch.setattr(sys, "argv", ["ccnn", "identify", str(SOCKETS), "--out", str(path), "--quiet"])
        main()
    assert not ended.value.code
    return path


def test_the_folder_has_everything(folder: Path) -> None:
    names = {p.name for p in folder.iterdir()}
    assert names >= {"identified.json", "identified.csv", "identified.md", "identified.yaml", "report.html"}
    assert {p.stem for p in (folder / "plots").glob("*.svg")} >= {"pose_error", "parameters"}
    results = json.loads((folder / "identified.json").read_text())
    jsonschema.validate(results, frozen("identified"))
    assert results["rows"] == {"train": 84, "per_leg": {}, "test": 36}
    assert [p["rows"] for p in results["constraint"]["placements"]] == [40, 40, 40]
    assert {"plate0_x", "plate2_turn2", "plate_scale"} <= set(results["constraint"]["unknowns"])
    page = (folder / "report.html").read_text()
    assert "where the other rows of its socket put the tool" in page and "What held the tool (sockets)" in page
    lines = (folder / "identified.csv").read_text().splitlines()
    assert any(line.startswith("constraint,plate0_x,sd,m,") for line in lines)


def test_held_out_rows_come_close_to_the_noise(folder: Path) -> None:
    results = json.loads((folder / "identified.json").read_text())
    test = results["test"]["position"]
    # Three coordinates of noise, and a tenth more for parameters and for the mean of 14 rows: no fit can do better.
    assert test["after"] < 1.25 * 3**0.5 * NOISE
    assert test["before"] > 10 * test["after"]
    assert test["max_after"] < 5 * NOISE
    assert results["test"]["rotation"] is None
    assert results["constraint"]["noise"] == pytest.approx(NOISE, rel=0.15)
    assert results["noise_ratio"]["value"] == pytest.approx(1, rel=1e-3)


def test_held_out_rows_are_judged_as_a_naive_twin_does(
    folder: Path, cli: Callable[..., tuple[int, str, str]], tmp_path: Path
) -> None:
    """Means of the training rows of each socket, rows drawn by numpy, from the files alone."""
    words = ("refit=false", "save_report=false", "--out", str(tmp_path / "judged"), "--quiet")
    assert cli("identify", str(SOCKETS), *words)[0] == 0
    arm = load_mechanism(str(tmp_path / "judged" / "identified.yaml"))
    points = tool_points(arm, joints_of(DATA)).numpy()
    table = read_table(DATA)
    cells = list(zip(table.raw("placement"), table.raw("socket"), strict=True))
    order = np.random.default_rng(0).permutation(120)
    train, held = order[:84], order[84:]
    far = []
    for row in held:
        mates = [points[i] for i in train if cells[i] == cells[row]]
        far.append(np.linalg.norm(points[row] - np.mean(mates, axis=0)))
    test = json.loads((folder / "identified.json").read_text())["test"]["position"]
    assert test["after"] == pytest.approx(np.sqrt(np.mean(np.square(far))), rel=1e-9)
    assert test["max_after"] == pytest.approx(max(far), rel=1e-9)


def test_what_rows_of_sockets_cannot_tell_has_no_interval(folder: Path) -> None:
    parameters = json.loads((folder / "identified.json").read_text())["parameters"]
    # Where the base stands and how it is turned, and what moves along with the ball.
    for name in ("d1", "theta1", "tool_z", "d6"):
        assert parameters[name]["free"] and not parameters[name]["identifiable"], name
    for name in ("alpha2", "theta3", "a3"):
        assert parameters[name]["identifiable"] and parameters[name]["sd"] < 5e-5, name
    assert not parameters["base_x"]["free"]


def test_the_machine_is_a_model_for_commands(folder: Path) -> None:
    model = load_compensation(folder / "identified.yaml")
    machine = model.machine
    assert machine is not None
    joints = joints_of(DATA)[:5]
    found = model(joints.numpy())
    assert found["inside_domain"].all()
    # Before: links nominal, the tool as it was fitted with them.
    wanted = tool_points(machine.nominal, joints)
    assert float((tool_points(machine.identified, joints) - wanted).norm(dim=-1).min()) > 1e-4
    reached = tool_points(machine.identified, torch.from_numpy(found["command"]))
    torch.testing.assert_close(reached, wanted, rtol=0, atol=1e-7)


def test_the_experiment_is_the_same_when_written_and_read_back(tmp_path: Path) -> None:
    config = IdentifyConfig.from_file(SOCKETS)
    (tmp_path / "config.yaml").write_text(config.to_yaml())
    assert IdentifyConfig.from_file(tmp_path / "config.yaml") == config
    assert {"constraint.kind", "constraint.where"} <= {key for key, _, _ in list_keys(IdentifyConfig)}


def simulated(kind: str, folder: Path) -> Identification:
    """80 rows of an arm 0.3 mm and 0.3 mrad off, held by two anchors or two planes; as many of another, broken one."""
    arm = load_mechanism(str(ARM), orientation="none")
    generator = torch.Generator().manual_seed(4)
    truth = arm.nominal + 3e-4 * torch.randn(arm.nominal.shape, generator=generator, dtype=torch.float64)
    truth[-6:-3] = torch.tensor([0.01, 0.02, 0.12])
    group = torch.arange(80) % 2
    place = torch.rand(80, 3, generator=generator, dtype=torch.float64) * 0.4 + torch.tensor([0.2, -0.2, 0.2])
    if kind == "plane":
        place[group == 0, 2] = 0.3 + 0.01 * place[group == 0, 2]
        place[group == 1, 0] = 0.4 + 0.01 * place[group == 1, 0]
    guess = 0.5 * torch.randn(80, 6, generator=generator, dtype=torch.float64) + torch.tensor(
        [0.3, 0.6, 0.9, 0, 0.8, 0]
    )
    joints = arm.nearest_joints(place, truth, guess, 1.0)
    points = tool_points(arm, joints, truth)
    anchors = torch.tensor([[0.9, 0.1, 0.0], [-0.1, 0.9, 0.6]], dtype=torch.float64)
    if kind == "distances":
        said, name, by = (points - anchors[group]).norm(dim=-1), "distance", "anchor"
    else:
        said, name, by = torch.where(group == 0, points[:, 2] - 0.3, points[:, 0] - 0.4), "reading", "plane"
    said = said + NOISE * torch.randn(80, generator=generator, dtype=torch.float64)
    columns: dict[str, Any] = {"robot[1]": np.repeat([1.0, 2.0], 80), f"{by}[1]": np.tile(group.numpy(), 2)}
    columns |= {f"q{i + 1}[rad]": np.tile(joints[:, i].numpy(), 2) for i in range(6)}
    columns |= {f"{name}[mm]": np.concatenate([1e3 * said.numpy(), np.full(80, 7.0)])}
    write_table(folder / "rows.csv", columns)
    constraint = {"kind": kind, "where": {"robot": 1}, "tolerance": {"m": "1 mm", "rad": 1e-3}}
    return identify(
        IdentifyConfig.from_keys(mechanism=str(ARM), records=str(folder / "rows.csv"), constraint=constraint)
    )


@pytest.mark.parametrize("kind", ["distances", "plane"])
def test_distances_and_planes_identify_too(kind: str, tmp_path: Path) -> None:
    found = simulated(kind, tmp_path)
    jsonschema.validate(json.loads(json.dumps(found.results)), frozen("identified"))
    test, constraint = found.results["test"]["position"], found.results["constraint"]
    assert found.results["rows"] == {"train": 56, "per_leg": {}, "test": 24}
    assert [place["rows"] for place in constraint["placements"]] == [40, 40]
    # 56 equations for some 27 directions: held-out rows have sqrt(1 + 27 / 56) of the noise and more.
    assert test["after"] < 3 * NOISE
    assert test["before"] > 5 * test["after"]
    assert constraint["noise"] < 2 * NOISE


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (["constraint.by=[plate]"], "constraint.by: .*sockets.csv has no column 'plate', which numbers the placement"),
        (["constraint.kind=socket"], "constraint.kind: must be 'sockets', 'distances', 'plane' or 'pose'"),
        (["constraint.kind=distances"], "plate_tolerance: a constraint of kind distances has no plate"),
        (["constraint.kind=distances", "constraint.plate_tolerance=null"], "there is no column 'distance'"),
        (["constraint={kind: distances}"], "no column 'anchor', which numbers the anchor of each row"),
        (["constraint.where={socket: 7}"], "no row of .*sockets.csv has socket = 7"),
        (["constraint.where={arm: 7}"], "constraint.where: .* has no column 'arm'"),
        (["split.test=0.97"], "split: .*none to identify from|cannot determine"),
        (["constraint.where={socket: 0}"], "plate_tolerance: a plate with a single socket has no scale"),
        (["split.test=0.93", "seed=2", "constraint={where: {socket: 0}}"], "none to identify from|cannot determine"),
        (["split.kind=block"], "split.kind: a constraint measures no positions"),
        (["split.kind=group", "split.by=[placement]"], "split: a socket of placement . has held-out rows but none"),
        (["methods=[hga]"], "methods: a constraint is identified by lm alone; write methods=\\[lm\\]"),
        (["frame={base: true}"], "frame.base: a constraint has no known place"),
        (["frame={tool: true}"], "frame.tool: an arm has a tool offset of its own"),
        (["constraint.tolerance=0"], "constraint.tolerance: 0 is no standard deviation"),
        (["constraint.tolerance={mm: 1}"], "constraint.tolerance.mm: there is no such name"),
        (["noise=0"], "noise: 0 is no standard deviation"),
    ],
)
def test_what_cannot_be_used_is_one_sentence(
    changes: list[str],
    message: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(sys, "argv", ["ccnn", "identify", str(SOCKETS), *changes, "--out", str(tmp_path / "out")])
    with pytest.raises(SystemExit) as ended:
        main()
    said = capsys.readouterr().err
    assert ended.value.code == 2
    assert len(said.splitlines()) == 1
    with pytest.raises(InputError, match=message):
        raise InputError(said)
    assert not (tmp_path / "out").exists()


def test_too_few_rows_are_refused(tmp_path: Path) -> None:
    lines = DATA.read_text().splitlines()
    (tmp_path / "few.csv").write_text("\n".join([lines[0], *lines[1:6:2]]) + "\n")
    config = IdentifyConfig.from_keys(
        mechanism=str(ARM), records=str(tmp_path / "few.csv"), constraint={}, split={"test": 0.4}
    )
    with pytest.raises(InputError, match="1 rows of 3 equations cannot determine 6 free parameters"):
        identify(config)


def test_given_noise_and_a_fixed_tool_are_kept() -> None:
    about = {"kind": "sockets", "tolerance": 1e-3, "plate_tolerance": 1e-5}
    fixed = identify(
        IdentifyConfig.from_keys(
            mechanism=str(ARM),
            records=str(DATA),
            constraint=about,
            noise="0.02 mm",
            parameters={"fixed": ["tool_*"], "prior": {"a3": 1e-7}},
        )
    )
    parameters = fixed.results["parameters"]
    assert fixed.results["constraint"]["noise"] == NOISE and fixed.results["constraint"]["noise_known"]
    assert parameters["tool_z"]["value"] == parameters["tool_z"]["nominal"] == 0
    assert abs(parameters["a3"]["value"] - parameters["a3"]["nominal"]) < 1e-6


def test_rows_of_another_machine_are_one_sentence() -> None:
    """The singular value decomposition behind a plate's start met NaN: joints of an arm have no pose of a five-bar."""
    config = IdentifyConfig.from_file(SOCKETS, ["mechanism=five_bar"])
    with pytest.raises(InputError, match="a column 'q3', and the machine has 2 joints"):
        identify(config)
    config = IdentifyConfig.from_file(SOCKETS, ["mechanism=five_bar", "columns={q3: ignore}"])
    with pytest.raises(InputError, match=r"row \d+: mechanism 'five_bar' .* is out of reach at q1 = "):
        identify(config)
