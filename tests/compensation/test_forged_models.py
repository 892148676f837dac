"""Files whose card and text are forged to match: whatever they compute, no wrong number comes out, and no code runs."""

from __future__ import annotations

import hashlib
import json
import shutil
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
import torch
from hypothesis import HealthCheck, given, settings, strategies as st
from machines import compensated, known
from onnx import TensorProto, helper, numpy_helper
from safetensors import safe_open
from safetensors.torch import load_file, save_file
from stand_ins import fields, tripod_joints

from ccnn_torch.compensation import load_model, save_model
from ccnn_torch.compensation.model_files.metadata import digest_of, to_json
from ccnn_torch.errors import FallbackWarning, ModelFileError
from ccnn_torch.mechanisms import load_mechanism
from ccnn_torch.records import read_table, write_table
from ccnn_torch.training import tensor_digest

LIMIT = 2e-4
Cli = Callable[..., tuple[int, str, str]]


@pytest.fixture
def copied(folder: Path, tmp_path: Path) -> Path:
    shutil.copytree(folder, tmp_path / "copy")
    return tmp_path / "copy"


def fingerprint(folder: Path) -> dict[str, Any]:
    with safe_open(folder / "model.safetensors", framework="pt") as file:
        found: dict[str, Any] = json.loads(file.metadata()["ccnn_torch"])
    return found


def vouch(path: Path, facts: dict[str, Any]) -> None:
    """A card that says what the file says."""
    card = facts | {"files": {path.name: hashlib.sha256(path.read_bytes()).hexdigest()}}
    (path.parent / "card.json").write_text(json.dumps(card))


def stamped(facts: dict[str, Any], **changed: Any) -> dict[str, Any]:
    """Facts with other values and a hash that fits them."""
    facts = json.loads(json.dumps(facts | changed))
    facts["sha256"]["keys"] = digest_of(facts)
    return facts


def forge(folder: Path, value: float, replaced: list[Any] | None = None, outputs: list[Any] | None = None) -> Path:
    """A graph whose deviation is `value` [m] everywhere, with nodes of other outputs and further outputs."""

    def number(name: str, *values: float) -> Any:
        array = np.array([values], dtype=np.float64)
        return helper.make_node("Constant", [], [name], value=numpy_helper.from_array(array, name))

    nodes = {
        "zero": number("zero", 0.0),
        "value": number("value", value, value, value),
        "axes": helper.make_node("Constant", [], ["axes"], value=numpy_helper.from_array(np.array([1]), "axes")),
        "nothing": helper.make_node("Mul", ["joints", "zero"], ["nothing"]),
        "deviation": helper.make_node("Add", ["nothing", "value"], ["deviation"]),
        "command": helper.make_node("Sub", ["joints", "deviation"], ["command"]),
        "ideal": helper.make_node("Add", ["joints", "deviation"], ["ideal"]),
        "deviation_sd": helper.make_node("Abs", ["deviation"], ["deviation_sd"]),
        "sum": helper.make_node("ReduceSum", ["nothing", "axes"], ["sum"], keepdims=0),
        "inside_domain": helper.make_node("Equal", ["sum", "sum"], ["inside_domain"]),
        "ideal_inside_domain": helper.make_node("Equal", ["sum", "sum"], ["ideal_inside_domain"]),
    }
    cast = {"to": TensorProto.INT64}
    nodes |= {name: helper.make_node("Cast", ["sum"], [name], **cast) for name in ("status", "ideal_status")}
    nodes |= {node.output[0]: node for node in replaced or []}

    def tensor(name: str, kind: int = TensorProto.DOUBLE, *more: int) -> Any:
        return helper.make_tensor_value_info(name, kind, ["batch", *more])

    declared = [tensor(name, TensorProto.DOUBLE, 3) for name in ("command", "deviation", "ideal", "deviation_sd")]
    declared += [tensor(name, TensorProto.BOOL) for name in ("inside_domain", "ideal_inside_domain")]
    declared += [tensor(name, TensorProto.INT64) for name in ("status", "ideal_status")]
    given = {d.name: d for d in outputs or []}
    declared = [given.pop(d.name, d) for d in declared] + [*given.values()]
    graph = helper.make_graph([*nodes.values()], "forged", [tensor("joints", TensorProto.DOUBLE, 3)], declared)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 20), helper.make_opsetid("evil", 1)])
    model.ir_version = 10
    facts = fingerprint(folder)
    model.metadata_props.add(key="ccnn_torch", value=to_json(facts))
    path = folder / "forged.onnx"
    path.write_bytes(model.SerializeToString())
    vouch(path, facts)
    return path


def assert_safe(found: dict[str, np.ndarray], joints: np.ndarray) -> None:
    assert found["fallback"].all()
    np.testing.assert_array_equal(found["command"], joints)
    np.testing.assert_array_equal(found["ideal"], joints)
    assert (found["deviation"] == 0).all() and np.isfinite(found["deviation_sd"]).all()
    assert not found["inside_domain"].any() and not found["ideal_inside_domain"].any()
    assert (found["status"] == 1).all() and (found["ideal_status"] == 1).all()


JOINTS = tripod_joints(20).numpy()


@pytest.mark.parametrize("value", [8.7e5 * LIMIT, -1e308, float("nan"), float("inf")])
def test_a_deviation_above_the_limit_is_never_commanded(copied: Path, value: float) -> None:
    model = load_model(forge(copied, value))
    with pytest.warns(FallbackWarning, match=r"forged\.onnx: in 20 of 20 rows \(the first is row 1\)"):
        assert_safe(model(JOINTS), JOINTS)
    with pytest.warns(FallbackWarning):
        np.testing.assert_array_equal(model.back(JOINTS[0]), JOINTS[0])


def test_a_deviation_within_the_limit_passes_and_the_domain_is_the_cards(copied: Path) -> None:
    model = load_model(forge(copied, 1e-5))
    far = JOINTS.copy()
    far[3] += 2.0
    found = model(far)
    assert not found["fallback"].any()
    np.testing.assert_allclose(found["command"], far - 1e-5, rtol=1e-15)
    assert found["inside_domain"].tolist() == found["ideal_inside_domain"].tolist() == [i != 3 for i in range(20)]
    # The graph says 0 everywhere.
    assert found["status"].tolist() == found["ideal_status"].tolist() == [int(i == 3) for i in range(20)]


def make(kind: str, inputs: list[str], output: str, **keys: Any) -> Any:
    return helper.make_node(kind, inputs, [output], **keys)


BREAKS = {
    "a command that is not joints - deviation": ([make("Add", ["joints", "deviation"], "command")], []),
    "an ideal too far": ([make("Add", ["joints", "joints"], "ideal")], []),
    "a negative standard deviation": ([make("Neg", ["deviation"], "deviation_sd")], []),
    "a wide command": (
        [make("Concat", ["joints", "joints"], "command", axis=1)],
        [helper.make_tensor_value_info("command", TensorProto.DOUBLE, ["batch", 6])],
    ),
    "a status of another kind": (
        [make("Cast", ["sum"], "status", to=TensorProto.FLOAT)],
        [helper.make_tensor_value_info("status", TensorProto.FLOAT, ["batch"])],
    ),
    "a column of flags": (
        [make("Equal", ["joints", "joints"], "inside_domain")],
        [helper.make_tensor_value_info("inside_domain", TensorProto.BOOL, ["batch", 3])],
    ),
    "single precision": (
        [make("Cast", ["joints"], "command", to=TensorProto.FLOAT)],
        [helper.make_tensor_value_info("command", TensorProto.FLOAT, ["batch", 3])],
    ),
    "words": (
        [make("Cast", ["joints"], "command", to=TensorProto.STRING)],
        [helper.make_tensor_value_info("command", TensorProto.STRING, ["batch", 3])],
    ),
}


@pytest.mark.parametrize("name", BREAKS)
def test_outputs_that_contradict_each_other_or_are_of_another_kind(copied: Path, name: str) -> None:
    model = load_model(forge(copied, 1e-5, *BREAKS[name]))
    with pytest.warns(FallbackWarning):
        assert_safe(model(JOINTS), JOINTS)


def test_a_graph_that_takes_one_row_and_no_two(copied: Path) -> None:
    shape = helper.make_node(
        "Constant", [], ["shape"], value=numpy_helper.from_array(np.array([1, 3], dtype=np.int64), "shape")
    )
    path = forge(copied, 1e-5, [shape, make("Reshape", ["joints", "shape"], "again")])
    model = load_model(path)
    # The node is computed only where something is made of it.
    graph = onnx.load(path)
    graph.graph.output.append(helper.make_tensor_value_info("again", TensorProto.DOUBLE, ["batch", 3]))
    path.write_bytes(graph.SerializeToString())
    vouch(path, fingerprint(copied))
    model = load_model(path)
    assert not model(JOINTS[:1])["fallback"].any()
    with pytest.warns(FallbackWarning):
        assert_safe(model(JOINTS), JOINTS)


def test_further_outputs_are_left_out(copied: Path) -> None:
    path = forge(copied, 1e-5, outputs=[helper.make_tensor_value_info("nothing", TensorProto.DOUBLE, ["batch", 3])])
    assert {*load_model(path)(JOINTS)} == {*load_model(copied / "forged.onnx")(JOINTS)}
    assert "nothing" not in load_model(path)(JOINTS)


@given(place=st.floats(0, 1, exclude_max=True), bit=st.integers(0, 7))
@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_a_flipped_bit_in_a_graph_gives_a_sentence_or_commands_within_the_limit(
    copied: Path, capfd: pytest.CaptureFixture[str], place: float, bit: int
) -> None:
    path = copied / "model.onnx"
    good = path.read_bytes()
    bad = bytearray(good)
    bad[int(place * len(bad))] ^= 1 << bit
    path.write_bytes(bad)
    vouch(path, fingerprint(copied))
    try:
        model = load_model(path)
        limit = np.array([model.facts["limits"][c.name]["limit"] for c in model.joints])
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", FallbackWarning)
            found = model(np.concatenate([JOINTS, np.full((1, 3), np.nan), np.full((1, 3), 1e155)]))
        assert np.isfinite(found["command"]).all() and (np.abs(found["deviation"]) <= limit * (1 + 1e-9)).all()
    except ModelFileError as refused:
        assert str(path) in str(refused)
    finally:
        path.write_bytes(good)
    # Nor does ONNX Runtime print anything of its own.
    assert capfd.readouterr() == ("", "")


def external(graph: Any) -> None:
    tensor = numpy_helper.from_array(np.zeros((1, 3)), "stolen")
    tensor.ClearField("raw_data")
    tensor.data_location = TensorProto.EXTERNAL
    tensor.external_data.add(key="location", value="../../../../../etc/passwd")
    graph.initializer.append(tensor)


def external_constant(graph: Any) -> None:
    external(graph)
    node = make("Constant", [], "stolen", value=graph.initializer[-1])
    del graph.initializer[-1]
    graph.node.append(node)


def foreign(graph: Any) -> None:
    graph.node.append(make("Steal", ["joints"], "stolen", domain="evil"))


def looped(graph: Any) -> None:
    body = helper.make_graph([], "body", [], [])
    graph.node.append(make("Loop", ["", "", "joints"], "stolen", body=body))


def unnamed(graph: Any) -> None:
    graph.input[0].name = "poses"


def without_output(graph: Any) -> None:
    del graph.output[0]


def unknown(graph: Any) -> None:
    graph.node.append(make("Stealing", ["joints"], "stolen"))


def without_inputs(graph: Any) -> None:
    del graph.input[:]


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (external, "reads another file"),
        (external_constant, "reads another file"),
        (foreign, r"operator of another library \(evil\)"),
        (looped, r"a loop or a branch \(Loop\)"),
        (unnamed, "does not take joints and give command"),
        (without_inputs, "does not take joints and give command"),
        (without_output, "does not take joints and give command"),
        (unknown, "ONNX Runtime does not take its graph"),
    ],
)
def test_graphs_that_reach_out_are_refused(copied: Path, change: Callable[[Any], None], sentence: str) -> None:
    path = forge(copied, 1e-5)
    model = onnx.load(path)
    change(model.graph)
    path.write_bytes(model.SerializeToString())
    vouch(path, fingerprint(copied))
    with pytest.raises(ModelFileError, match=sentence):
        load_model(path)


def test_the_command_line_writes_safe_rows_and_says_so(copied: Path, tmp_path: Path, cli: Cli) -> None:
    # The square root of q1 - 0.95 m is no number below.
    edge = helper.make_node(
        "Constant", [], ["edge"], value=numpy_helper.from_array(np.array([[0.95, 0.0, 0.0]]), "edge")
    )
    path = forge(
        copied,
        1e-5,
        [
            *(edge, make("Sub", ["joints", "edge"], "above"), make("Sqrt", ["above"], "root")),
            *(make("Mul", ["root", "zero"], "nothing2"), make("Add", ["nothing2", "value"], "deviation")),
            # Anew, since they come after it.
            *(make("Sub", ["joints", "deviation"], "command"), make("Add", ["joints", "deviation"], "ideal")),
            make("Abs", ["deviation"], "deviation_sd"),
        ],
    )
    model = onnx.load(path)
    order = sorted(model.graph.node, key=lambda node: node.output[0] in ("deviation",))
    order = sorted(order, key=lambda node: node.output[0] in ("command", "ideal", "deviation_sd"))
    del model.graph.node[:]
    model.graph.node.extend(order)
    path.write_bytes(model.SerializeToString())
    vouch(path, fingerprint(copied))
    joints = np.array([[1.0, 1.0, 1.0], [0.9, 1.0, 1.0], [0.94, 1.0, 1.0], [0.99, 1.0, 1.0]])
    program, out = tmp_path / "in.csv", tmp_path / "out.csv"
    write_table(program, {f"q{k + 1}[m]": joints[:, k] for k in range(3)})
    for options, what in (((), "command"), (("--sd",), "command"), (("--back",), "ideal")):
        code, _, err = cli("compensate", path, program, out, *options)
        assert code == 2 and len(err.splitlines()) == 1
        assert "in 2 of 4 rows, the first from line 3 (row 2)" in err and "violates the limits in its card" in err
        table = read_table(out)
        found = np.stack([table.column(f"{what}_q{k}") for k in (1, 2, 3)], -1)
        expected = joints + (1e-5 if what == "ideal" else -1e-5) * np.array([[1.0], [0.0], [0.0], [1.0]])
        np.testing.assert_allclose(found, expected, rtol=1e-15)
        assert table.column("inside_domain")[1] == table.column("inside_domain")[2] == 0


# The master


def forge_master(folder: Path, facts: dict[str, Any], change: Callable[[dict[str, torch.Tensor]], None]) -> Path:
    path = folder / "model.safetensors"
    tensors = load_file(path)
    change(tensors)
    facts["sha256"]["tensors"] = tensor_digest(tensors)
    facts = stamped(facts)
    save_file(tensors, path, metadata={"ccnn_torch": to_json(facts)})
    vouch(path, facts)
    return path


def test_a_master_of_weights_that_overflow_falls_back_in_calls_and_in_the_hook(copied: Path) -> None:
    path = forge_master(
        copied, fingerprint(copied), lambda t: t.update({k: v * float("nan") for k, v in t.items() if "weights" in k})
    )
    model, tripod = load_model(path), load_mechanism("tripod")
    with pytest.warns(FallbackWarning):
        assert_safe(model(JOINTS), JOINTS)
    handle = tripod.inverse_kinematics.register_forward_hook(model.compensator.hook(), with_kwargs=True)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        hooked = tripod.inverse_kinematics(tripod.home_pose)
    handle.remove()
    assert torch.equal(hooked, tripod.inverse_kinematics(tripod.home_pose))


def test_a_master_whose_limits_are_not_those_of_its_metadata(copied: Path) -> None:
    path = forge_master(copied, fingerprint(copied), lambda t: t.update(limit=t["limit"] * 1e6))
    with pytest.raises(ModelFileError, match="its limits are not those of its metadata"):
        load_model(path)


@pytest.mark.parametrize(
    "change",
    [
        lambda t: t.pop("limit"),
        lambda t: t.update({"scaling.extra": torch.zeros(1)}),
        lambda t: t.update({"network.weights.0": torch.zeros(2, 2)}),
        lambda t: t.update({"domain.centre": torch.zeros(7, dtype=torch.float64)}),
        lambda t: t.update({"scaling.periodic": torch.tensor([7])}),
    ],
)
def test_tensors_that_do_not_fit(copied: Path, change: Callable[[dict[str, torch.Tensor]], None]) -> None:
    path = forge_master(copied, fingerprint(copied), change)
    with pytest.raises(ModelFileError, match=r"tensors are not those|cannot be run"):
        load_model(path)


def refused_or_bounded(folder: Path, facts: dict[str, Any], bound: str, *covariates: np.ndarray) -> None:
    """The master with these facts is refused by its path, or its deviation keeps the bound of that key; then undone."""
    path = folder / "model.safetensors"
    good = path.read_bytes()
    try:
        model = load_model(forge_master(folder, facts, lambda tensors: None))
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", FallbackWarning)
            found = model(np.ones(len(model.joints)), *covariates)
        assert np.isfinite(found["command"]).all()
        most = np.array([model.facts["limits"][c.name][bound] for c in model.joints])
        assert (np.abs(found["deviation"]) <= most).all()
    except ModelFileError as refused:
        assert str(path) in str(refused)
    finally:
        path.write_bytes(good)


@pytest.mark.parametrize("number", [-(2**63) - 1, 10**400])
def test_an_integer_of_many_digits_is_a_number_or_refused(copied: Path, number: int) -> None:
    for change in (
        lambda facts: next(iter(facts["limits"].values())).update(safe_correction=number),
        lambda facts: facts["domain"]["principal"]["low"].__setitem__(0, number),
    ):
        facts = fingerprint(copied)
        change(facts)
        refused_or_bounded(copied, facts, "limit")


LEAVES = ("domain", "limits", "joints", "network", "lipschitz", "iterations", "covariates", "pose", "mechanism")
ANYTHING = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False, allow_infinity=False) | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=5,
)


@given(key=st.sampled_from(LEAVES), deep=st.booleans(), draw=st.randoms(use_true_random=False), value=ANYTHING)
@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_any_fact_replaced_by_anything_gives_a_sentence_or_finite_commands(
    copied: Path, key: str, deep: bool, draw: Any, value: Any
) -> None:
    facts = fingerprint(copied)
    place, last = facts, key
    while deep and isinstance(place[last], dict | list) and place[last]:
        place = place[last]
        last = draw.choice([*place]) if isinstance(place, dict) else draw.randrange(len(place))
    place[last] = value
    refused_or_bounded(copied, facts, "limit")


@pytest.fixture
def with_machine(tmp_path: Path) -> Path:
    """Folder of the master of an arm with effects."""
    name = "sliding arm with effects"
    about = fields() | {"mechanism": known(name).mechanism.describe()}
    save_model(tmp_path / "machine", compensated(name), about, forms=())
    return tmp_path / "machine"


@given(draw=st.randoms(use_true_random=False), value=ANYTHING)
@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_any_fact_of_a_machine_replaced_by_anything(with_machine: Path, draw: Any, value: Any) -> None:
    facts = fingerprint(with_machine)
    place: Any = facts
    last: Any = "machine"
    # The mechanism's own keys are read as those of a mechanism file, which has tests of its own.
    while isinstance(place[last], dict | list) and place[last] and (last == "machine" or draw.random() < 0.8):
        place = place[last]
        last = draw.choice([*place]) if isinstance(place, dict) else draw.randrange(len(place))
    place[last] = value
    refused_or_bounded(with_machine, facts, "most_deviation", np.ones(3))


@pytest.mark.parametrize("place", [("newton",), ("degree",), ("effects", "acting", 0, 1), ("effects", "acting", 0, 2)])
def test_a_machine_that_would_compute_for_ever_is_refused(with_machine: Path, place: tuple[str | int, ...]) -> None:
    part: Any = (facts := fingerprint(with_machine))["machine"]
    for key in place[:-1]:
        part = part[key]
    part[place[-1]] = 10**9
    path = forge_master(with_machine, facts, lambda tensors: None)
    key = r"\.".join(map(str, place))
    with pytest.raises(ModelFileError, match=rf"'machine\.{key}.*' wrong \(Input should be "):
        load_model(path)


def test_a_polynomial_of_endless_terms_is_refused(with_machine: Path) -> None:
    """Each number is a possible one, and all together are no model."""
    facts = fingerprint(with_machine)
    facts["machine"] |= {"kind": "expanded", "joints": 60, "degrees": [60, 60, 60], "turns": True, "effects": None}
    with pytest.raises(ModelFileError, match=r"not those that its metadata lists \(a polynomial of degree 60 of 60"):
        load_model(forge_master(with_machine, facts, lambda tensors: None))


def test_a_master_that_names_code_does_not_run_it(copied: Path, tmp_path: Path) -> None:
    (tmp_path / "own.py").write_text(f"open({str(tmp_path / 'ran')!r}, 'w').close()\n")
    spec = f"{tmp_path / 'own.py'}:Own"
    for mechanism, acting in (({"spec": spec, "keys": {}, "parameters": {}}, []), (None, [[spec, 0, 0]])):
        about = {"mechanism": mechanism or load_mechanism("tripod").describe()}
        effects = about | {"covariates": [], "acting": acting, "fields": {}, "numbers": {}} if acting else None
        machine = about | {"kind": "forward", "identified": [], "effects": effects, "rule": {}}
        path = forge_master(copied, fingerprint(copied) | {"machine": machine}, lambda tensors: None)
        with pytest.raises(ModelFileError, match=r"names Python code, .*own\.py:Own, which would run.*=True"):
            load_model(path)
    assert not (tmp_path / "ran").exists()
    with pytest.raises(ModelFileError):
        load_model(path, allow_code=True)
    assert (tmp_path / "ran").exists()


@pytest.mark.parametrize("text", ["[" * 100_000, '{"format": NaN}', "1" * 5000, "\x00", "{" * 10])
def test_cards_and_texts_that_are_no_json(copied: Path, text: str) -> None:
    path = copied / "model.safetensors"
    save_file(load_file(path), path, metadata={"ccnn_torch": text})
    vouch(path, {})
    with pytest.raises(ModelFileError):
        load_model(path)
    (copied / "card.json").write_text(text)
    with pytest.raises(ModelFileError):
        load_model(path)
