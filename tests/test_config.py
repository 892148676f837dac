"""Configs: what is read is what was meant, and all that is wrong is said at once, with the nearest right key."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from hypothesis import HealthCheck, example, given, settings, strategies as st

from ccnn_torch.calibration.config import RunConfig, method_names
from ccnn_torch.config.keys import list_keys
from ccnn_torch.diagnosis.config import DiagnoseConfig
from ccnn_torch.errors import InputError
from ccnn_torch.evolution.settings import CCNNSettings
from ccnn_torch.files.yaml_file import dump_yaml, parse_yaml
from ccnn_torch.learners import LEARNERS

TRIPOD = """
case: tripod
split: {test: 0.2}
ccnn:
  hidden: [4, 5]
  weight_mutation: 1e-4
"""


def config(folder: Path, text: str = TRIPOD, *overrides: str) -> RunConfig:
    path = folder / "trial.yaml"
    path.write_text(text, encoding="utf-8")
    return RunConfig.from_file(path, overrides)


def fails(folder: Path, text: str, *overrides: str) -> str:
    with pytest.raises(InputError) as caught:
        config(folder, text, *overrides)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_file_defaults_and_overrides(tmp_path: Path) -> None:
    plain = config(tmp_path)
    assert (plain.name, plain.case, plain.order, plain.variant) == ("trial", "tripod", "raster", None)
    assert (plain.split.kind, plain.split.test, plain.split.validation) == ("random", 0.2, 0.2)
    assert plain.ccnn == CCNNSettings(hidden=(4, 5), weight_mutation=1e-4)
    assert plain.settings("ccnn") == plain.ccnn and plain.settings("constant") is None
    changed = config(
        tmp_path,
        TRIPOD,
        "split.test=0.5",
        "ccnn.generations=7",
        "name=2024",
        "covariates=t",
        "order=shuffled",
        "seed=3",
    )
    assert (changed.split.test, changed.split.kind) == (0.5, "random")
    assert changed.ccnn == CCNNSettings(hidden=(4, 5), weight_mutation=1e-4, generations=7)
    assert (changed.name, changed.covariates, changed.order, changed.seed) == ("2024", ["t"], "shuffled", 3)


def test_empty_sections_and_null_are_defaults(tmp_path: Path) -> None:
    assert config(tmp_path, "case: tripod\nccnn:\nsplit:\ntraining: null\n") == config(tmp_path, "case: tripod\n")
    assert config(tmp_path, "case: tripod\nccnn:\n", "ccnn.population=9").ccnn.population == 9


@pytest.mark.parametrize(
    "text, variant", [("case: machine_tool", "printed"), ("case: machine_tool\nvariant: tabulated", "tabulated")]
)
def test_variant(tmp_path: Path, text: str, variant: str) -> None:
    assert config(tmp_path, text).variant == variant
    assert config(tmp_path, text, "variant=tabulated").variant == "tabulated"


@pytest.mark.parametrize(
    "methods, expected",
    [
        ("[ccnn, constant]", ["ccnn", "constant"]),
        ("ccnn", ["ccnn"]),
        ("ccnn,constant", ["ccnn", "constant"]),
        ("all", list(LEARNERS)),
        ("auto", ["constant", "grnn", "gp", "bp_lm", "enn", "ccnn"]),
    ],
)
def test_methods(tmp_path: Path, methods: str, expected: list[str]) -> None:
    assert method_names(config(tmp_path, f"case: tripod\nmethods: {methods}")) == expected
    assert method_names(config(tmp_path, "case: tripod", f"methods={methods}")) == expected


def test_paths_start_from_the_file_or_from_the_current_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "here").mkdir()
    (tmp_path / "there").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    text = "records: data/r.csv\nmechanism: arm.yaml\nout: ../runs\nmethods: [ccnn, own.py:Mine]\n"
    plain = config(tmp_path / "there", text)
    assert plain.records == str(tmp_path / "there" / "data" / "r.csv")
    assert plain.mechanism == str(tmp_path / "there" / "arm.yaml") and plain.out == str(tmp_path / "runs")
    assert plain.methods == ["ccnn", f"{tmp_path / 'there' / 'own.py'}:Mine"]
    changed = config(
        tmp_path / "there", text, "records=r: 2.csv", "mechanism=own.py:Arm", "out=1e3", "methods=[a.py:B]"
    )
    assert changed.records == str(tmp_path / "here" / "r: 2.csv") and changed.out == str(tmp_path / "here" / "1e3")
    assert changed.mechanism == f"{tmp_path / 'here' / 'own.py'}:Arm"
    assert changed.methods == [f"{tmp_path / 'here' / 'a.py'}:B"]
    compared = config(tmp_path / "there", text + "auto: {methods: [gp, own.py:Mine]}\n")
    assert compared.auto.methods == ["gp", f"{tmp_path / 'there' / 'own.py'}:Mine"]
    assert config(tmp_path / "there", text, "auto.methods=[a.py:B]").auto.methods == [f"{tmp_path / 'here' / 'a.py'}:B"]
    assert config(tmp_path / "there", text, "mechanism=tripod", "out=null").mechanism == "tripod"
    assert config(tmp_path / "there", text, "out=null").out is None
    assert config(tmp_path / "there", text, f"records={tmp_path / 'a.csv'}").records == str(tmp_path / "a.csv")
    made = RunConfig.from_keys(records="r.csv", mechanism=str(Path("~") / "arm.urdf"))
    assert made.records == str(tmp_path / "here" / "r.csv") and made.mechanism == os.path.expanduser("~/arm.urdf")


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None, max_examples=5)
@given(
    name=st.text(st.characters(codec="utf-8", categories=("L", "N", "P", "S", "Zs")), min_size=1),
    weight=st.floats(1e-300, 1e300),
    seed=st.integers(0, 2**63 - 1),
    hidden=st.lists(st.integers(1, 99), min_size=1, max_size=3),
    limit=st.none() | st.floats(1e-9, 1.0) | st.lists(st.floats(1e-9, 1.0), min_size=1),
    covariates=st.none() | st.lists(st.text("abn_*0123", min_size=1)),
    by=st.none() | st.sampled_from(["robot", "position:5mm", ["robot", "no"]]),
)
def test_dump_and_load_is_the_identity(tmp_path: Path, name, weight, seed, hidden, limit, covariates, by) -> None:  # type: ignore[no-untyped-def]
    made = RunConfig.from_keys(
        name=name,
        rotation_weight=weight,
        seed=seed,
        ccnn={"hidden": hidden},
        compensation={"limit": limit},
        covariates=covariates,
        split={"kind": "group", "by": by},
        records="r.csv",
        mechanism="arm.yaml",
        methods="all",
    )
    assert config(tmp_path, made.to_yaml()) == made
    assert config(tmp_path, config(tmp_path, made.to_yaml()).to_yaml()) == made


def test_dump_spells_out_every_key(tmp_path: Path) -> None:
    tree = parse_yaml(config(tmp_path).to_yaml(), "dump")
    for key, _, _ in list_keys(RunConfig):
        section, _, last = key.rpartition(".")
        assert last in (tree[section] if section else tree)
    assert list(tree)[:3] == ["name", "seed", "repeats"]


def test_all_errors_at_once_each_with_the_nearest_key(tmp_path: Path) -> None:
    text = "case: tripod\nsed: 1\nsplit: {kind: grup, tets: 0.2}\nccnn: {generatons: 3}\n"
    message = fails(tmp_path, text, "repeats=0", "generations=4")
    for part in (
        f"{tmp_path / 'trial.yaml'}: ",
        "no key 'sed'; did you mean 'seed'?",
        "split.kind: must be 'random', 'group', 'block' or 'column', not grup",
        "no key 'split.tets'; did you mean 'split.test'?",
        "no key 'ccnn.generatons'; did you mean 'ccnn.generations'?",
        "'repeats=0': repeats: must be greater than or equal to 1, not 0",
        "'generations=4': there is no key 'generations'; did you mean 'ccnn.generations'?",
    ):
        assert part in message, message


@pytest.mark.parametrize(
    "override, parts",
    [
        ("wibble=1", ("'wibble'", "seed, repeats")),
        ("split.wibble=1", ("'split.wibble'", "the keys of split are kind, by, test, test_values, validation")),
        ("split=3", ("split: must hold the keys kind, by, test, test_values, validation, not 3",)),
        ("ccnn=[1]", ("ccnn: must hold the keys", "generations")),
        ("seed.x=3", ("'seed.x=3'", "seed")),
        ("case.x=3", ("'case.x=3'", "case has a plain value (tripod)")),
        ("seed", ("'seed': write key=value",)),
        ("=3", ("'=3': write key=value",)),
        ("split..test=3", ("write key=value",)),
        ("split.test=[0.3", ("'split.test=[0.3'", "not valid YAML")),
        ("split.test=a", ("split.test: must be a share such as 0.3, or a file of records", "not a")),
        ("split.test=1", ("split.test: must be greater than 0 and less than 1", "not 1")),
        ("split.test=.nan", ("split.test: must be greater than 0 and less than 1", "not nan")),
        ("split.validation=0", ("training.early_stop", "split.validation=0.2")),
        ("auto.folds=1", ("auto.folds: must be greater than or equal to 2, not 1",)),
        ("auto.methods=[cnn]", ("auto.methods: there is no method 'cnn'; did you mean 'ccnn'?",)),
        ("methods=[]", ("methods: must have at least 1 item",)),
        ("methods=cnn", ("no method 'cnn'; did you mean 'ccnn'?",)),
        ("methods=transformer", ("no method 'transformer'; known are ccnn, bp_lm",)),
        ("methods=[ccnn, ccnn]", ("'ccnn' is given twice",)),
        ("methods=[all, ccnn]", ("'all' cannot be combined",)),
        ("device=gpu", ("device: must be cpu, cuda, cuda:N or mps, not gpu",)),
        ("covariates=3", ("covariates: must be a list, not 3",)),
        ("compensation.limit=-1", ("compensation.limit", "greater than 0")),
        ("ccnn.hidden=3", ("ccnn.hidden: must be a list, not 3",)),
        ("case=tripodd", ("case: must be 'tripod', 'machine_tool' or 'realistic', not tripodd",)),
        ("case=null", ("no data is named", "records=FILE.csv")),
        ("records=r.csv", ("both case and records",)),
        ("mechanism=machine_tool", ("mechanism: the case tripod brings its own",)),
        ("variant=printed", ("variant: only the case machine_tool",)),
    ],
)
def test_bad_override(tmp_path: Path, override: str, parts: tuple[str, ...]) -> None:
    message = fails(tmp_path, TRIPOD, override)
    assert all(part in message for part in parts), message


@pytest.mark.parametrize(
    "text, parts",
    [
        ("records: r.csv", ("mechanism: records need it",)),
        ("records: r.csv\nmechanism: tripod\norder: raster", ("order: records have the order",)),
        ("", ("no data is named",)),
        ("- case", ("`key: value`",)),
        ("tripod", ("`key: value`",)),
        ("1: 2", ("`key: value`",)),
        ("case: tripod\ncase: tripod", ("line 2", "duplicate key")),
        ("case: [tripod", ("line 1", "not valid YAML")),
        ("case: tripod\n\tseed: 1", ("line 2", "not valid YAML")),
        (
            "case: !!python/name:os.system x",
            (
                "line 1",
                "tags such as",
            ),
        ),
        ("name: 2026-13-45", ("not valid YAML",)),
        ("name: \x00", ("not valid YAML",)),
    ],
)
def test_bad_file(tmp_path: Path, text: str, parts: tuple[str, ...]) -> None:
    message = fails(tmp_path, text)
    assert all(part in message for part in (str(tmp_path / "trial.yaml"), *parts)), message


def test_unreadable_file(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"none\.yaml: there is no such file"):
        RunConfig.from_file(tmp_path / "none.yaml")
    (tmp_path / "latin.yaml").write_bytes("name: é".encode("latin-1"))
    with pytest.raises(InputError, match="not UTF-8"):
        RunConfig.from_file(tmp_path / "latin.yaml")


def test_a_key_of_another_command_is_told_so() -> None:
    with pytest.raises(InputError, match="there is no key 'save_report'; only `ccnn run` has it; leave it out"):
        DiagnoseConfig.from_keys(records="rows.csv", mechanism="five_bar", save_report=False)


def test_make_config_is_checked_too() -> None:
    assert RunConfig.from_keys(case="tripod", ccnn={"generations": 60}).ccnn.generations == 60
    with pytest.raises(InputError, match=r"config: there is no key 'sed'; did you mean 'seed'\?"):
        RunConfig.from_keys(case="tripod", sed=1)


@settings(deadline=None)
@given(
    st.recursive(
        st.none()
        | st.booleans()
        | st.floats(allow_nan=False)
        | st.integers()
        | st.text(st.characters(codec="utf-8", exclude_characters="\0")),
        lambda part: st.lists(part, max_size=3) | st.dictionaries(st.text("abc_.", min_size=1), part, max_size=3),
        max_leaves=8,
    )
)
@example("a\x85b")
def test_yaml_round_trip(value: object) -> None:
    back = parse_yaml(dump_yaml({"value": value}), "dump")["value"]
    assert back == value and repr(back) == repr(value)


def test_every_key_is_described() -> None:
    keys = [*list_keys(RunConfig)]
    assert len({key for key, _, _ in keys}) == len(keys)
    assert [key for key, _, description in keys if not description] == []
    assert ("split.test", "0.3") in {(key, default) for key, default, _ in keys}
    assert "ccnn.hidden" in {key for key, _, _ in keys}


def test_two_wrong_keys_are_each_named_with_what_set_them(tmp_path: Path) -> None:
    with pytest.raises(InputError) as caught:
        config(tmp_path, "case: tripod\n", "ccnn={hiden: 2}", "ccnn.generatons=3")
    assert "'ccnn={hiden: 2}': there is no key 'ccnn.hiden'; did you mean 'ccnn.hidden'?" in str(caught.value)
    assert "'ccnn.generatons=3': there is no key 'ccnn.generatons'" in str(caught.value)
    # A config of `ccnn run` with a mistake: of `methods`, which is right there, nothing is said.
    (tmp_path / "run.yaml").write_text("records: r.csv\nmechanism: five_bar\nmethods: gp\nsede: 1\n", encoding="utf-8")
    with pytest.raises(InputError, match=r"run.yaml: there is no key 'sede'; did you mean 'seed'\?$"):
        DiagnoseConfig.from_file(tmp_path / "run.yaml")
    # And one of a diagnosis: all of its keys are read.
    (tmp_path / "diagnose.yaml").write_text("motion: r.csv\nnoise: 1e-5\nmethods: gp\n", encoding="utf-8")
    with pytest.raises(InputError, match=r"diagnose.yaml: there is no key 'methods'"):
        DiagnoseConfig.from_file(tmp_path / "diagnose.yaml")
