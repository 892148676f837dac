"""Microseconds of one command as it runs on a controller: `python benchmarks/targets.py [CALLS]`; needs gcc.

For a tripod with a CCNN 3-6-6-3 (all connections, then 40 % of them) and an arm of six joints with identified links,
a masked network and 40 harmonics a joint: eager, ONNX Runtime in double, our C in double and single precision, and for
the dense tripod a C program written by hand with the same network, guard and fixed point. p50 and p99 of single calls
on one core, each between two readings of the clock, with inputs inside the domain; -O2.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
import onnxruntime
import torch
from command import percentiles, session

ROOT = Path(__file__).parent.parent
sys.path[:0] = [str(ROOT / "tests"), str(ROOT / "tests" / "compensation")]

from kinds import masked, six_joints  # noqa: E402

from ccnn_torch.compensation import Compensator  # noqa: E402
from ccnn_torch.compensation.export.export import export_onnx, trace  # noqa: E402
from ccnn_torch.compensation.targets.c99 import print_c99  # noqa: E402
from ccnn_torch.compensation.targets.from_model import form_of  # noqa: E402
from ccnn_torch.compensation.targets.golden import golden_vectors, require_equal  # noqa: E402

_TIMER = """
#include "compensator.h"
#include <stdio.h>
#include <stdlib.h>
#include <time.h>
static const ccnn_real given[] = { @GIVEN@ };
static double taken[@CALLS@];
static int compare(const void *a, const void *b)
{
    const double x = *(const double *)a, y = *(const double *)b;
    return (x > y) - (x < y);
}
int main(void)
{
    ccnn_real command[16], deviation[16], sum = 0;
    for (int k = 0; k < @CALLS@; k++) {
        struct timespec a, b;
        clock_gettime(CLOCK_MONOTONIC, &a);
        ccnn_compensate(given + (k % 1000) * @N@, NULL, command, deviation);
        clock_gettime(CLOCK_MONOTONIC, &b);
        sum += command[0];
        taken[k] = (double)(b.tv_sec - a.tv_sec) * 1e6 + (double)(b.tv_nsec - a.tv_nsec) / 1e3;
    }
    qsort(taken, @CALLS@, sizeof(double), compare);
    printf("%.3f %.3f %g\\n", taken[@CALLS@ / 2], taken[@CALLS@ / 100 * 99], (double)sum);
    return 0;
}
"""

# What a programmer would write: loops over the network's matrices, the guard, and the fixed point around them.
_BY_HAND = """
#include "compensator.h"
#include <math.h>
@TABLES@
static double delta(const double q[3], double d[3])
{
    double x[3], f[3], a[6], b[6], u = 0.0;
    for (int j = 0; j < 3; j++) {
        x[j] = fmin(fmax(q[j], cage_low[j]), cage_high[j]);
        f[j] = (x[j] - centre[j]) / half[j];
    }
    for (int i = 0; i < 6; i++) {
        double s = b0[i];
        for (int j = 0; j < 3; j++) s += w0[i][j] * f[j];
        a[i] = 1.0 / (1.0 + exp(-s));
    }
    for (int i = 0; i < 6; i++) {
        double s = b1[i];
        for (int j = 0; j < 6; j++) s += w1[i][j] * a[j];
        b[i] = 1.0 / (1.0 + exp(-s));
    }
    for (int i = 0; i < 6; i++) {
        double y = 0.0;
        for (int j = 0; j < 3; j++) y += axes[j][i] * (x[j] - middle_of[j]);
        const double e = fmax(fabs(y - middle[i]) - radius[i], 0.0) / width[i];
        u += e * e;
    }
    const double fade = fmax(1.0 - u, 0.0), weight = fade * fade;
    for (int i = 0; i < 3; i++) {
        double s = b2[i];
        for (int j = 0; j < 6; j++) s += w2[i][j] * b[j];
        s = fmin(fmax(s * scale[i] + mean[i], -limit[i]), limit[i]);
        d[i] = fmin(fmax(weight * s + (1.0 - weight) * safe[i], -limit[i]), limit[i]);
    }
    return u;
}
int ccnn_compensate(const double joints[], const double covariates[], double command[], double deviation[])
{
    (void)covariates;
    for (int j = 0; j < 3; j++) {
        if (!(fabs(joints[j]) < 1e300)) return 2;
    }
    double u = delta(joints, deviation);
    for (int k = 0; k < @STEPS@; k++) {
        for (int j = 0; j < 3; j++) command[j] = joints[j] - deviation[j];
        u = delta(command, deviation);
    }
    return u > 0.0;
}
"""


def by_hand(compensator: Compensator) -> str:
    """The program with the model's numbers."""
    domain, scaling, layers = compensator.domain, compensator.scaling, compensator.network.layers
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
    return _BY_HAND.replace("@TABLES@", "\n".join(lines)).replace("@STEPS@", str(compensator.iterations))


def timed(folder: Path, points: np.ndarray, calls: int) -> tuple[float, float, float]:
    """p50 and p99 of the program in a folder [µs], and the sum of its first commands, which shows what it did."""
    text = _TIMER.replace("@GIVEN@", ", ".join(map(repr, points.ravel().tolist()))).replace("@CALLS@", str(calls))
    (folder / "timer.c").write_text(text.replace("@N@", str(points.shape[1])))
    sources = [str(folder / name) for name in ("timer.c", "compensator.c")]
    words = ["gcc", "-O2", "-std=gnu99", "-ffp-contract=off", "-o", str(folder / "timer"), *sources, "-lm"]
    subprocess.run(words, check=True)
    told = subprocess.run([str(folder / "timer")], check=True, capture_output=True, text=True).stdout
    p50, p99, total = map(float, told.split())
    return p50, p99, total


def measure(name: str, compensator: Compensator, calls: int, hand: bool) -> None:
    """Measure one model and print its rows."""
    n, domain = len(compensator.joints), compensator.domain
    draw = torch.rand(1000, n, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    points = (domain.centre + domain.half_range * (1.2 * draw - 0.6)).numpy()
    print(f"{name}: {compensator.iterations} steps of the fixed point")
    one = torch.from_numpy(points[:1].copy())
    with torch.inference_mode():
        rows = {"eager": (*percentiles(lambda: compensator(one), 2000), None)}
    with tempfile.TemporaryDirectory() as made:
        folder = Path(made)
        (folder / "m.onnx").write_bytes(export_onnx(compensator, trace(compensator), "{}"))
        run = session(folder / "m.onnx")
        feeds = {"joints": points[:1]}
        rows["onnxruntime, float64"] = (*percentiles(lambda: run.run(None, feeds), 2000), None)
        for dtype in ("float64", "float32"):
            form = form_of(compensator, dtype)
            golden = golden_vectors(compensator, form)
            if dtype == "float64":
                require_equal(form, golden)
            for file, content in print_c99(form, golden).items():
                (folder / file).write_text(content)
            rows[f"ccnn export, {dtype}"] = timed(folder, points, calls)
            if hand and dtype == "float64":
                (folder / "compensator.c").write_text(by_hand(compensator))
                rows["written by hand, float64"] = timed(folder, points, calls)
    for way, (p50, p99, total) in rows.items():
        print(f"  {way:26}{p50:10.2f}{p99:10.2f}" + ("" if total is None else f"   sum {total:.9g}"))


def main(calls: int) -> None:
    """Measure all and print."""
    torch.set_num_threads(1)
    # It tells of nodes that it does not fold.
    onnxruntime.set_default_logger_severity(3)
    print(f"{'':28}{'p50 µs':>10}{'p99 µs':>10}   (sum: of the first joint's commands)")
    measure("tripod, CCNN 3-6-6-3, all connections", masked(1.0), calls, True)
    measure("tripod, CCNN 3-6-6-3, masked", masked(0.4), calls, False)
    measure("six joints, links, masks, 40 harmonics", six_joints(40), calls, False)


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 100_000)
