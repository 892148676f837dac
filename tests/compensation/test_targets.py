"""`ccnn export`: the form of every kind of model, its C99 and Structured Text, against the eager model."""

from __future__ import annotations

import ctypes
import json
import re
import shutil
import subprocess
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
import torch
from kinds import KINDS, little, little_arm, masked, six_joints
from module_graph import to_onnx
from onnx import numpy_helper
from stand_ins import tripod_compensator
from structured_text import Instance, parse_blocks
from torch import Tensor

from ccnn_torch import export_model
from ccnn_torch.compensation import Compensator
from ccnn_torch.compensation.model_files.identified import load_geometry
from ccnn_torch.compensation.model_files.metadata import open_onnx, run_onnx
from ccnn_torch.compensation.targets import from_model
from ccnn_torch.compensation.targets.c99 import print_c99
from ccnn_torch.compensation.targets.form import Form
from ccnn_torch.compensation.targets.from_model import form_of, traced_program
from ccnn_torch.compensation.targets.golden import Golden, golden_vectors, require_equal, run_form, run_program
from ccnn_torch.compensation.targets.onnx_export import export_float32
from ccnn_torch.compensation.targets.onnx_graph import Graph
from ccnn_torch.compensation.targets.structured_text import print_structured_text
from ccnn_torch.errors import MethodFailedError
from ccnn_torch.mechanisms import load_mechanism

Cli = Callable[..., tuple[int, str, str]]
COMPILER = shutil.which("cc") or shutil.which("gcc") or shutil.which("clang")
# The Makefile of an export compiles with optimisation, see below.
STRICT = ["-O0", "-std=c99", "-pedantic", "-Wall", "-Wextra", "-Wconversion", "-Werror"]


def made(compensator: Compensator, dtype: str = "float64", sd: bool = True) -> tuple[Form, Golden]:
    form = form_of(compensator, dtype, sd)
    return form, golden_vectors(compensator, form)


def compiled(form: Form, golden: Golden, folder: Path) -> str:
    """Write, compile and run the self-test; on a machine without a compiler the form itself has been run before."""
    for name, content in print_c99(form, golden).items():
        (folder / name).write_text(content)
    if COMPILER is None:
        return f"0 of {len(golden.joints)} vectors failed"
    sources = [str(folder / name) for name in ("selftest.c", "compensator.c")]
    subprocess.run([COMPILER, *STRICT, "-o", str(folder / "selftest"), *sources, "-lm"], check=True)
    return subprocess.run([str(folder / "selftest")], capture_output=True, text=True).stdout


@cache
def made_kind(kind: str, dtype: str = "float64", sd: bool = True) -> tuple[Compensator, Form, Golden]:
    """A stand-in, its form and vectors, traced once for all tests."""
    compensator = KINDS[kind]()
    return compensator, *made(compensator, dtype, sd)


# The kinds left out have operations and programs that these have, too; forms of machines are run in test_machine.py.
_IN_C = (
    "covariates",
    "steep",
    "six joints",
    "polynomials",
    "sliding arm with effects",
    "scara",
    "framed stewart with effects",
)
_IN_C += ("five-bar with effects", "constant", "gp", "enn", "grnn")


@pytest.mark.parametrize("kind", _IN_C)
def test_every_kind_of_model_gives_its_numbers_in_c(kind: str, tmp_path: Path) -> None:
    _, form, golden = made_kind(kind)
    worst = require_equal(form, golden)
    assert {*worst} == {"command", "deviation", "ideal", "status", "ideal_status", "sd"}
    assert len(golden.joints) > 1100 and {*golden.outputs["status"].tolist()} >= {0, 1, 2}
    assert f"0 of {len(golden.joints)} vectors failed" in compiled(form, golden, tmp_path)
    # Nothing that Structured Text lacks; what it computes is compared below.
    assert "CCNN_DeviationSd" in print_structured_text(form, golden)["compensator.st"]


@pytest.mark.parametrize("kind", ["covariates", "gp"])
def test_single_precision_is_right_to_its_share_of_the_limit(kind: str, tmp_path: Path) -> None:
    _, form, golden = made_kind(kind, "float32")
    require_equal(form, golden)
    assert f"0 of {len(golden.joints)} vectors failed" in compiled(form, golden, tmp_path)
    source = (tmp_path / "compensator.c").read_text()
    # No number is computed in double in between.
    assert "double" not in source and not re.search(r"\d\.\d+(e-?\d+)?[^\df.e]", source)


def test_single_precision_does_not_hold_a_machine() -> None:
    # A length of 1 m is rounded by more of the limit than single precision may be off.
    with pytest.raises(MethodFailedError, match="computes the machine's kinematics: 1 m is rounded"):
        require_equal(*made(KINDS["sliding arm"](), "float32", sd=False))


@pytest.mark.parametrize(("kind", "tables"), [("grnn", False), ("framed stewart with effects", True)])
def test_the_code_has_no_heap_no_recursion_and_no_state(kind: str, tables: bool, tmp_path: Path) -> None:
    for name, content in print_c99(*made_kind(kind)[1:]).items():
        (tmp_path / name).write_text(content)
    source = (tmp_path / "compensator.c").read_text()
    assert not re.search(r"\b(malloc|calloc|free|goto|while|printf)\b", source)
    outside = [line for line in source.splitlines() if line.startswith("static") and "(" not in line]
    assert bool(outside) is tables and all(line.startswith("static const ccnn_real") for line in outside)
    for function in re.findall(r"^static void (\w+)\(", source, re.MULTILINE):
        body = source.split(f"static void {function}(")[1].split("\n}\n")[0]
        assert not re.search(r"ccnn_(?!min|max|real)\w*\(", body.partition("{")[2])
    header = (tmp_path / "compensator.h").read_text()
    assert "Operations of one command" in header and "Tables: " in header


def test_connections_that_are_dead_cost_nothing() -> None:
    def count(density: float) -> tuple[int, int]:
        compensator = masked(density)
        layers: list[Any] = list(compensator.network.layers)  # type: ignore[arg-type, union-attr]
        alive = sum(int((layer.weight != 0).sum()) for layer in layers)
        return alive, form_of(compensator).programs["step"].operations()["mul"]

    (few, cheap), (many, dear) = count(0.3), count(1.0)
    assert many == 3 * 6 + 6 * 6 + 6 * 3
    assert dear - cheap >= many - few > 20


def test_harmonics_cost_one_sine_and_cosine_a_joint() -> None:
    few, many = (form_of(six_joints(count, links=False)).programs["step"].operations() for count in (1, 4))
    assert few["sin"] == many["sin"] and few["cos"] == many["cos"]


def test_missing_covariates_and_numbers_that_are_none(tmp_path: Path) -> None:
    compensator, form, golden = made_kind("covariates")
    point = compensator.domain.centre.numpy()[None]
    found = run_form(form, point[:, :2], None)
    assert found["status"] == 2 and found["ideal_status"] == 2
    assert (found["command"] == point[:, :2]).all() and (found["deviation"] == 0).all()
    compiled(form, golden, tmp_path)
    if COMPILER is None:
        return
    library = tmp_path / "c.so"
    subprocess.run(
        [COMPILER, *STRICT, "-fPIC", "-shared", "-o", str(library), str(tmp_path / "compensator.c"), "-lm"], check=True
    )
    function = ctypes.CDLL(str(library)).ccnn_compensate
    given, command, deviation = (np.array(v) for v in (point[0, :2], [7.0, 7.0], [7.0, 7.0]))
    pointers = [v.ctypes.data_as(ctypes.c_void_p) for v in (given, command, deviation)]
    assert function(pointers[0], None, *pointers[1:]) == 2
    assert (command == given).all() and (deviation == 0).all()
    # An output may be the same array as the input.
    more = np.array(point[0, 2:])
    assert function(pointers[0], more.ctypes.data_as(ctypes.c_void_p), pointers[0], pointers[2]) == 0
    with torch.no_grad():
        wanted = compensator(torch.from_numpy(point[:, :2]), torch.from_numpy(point[:, 2:]))[0].numpy()
    np.testing.assert_allclose(given, wanted[0], rtol=0, atol=1e-15)


@pytest.mark.parametrize("arrays", [True, False], ids=["arrays in single precision", "machine"])
def test_structured_text_is_parsed_and_gives_the_numbers(arrays: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    compensator = little(1, 1, 2, turning=True) if arrays else little_arm()
    dtype = "float32" if arrays else "float64"
    if arrays:
        # As in a large model, whose parser would take minutes.
        monkeypatch.setattr(from_model, "_ELEMENTS", 2)
        monkeypatch.setattr(from_model, "_PRODUCTS", 4)
    compensator.secant = arrays
    form, golden = made(compensator, dtype, sd=arrays)
    files = print_structured_text(form, golden)
    assert (" DO" in files["compensator.st"].partition("CCNN_Compensate")[0]) == arrays
    # The parser takes seconds: the test of itself, alike for all models, is read once.
    text = files["compensator.st"] + files["selftest.st"] * arrays
    if not arrays:
        # Of the machine the way to the command; the way back is of the same statements, and as long.
        text = re.sub(r"FUNCTION_BLOCK CCNN_(\w+_back_|Back_|Ideal)\b.*?END_FUNCTION_BLOCK", "", text, flags=re.DOTALL)
    blocks = parse_blocks(text)
    rows, more = len(golden.joints), {"covariates": golden.covariates.T} if form.covariates else {}
    with np.errstate(all="ignore"):
        compensate = Instance(blocks, "CCNN_Compensate", rows)
        compensate(joints=golden.joints.T, **more)
        found = {name: compensate.values[name].T for name in ("command", "deviation", "status")}
        if arrays:
            ideal = Instance(blocks, "CCNN_Ideal", rows)
            ideal(command=golden.joints.T, **more)
            found |= {"ideal": ideal.values["joints"].T, "ideal_status": ideal.values["status"]}
        if form.sd:
            spread = Instance(blocks, "CCNN_DeviationSd", rows)
            spread(command=golden.joints.T, **more)
            found["sd"] = spread.values["sd"].T
        if arrays:
            test = Instance(blocks, "CCNN_SelfTest", 1)
            test()
            assert bool(test.values["passed"][0]) and test.values["failed"][0] == 0
    assert {k: v for k, v in golden.errors(found, [*found]).items() if v > 1} == {}
    assert "status" in blocks["ccnn_compensate"].declarations[1].items[-1].variables[0].variable.name


def test_a_command_that_is_not_settled_is_not_sent() -> None:
    """Command and deviation are not the joints, by far less than the limit: a controller commands these as they are."""
    compensator = tripod_compensator(gain=2.0, size=2e-2)
    compensator.secant, compensator.iterations = False, 1
    joints = compensator.domain.centre + compensator.domain.half_range * torch.linspace(-0.9, 0.9, 40)[:, None].double()
    with torch.no_grad():
        solved = compensator.solve(joints)
    apart = ((solved.command + compensator.deviation(solved.command) - joints).abs() / compensator.limit).amax(-1)
    found = run_form(form_of(compensator), joints.numpy(), None)
    astray = (apart > 1e-5).numpy()
    assert astray.any() and float(apart.max()) < 1
    assert (found["status"][astray] == 1).all() and (found["deviation"][astray] == 0).all()
    assert (found["command"][astray] == joints.numpy()[astray]).all()


class Cross(torch.nn.Module):
    def forward(self, a: Tensor, b: Tensor) -> Tensor:
        return torch.linalg.cross(a, b)


def test_moments_of_forces_are_in_every_target() -> None:
    """Compliance of an arm needs them, and no engine has such an operation in double."""
    a, b = torch.rand(2, 1, 3, dtype=torch.float64)
    program = traced_program(Cross(), (a, b), "cross", ("a", "b"), ["found"])
    given = {"a": a.numpy(), "b": b.numpy()}
    session = open_onnx(to_onnx(Cross(), {"a": a, "b": b}, ["found"]).SerializeToString())
    for found in (run_program(program, given)["found"], session.run(None, given)[0]):
        np.testing.assert_allclose(found, np.cross(a, b), rtol=0, atol=1e-15)


def test_no_product_of_a_graph_is_nothing() -> None:
    """Steps of Broyden's method are put side by side and taken apart again."""
    graph = onnx.load_from_string(export_float32(KINDS["steep"](), "{}")).graph
    constants = {tensor.name: numpy_helper.to_array(tensor) for tensor in graph.initializer}
    matrices = [constants[node.input[1]] for node in graph.node if node.op_type == "Gemm"]
    assert len(matrices) > 50 and all(matrix.any() for matrix in matrices)


def test_rounding_does_not_grow_in_the_steps_of_single_precision() -> None:
    steep = KINDS["steep"]()
    session = open_onnx(export_float32(steep, "{}"))
    draw = torch.rand(1000, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    rows = (steep.domain.centre + steep.domain.half_range * (4 * draw - 2)).float()
    found = np.concatenate([session.run(["deviation"], {"joints": row[None].numpy()})[0] for row in rows])
    with torch.no_grad():
        wanted = steep(rows.double())[1].numpy()
    assert (np.abs(found - wanted) < 1e-5 * steep.limit.numpy()).all()


class Odd(torch.nn.Module):
    def __init__(self, inner: torch.nn.Module, strange: Callable[[Tensor], Tensor]) -> None:
        super().__init__()
        self.inner, self.strange = inner, strange

    def forward(self, features: Tensor) -> Tensor:
        return self.inner(features) + 1e-9 * self.strange(features)


def test_what_a_target_lacks_is_said() -> None:
    compensator = KINDS["tripod"]()
    inner = compensator.network
    compensator.network = Odd(inner, torch.special.bessel_j0)
    with pytest.raises(MethodFailedError, match="'special_bessel_j0', which no target has"):
        form_of(compensator)
    compensator.network = Odd(inner, torch.floor)
    form, golden = made(compensator, sd=False)
    assert "floor(" in print_c99(form, golden)["compensator.c"]
    with pytest.raises(MethodFailedError, match="st has no 'floor'"):
        print_structured_text(form, golden)


def test_a_wrong_form_is_not_written() -> None:
    compensator = KINDS["tripod"]()
    form, _ = made(compensator)
    with torch.no_grad():
        compensator.safe.add_(1e-6)
    with pytest.raises(MethodFailedError, match="is not the model's"):
        require_equal(form, golden_vectors(compensator, form))


@pytest.mark.parametrize("to", ["c99", "st"])
def test_the_command_writes_files_that_say_what_they_are(cli: Cli, folder: Path, tmp_path: Path, to: str) -> None:
    out = tmp_path / "a" / "b"
    code, told, err = cli("export", folder / "model.safetensors", "--to", to, "--out", out)
    assert (code, err) == (0, "") and str(out) in told
    names = {"c99": ["Makefile", "compensator.c", "compensator.h", "selftest.c"]}
    names["st"] = ["README.md", "compensator.st", "selftest.st"]
    assert sorted(p.name for p in out.iterdir()) == names[to]
    card = json.loads((folder / "card.json").read_text())
    text = (out / names[to][-2]).read_text()
    assert card["files"]["model.safetensors"] in text and "q1[m], q2[m], q3[m]" in text
    # The same again, byte for byte.
    again = export_model(folder / "model.safetensors", to, tmp_path / "again")
    assert all(path.read_bytes() == (out / name).read_bytes() for name, path in again.items())
    if to == "c99" and COMPILER is not None and shutil.which("make") is not None:
        told = subprocess.run(["make", "-s", "test"], cwd=out, check=True, capture_output=True, text=True).stdout
        assert told.startswith("0 of ")


def test_bad_input_is_one_sentence(cli: Cli, folder: Path, tmp_path: Path) -> None:
    model, out = folder / "model.safetensors", tmp_path / "out"
    (tmp_path / "no.safetensors").write_bytes(b"nothing")
    (tmp_path / "file").write_text("a file")
    shutil.copy(model, tmp_path / "model.safetensors")
    shutil.copy(folder / "card.json", tmp_path / "card.json")
    forged = bytearray(model.read_bytes())
    forged[-1] ^= 1
    (tmp_path / "model.safetensors").write_bytes(forged)
    for words, said in (
        ([model, "--to", "c9", "--out", out], "no target 'c9'; did you mean 'c99'?"),
        ([model, "--to", "c99", "--dtype", "float16", "--out", out], "no dtype 'float16'"),
        ([tmp_path / "none.safetensors", "--to", "c99", "--out", out], "none.safetensors"),
        ([tmp_path / "no.safetensors", "--to", "c99", "--out", out], "no.safetensors"),
        ([tmp_path / "model.safetensors", "--to", "st", "--out", out], "model.safetensors"),
        ([folder / "model.onnx", "--to", "c99", "--out", out], "give the .safetensors beside it"),
        ([model, "--to", "c99", "--out", tmp_path / "file"], "file"),
        ([model, "--to", "c99"], "--out"),
    ):
        code, told, err = cli("export", *words)
        assert code == 2 and told == "" and len(err.strip().splitlines()) == 1 and said in err, words
    assert not out.exists()


@pytest.mark.parametrize("error", [2e-4, 0.02])
def test_identified_geometry_alone(error: float, tmp_path: Path) -> None:
    """The same compensator as `ccnn compensate` commands by, however far off the machine is."""
    bar = load_mechanism("five_bar")
    rows = zip(bar.geometry, bar.nominal.tolist(), strict=True)
    path = tmp_path / "identified.yaml"
    lines = [f"  {p.name}: {{value: {v + error!r}, nominal: {v!r}, unit: {json.dumps(p.unit)}}}" for p, v in rows]
    path.write_text("\n".join(["mechanism: five_bar", "keys: {}", "parameters:", *lines]))
    model = load_geometry(path)
    assert model.compensator is not None and model.machine is not None
    domain = model.compensator.domain
    draw = torch.rand(50, 2, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    joints = domain.centre + 0.5 * domain.half_range * (2 * draw - 1)
    found = model(joints.numpy())
    exact = found["status"] == 0
    assert exact.sum() > 20
    wanted, real = bar.forward_kinematics(joints), model.machine.identified.forward_kinematics
    reached = real(torch.from_numpy(found["command"]))
    assert float((reached - wanted)[exact].abs().max()) < 1e-9
    if error > 1e-3:
        return
    files = export_model(path, "c99", tmp_path / "out")
    assert "five_bar" in files["compensator.h"].read_text()


@pytest.mark.parametrize("near", [1 + 3e-8, 1 - 2e-8])
def test_a_factor_that_single_precision_takes_for_one_is_kept(near: float) -> None:
    """As the cosine of an identified lean: ONNX Runtime leaves out a product with what it takes for 1."""
    graph = Graph(2, 17)
    joints = graph.input("joints", 3, "batch")
    sine, constant = graph.node("Sin", [joints.name], joints.shape, joints.real).name, graph.constant(np.float64(near))
    pairs = {"times": ("Mul", [sine, constant]), "over": ("Div", [sine, constant]), "under": ("Div", [constant, sine])}
    made = {name: graph.node(*what, joints.shape, joints.real).name for name, what in pairs.items()}
    ends = {name: graph.node("Cos", [one], joints.shape, joints.real) for name, one in made.items()}
    session = open_onnx(graph.model(ends, "batch", "near").SerializeToString())
    rows = np.array([[0.3, 1.0, 2.0]])
    found, wanted = run_onnx(session, rows, None), np.sin(rows)
    for name, value in {"times": wanted * near, "over": wanted / near, "under": near / wanted}.items():
        assert np.abs(found[name] - np.cos(value)).max() < 1e-14
