"""All ways to run a model against PyTorch over 100,000 vectors, for every kind: `python -m benchmarks.equality`.

Arguments: number of vectors (100000), then further model.safetensors. Prints for each kind of model the largest
difference of the deviation as a share of the limit, and how often the status is another one: C and ONNX Runtime in
double and single precision, and Structured Text by the tests' interpreter. Vectors are in and out of the domain.
"""

from __future__ import annotations

import ctypes
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import onnxruntime
import torch

from benchmarks.command import session

ROOT = Path(__file__).parent.parent
sys.path[:0] = [str(ROOT / "tests"), str(ROOT / "tests" / "compensation")]

from kinds import KINDS  # noqa: E402
from structured_text import Instance, parse_blocks  # noqa: E402

from ccnn_torch.compensation import Compensator, load_model  # noqa: E402
from ccnn_torch.compensation.targets.c99 import print_c99  # noqa: E402
from ccnn_torch.compensation.targets.from_model import form_of  # noqa: E402
from ccnn_torch.compensation.targets.golden import golden_vectors, require_equal  # noqa: E402
from ccnn_torch.compensation.targets.onnx_export import export_float32, export_onnx  # noqa: E402
from ccnn_torch.compensation.targets.structured_text import print_structured_text  # noqa: E402
from ccnn_torch.errors import MethodFailedError  # noqa: E402

# Longer texts keep the parser of Structured Text busy for hours.
_LONGEST = 80_000
Array = np.ndarray
# Deviation and, where the way tells it, status.
Found = tuple[Array, Array | None]

_MANY = """
#include "compensator.h"
#include <stddef.h>
void many(const double *joints, const double *covariates, double *deviation, int *status, long rows)
{
    ccnn_real q[CCNN_JOINTS], x[CCNN_COVARIATES + 1], command[CCNN_JOINTS], found[CCNN_JOINTS];
    for (long k = 0; k < rows; k++) {
        for (int j = 0; j < CCNN_JOINTS; j++) q[j] = (ccnn_real)joints[k * CCNN_JOINTS + j];
        for (int j = 0; j < CCNN_COVARIATES; j++) x[j] = (ccnn_real)covariates[k * CCNN_COVARIATES + j];
        status[k] = ccnn_compensate(q, x, command, found);
        for (int j = 0; j < CCNN_JOINTS; j++) deviation[k * CCNN_JOINTS + j] = found[j];
    }
}
"""


def in_c(compensator: Compensator, dtype: str, joints: Array, covariates: Array) -> Found:
    """The exported C, compiled by gcc."""
    form = form_of(compensator, dtype)
    golden = golden_vectors(compensator, form)
    require_equal(form, golden)
    folder = Path(tempfile.mkdtemp())
    for name, text in {**print_c99(form, golden), "many.c": _MANY}.items():
        (folder / name).write_text(text)
    words = ["gcc", "-O2", "-std=c99", "-ffp-contract=off", "-fPIC", "-shared", "-o", "many.so"]
    subprocess.run([*words, "many.c", "compensator.c", "-lm"], cwd=folder, check=True)
    deviation, status = np.empty_like(joints), np.empty(len(joints), np.int32)
    given = [v.ctypes.data_as(ctypes.c_void_p) for v in (joints, covariates, deviation, status)]
    ctypes.CDLL(str(folder / "many.so")).many(*given, ctypes.c_long(len(joints)))
    return deviation, status


def in_onnx(compensator: Compensator, dtype: str, joints: Array, covariates: Array) -> Found:
    """ONNX Runtime; in single precision row by row, as that file wants it."""
    single = dtype == "float32"
    content = (export_float32 if single else export_onnx)(compensator, "{}")
    with tempfile.NamedTemporaryFile(suffix=".onnx") as file:
        file.write(content)
        file.flush()
        run = session(Path(file.name))
    feeds = {"joints": joints.astype(dtype)} | ({"covariates": covariates.astype(dtype)} if covariates.size else {})
    size, names = (1 if single else 1000), ["deviation"] + ([] if single else ["inside_domain"])
    parts = [run.run(names, {k: v[i : i + size] for k, v in feeds.items()}) for i in range(0, len(joints), size)]
    deviation, *inside = (np.concatenate(part) for part in zip(*parts, strict=True))
    return deviation, 1 - inside[0].astype(int) if inside else None


def in_structured_text(compensator: Compensator, dtype: str, joints: Array, covariates: Array) -> Found:
    """Structured Text, executed by the tests' interpreter."""
    form = form_of(compensator, dtype)
    golden = golden_vectors(compensator, form)
    require_equal(form, golden)
    text = print_structured_text(form, golden)["compensator.st"]
    if len(text) > _LONGEST:
        raise MethodFailedError(f"{len(text)} characters")
    blocks, found = parse_blocks(text), []
    for part, more in zip(np.array_split(joints, 50), np.array_split(covariates, 50), strict=True):
        block = Instance(blocks, "CCNN_Compensate", len(part))
        with np.errstate(all="ignore"):
            block(joints=part.T, **({"covariates": more.T} if covariates.size else {}))
        found.append((block.values["deviation"].T.copy(), block.values["status"].copy()))
    deviation, status = (np.concatenate(v) for v in zip(*found, strict=True))
    return deviation, status


WAYS: dict[str, tuple[Callable[[Compensator, str, Array, Array], Found], str]] = {
    "C99, float64": (in_c, "float64"),
    "ONNX Runtime, float64": (in_onnx, "float64"),
    "Structured Text, LREAL": (in_structured_text, "float64"),
    "C99, float32": (in_c, "float32"),
    "ONNX Runtime, float32": (in_onnx, "float32"),
    "Structured Text, REAL": (in_structured_text, "float32"),
}


def compare(name: str, compensator: Compensator, rows: int) -> None:
    """One line of the table."""
    n, domain, limit = len(compensator.joints), compensator.domain, compensator.limit.numpy()
    draw = torch.rand(rows, len(domain.centre), generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    given = domain.centre + domain.half_range * (4 * draw - 2)
    joints, covariates = given[:, :n].contiguous(), given[:, n:].contiguous()
    with torch.inference_mode():
        parts = [
            compensator(q, x if n < given.shape[1] else None)[1:]
            for q, x in zip(torch.split(joints, 2000), torch.split(covariates, 2000), strict=True)
        ]
    wanted, inside = (torch.cat(v).numpy() for v in zip(*parts, strict=True))
    cells = []
    for way, dtype in WAYS.values():
        start = time.perf_counter()
        try:
            deviation, status = way(compensator, dtype, joints.numpy(), covariates.numpy())
        except MethodFailedError as reason:
            print(f"    {name}, {way.__name__}, {dtype}: {reason}", file=sys.stderr)
            cells.append("-")
            continue
        # A joint that never deviates has no limit.
        share = (np.abs(deviation - wanted) / np.where(limit > 0, limit, 1)).max()
        others = 0 if status is None else int(((status == 0) != inside).sum())
        cells.append(f"{share:.1e}" + (f" ({others})" if others else ""))
        print(f"    {name}, {way.__name__}, {dtype}: {time.perf_counter() - start:.0f} s", file=sys.stderr)
    print(f"| {name} | {compensator.iterations} | " + " | ".join(cells) + " |", flush=True)


def main(rows: int, models: list[str]) -> None:
    """Compare all and print a table."""
    torch.set_num_threads(1)
    onnxruntime.set_default_logger_severity(3)
    print("| model | steps | " + " | ".join(WAYS) + " |\n|" + " --- |" * (len(WAYS) + 2))
    for name, make in KINDS.items():
        compare(name, make(), rows)
    for path in models:
        compensator = load_model(path).compensator
        assert compensator is not None
        compare(path, compensator, rows)


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 100_000, sys.argv[2:])
