"""A Python file runs when a user names it on the command line, and not when a file from outside names it."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from stand_ins import fields, tripod_compensator

from ccnn_torch.compensation import load_compensation, load_model, save_model
from ccnn_torch.errors import InputError
from ccnn_torch.mechanisms import load_mechanism, mechanism_from_description
from ccnn_torch.mechanisms.mechanism_file import mechanism_text
from ccnn_torch.records import read_table, write_table

Cli = Callable[..., tuple[int, str, str]]
REFUSED = r"names Python code, .*own\.py:Own, which would run; .* allow it: --allow-code"


@pytest.fixture
def own(tmp_path: Path) -> Path:
    """A tripod of a user's own, whose file leaves a trace when it runs."""
    path = tmp_path / "own.py"
    path.write_text(
        "from pathlib import Path\n"
        "from ccnn_torch.mechanisms import Tripod\n\n"
        f"Path({str(tmp_path / 'ran')!r}).touch()\n\n\n"
        "class Own(Tripod):\n    pass\n"
    )
    return path


@pytest.fixture
def ran(tmp_path: Path) -> Callable[[], bool]:
    """Whether the file ran since it was last asked."""

    def asked() -> bool:
        trace = tmp_path / "ran"
        there = trace.exists()
        trace.unlink(missing_ok=True)
        return there

    return asked


@pytest.fixture
def identified(own: Path, ran: Callable[[], bool], tmp_path: Path) -> Path:
    mechanism = load_mechanism(f"{own}:Own")
    nominal = dict(zip([p.name for p in mechanism.geometry], mechanism.nominal.tolist(), strict=True))
    path = tmp_path / "identified.yaml"
    path.write_text(mechanism_text(mechanism.with_nominal(mechanism.nominal * 1.001), nominal))
    assert ran()
    return path


def test_an_identified_machine_runs_its_file_only_where_allowed(identified: Path, ran: Callable[[], bool]) -> None:
    for load in (load_compensation, lambda path: load_mechanism(str(path))):
        with pytest.raises(InputError, match=rf"identified\.yaml: its key 'mechanism' {REFUSED}"):
            load(identified)
    assert not ran()
    assert load_compensation(identified, allow_code=True)([1.0, 1.0, 1.0])["command"].shape == (3,)
    assert ran()
    load_mechanism(str(identified), allow_code=True)
    assert ran()


def test_a_file_cannot_allow_itself(identified: Path, own: Path, ran: Callable[[], bool]) -> None:
    text = identified.read_text()
    inner = json.dumps({"spec": f"{own}:Own", "keys": {}, "parameters": {}})
    for old, new in (
        ("keys: {}", "keys: {allow_code: true}"),
        (f"mechanism: {own}:Own\nkeys: {{}}", f"mechanism: framed\nkeys: {{mechanism: '{own}:Own', allow_code: true}}"),
        (f"mechanism: {own}:Own\nkeys: {{}}", f"mechanism: framed\nkeys: {{mechanism: {inner}}}"),
    ):
        assert old in text
        identified.write_text(text.replace(old, new))
        with pytest.raises(InputError, match=REFUSED):
            load_compensation(identified)
    assert not ran()


@pytest.mark.parametrize("other", ["other.yaml", "identified.yaml", "/etc/hostname", "arm.urdf", "no_such"])
def test_a_file_names_no_other_file(identified: Path, own: Path, tmp_path: Path, other: str) -> None:
    (tmp_path / "other.yaml").write_text(identified.read_text())
    text = identified.read_text()
    identified.write_text(text.replace(f"{own}:Own", str(tmp_path / other)))
    with pytest.raises(InputError, match=r"mechanism: must be one of tripod, .* not '.*"):
        load_compensation(identified)
    identified.write_text(
        text.replace(f"mechanism: {own}:Own\nkeys: {{}}", f"mechanism: framed\nkeys: {{mechanism: {tmp_path / other}}}")
    )
    with pytest.raises(InputError, match=r"mechanism: must be one of tripod, .* not '.*"):
        load_compensation(identified)


@pytest.mark.parametrize("keys", ["{1: 2}", "{per_leg: [[]]}", "{links: 3}", "{spec: tripod}", "{mechanism: {}}"])
@pytest.mark.parametrize("mechanism", ["tripod", "serial", "framed"])
def test_keys_of_any_kind_give_a_sentence(tmp_path: Path, keys: str, mechanism: str) -> None:
    path = tmp_path / "identified.yaml"
    path.write_text(f"mechanism: {mechanism}\nkeys: {keys}\nparameters: {{}}\n")
    with pytest.raises(InputError, match=r"tripod|serial|framed|identified\.yaml|mechanism"):
        load_compensation(path)


def test_a_description_runs_nothing_unless_allowed(own: Path, ran: Callable[[], bool]) -> None:
    described = load_mechanism(f"{own}:Own").describe()
    assert ran()
    with pytest.raises(InputError, match=rf"the mechanism's description {REFUSED}"):
        mechanism_from_description(described)
    assert not ran()
    assert mechanism_from_description(described, allow_code=True).name == "tripod"
    for wrong in ({"spec": [], "keys": {}}, {"spec": "tripod", "keys": []}, {"spec": "tripod", "keys": {}}):
        with pytest.raises(InputError, match=r"does not describe a mechanism|has the parameters"):
            mechanism_from_description(wrong | {"parameters": 3.0})


def test_the_command_line(own: Path, identified: Path, ran: Callable[[], bool], tmp_path: Path, cli: Cli) -> None:
    mechanism = load_mechanism(f"{own}:Own")
    save_model(tmp_path, tripod_compensator(), fields() | {"mechanism": mechanism.describe()}, forms=())
    model, poses, out = tmp_path / "model.safetensors", tmp_path / "poses.csv", tmp_path / "out.csv"
    write_table(poses, {c.header: [v] for c, v in zip(mechanism.pose, mechanism.home_pose.tolist(), strict=True)})
    assert ran()
    # A model knows its joints without the machine; only poses ask for it.
    assert load_model(model).facts["mechanism"]["spec"] == f"{own}:Own" and not ran()
    for file in (model, identified):
        code, _, err = cli("compensate", file, poses, out, "--pose")
        assert code == 2 and len(err.splitlines()) == 1 and "which would run" in err and "--allow-code" in err
        assert str(file) in err and not out.exists() and not ran()
        code, _, err = cli("compensate", file, poses, out, "--pose", "--allow-code", "--quiet")
        assert (code, err) == (0, "") and ran()
        assert np.isfinite(read_table(out).column("command_q1")).all()
        out.unlink()


def test_a_config_allows_it_by_a_key(identified: Path, ran: Callable[[], bool], tmp_path: Path, cli: Cli) -> None:
    mechanism = load_mechanism("tripod")
    poses = mechanism.sample_workspace(40, torch.Generator().manual_seed(0))
    rows = torch.cat([mechanism.solve_inverse(poses) + 1e-4, poses], -1).numpy()
    headers = [c.header for c in (*mechanism.joints, *mechanism.pose)]
    write_table(tmp_path / "rows.csv", dict(zip(headers, rows.T, strict=True)))
    config = tmp_path / "config.yaml"
    about = f"records: {tmp_path / 'rows.csv'}\nmechanism: {identified}\n"
    config.write_text(f"{about}methods: [constant]\ngeometry: none\neffects: none\n")
    words = ("run", config, f"out={tmp_path / 'run'}", "save_models=false", "save_report=false", "--quiet")
    code, _, err = cli(*words)
    assert code == 2 and "which would run" in err and "mechanism_keys.allow_code=true" in err and not ran()
    code, _, err = cli(*words, "mechanism_keys.allow_code=true")
    assert (code, err) == (0, "") and ran()


@pytest.mark.parametrize(
    "words",
    [
        ("run", "methods=[constant]", "geometry=none", "effects=none", "save_report=false"),
        ("diagnose", "--effects", "joint_offset,joint_gain", "--no-network"),
        ("identify",),
    ],
    ids=lambda words: words[0],
)
def test_the_line_that_is_printed_to_compensate_by_a_class_of_ones_own_runs(
    own: Path, tmp_path: Path, cli: Cli, monkeypatch: pytest.MonkeyPatch, words: tuple[str, ...]
) -> None:
    monkeypatch.chdir(tmp_path)
    mechanism, generator = load_mechanism("tripod"), torch.Generator().manual_seed(0)
    poses = mechanism.sample_workspace(60, generator)
    joints = mechanism.solve_inverse(poses) + torch.tensor([1e-4, 0.0, -5e-5], dtype=torch.float64)
    noise = 1e-6 * torch.randn(poses.shape, generator=generator, dtype=torch.float64)
    headers = [c.header for c in (*mechanism.joints, *mechanism.pose)]
    write_table(Path("rows.csv"), dict(zip(headers, torch.cat([joints, poses + noise], -1).numpy().T, strict=True)))
    write_table(Path("TARGETS.csv"), dict(zip(headers[3:], poses[:5].numpy().T, strict=True)))
    code, shown, err = cli(*words, "--records", "rows.csv", "--mechanism", f"{own.name}:Own", "--out", "found")
    assert code == 0, err
    line = next(line for line in shown.splitlines() if line.startswith("  ccnn compensate "))
    code, _, err = cli(*line.split()[1:])
    assert code == 0 and Path("COMMANDS.csv").is_file(), err


def test_numbers_that_are_none_or_huge_leave_the_joints_as_they_are(tmp_path: Path) -> None:
    for name in ("tripod", "five_bar"):
        mechanism = load_mechanism(name)
        path = tmp_path / f"{name}.yaml"
        nominal = dict(zip([p.name for p in mechanism.geometry], mechanism.nominal.tolist(), strict=True))
        path.write_text(mechanism_text(mechanism.with_nominal(mechanism.nominal * 1.0001), nominal))
        model, home = load_compensation(path), mechanism.home_joints
        strange = torch.tensor([np.nan, np.inf, -np.inf, 1e155, -1e300, 1e308], dtype=torch.float64)
        rows = home.repeat(len(strange), 1)
        rows[:, 0] = strange
        found = model(rows)
        assert not found["inside_domain"].any() and not found["fallback"].any()
        assert np.isfinite(found["command"]).all() and (found["deviation"] == 0).all()
        assert model(home)["inside_domain"] and np.abs(model(home)["deviation"]).max() > 0
