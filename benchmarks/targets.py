"""A command as it runs on a controller, by gcc and clang where they are, and by hand.

For a tripod with a CCNN 3-6-6-3 (all connections, then 40 % of them) and the model of a folder: eager, ONNX Runtime,
our C in double and single precision, and for the dense tripod C written by hand with the same network, guard and fixed
point. Every way follows one trajectory, as a controller of 1 kHz would send it: a million commands (a hundredth with
`--quick`, and again in Python) along sines in the domain, in five rounds of all ways, each command between two
readings of the clock: p50, with p99 and largest in the note; a ratio is the median over the rounds. The C program
counts calls of malloc, calloc and realloc in its loop. Then 100,000 vectors, in and out of the domain, by all ways:
largest difference of the deviation from the eager model's, as a share of the limit.
"""

from __future__ import annotations

import ctypes
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime
import torch

ROOT = Path(__file__).parent.parent
sys.path[:0] = [str(ROOT / "tests"), str(ROOT / "tests" / "compensation")]

from kinds import masked  # noqa: E402

from benchmarks.command import session  # noqa: E402
from benchmarks.measure import Row  # noqa: E402
from ccnn_torch.compensation import Compensator, load_model  # noqa: E402
from ccnn_torch.compensation.outputs import OUTPUTS  # noqa: E402
from ccnn_torch.compensation.targets.c99 import print_c99  # noqa: E402
from ccnn_torch.compensation.targets.export import COMMAND  # noqa: E402
from ccnn_torch.compensation.targets.from_model import form_of  # noqa: E402
from ccnn_torch.compensation.targets.golden import golden_vectors, require_equal  # noqa: E402
from ccnn_torch.compensation.targets.onnx_export import export_onnx  # noqa: E402
from ccnn_torch.errors import MethodFailedError  # noqa: E402

# In each round every way follows the trajectory once.
ROUNDS = 5

_TIMER = """
#include "compensator.h"
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>
extern void *__libc_malloc(size_t size);
extern void *__libc_calloc(size_t count, size_t size);
extern void *__libc_realloc(void *old, size_t size);
static long allocations = 0;
void *malloc(size_t size) { allocations++; return __libc_malloc(size); }
void *calloc(size_t count, size_t size) { allocations++; return __libc_calloc(count, size); }
void *realloc(void *old, size_t size) { allocations++; return __libc_realloc(old, size); }
static const double low[] = { @LOW@ }, high[] = { @HIGH@ };
static int compare(const void *a, const void *b)
{
    const double x = *(const double *)a, y = *(const double *)b;
    return (x > y) - (x < y);
}
void ccnn_many(const double *given, double *found, long rows)
{
    for (long k = 0; k < rows; k++) {
        ccnn_real q[@N@], command[@N@], deviation[@N@];
        for (int j = 0; j < @N@; j++) q[j] = (ccnn_real)given[k * @N@ + j];
        ccnn_compensate(q, NULL, command, deviation);
        for (int j = 0; j < @N@; j++) found[k * @N@ + j] = deviation[j];
    }
}
int main(void)
{
    double *taken = malloc(@CALLS@ * sizeof(double));
    const long before = allocations;
    ccnn_real q[@N@], command[@N@], deviation[@N@], sum = 0;
    memset(taken, 0, @CALLS@ * sizeof(double));
    for (long k = 0; k < @CALLS@; k++) {
        struct timespec a, b;
        for (int j = 0; j < @N@; j++) {
            const double s = sin(6.283185307 * (0.2 + 0.1 * j) * 1e-3 * (double)k);
            q[j] = (ccnn_real)((low[j] + high[j]) / 2 + s * (high[j] - low[j]) / 2);
        }
        clock_gettime(CLOCK_MONOTONIC, &a);
        ccnn_compensate(q, NULL, command, deviation);
        clock_gettime(CLOCK_MONOTONIC, &b);
        sum += command[0];
        taken[k] = (double)(b.tv_sec - a.tv_sec) * 1e6 + (double)(b.tv_nsec - a.tv_nsec) / 1e3;
    }
    const long within = allocations - before;
    qsort(taken, @CALLS@, sizeof(double), compare);
    printf("%.3f %.3f %.3f ", taken[@CALLS@ / 2], taken[@CALLS@ / 100 * 99], taken[@CALLS@ - 1]);
    printf("%ld %ld\\n", within, before);
    return sum != sum;
}
"""

_LAYER = """
    double a@NEXT@[@OUT@];
    for (int i = 0; i < @OUT@; i++) {
        double s = b@K@[i];
        for (int j = 0; j < @IN@; j++) s += w@K@[i][j] * a@K@[j];
        a@NEXT@[i] = @VALUE@;
    }"""

# What a programmer would write: loops over the network's matrices, the guard, and the fixed point around them.
_BY_HAND = """
#include "compensator.h"
#include <math.h>
@TABLES@
static double delta(const double q[@N@], double d[@N@])
{
    double x[@N@], a0[@N@], u = 0.0;
    for (int j = 0; j < @N@; j++) {
        x[j] = fmin(fmax(q[j], cage_low[j]), cage_high[j]);
        a0[j] = (x[j] - centre[j]) / half[j];
    }
@LAYERS@
    for (int i = 0; i < 2 * @N@; i++) {
        double y = 0.0;
        for (int j = 0; j < @N@; j++) y += axes[j][i] * (x[j] - middle_of[j]);
        const double e = fmax(fabs(y - middle[i]) - radius[i], 0.0) / width[i];
        u += e * e;
    }
    const double fade = fmax(1.0 - u, 0.0), weight = fade * fade;
    for (int i = 0; i < @N@; i++) {
        const double s = fmin(fmax(@LAST@[i] * scale[i] + mean[i], -limit[i]), limit[i]);
        d[i] = fmin(fmax(weight * s + (1.0 - weight) * safe[i], -limit[i]), limit[i]);
    }
    return u;
}
int ccnn_compensate(const double joints[], const double covariates[], double command[], double deviation[])
{
    (void)covariates;
    for (int j = 0; j < @N@; j++) {
        if (!(fabs(joints[j]) < 1e300)) return 2;
    }
    double u = delta(joints, deviation);
    for (int k = 0; k < @STEPS@; k++) {
        for (int j = 0; j < @N@; j++) command[j] = joints[j] - deviation[j];
        u = delta(command, deviation);
    }
    return u > 0.0;
}
"""


def by_hand(compensator: Compensator) -> str:
    """The program with the model's numbers."""
    domain, scaling = compensator.domain, compensator.scaling
    layers: Any = compensator.network.layers
    tables = {f"w{k}": layer.weight for k, layer in enumerate(layers)}
    tables |= {f"b{k}": layer.bias for k, layer in enumerate(layers)}
    tables |= {"centre": scaling.centre, "half": scaling.half_range, "mean": scaling.mean, "scale": scaling.deviation}
    tables |= {"cage_low": domain._cage_low, "cage_high": domain._cage_high, "axes": domain._axes}
    tables |= {"middle_of": domain.centre, "middle": domain.middle, "radius": domain.radius, "width": domain.width}
    tables |= {"limit": compensator.limit, "safe": compensator.safe}
    lines = []
    for name, values in tables.items():
        numbers = repr(values.tolist()).replace("[", "{").replace("]", "}")
        lines.append(f"static const double {name}{''.join(f'[{n}]' for n in values.shape)} = {numbers};")
    parts = []
    for k, layer in enumerate(layers):
        value = "s" if k == len(layers) - 1 else "1.0 / (1.0 + exp(-s))"
        names = {"OUT": layer.out_features, "IN": layer.in_features, "NEXT": k + 1, "K": k, "VALUE": value}
        parts.append(_filled(_LAYER, names))
    names = {"TABLES": "\n".join(lines), "LAYERS": "".join(parts), "LAST": f"a{len(layers)}"}
    return _filled(_BY_HAND, names | {"STEPS": compensator.iterations, "N": len(compensator.joints)})


def _filled(text: str, names: dict[str, object]) -> str:
    for key, value in names.items():
        text = text.replace(f"@{key}@", str(value))
    return text


def built(
    folder: Path, compensator: Compensator, calls: int, compiler: str, given: np.ndarray
) -> tuple[Callable[[], list[float]], int, np.ndarray]:
    """What times so many commands, giving p50, p99, largest [µs], allocations; bytes of code and tables; deviations."""
    n = len(compensator.joints)
    low, high = reach(compensator)
    names = {"@LOW@": ", ".join(map(repr, low)), "@HIGH@": ", ".join(map(repr, high)), "@N@": str(n)}
    text = _TIMER.replace("@CALLS@", str(calls))
    for key, value in names.items():
        text = text.replace(key, value)
    (folder / "timer.c").write_text(text)
    flags = [compiler, "-O2", "-std=gnu99", "-ffp-contract=off", "-fno-builtin-malloc", "-fPIC"]
    subprocess.run([*flags, "-c", "compensator.c"], cwd=folder, check=True)
    # Under names of their own: a library of a known name is not loaded again.
    number = len([*folder.glob("many*")])
    program, library = folder / f"timer{number}", folder / f"many{number}.so"
    for words in (["-o", program.name], ["-shared", "-o", library.name]):
        subprocess.run([*flags, "timer.c", "compensator.o", *words, "-lm"], cwd=folder, check=True)
    size = subprocess.run(["size", "compensator.o"], cwd=folder, check=True, capture_output=True, text=True).stdout
    found = np.zeros_like(given)
    pointers = [v.ctypes.data_as(ctypes.c_void_p) for v in (given, found)]
    ctypes.CDLL(str(library)).ccnn_many(*pointers, ctypes.c_long(len(given)))

    def timed() -> list[float]:
        told = subprocess.run([str(program)], check=True, capture_output=True, text=True).stdout.split()
        assert int(told[4]) == 1, "the hook counts"
        return [float(word) for word in told[:4]]

    return timed, sum(map(int, size.splitlines()[1].split()[:3])), found


def reach(compensator: Compensator) -> tuple[list[float], list[float]]:
    """The part of the domain that the trajectory is in."""
    domain, n = compensator.domain, len(compensator.joints)
    centre, half = domain.centre[:n], 0.5 * domain.half_range[:n]
    return (centre - half).tolist(), (centre + half).tolist()


def streamed(compensator: Compensator, call: Callable[[np.ndarray], object], cycles: int) -> list[float]:
    """p50, p99 and largest [µs] of the same trajectory in Python."""
    low, high = (np.array(v) for v in reach(compensator))
    speed = 2 * np.pi * (0.2 + 0.1 * np.arange(len(low))) * 1e-3
    rows = (low + high) / 2 + np.sin(speed * np.arange(cycles)[:, None]) * (high - low) / 2
    times = np.empty(cycles)
    for k in range(cycles):
        row = rows[k : k + 1]
        start = time.perf_counter_ns()
        call(row)
        times[k] = time.perf_counter_ns() - start
    return [float(v) / 1e3 for v in (*np.percentile(times, (50, 99)), times.max())]


def bound(run: onnxruntime.InferenceSession, row: np.ndarray) -> Callable[[np.ndarray], object]:
    """Inputs and outputs stay where they are from call to call."""
    binding, value = run.io_binding(), onnxruntime.OrtValue.ortvalue_from_numpy(row)
    binding.bind_ortvalue_input("joints", value)
    for output in run.get_outputs():
        binding.bind_output(output.name)

    def call(q: np.ndarray) -> None:
        value.update_inplace(q)
        run.run_with_iobinding(binding)

    return call


def measure(name: str, compensator: Compensator, calls: int, hand: bool) -> Iterator[Row]:
    """Measure one model: every way once a round, one after the other."""
    n, domain, limit = len(compensator.joints), compensator.domain, compensator.limit.numpy()
    draw = torch.rand(100_000, n, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    given = (domain.centre + domain.half_range * (4 * draw - 2)).numpy()
    calls //= ROUNDS
    with torch.no_grad(), tempfile.TemporaryDirectory() as made:
        wanted = compensator(torch.from_numpy(given))[1].numpy()
        # Of each way what times it, bytes, and how far its deviations are off, as a share of the limit.
        ways: dict[str, tuple[Callable[[], list[float]], int, float]] = {}

        def python(way: str, call: Callable[[np.ndarray], object], size: int, off: float) -> None:
            ways[way] = (lambda: streamed(compensator, call, calls // 100), size, off)

        def compiled(way: str, compiler: str) -> None:
            timed, size, found = built(folder, compensator, calls, compiler, given)
            ways[way] = (timed, size, float((np.abs(found - wanted) / limit).max()))

        python("eager", lambda q: compensator(torch.from_numpy(q)), 0, 0.0)
        folder = Path(made)
        for file, outputs in (("model.onnx", OUTPUTS), ("controller.onnx", COMMAND)):
            content = export_onnx(compensator, "{}", outputs)
            (folder / file).write_bytes(content)
            run = session(folder / file)
            parts = [run.run(["deviation"], {"joints": part})[0] for part in np.array_split(given, 100)]
            off = np.abs((np.concatenate(parts) - wanted) / limit).max()
            plain = file == "model.onnx"
            call = (lambda q, run=run: run.run(None, {"joints": q})) if plain else bound(run, given[:1].copy())
            python(f"onnxruntime, {file}", call, len(content), off)
        for dtype in ("float64", "float32"):
            try:
                form = form_of(compensator, dtype)
                golden = golden_vectors(compensator, form)
                require_equal(form, golden)
            except MethodFailedError as reason:
                print(f"  ccnn export, {dtype}: {reason}")
                continue
            for file, text in print_c99(form, golden).items():
                (folder / file).write_text(text)
            for compiler in filter(shutil.which, ("gcc", "clang")):
                compiled(f"ccnn export, {dtype}, {compiler}", compiler)
            if hand and dtype == "float64":
                (folder / "compensator.c").write_text(by_hand(compensator))
                compiled("written by hand, float64, gcc", "gcc")
        rounds = [{way: timed() for way, (timed, _, _) in ways.items()} for _ in range(ROUNDS)]
    ours = "ccnn export, float64, gcc" if "ccnn export, float64, gcc" in ways else "eager"
    base = statistics.median(one[ours][0] for one in rounds)
    for way, (_, size, off) in ways.items():
        ratio = statistics.median(one[way][0] / one[ours][0] for one in rounds)
        p99, most = statistics.median(one[way][1] for one in rounds), max(one[way][2] for one in rounds)
        counted = f", {rounds[0][way][3]:.0f} allocations" if len(rounds[0][way]) > 3 else ""
        counted += f", {size} bytes" if size else ""
        note = f"p99 {p99:.2f} µs, largest {most:.0f} µs{counted}, off by {off:.0e} of the limit"
        yield Row(f"one command of {name}", 1, "command", base * 1e-6, way, ratio, None, note)


def run(quick: bool, model: Path | None = None) -> Iterator[Row]:
    """Dense, masked, and the model of the folder that is named."""
    # It tells of nodes that it does not fold.
    onnxruntime.set_default_logger_severity(3)
    calls = 10_000 if quick else 1_000_000
    yield from measure("a dense tripod, CCNN 3-6-6-3", masked(1.0), calls, True)
    if not quick:
        yield from measure("a masked tripod, CCNN 3-6-6-3", masked(0.4), calls, False)
    if model is not None:
        compensator = load_model(model / "model.safetensors").compensator
        assert compensator is not None and not compensator.covariates
        yield from measure(
            f"the model in {model.name}",
            compensator,
            calls,
            compensator.machine is None,
        )
