"""`ccnn identify` and `ccnn compensate` with what it wrote: files, resuming, exit codes."""

import json
import math
import shutil
from collections.abc import Callable
from pathlib import Path

import jsonschema
import pytest
import torch
from frozen import frozen

from ccnn_torch.compensation import load_compensation
from ccnn_torch.errors import InputError, ModelFileError
from ccnn_torch.identification.config import IdentifyConfig
from ccnn_torch.identification.identify import IDENTIFY
from ccnn_torch.identification.page import write_identified_report
from ccnn_torch.mechanisms import load_mechanism
from ccnn_torch.records import read_table, write_table

# Its figures are looked at.
DRAWN = True

CONFIG = """\
mechanism: five_bar
simulate: {machines: 3, poses: 20, noise: 1e-6, circle: true, test_poses: 12, counts: [16],
           design: planned_per_leg, candidates: 200}
methods: [lm, lm_per_leg, tikhonov]
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished folder of `ccnn identify`."""
    path = tmp_path_factory.mktemp("identify")
    (path / "bar.yaml").write_text(CONFIG)
    return IDENTIFY.start(IdentifyConfig.from_file(path / "bar.yaml", [f"out={path / 'out'}"]), quiet=True).path


def test_the_folder_has_everything(folder: Path) -> None:
    names = {p.name for p in folder.iterdir()}
    assert names >= {"config.yaml", "identified.json", "identified.csv", "identified.md", "identified.yaml"}
    assert names >= {"report.html", "plots", "arrays.safetensors", "methods"}
    results = json.loads((folder / "identified.json").read_text())
    jsonschema.validate(results, frozen("identified"))
    assert list(results["methods"]) == ["lm", "lm_per_leg", "tikhonov"]
    assert set(results["parameters"]["l1"]["spread"]) >= {"value", "sd"}
    assert [c["poses"] for c in results["counts"]] == [16]
    plots = {p.stem for p in (folder / "plots").glob("*.svg")}
    assert plots == {"machine", "pose_error", "parameters"}
    page = (folder / "report.html").read_text()
    assert page.count("<figure") == len(plots) and page.index('id="machine"') < page.index("What is known")
    assert "http" not in page.replace("http://www.w3.org", "")
    csv = (folder / "identified.csv").read_text().splitlines()
    assert csv[0] == "subject,name,quantity,unit,value,low,high"
    assert any(line.startswith("parameter,l1,sd,m,") for line in csv)


def test_a_report_needs_its_arrays(folder: Path, tmp_path: Path) -> None:
    shutil.copy(folder / "identified.json", tmp_path)
    with pytest.raises(InputError, match=r"arrays\.safetensors is "):
        write_identified_report(tmp_path)


def test_an_interrupted_one_goes_on_behind_the_last_method(folder: Path, tmp_path: Path) -> None:
    stopped = tmp_path / "stopped"
    shutil.copytree(folder, stopped)
    (stopped / "identified.json").unlink()
    (stopped / "methods" / "tikhonov.safetensors").unlink()
    config = (stopped / "config.yaml").read_text()
    (stopped / "config.yaml").write_text(config.replace("save_report: true", "save_report: false"))
    kept = (stopped / "methods" / "lm.safetensors").read_bytes()
    IDENTIFY.resume(stopped, quiet=True)
    assert (stopped / "methods" / "lm.safetensors").read_bytes() == kept
    first, second = (json.loads((f / "identified.json").read_text()) for f in (folder, stopped))
    for results in (first, second):
        results["methods"]["tikhonov"].pop("seconds")
    assert first == second
    finished = (stopped / "identified.json").read_bytes()
    IDENTIFY.resume(stopped, quiet=True)
    assert (stopped / "identified.json").read_bytes() == finished


def test_changed_data_and_damaged_files_are_refused(folder: Path, tmp_path: Path) -> None:
    other = tmp_path / "other"
    shutil.copytree(folder, other)
    (other / "identified.json").unlink()
    config = (other / "config.yaml").read_text()
    (other / "config.yaml").write_text(config.replace("seed: 0", "seed: 1"))
    with pytest.raises(InputError, match=r"config\.yaml: seed is 1, the checkpoint was made with seed 0"):
        IDENTIFY.resume(other, quiet=True)
    (other / "config.yaml").write_text(config)
    (other / "methods" / "lm.safetensors").write_bytes(b"12345678")
    with pytest.raises(InputError, match=r"lm\.safetensors: this checkpoint cannot be read"):
        IDENTIFY.resume(other, quiet=True)
    with pytest.raises(InputError, match="nothing to resume"):
        IDENTIFY.resume(tmp_path / "empty", quiet=True)


def test_a_folder_whose_data_cannot_be_used_is_free_again(tmp_path: Path) -> None:
    (tmp_path / "bar.yaml").write_text("mechanism: five_bar\nsimulate: {poses: 2}\n")
    config = IdentifyConfig.from_file(tmp_path / "bar.yaml", [f"out={tmp_path / 'out'}"])
    with pytest.raises(InputError, match="cannot determine"):
        IDENTIFY.start(config, quiet=True)
    assert not (tmp_path / "out").exists()


def test_commands_by_identified_geometry_are_exact_and_lead_back(folder: Path) -> None:
    model = load_compensation(folder / "identified.json")
    nominal, real = load_mechanism("five_bar"), load_mechanism(str(folder / "identified.yaml"))
    assert not torch.equal(nominal.nominal, real.nominal)
    wanted = nominal.sample_workspace(30, torch.Generator().manual_seed(0))
    wanted = wanted[(wanted - nominal.home_pose).norm(dim=-1) < 0.5]
    ideal = nominal.solve_inverse(wanted)
    found = model(ideal)
    assert found["inside_domain"].all()
    reached = real.forward_kinematics(torch.from_numpy(found["command"]))
    near = found["status"] == 0
    assert near.mean() > 0.9
    torch.testing.assert_close(reached[near], wanted[near], rtol=0, atol=1e-9)
    again = model(found["command"])
    near &= again["ideal_status"] == 0
    assert near.mean() > 0.9
    torch.testing.assert_close(torch.from_numpy(again["ideal"])[near], ideal[near], rtol=0, atol=1e-8)
    torch.testing.assert_close(torch.from_numpy(found["command"] + found["deviation"]), ideal, rtol=0, atol=1e-15)


def test_what_cannot_be_reached_comes_back_as_it_was(folder: Path) -> None:
    model = load_compensation(folder / "identified.yaml")
    far = [[math.pi, 0.0], [float("nan"), 1.0]]  # the couplers do not meet
    found = model(far)
    assert not found["inside_domain"].any() and found["status"].tolist() == [3, 2]
    assert found["command"][0].tolist() == far[0]
    # The left crank inward, another working mode: as much the same machine.
    command = torch.from_numpy(model([0.0, 0.0])["command"])
    nominal, real = load_mechanism("five_bar"), load_mechanism(str(folder / "identified.yaml"))
    wanted = nominal.forward_kinematics(torch.zeros(2, dtype=torch.float64))
    torch.testing.assert_close(real.forward_kinematics(command), wanted, rtol=0, atol=1e-9)
    with pytest.raises(InputError, match=r"takes the joints q1\[rad\], q2\[rad\]"):
        model([1.0, 2.0, 3.0])


def test_the_command_line(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, cli: Callable[..., tuple[int, str, str]]
) -> None:
    def ccnn(*words: object) -> tuple[int, str]:
        code, _, told = cli(*words)
        return code, told

    monkeypatch.chdir(tmp_path)
    poses = load_mechanism("five_bar").sample_workspace(9, torch.Generator().manual_seed(2)) * 0.3
    poses[:, 1] += 0.8
    write_table(tmp_path / "in.csv", {"x[mm]": 1e3 * poses[:, 0].numpy(), "y[mm]": 1e3 * poses[:, 1].numpy()})
    assert ccnn("compensate", folder / "identified.yaml", "in.csv", "out.csv", "--pose") == (0, "")
    table = read_table(tmp_path / "out.csv")
    command = torch.stack([torch.from_numpy(table.column(f"command_q{i}", "rad")) for i in (1, 2)], dim=-1)
    reached = load_mechanism(str(folder / "identified.yaml")).forward_kinematics(command)
    torch.testing.assert_close(reached, poses, rtol=0, atol=1e-9)
    code, said = ccnn("compensate", folder / "identified.yaml", "in.csv", "out.csv", "--pose", "--sd")
    assert code == 2 and "has no standard deviation" in said
    code, said = ccnn("identify", folder / "config.yaml", "methods=lm_pr_leg", "--out", "x")
    assert code == 2 and len(said.splitlines()) == 1 and "did you mean 'lm_per_leg'" in said
    code, said = ccnn("identify", "mechanism=five_bar", "records=in.csv", "--out", "x")
    assert code == 2 and len(said.splitlines()) == 1 and "in.csv" in said and "there is no such file" not in said
    code, said = ccnn("identify", "--resume", folder, "seed=3")
    assert code == 2 and len(said.splitlines()) == 1
    assert ccnn(
        "identify", folder / "config.yaml", "save_report=false", "--quiet", "--out", "again", "--seed", "7"
    ) == (0, "")
    assert json.loads((tmp_path / "again" / "identified.json").read_text())["seed"] == 7


def test_a_file_that_is_no_identified_machine_is_refused(tmp_path: Path) -> None:
    (tmp_path / "dh.yaml").write_text("dof: 6\n")
    for name in ("dh.yaml", "missing.yaml", "missing.json"):
        with pytest.raises(ModelFileError, match=r"there is no (identified machine|such file)"):
            load_compensation(tmp_path / name)
