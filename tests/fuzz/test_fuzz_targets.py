"""Every kind of model in every target against the eager model, on inputs that a controller should never get.

With `--fuzz-cases` also by clang where it is installed, and Structured Text by the interpreter of its tests.
"""

from __future__ import annotations

import shutil
import subprocess
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import example, given, strategies as st
from kinds import KINDS, little
from numpy.typing import NDArray
from structured_text import Instance, parse_blocks
from test_targets import STRICT

from ccnn_torch.compensation import Compensator
from ccnn_torch.compensation.model_files.metadata import open_onnx, run_onnx
from ccnn_torch.compensation.targets.c99 import print_c99
from ccnn_torch.compensation.targets.form import Form
from ccnn_torch.compensation.targets.from_model import form_of
from ccnn_torch.compensation.targets.golden import Golden, golden_vectors, require_equal, run_form
from ccnn_torch.compensation.targets.onnx_export import export_onnx
from ccnn_torch.compensation.targets.structured_text import print_structured_text
from ccnn_torch.errors import MethodFailedError

pytestmark = pytest.mark.fuzz
CASES = 0
ROWS = 60
# The parser of Structured Text takes a second for a thousand characters.
LONGEST = 80_000
Array = NDArray[Any]
MODELS = {"little": lambda: little(1, 1, 2, turning=True), **KINDS}
# The order of a sum is the compiler's without these; what is undefined ends the program.
SANITIZED = ["-O0", "-g", *STRICT[1:], "-fsanitize=address,undefined", "-fno-sanitize-recover=all"]
BUILDS = {"gcc": ("gcc", STRICT), "gcc -O3": ("gcc", ["-O3", *STRICT[1:]]), "sanitized": ("gcc", SANITIZED)}
BUILDS |= {"clang": ("clang", ["-O2", *STRICT[1:]]), "clang, sanitized": ("clang", SANITIZED)}

# Rows come in and go out as numbers of the target's precision: joints, covariates; then command, deviation, ideal, sd,
# status and the status of the way back.
MAIN = """
#include "compensator.h"
#include <stddef.h>
#include <stdio.h>
int main(void)
{
    ccnn_real given[CCNN_JOINTS + CCNN_COVARIATES], found[4 * CCNN_JOINTS + 2];
    while (fread(given, sizeof given, 1, stdin) == 1) {
        const ccnn_real *more = CCNN_COVARIATES ? given + CCNN_JOINTS : NULL;
        ccnn_real *ideal = found + 2 * CCNN_JOINTS;
        found[4 * CCNN_JOINTS] = (ccnn_real)ccnn_compensate(given, more, found, found + CCNN_JOINTS);
        found[4 * CCNN_JOINTS + 1] = (ccnn_real)ccnn_ideal(given, more, ideal);
        ccnn_deviation_sd(given, more, ideal + CCNN_JOINTS);
        fwrite(found, sizeof found, 1, stdout);
    }
    return 0;
}
"""
EXTREMES = [float("nan"), float("inf"), float("-inf"), 5e-324, -2.3e-308, 1e-310, 1e-45, 0.0, -0.0, 1e16, 2.0**53]
EXTREMES += [
    sign * size for size in (1e30, 2.9e38, 3.5e38, 1e154, 9.9e299, 1e300, 1.01e300, 1.79e308) for sign in (1, -1)
]
numbers = st.one_of(st.sampled_from(EXTREMES), st.floats())


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("programs")


@cache
def made(kind: str, dtype: str) -> tuple[Compensator, Form, Golden] | None:
    """None where single precision does not hold the model."""
    compensator = MODELS[kind]()
    form = form_of(compensator, dtype, sd=True)
    golden = golden_vectors(compensator, form)
    if dtype == "float32":
        # Single precision has no 1e300.
        compensator.domain.huge.fill_(3e38)
    try:
        require_equal(form, golden)
    except MethodFailedError:
        assert dtype == "float32"
        return None
    return compensator, form, golden


@cache
def program(home: Path, kind: str, dtype: str, build: str) -> Path:
    folder = home / f"{kind}, {dtype}, {build}"
    folder.mkdir()
    _, form, golden = made(kind, dtype)  # type: ignore[misc]
    for name, text in {**print_c99(form, golden), "main.c": MAIN}.items():
        (folder / name).write_text(text)
    compiler, flags = BUILDS[build]
    words = [compiler, *flags, "-o", "many", "main.c", "compensator.c", "-lm"]
    subprocess.run(words, cwd=folder, check=True)
    return folder / "many"


@cache
def onnx_session(kind: str) -> Any:
    return open_onnx(export_onnx(made(kind, "float64")[0], "{}"))  # type: ignore[index]


@cache
def blocks(kind: str, dtype: str) -> dict[str, Any] | None:
    """None where the text is too long for the parser."""
    text = print_structured_text(*made(kind, dtype)[1:])["compensator.st"]  # type: ignore[index]
    return parse_blocks(text) if len(text) <= LONGEST else None


def in_c(home: Path, kind: str, form: Form, build: str, rows: Array) -> dict[str, Array]:
    words = [str(program(home, kind, form.dtype, build))]
    ran = subprocess.run(words, input=rows.astype(form.dtype).tobytes(), capture_output=True)
    assert ran.returncode == 0 and not ran.stderr, ran.stderr.decode()
    n = len(form.joints)
    found = np.frombuffer(ran.stdout, form.dtype).reshape(len(rows), 4 * n + 2)
    parts = dict(zip(("command", "deviation", "ideal", "sd"), np.split(found[:, : 4 * n], 4, -1), strict=True))
    return parts | {"status": found[:, -2].astype(int), "ideal_status": found[:, -1].astype(int)}


def in_structured_text(kind: str, form: Form, rows: Array) -> dict[str, Array] | None:
    known, n = blocks(kind, form.dtype), len(form.joints)
    if known is None:
        return None
    more = {"covariates": rows[:, n:].T} if form.covariates else {}
    one, back, sd = (Instance(known, f"CCNN_{name}", len(rows)) for name in ("Compensate", "Ideal", "DeviationSd"))
    with np.errstate(all="ignore"):
        one(joints=rows[:, :n].T, **more)
        back(command=rows[:, :n].T, **more)
        sd(command=rows[:, :n].T, **more)
    found = {name: one.values[name].T for name in ("command", "deviation", "status")} | {"sd": sd.values["sd"].T}
    return found | {"ideal": back.values["joints"].T, "ideal_status": back.values["status"]}


def promised(compensator: Compensator, form: Form, joints: Array, covariates: Array | None) -> dict[str, Array]:
    """The eager model's outputs."""
    given = torch.from_numpy(joints), None if covariates is None else torch.from_numpy(covariates)
    with torch.no_grad():
        found = compensator.solve(*given)
        clean, strange = compensator.domain.clean(compensator._inputs(*given))
        clean = clean[..., : len(form.joints)]
        sd = compensator.sd(*given)
    lost = (strange > 0).numpy()
    return {
        "command": np.where(lost, clean, found.command),
        "deviation": np.where(lost, 0.0, found.deviation),
        "ideal": np.where(lost, clean, found.ideal),
        "sd": np.where(lost, compensator.fallback_sd, sd),
        "status": found.status.numpy(),
        "ideal_status": found.ideal_status.numpy(),
    }


def in_onnx(kind: str, joints: Array, covariates: Array | None, wanted: dict[str, Array]) -> dict[str, Array]:
    """As the other ways: the standard deviation of an .onnx is that at the command."""
    compensator, _, golden = made(kind, "float64")  # type: ignore[misc]
    found = run_onnx(onnx_session(kind), joints, covariates)
    given = torch.from_numpy(joints), None if covariates is None else torch.from_numpy(covariates)
    with torch.no_grad():
        eager = compensator.solve(*given)._asdict()
    lost, far = wanted["status"] == 2, float(golden.tolerance.max())
    for name, value in eager.items():
        same = np.isclose(found[name], value.numpy(), rtol=golden.relative, atol=far)
        assert same[lost | (name == "deviation_sd")].all(), name
    new = {name: found[name] for name in ("command", "deviation", "ideal")} | {"sd": wanted["sd"]}
    new |= {name: found[name] for name in ("status", "ideal_status")}
    return {k: np.where(lost.reshape(-1, *[1] * (v.ndim - 1)), wanted[k], v) for k, v in new.items()}


def drawn(compensator: Compensator, seed: int, values: list[float]) -> Array:
    """Rows in and about the domain, where one number in three is an extreme one in two rows of three."""
    draw, domain = np.random.default_rng(seed), compensator.domain
    reach = draw.choice([0.5, 1.0, 1.5, 20.0], (ROWS, 1))
    rows = domain.centre.numpy() + domain.half_range.numpy() * reach * draw.uniform(-1, 1, (ROWS, len(domain.centre)))
    strange = (draw.random(rows.shape) < 0.34) & (draw.random((ROWS, 1)) < 0.67)
    return np.where(strange, draw.choice(np.array([*EXTREMES, *values]), rows.shape), rows)


@given(kind=st.sampled_from([*MODELS]), single=st.booleans(), seed=st.integers(0, 2**32), values=st.lists(numbers))
@example("covariates", False, 3, [])
@example("sliding arm", False, 0, [])
def test_every_target_is_the_model(
    home: Path, pytestconfig: Any, kind: str, single: bool, seed: int, values: Any
) -> None:
    whole = pytestconfig.getoption("--fuzz-cases") is not None
    known = made(kind, "float32" if single else "float64")
    if known is None:
        return
    compensator, form, golden = known
    n, rows = len(form.joints), drawn(compensator, seed, values)
    with np.errstate(over="ignore"):
        rows = rows.astype(form.dtype).astype(float)
    joints, covariates = rows[:, :n].copy(), rows[:, n:].copy() if form.covariates else None
    outputs = promised(compensator, form, joints, covariates)
    wanted = replace(golden, joints=joints, covariates=rows[:, n:], outputs=outputs)
    ways = {"form": run_form(form, joints, covariates)}
    if not single:
        ways["onnx"] = in_onnx(kind, joints, covariates, outputs)
    builds = [b for b, (compiler, _) in BUILDS.items() if shutil.which(compiler) and (whole or b == "sanitized")]
    ways |= {build: in_c(home, kind, form, build, rows) for build in builds}
    text = in_structured_text(kind, form, rows) if whole else None
    ways |= {} if text is None else {"st": text}
    for way, found in ways.items():
        wrong = {name: share for name, share in wanted.errors(found).items() if not share <= 1}
        assert wrong == {}, (way, [rows[(found[name] != outputs[name]).reshape(ROWS, -1).any(-1)] for name in wrong])
