"""Every form of a model gives the same numbers, and none is read that was touched."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import subprocess
import sys
from collections import Counter
from functools import cache
from pathlib import Path

import jsonschema
import numpy as np
import onnx
import onnxruntime
import pytest
import torch
from frozen import frozen
from hypothesis import HealthCheck, given, settings, strategies as st
from safetensors import safe_open
from safetensors.torch import load_file, save_file
from stand_ins import Sigmoids, fields, tripod_compensator

from ccnn_torch.compensation import (
    Compensator,
    LoadedModel,
    fit_compensator,
    load_compensation,
    load_model,
    save_model,
)
from ccnn_torch.compensation.model_files.metadata import OUTPUTS
from ccnn_torch.compensation.targets.export import COMMAND
from ccnn_torch.compensation.targets.golden import probe_points
from ccnn_torch.compensation.targets.onnx_export import export_onnx, verify
from ccnn_torch.coordinates import Coordinate
from ccnn_torch.errors import InputError, MethodFailedError, ModelFileError
from ccnn_torch.training import Scaling

FORMS = ("safetensors", "onnx")


@pytest.fixture
def copied(folder: Path, tmp_path: Path) -> Path:
    shutil.copytree(folder, tmp_path / "copy")
    return tmp_path / "copy"


@cache
def loaded_once(path: Path) -> LoadedModel:
    return load_model(path)


def vouch(path: Path) -> None:
    """What a forger does: write the hash of the altered file into the card."""
    card = json.loads((path.parent / "card.json").read_text())
    card["files"][path.name] = hashlib.sha256(path.read_bytes()).hexdigest()
    (path.parent / "card.json").write_text(json.dumps(card))


@pytest.mark.parametrize("form", FORMS)
def test_all_forms_give_the_eager_numbers(folder: Path, tripod: Compensator, arm: Compensator, form: str) -> None:
    for name, compensator in (("model", tripod), ("arm", arm)):
        loaded = load_model(folder / f"{name}.{form}")
        joints, covariates = probe_points(compensator, 2000)
        with torch.no_grad():
            expected = compensator.solve(joints, covariates)
        found = loaded(joints.numpy(), None if covariates is None else covariates.numpy())
        assert {*found} == {*OUTPUTS, "fallback"} and not found["fallback"].any()
        limit = compensator.limit.numpy()
        for output, wanted in zip(OUTPUTS, (v.numpy() for v in expected), strict=True):
            if wanted.dtype.kind in "bi":
                np.testing.assert_array_equal(found[output], wanted)
                continue
            rounding = 0 if output == "deviation" else np.spacing(np.abs(wanted))
            assert (np.abs(found[output] - wanted) <= 1e-12 * limit + rounding).all()
        single = loaded(joints[0].numpy(), None if covariates is None else covariates[0].numpy())
        assert single["command"].shape == (len(limit),) and single["inside_domain"].shape == ()


def test_a_pt2_of_an_earlier_version_is_refused_before_it_is_opened(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "model.pt2")
    for load in (load_model, load_compensation):
        with pytest.raises(ModelFileError, match=r"never read back.*torch\.export\.load\(.*model\.pt2'\)\.module\(\)"):
            load(tmp_path / "model.pt2")


@pytest.mark.parametrize("form", FORMS)
@given(
    values=st.lists(st.floats(allow_nan=True, allow_infinity=True, width=64), min_size=3, max_size=3),
    near=st.booleans(),
)
@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_no_form_gives_nan_or_breaks_the_limit(folder: Path, form: str, values: list[float], near: bool) -> None:
    loaded = loaded_once(folder / f"model.{form}")
    joints = 1.0 + 0.3 * np.tanh(values) if near else np.array(values)
    found = loaded(joints)
    limit = np.array([entry["limit"] for entry in loaded.facts["limits"].values()])
    assert np.isfinite(found["command"]).all() and np.isfinite(found["ideal"]).all()
    assert (np.abs(found["deviation"]) <= limit).all()
    assert np.isfinite(found["deviation_sd"]).all() and (found["deviation_sd"] > 0).all()
    if np.isfinite(joints).all() and (np.abs(joints) < 1e3).all():
        tolerance = 1e-12 * limit + 2 * np.spacing(np.abs(joints))
        assert (np.abs(loaded.back(found["command"]) - joints) <= tolerance).all()


def test_a_training_like_network_survives_the_masters_round_trip(folder: Path, tripod: Compensator) -> None:
    loaded = load_model(folder / "model.safetensors")
    assert loaded.compensator is not None
    for name, value in tripod.state_dict().items():
        torch.testing.assert_close(loaded.compensator.state_dict()[name], value, rtol=0, atol=0)
    assert (loaded.compensator.lipschitz, loaded.compensator.iterations) == (tripod.lipschitz, tripod.iterations)
    assert [c.header for c in loaded.joints] == ["q1[m]", "q2[m]", "q3[m]"]
    assert [c.header for c in loaded.pose] == ["y[m]", "z[m]", "phi[rad]"]


def test_another_process_writes_the_same_bytes(folder: Path, tmp_path: Path) -> None:
    code = (
        "import sys; from stand_ins import *; from ccnn_torch.compensation import save_model;"
        "save_model(sys.argv[1], tripod_compensator(), fields())"
    )
    here = Path(__file__).parent
    paths = os.pathsep.join([str(here), str(here.parent.parent)])
    environment = {**os.environ, "PYTHONPATH": paths, "PYTHONHASHSEED": "7"}
    subprocess.run([sys.executable, "-c", code, str(tmp_path)], check=True, env=environment)
    for name in ("model.safetensors", "model.onnx", "model.float32.onnx"):
        assert (tmp_path / name).read_bytes() == (folder / name).read_bytes(), name


def test_files_hold_no_path_and_no_time(folder: Path) -> None:
    for name in ("model.safetensors", "model.onnx", "model.float32.onnx"):
        content = (folder / name).read_bytes()
        assert str(Path(__file__).parent.parent.parent).encode() not in content
        assert os.environ["HOME"].encode() + b"/" not in content
        assert b".py" not in content and b"stack_trace" not in content
        assert b"2026-" not in content and b"date" not in content.replace(b"update", b"")


def test_a_name_that_is_no_text_is_refused_and_nothing_is_written(tmp_path: Path, tripod: Compensator) -> None:
    with pytest.raises(InputError, match=r"fields must be JSON: .*surrogates not allowed"):
        save_model(tmp_path, tripod, fields() | {"metrics": {"\ud800": 1.0}}, forms=())
    assert not [*tmp_path.iterdir()]


def test_metadata_is_one_key_of_sorted_json(folder: Path) -> None:
    with safe_open(folder / "model.safetensors", framework="pt") as file:
        metadata = file.metadata()
    assert list(metadata) == ["ccnn_torch"]
    facts = json.loads(metadata["ccnn_torch"])
    assert metadata["ccnn_torch"] == json.dumps(facts, sort_keys=True, ensure_ascii=False)
    assert {"mechanism", "joints", "covariates", "pose", "domain", "limits", "metrics", "seed", "versions"} <= set(
        facts
    )
    assert {"tensors", "keys"} == set(facts["sha256"])


def test_the_card_holds_to_its_schema(folder: Path) -> None:
    for name in ("card.json", "arm.card.json"):
        card = json.loads((folder / name).read_text())
        jsonschema.validate(card, frozen("card"))
        for file, digest in card["files"].items():
            assert hashlib.sha256((folder / file).read_bytes()).hexdigest() == digest
        assert card["iterations"] == 4 and card["lipschitz"] < 0.01 and card["notes"] == []
    assert json.loads((folder / "card.json").read_text())["remark"] == "for the card alone"


def test_the_onnx_file_is_what_controllers_expect(folder: Path) -> None:
    model = onnx.load(folder / "model.onnx")
    onnx.checker.check_model(model, full_check=True)
    assert {o.domain: o.version for o in model.opset_import}[""] == 20
    assert [i.name for i in model.graph.input] == ["joints"]
    assert [o.name for o in model.graph.output] == list(OUTPUTS)
    assert all(not t.external_data for t in model.graph.initializer)
    shape = model.graph.input[0].type.tensor_type.shape.dim
    assert (shape[0].dim_param, shape[1].dim_value) == ("batch", 3)
    arm = onnx.load(folder / "arm.onnx")
    assert [i.name for i in arm.graph.input] == ["joints", "covariates"]


def test_a_step_of_the_fixed_point_is_eleven_nodes(folder: Path, tripod: Compensator) -> None:
    # Four products with constants, and what stands between them; a node costs as much as a row of sums.
    model = onnx.load(folder / "model.onnx")
    counted = Counter(node.op_type for node in model.graph.node)
    evaluations = json.loads((folder / "card.json").read_text())["iterations"] + 1
    # One more for the way back; the last one is for the standard deviation alone, and a clip for finite inputs.
    assert counted["Tanh"] == counted["Clip"] == evaluations + 1
    assert len(model.graph.node) <= 11 * evaluations + 56
    # Commands alone take one evaluation less than steps and the way back.
    choice = onnx.load_from_string(export_onnx(tripod, "{}", COMMAND)).graph.node[-1]
    outside, inside = (Counter(node.op_type for node in branch.g.node) for branch in choice.attribute)
    assert inside["Tanh"] == outside["Tanh"] == evaluations - 1
    assert outside.total() <= 11 * evaluations + 10 and inside.total() <= 4 * evaluations + 1
    assert not counted.keys() & {"Shape", "Expand", "Concat", "Slice", "Gather", "Reshape", "MatMul"}


def test_the_single_precision_variant(folder: Path, tripod: Compensator, arm: Compensator) -> None:
    model = onnx.load(folder / "model.float32.onnx")
    elementwise = {"Abs", "Add", "Div", "Equal", "Less", "Max", "Min", "Mul", "Neg", "Relu", "Sub", "Where", "Sigmoid"}
    elementwise.add("Clip")
    assert {node.op_type for node in model.graph.node} <= elementwise | {"MatMul", "Gemm"}
    assert [(o.domain, o.version) for o in model.opset_import if not o.domain] == [("", 17)]
    for name, compensator in (("model", tripod), ("arm", arm)):
        session = onnxruntime.InferenceSession(folder / f"{name}.float32.onnx")
        assert session.get_inputs()[0].shape == [1, len(compensator.joints)]
        joints, covariates = probe_points(compensator, 60)
        for row in range(len(joints)):
            feeds = {"joints": joints[row : row + 1].float().numpy()}
            if covariates is not None:
                feeds["covariates"] = covariates[row : row + 1].float().numpy()
            deviation, guard, back, back_guard = session.run(None, feeds)
            given_back = [torch.from_numpy(v.astype(np.float64)) for v in feeds.values()]
            solution = compensator.solve(*given_back)
            allowed = 1e-5 * compensator.limit.numpy()
            assert (np.abs(deviation - solution.deviation.numpy()) <= allowed).all()
            assert (np.abs(back - compensator.deviation(*given_back).numpy()) <= allowed).all()
            assert (guard.item() == 1) >= bool(solution.inside_domain)
            assert 0 <= guard.item() <= 1 and 0 <= back_guard.item() <= 1
    with pytest.raises(ModelFileError, match="single precision variant"):
        load_model(folder / "model.float32.onnx")


def test_a_model_that_single_precision_cannot_hold_is_noted(tmp_path: Path) -> None:
    joints = tripod_compensator().domain.centre + 1e-3 * torch.rand(50, 3, dtype=torch.float64).sub(0.5)
    joints = joints + 100.0
    ones = torch.ones(1, 50, dtype=torch.float64)
    scaling = Scaling.fit(joints[None], torch.zeros(1, 50, 3, dtype=torch.float64), ones, torch.zeros(3).bool()).repeat(
        0
    )
    scaling.deviation.fill_(1e-6)
    network = Sigmoids([3, 5, 3], seed=3)
    deviations = scaling.restore(network(scaling.features(joints))).detach()
    names = [Coordinate(f"q{i}", "m") for i in (1, 2, 3)]
    compensator = fit_compensator(network, scaling, joints, deviations, names)
    paths = save_model(tmp_path, compensator, fields(), forms=("safetensors", "float32.onnx"))
    assert set(paths) == {"safetensors", "card"}
    assert "single precision does not hold this model" in json.loads(paths["card"].read_text())["notes"][0]


def test_an_export_that_differs_is_not_written(tripod: Compensator) -> None:
    def off(joints: np.ndarray, covariates: None) -> dict[str, np.ndarray]:
        with torch.no_grad():
            found = tripod.solve(torch.from_numpy(joints))._asdict()
        found["deviation"] = found["deviation"] + 2e-12 * tripod.limit
        return {name: value.numpy() for name, value in found.items()}

    with pytest.raises(MethodFailedError, match="output 'deviation' is not the model's"):
        verify(tripod, off)


@pytest.mark.parametrize("form", FORMS)
@given(place=st.floats(0, 1, exclude_max=True), bit=st.integers(0, 7))
@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_a_flipped_bit_anywhere_is_refused(copied: Path, form: str, place: float, bit: int) -> None:
    path = copied / f"model.{form}"
    good = path.read_bytes()
    bad = bytearray(good)
    bad[int(place * len(bad))] ^= 1 << bit
    path.write_bytes(bad)
    try:
        with pytest.raises(ModelFileError, match="SHA-256 is in none of the cards"):
            load_model(path)
    finally:
        path.write_bytes(good)


@given(place=st.floats(0, 1, exclude_max=True), bit=st.integers(0, 7))
@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_the_master_is_refused_also_where_the_card_was_forged(copied: Path, place: float, bit: int) -> None:
    path = copied / "model.safetensors"
    good, card = path.read_bytes(), (copied / "card.json").read_bytes()
    bad = bytearray(good)
    bad[int(place * len(bad))] ^= 1 << bit
    path.write_bytes(bad)
    vouch(path)
    try:
        with pytest.raises(ModelFileError):
            load_model(path)
    finally:
        path.write_bytes(good)
        (copied / "card.json").write_bytes(card)


def test_edited_metadata_is_refused_also_where_the_card_was_forged(copied: Path) -> None:
    path = copied / "model.safetensors"
    with safe_open(path, framework="pt") as file:
        facts = json.loads(file.metadata()["ccnn_torch"])
    facts["limits"]["q1"]["limit"] = 1.0
    save_file(load_file(path), path, metadata={"ccnn_torch": json.dumps(facts, sort_keys=True, ensure_ascii=False)})
    vouch(path)
    with pytest.raises(ModelFileError, match="edited after it was written"):
        load_model(path)


def test_a_file_of_an_earlier_version_says_what_to_do(copied: Path) -> None:
    path = copied / "model.safetensors"
    with safe_open(path, framework="pt") as file:
        text = file.metadata()["ccnn_torch"]
    for version in (1, 6, 60):
        older = text.replace("ccnn_torch compensator 8", f"ccnn_torch compensator {version}")
        save_file(load_file(path), path, metadata={"ccnn_torch": older})
        vouch(path)
        with pytest.raises(ModelFileError, match=rf"compensator {version}' of another version.*write it again"):
            load_model(path)


@pytest.mark.parametrize("form", FORMS)
def test_truncated_empty_and_foreign_files(copied: Path, form: str) -> None:
    path = copied / f"model.{form}"
    good = path.read_bytes()
    for content, sentence in (
        (good[: len(good) // 2], "SHA-256 is in none"),
        (b"", "is empty"),
        (b"PK\x03\x04 something else", "SHA-256 is in none"),
    ):
        path.write_bytes(content)
        with pytest.raises(ModelFileError, match=sentence):
            load_model(path)
    for content in (good[: len(good) // 2], b"something else"):
        path.write_bytes(content)
        vouch(path)
        with pytest.raises(ModelFileError, match=r"(damaged|no \w+ file|did not write)"):
            load_model(path)


def test_a_foreign_but_valid_file_is_refused_where_the_card_vouches(copied: Path) -> None:
    save_file({"weight": torch.zeros(2)}, copied / "model.safetensors")
    vouch(copied / "model.safetensors")
    with pytest.raises(ModelFileError, match="this package did not write it"):
        load_model(copied / "model.safetensors")


def test_cards(copied: Path) -> None:
    path = copied / "model.onnx"
    (copied / "renamed.onnx").write_bytes(path.read_bytes())
    assert load_model(copied / "renamed.onnx").facts["seed"] == 4
    shutil.move(copied / "card.json", copied / "ccnn.card.json")
    assert load_model(path).card["seed"] == 4
    card = json.loads((copied / "ccnn.card.json").read_text())
    (copied / "ccnn.card.json").write_text(json.dumps(card | {"limits": {}}))
    with pytest.raises(ModelFileError, match="its card says something else about 'limits'"):
        load_model(path)
    for key, value in (("columns", " "), ("columns", {"A1": 1}), ("joint_map", [["q1", "J1"]])):
        (copied / "ccnn.card.json").write_text(json.dumps(card | {key: value}))
        with pytest.raises(ModelFileError, match=f"{key} is no table of names and texts"):
            load_model(path)
    (copied / "ccnn.card.json").write_text("{")
    with pytest.raises(ModelFileError, match="this card is damaged"):
        load_model(path)
    for name in copied.glob("*card.json"):
        name.unlink()
    with pytest.raises(ModelFileError, match=r"no card\.json beside it"):
        load_model(path)
    with pytest.raises(ModelFileError, match="cannot be read"):
        load_model(copied / "nothing.onnx")


def test_other_endings_are_refused(copied: Path) -> None:
    (copied / "model.bin").write_bytes((copied / "model.onnx").read_bytes())
    with pytest.raises(ModelFileError, match=r"ends in \.safetensors or \.onnx"):
        load_model(copied / "model.bin")


def test_wrong_shapes_and_missing_covariates(folder: Path) -> None:
    loaded = load_model(folder / "arm.onnx")
    with pytest.raises(InputError, match=r"time\[s\], temperature\[K\]"):
        loaded(np.zeros((3, 2)))
    with pytest.raises(InputError, match=r"got the shape \(3, 3\)"):
        loaded(np.zeros((3, 3)), np.zeros((3, 2)))
    with pytest.raises(InputError, match=r"got the shape \(3, 1\)"):
        loaded(np.zeros((3, 2)), np.zeros((3, 1)))


def test_memory_that_runs_out_while_a_model_is_read_is_no_fault_of_it(
    copied: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object) -> None:
        raise RuntimeError("[enforce fail at alloc_cpu.cpp:117] DefaultCPUAllocator: can't allocate memory")

    for name, where in (("model.safetensors", "master._rebuild"), ("model.onnx", "metadata.open_onnx")):
        with monkeypatch.context() as patched, pytest.raises(MemoryError):
            patched.setattr(f"ccnn_torch.compensation.model_files.{where}", full)
            load_model(copied / name)
