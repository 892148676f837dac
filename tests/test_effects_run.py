"""`effects: from:diagnosis.json`: simulated, diagnosed, compensated; and the effects in the files of a run."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np
import pytest
import torch
from frozen import frozen
from module_graph import to_onnx
from torch import Tensor, nn
from typer.testing import CliRunner

from ccnn_torch import calibrate
from ccnn_torch.calibration.config import RunConfig
from ccnn_torch.calibration.page import verdict
from ccnn_torch.calibration.prepare import over_all_rows, prepare
from ccnn_torch.cli.application import app
from ccnn_torch.compensation import PhysicalEffects, expand_effects, load_model
from ccnn_torch.compensation.model_files.metadata import open_onnx
from ccnn_torch.diagnosis.from_file import Verdict, read_verdict
from ccnn_torch.effects import Acting, Effect, Situation, default_gravity, make_effect
from ccnn_torch.effects.covariates import draw_covariates
from ccnn_torch.errors import InputError
from ccnn_torch.mechanisms import load_mechanism
from ccnn_torch.records import read_table, write_table
from ccnn_torch.report.json_files import plain

Cli = Callable[..., tuple[int, str, str]]
ARM = str(Path(__file__).parent / "effects" / "arm.yaml")
NOISE = 5e-6


@pytest.fixture(scope="module")
def played(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A five-bar with wrong gains and compliance away from singular poses: records, diagnosis and a config."""
    folder = tmp_path_factory.mktemp("then")
    runner = CliRunner()
    words = ["--mechanism", "five_bar", "--effect", "compliance", "--effect", "joint_gain", "--rows", "160"]
    words += ["--noise", str(NOISE), "--seed", "3", "--out", str(folder / "rows.csv"), "--quiet"]
    assert runner.invoke(app, ["simulate", *words]).exit_code == 0
    table, bar = read_table(folder / "rows.csv"), load_mechanism("five_bar")
    joints = torch.as_tensor(np.stack([table.column(q, "rad") for q in ("q1", "q2")], -1))
    fine = (bar.condition_number(joints, 0.04) < 4).numpy()
    assert fine.sum() > 100
    write_table(folder / "rows.csv", {f"{n}[{table.units[n]}]": table.raw(n)[fine] for n in table.names})
    words = [
        "--records",
        str(folder / "rows.csv"),
        "--mechanism",
        "five_bar",
        "--out",
        str(folder / "found"),
        "--no-network",
        "--quiet",
    ]
    words += ["--effects", "compliance,joint_gain,backlash,gravity,drift"]
    assert runner.invoke(app, ["diagnose", *words]).exit_code == 0
    text = "records: rows.csv\nmechanism: five_bar\nmethods: [gp]\neffects: from:found/diagnosis.json\n"
    (folder / "config.yaml").write_text(text, encoding="utf-8")
    return folder


def keys(played: Path, **more: Any) -> dict[str, Any]:
    found = f"from:{played / 'found' / 'diagnosis.json'}"
    return {
        "records": str(played / "rows.csv"),
        "mechanism": "five_bar",
        "methods": ["constant"],
        "effects": found,
    } | more


def test_held_out_rows_come_near_the_noise(played: Path) -> None:
    told = json.loads((played / "found" / "diagnosis.json").read_text(encoding="utf-8"))
    jsonschema.validate(told, frozen("diagnosis"))
    assert sorted(told["verdict"]["effects"]) == ["compliance", "joint_gain"]
    found = calibrate(**keys(played, repeats=2))
    pose = found.results["pose"]["position"]
    before, alone, after = (pose[key]["rms"]["median"] for key in ("before", "effects", "after"))
    floor = 2**0.5 * NOISE
    assert before > 30 * floor
    assert alone < 1.6 * floor and after < 1.6 * floor
    block = found.results["effects"]
    assert block["test"]["q1"]["mse"]["median"] < 0.01 * before**2
    # Of each repeat's own training rows, near the file's, which saw all rows.
    gain = block["coefficients"]["joint_gain"]["q1"]["values"]
    given = next(e for e in told["effects"] if e["name"] == "joint_gain")["parameters"]["q1"]["value"]
    assert gain[0] != gain[1] and gain == pytest.approx([given] * 2, rel=0.02)
    assert any("fitted anew to the training rows" in note for note in found.results["notes"])
    jsonschema.validate(json.loads(json.dumps(plain(found.results))), frozen("results"))
    # The compensator, effects and network in it, does so on held-out rows inside its domain.
    prepared, made = found.prepared, found.compensator()
    k = found.repeat()
    test = prepared.dataset.splits[k].test
    joints, covariates = prepared.joints[k, test], prepared.covariates[k, test]
    # It asks for the columns alone that an effect uses.
    assert [c.name for c in made.covariates] == ["load_x", "load_y"]
    covariates = covariates[:, [c.name.startswith("load") for c in prepared.covariate_coordinates]]
    bar, told_of = found.mechanism(), made.solve(joints, covariates)
    left = bar.pose_error(prepared.pose[k, test], bar.forward_kinematics(told_of.ideal)).position
    inside = told_of.ideal_inside_domain
    assert int(inside.sum()) > 15 and float(left[inside].square().mean().sqrt()) < 1.6 * floor


def test_held_out_rows_do_not_change_the_coefficients(played: Path, tmp_path: Path) -> None:
    first = prepare(RunConfig.from_keys(**keys(played)))
    assert first.physics is not None
    lines = (played / "rows.csv").read_text(encoding="utf-8").splitlines()
    for row in first.dataset.splits[0].test.tolist():
        cells = lines[row + 1].split(",")
        cells[2] = str(float(cells[2]) + 1e-3)
        lines[row + 1] = ",".join(cells)
    (tmp_path / "rows.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")
    other = prepare(RunConfig.from_keys(**keys(played, records=str(tmp_path / "rows.csv"), split={"kind": "random"})))
    assert other.physics is not None
    assert torch.equal(first.dataset.splits[0].test, other.dataset.splits[0].test)
    assert first.physics.block() == other.physics.block()


def test_effects_of_the_saved_model_are_searched_in_all_rows(played: Path) -> None:
    prepared = prepare(RunConfig.from_keys(**keys(played, geometry="none", effects=["compliance", "joint_gain"])))
    source = prepared.source
    assert source is not None and source.search is not None and source.verdict is not None
    assert {name for name, _ in source.verdict.effects} == {"compliance", "joint_gain"}
    every = torch.arange(len(source.records))
    again = over_all_rows(prepared)
    assert again.physics is not None and bool(again.physics.rows.all())
    searched = source.search(every)[0]
    assert searched is not None and again.source is not None and again.source.verdict is not None
    assert again.source.verdict.effects == searched.effects
    # Where all rows show nothing the effects of the training rows stay.
    alone = replace(prepared, source=source._replace(search=lambda rows: (None, [])))
    kept = over_all_rows(alone).source
    assert kept is not None and kept.verdict is source.verdict
    # A file's effects are what was asked for.
    given = prepare(RunConfig.from_keys(**keys(played))).source
    assert given is not None and given.search is None


def test_the_network_learns_what_is_left_exactly(played: Path) -> None:
    found = prepare(RunConfig.from_keys(**keys(played)))
    assert found.physics is not None
    usable = found.dataset.usable[0]
    reached = found.physics.poses(0, found.joints[0] + found.dataset.deviation[0])
    torch.testing.assert_close(reached[usable], found.pose[0][usable], rtol=0, atol=1e-8)


def test_with_identified_geometry_beside_it(played: Path) -> None:
    found = prepare(RunConfig.from_keys(**keys(played, geometry="identify")))
    assert found.physics is not None
    left, usable = found.dataset.deviation, found.dataset.usable[0]
    assert not torch.equal(found.physics.values[0, 0], found.mechanism.nominal)
    reached = found.physics.poses(0, found.joints[0] + left[0])
    torch.testing.assert_close(reached[usable], found.pose[0][usable], rtol=0, atol=1e-8)
    test = found.dataset.splits[0].test
    assert float(left[0, test].square().mean().sqrt()) < 0.1 * float(found.total[0, test].square().mean().sqrt())


def test_a_run_from_the_command_line_and_its_files(cli: Cli, tmp_path: Path) -> None:
    rows, out = tmp_path / "rows.csv", tmp_path / "run"
    words = ("--mechanism", "five_bar", "--effect", "joint_gain", "--rows", "80", "--noise", "5e-6", "--seed", "3")
    assert cli("simulate", *words, "--out", rows, "--quiet")[0] == 0
    found = ("--effects", "joint_gain,backlash", "--no-network", "--out", tmp_path / "found", "--quiet")
    assert cli("diagnose", "--records", rows, *words[:2], *found)[0] == 0
    (tmp_path / "c.yaml").write_text("records: rows.csv\nmechanism: five_bar\nmethods: [constant]\n", encoding="utf-8")
    effects = f"effects=from:{tmp_path / 'found' / 'diagnosis.json'}"
    code, _, told = cli("run", tmp_path / "c.yaml", effects, f"out={out}", "save_report=false", "--quiet")
    assert code == 0, told
    results = json.loads((out / "results.json").read_text(encoding="utf-8"))
    pose = results["pose"]["position"]
    assert pose["after"]["rms"]["median"] < 1.3 * 2**0.5 * NOISE < 0.2 * pose["before"]["rms"]["median"]
    assert "effects + constant removes" in (out / "results.md").read_text(encoding="utf-8")
    card = json.loads((out / "card.json").read_text(encoding="utf-8"))
    assert card["format"] == "ccnn_torch compensator 8"
    assert set(card["machine"]["effects"]["numbers"]) == {"joint_gain"}
    # The effect looks at no column, so that the model asks for none.
    assert card["covariates"] == []
    assert any("double precision" in note for note in card["notes"])
    # Every form gives the commands of the master, and these reach the pose to the noise of the numbers.
    table = read_table(rows)
    master = load_model(out / "model.safetensors")
    joints = np.stack([table.column(c.name, c.unit) for c in master.joints], -1)
    wanted = master(joints)
    command = load_model(out / "model.onnx")(joints)["command"]
    np.testing.assert_allclose(command, wanted["command"], rtol=0, atol=1e-12)
    gain = torch.tensor([results["effects"]["coefficients"]["joint_gain"][q]["values"][0] for q in ("q1", "q2")])
    moved = (wanted["command"] + wanted["deviation"]) - joints
    assert np.abs(moved).max() < 1e-12 and (gain.abs() > 1e-4).all()


def test_a_killed_run_resumes_to_the_same(cli: Cli, played: Path, tmp_path: Path) -> None:
    quick = (
        "methods=bp_lm",
        "bp_lm.iterations=4",
        "bp_lm.restarts=1",
        "save_report=false",
        "save_models=false",
        "--quiet",
    )
    whole, cut = tmp_path / "whole", tmp_path / "cut"
    assert cli("run", played / "config.yaml", f"out={whole}", *quick)[0] == 0
    shutil.copytree(whole, cut)
    (cut / "results.json").unlink()
    assert cli("run", "--resume", cut, "--quiet")[0] == 0
    first, again = (json.loads((p / "results.json").read_text(encoding="utf-8")) for p in (whole, cut))
    assert first["pose"] == again["pose"] and first["effects"] == again["effects"]
    assert first["methods"]["bp_lm"]["test"] == again["methods"]["bp_lm"]["test"]


def test_a_learner_is_compared_on_geometry_alone_and_beside_effects(played: Path) -> None:
    """Effects that stand for others may leave what no learner makes anything of."""
    found = prepare(RunConfig.from_keys(**keys(played, effects="auto")))
    assert found.choice is not None
    for parts in ("identified geometry", "identified geometry + effects"):
        assert f"{parts} + learner " in found.choice.why


def usual(effect: Effect, situation: Situation) -> Tensor:
    """Shapes that a simulation takes."""
    values = [s.grid[len(s.grid) // 2] if s.usual is None else s.usual for s in effect.shapes(situation)]
    return torch.tensor(values, dtype=torch.float64)


@pytest.mark.parametrize(
    ("name", "effects"),
    [
        ("five_bar", ("compliance", "friction")),
        ("tripod", ("thermal", "frame")),
        ("machine_tool", ("thermal", "frame")),
        (ARM, ("compliance", "friction")),
    ],
)
def test_the_module_does_what_the_effects_do(name: str, effects: tuple[str, ...]) -> None:
    mechanism = load_mechanism(name)
    generator = torch.Generator().manual_seed(2)
    joints = mechanism.sample_joints(400, generator)
    joints = joints[mechanism.condition_number(joints, 0.3) < 25][:60]
    covariates = draw_covariates(mechanism, joints, generator)
    del covariates["time"]
    situation = Situation(mechanism, joints, covariates, default_gravity(mechanism))
    acting = []
    for effect in map(make_effect, effects):
        sizes = [0.0 if c.secondary else 0.1 * c.scale for c in effect.coefficients(situation)]
        acting.append(Acting(effect, usual(effect, situation), torch.tensor(sizes, dtype=torch.float64)))
    module = expand_effects(situation, acting, [*covariates], 0.1)
    given = torch.stack([*covariates.values()], -1)
    for found, kind in zip(module.changes(joints, given), ("joints", "pose"), strict=True):
        changes = [one.change(situation) for one in acting if one.effect.kind == kind]
        assert (found is None) == (not changes)
        if found is not None:
            exact = torch.stack(changes).sum(0)
            torch.testing.assert_close(found, exact, rtol=0, atol=1e-4 * float(exact.abs().max()))
    # Whatever comes in, what comes out is finite.
    odd = torch.cat([joints * 50, joints * 0 + 1e3])
    for found in module.changes(odd, given.repeat(2, 1) * 100):
        assert found is None or bool(torch.isfinite(found).all())


def test_an_exported_graph_has_the_numbers_of_the_effects() -> None:
    # 293.15 K and other numbers in their code are none that single precision could hold.
    bar, generator = load_mechanism("five_bar"), torch.Generator().manual_seed(4)
    joints = bar.sample_joints(60, generator)
    covariates = draw_covariates(bar, joints, generator)
    del covariates["time"]
    situation = Situation(bar, joints, covariates, default_gravity(bar))
    acting = []
    for effect in map(make_effect, ("thermal", "backlash")):
        sizes = [c.scale for c in effect.coefficients(situation)]
        acting.append(Acting(effect, usual(effect, situation), torch.tensor(sizes, dtype=torch.float64)))
    module = expand_effects(situation, acting, [*covariates], 0.1)
    given = torch.stack([*covariates.values()], -1)
    model = to_onnx(_Moved(module), {"joints": joints, "covariates": given}, ["moved"])
    session = open_onnx(model.SerializeToString())
    found = session.run(None, {"joints": joints.numpy(), "covariates": given.numpy()})[0]
    wanted = module.changes(joints, given)
    np.testing.assert_allclose(found, _Moved(module)(joints, given).numpy(), rtol=0, atol=1e-13)
    again = PhysicalEffects.from_description(json.loads(json.dumps(module.describe())))
    again.load_state_dict(module.state_dict())
    for one, other in zip(again.changes(joints, given), wanted, strict=True):
        assert (one is None and other is None) or torch.equal(one, other)


class _Moved(nn.Module):
    """What the effects add to the joints, as a module."""

    def __init__(self, effects: PhysicalEffects) -> None:
        super().__init__()
        self.effects = effects

    def forward(self, joints: Tensor, covariates: Tensor) -> Tensor:
        moved = self.effects.changes(joints, covariates)[0]
        assert moved is not None
        return moved


def edited(played: Path, tmp_path: Path, change: Callable[[dict[str, Any]], None]) -> str:
    told = json.loads((played / "found" / "diagnosis.json").read_text(encoding="utf-8"))
    change(told)
    (tmp_path / "diagnosis.json").write_text(json.dumps(told), encoding="utf-8")
    return f"from:{tmp_path / 'diagnosis.json'}"


def _rename(told: dict[str, Any]) -> None:
    entry = next(e for e in told["effects"] if e["name"] == "joint_gain")
    entry["parameters"]["q9"] = entry["parameters"].pop("q1")


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (lambda d: d["verdict"].update(effects=[], none=True), "verdict: none: the gap is no more than the noise"),
        (lambda d: d["verdict"].update(outside_library=True, effects=[]), "something is there that no effect"),
        (lambda d: d["verdict"].update(effects=["outlier"]), "bad rows are the only finding"),
        (lambda d: d["verdict"].update(effects=["wobble"]), "'wobble' is no effect of this version's library"),
        (lambda d: d["verdict"].update(effects=["drift"]), "effects, drift: needs the time of each row"),
        (lambda d: d["mechanism"].update(name="tripod"), "mechanism: was diagnosed on tripod"),
        (_rename, "joint_gain, parameters: 'q9' is no parameter of joint_gain on five_bar"),
        (lambda d: d.pop("verdict"), "is no diagnosis"),
    ],
)
def test_what_does_not_fit_is_one_sentence(
    played: Path, tmp_path: Path, change: Callable[[dict[str, Any]], None], sentence: str
) -> None:
    with pytest.raises(InputError, match=sentence) as caught:
        prepare(RunConfig.from_keys(**keys(played, effects=edited(played, tmp_path, change))))
    assert "\n" not in str(caught.value) and "diagnosis.json" in str(caught.value)


def test_keys_that_do_not_go_together(played: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="effects: a case is there to compare learners"):
        RunConfig.from_keys(case="tripod", effects="from:x.json")
    with pytest.raises(InputError, match=r"effects: is '.*diagnosis\.json'; write effects=from:"):
        RunConfig.from_keys(**keys(played, effects="found/diagnosis.json"))
    with pytest.raises(InputError, match=r"rows\.csv: compliance of .* a column of the load.*not among covariates"):
        prepare(RunConfig.from_keys(**keys(played, covariates=["time"])))
    table = read_table(played / "rows.csv")
    kept = {f"{n}[{table.units[n]}]": table.raw(n) for n in table.names if not n.startswith("load_")}
    write_table(tmp_path / "unloaded.csv", kept)
    sentence = r"unloaded\.csv: compliance of .*diagnosis\.json needs .*load_x.* there is no such column; add it"
    with pytest.raises(InputError, match=sentence):
        prepare(RunConfig.from_keys(**keys(played, records=str(tmp_path / "unloaded.csv"))))
    with pytest.raises(InputError, match="there is no such file"):
        prepare(RunConfig.from_keys(**keys(played, effects="from:nowhere.json")))
    for ends, sentence in (
        ({"load_q": [0, 1]}, "load_q: this run has no such covariate; did you mean 'load_"),
        ({"load_x": ["10 N", "-1 kN"]}, r"load_x: the lower end comes first, and \[10 N, -1 kN\] does not ascend"),
        ({"load_x": ["0 m", "1 m"]}, "load_x is in .m., a length, but must be a force"),
    ):
        with pytest.raises(InputError, match=rf"compensation\.ends\.{sentence}"):
            prepare(RunConfig.from_keys(**keys(played, compensation={"ends": ends})))
    # Without any effect nothing follows a covariate.
    told = {"ends": {"load_x": ["-1 kN", "1 kN"]}}
    made = calibrate(**keys(played, effects="none", geometry="none", compensation=told))
    assert made.compensator().machine is None


def test_it_says_that_no_growth_by_the_thermometers_pays(tmp_path: Path) -> None:
    machine, generator = load_mechanism("tripod"), torch.Generator().manual_seed(2)
    joints = machine.sample_joints(80, generator)
    pose = machine.forward_kinematics(joints) + 2e-6 * torch.randn(80, 3, generator=generator, dtype=torch.float64)
    warm = 293 + 5 * torch.rand(80, 2, generator=generator, dtype=torch.float64)
    columns = dict(zip(("temperature_base[K]", "temperature_rods[K]"), warm.numpy().T, strict=True))
    about = {"mechanism": "tripod", "methods": ["constant"], "geometry": "none", "effects": ["joint_gain", "thermal"]}
    told = "Thermal growth was tried with temperature_base, temperature_rods and does not pay."
    longer = machine.nominal * (1 + 1e-4 * (warm.mean(-1, keepdim=True) - 293))
    growth = machine.forward_kinematics(joints, longer) - machine.forward_kinematics(joints)
    for name, there in (("still", pose), ("grown", pose + growth)):
        rows = torch.cat([joints, there], -1).numpy().T
        headers = [c.header for c in (*machine.joints, *machine.pose)]
        write_table(tmp_path / f"{name}.csv", dict(zip(headers, rows, strict=True)) | columns)
        notes = prepare(RunConfig.from_keys(records=str(tmp_path / f"{name}.csv"), **about)).notes
        assert (told in notes) is (name == "still")
    # Nothing was told of temperatures, and nothing is said of them.
    write_table(tmp_path / "plain.csv", dict(zip(headers, torch.cat([joints, pose], -1).numpy().T, strict=True)))
    plain = prepare(RunConfig.from_keys(records=str(tmp_path / "plain.csv"), **about | {"effects": "auto"})).notes
    assert not any("Thermal" in note for note in plain)


def test_lengths_grow_on_beyond_the_temperatures_that_were_measured(cli: Cli, tmp_path: Path) -> None:
    """Half their range farther on both sides, and where `compensation.ends` says so up to there."""
    words = (
        "--effect",
        "thermal",
        "--rows",
        "60",
        "--noise",
        "2e-6",
        "--seed",
        "3",
        "--out",
        str(tmp_path / "rows.csv"),
    )
    assert cli("simulate", "--mechanism", "tripod", *words, "--quiet")[0] == 0
    about = {
        "records": str(tmp_path / "rows.csv"),
        "mechanism": "tripod",
        "methods": ["constant"],
        "effects": ["thermal"],
    }
    warmth = read_table(tmp_path / "rows.csv").column("temperature", "K")
    for told, ends in (
        (None, (warmth.min() - np.ptp(warmth) / 2, warmth.max() + np.ptp(warmth) / 2)),
        (270.0, (270, 320)),
    ):
        more = {} if told is None else {"compensation": {"ends": {"temperature": ["270 K", "320 K"]}}}
        made = calibrate(**about, **more).compensator()
        assert [c.name for c in made.covariates] == ["temperature"]
        found = torch.cat(made.ends).tolist()
        assert found == pytest.approx(ends, abs=1e-6)
        joints = made.domain.centre[None, :3].expand(3, -1)
        at = torch.tensor([[ends[0] - 9], [ends[0]], [ends[0] + 1]], dtype=torch.float64)
        colder, end, inner = made.solve(joints, at).deviation
        assert torch.allclose(colder, end, rtol=0, atol=1e-12) and not torch.allclose(end, inner, rtol=0, atol=1e-9)


def test_paths_start_where_the_key_stands(played: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    path = played / "config.yaml"
    assert RunConfig.from_file(path).effects == f"from:{played / 'found' / 'diagnosis.json'}"
    assert RunConfig.from_file(path, ["effects=from:d.json"]).effects == f"from:{tmp_path / 'd.json'}"


def test_a_lag_is_left_out_and_said(played: Path) -> None:
    config = RunConfig.from_keys(**keys(played, effects="none"))
    rows = prepare(config)
    names = [c.name for c in rows.covariate_coordinates]
    covariates = dict(zip(names, rows.covariates[0].unbind(-1), strict=True))
    situation = Situation(rows.mechanism, rows.joints[0], covariates, default_gravity(rows.mechanism))
    verdict = Verdict("d.json", None, (("thermal", {"growth": 1.1e-5, "lag": 900.0, "at once": 1e-6}),))
    known, notes = verdict.on(situation)
    assert len(notes) == 1 and "What thermal has of lag, at once comes from before" in notes[0]
    assert known[0].shape.shape == (0,) and float(known[0].coefficients[0]) == 1.1e-5
    bare = replace(situation, covariates={n: v for n, v in covariates.items() if n != "time"})
    assert len(known[0].coefficients) == len(known[0].effect.coefficients(bare))


def test_names_beside_something_outside_are_taken_and_the_rest_is_said(played: Path, tmp_path: Path) -> None:
    told = json.loads((played / "found" / "diagnosis.json").read_text(encoding="utf-8"))
    told["verdict"] |= {"outside_library": True, "driver": "workspace"}
    (tmp_path / "d.json").write_text(json.dumps(told), encoding="utf-8")
    verdict = read_verdict(tmp_path / "d.json", "five_bar", ["q1", "q2"])
    rows = prepare(RunConfig.from_keys(**keys(played, effects="none")))
    covariates = dict(zip([c.name for c in rows.covariate_coordinates], rows.covariates[0].unbind(-1), strict=True))
    situation = Situation(rows.mechanism, rows.joints[0], covariates, default_gravity(rows.mechanism))
    known, notes = verdict.on(situation)
    assert [k.effect.name for k in known] == told["verdict"]["effects"]
    assert any("left to the network" in note for note in notes)


def test_a_gross_outlier_is_not_learned_from_and_is_judged_where_it_is_held_out(played: Path, tmp_path: Path) -> None:
    table = read_table(played / "rows.csv")
    first = prepare(RunConfig.from_keys(**keys(played)))
    split = first.dataset.splits[0]
    wrong = [int(split.train[0]), int(split.test[0])]
    columns = {f"{n}[{table.units[n]}]": table.raw(n).copy() for n in table.names}
    columns["x[m]"][wrong] += 5e-3
    write_table(tmp_path / "rows.csv", columns)
    rows = prepare(RunConfig.from_keys(**keys(played, records=str(tmp_path / "rows.csv"))))
    flagged = torch.nonzero(rows.pseudoerror.reasons["outlier"][0]).squeeze(-1).tolist()
    assert flagged == wrong[:1]
    assert not bool(rows.dataset.usable[0, wrong[0]]) and bool(rows.dataset.usable[0, wrong[1]])
    assert any("misses them by more than ten times the usual" in note for note in rows.notes)
    results = calibrate(**keys(played, records=str(tmp_path / "rows.csv"))).results
    position = results["pose"]["position"]
    others = position["without_outliers"]
    assert others["rows"] == 1 and 10 * others["after"]["median"] < position["after"]["rms"]["median"]
    # What is told first is of the rows that say something of the model.
    left, right = (f"{1e6 * others[when]['median']:.3g}" for when in ("before", "after"))
    told = verdict(results)
    assert ", without 1 row far from every model, geometry + effects" in told and "; with it " in told
    assert told.index(f"({left} → {right} µm") < told.index("; with it ")


def test_rows_that_no_machine_takes_are_one_sentence(tmp_path: Path) -> None:
    """Joints in another unit: the search for effects has no row, either."""
    tripod = load_mechanism("tripod")
    pose = tripod.sample_workspace(40, torch.Generator().manual_seed(1))
    joints = tripod.solve_inverse(pose) * torch.tensor([1e-20, 1.0, 1.0], dtype=torch.float64)
    told = [*zip(tripod.joints, joints.mT, strict=True), *zip(tripod.pose, pose.mT, strict=True)]
    write_table(tmp_path / "rows.csv", {c.header: values.numpy() for c, values in told})
    with pytest.raises(InputError, match="40 of 40 rows are outside the reach of tripod"):
        calibrate(records=str(tmp_path / "rows.csv"), mechanism="tripod", methods=["constant"], geometry="none")
