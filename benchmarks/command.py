"""Microseconds of one command by every way of running a model: `python benchmarks/command.py MODEL_FOLDER [CALLS]`.

MODEL_FOLDER holds the model files and their card, as `ccnn run` writes them.
Prints p50 and p99 of single calls on one thread, and p50 as a ratio to ONNX Runtime's.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import onnxruntime
import torch

from ccnn_torch.compensation import load_model


def percentiles(call: Callable[[], object], calls: int) -> tuple[float, float]:
    """p50 and p99 of single calls [µs]."""
    for _ in range(calls // 10):
        call()
    times = np.empty(calls)
    for k in range(calls):
        start = time.perf_counter_ns()
        call()
        times[k] = time.perf_counter_ns() - start
    p50, p99 = np.percentile(times, (50, 99)) / 1e3
    return float(p50), float(p99)


def session(path: Path) -> onnxruntime.InferenceSession:
    """ONNX Runtime on one thread, as a controller would run it."""
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    return onnxruntime.InferenceSession(path, options)


def main(folder: Path, calls: int) -> None:
    """Measure and print."""
    torch.set_num_threads(1)
    master = load_model(folder / "model.safetensors")
    compensator = master.compensator
    assert compensator is not None
    point, n = compensator.domain.centre.unsqueeze(0), len(compensator.joints)
    tensors = (point[:, :n].clone(), point[:, n:].clone())[: 2 if compensator.covariates else 1]
    feeds = dict(zip(("joints", "covariates"), (t.numpy() for t in tensors), strict=False))
    single = {name: value.astype(np.float32) for name, value in feeds.items()}
    double_session, single_session = session(folder / "model.onnx"), session(folder / "model.float32.onnx")
    loaded = load_model(folder / "model.onnx")
    ways: dict[str, Callable[[], object]] = {
        "onnxruntime, float64": lambda: double_session.run(None, feeds),
        "onnxruntime, float32": lambda: single_session.run(None, single),
        "load_model(.onnx)": lambda: loaded(*feeds.values()),
        "eager": lambda: compensator(*tensors),
    }
    print(f"{folder}: {compensator.iterations} steps of the fixed point, {calls} calls")
    print(f"{'':24}{'p50 µs':>10}{'p99 µs':>10}{'ratio':>10}")
    base = None
    with torch.inference_mode():
        for name, call in ways.items():
            p50, p99 = percentiles(call, calls)
            base = base or p50
            print(f"{name:24}{p50:10.1f}{p99:10.1f}{p50 / base:10.2f}")


if __name__ == "__main__":
    if len(sys.argv) < 2:
        sys.exit(__doc__)
    main(Path(sys.argv[1]), int(sys.argv[2]) if len(sys.argv) > 2 else 2000)
