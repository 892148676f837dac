"""One command of a model, by every way of running it in Python: the folder is one that `ccnn run` writes."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime
import torch

from benchmarks.measure import Row, compare
from ccnn_torch.compensation import load_model
from ccnn_torch.compensation.targets.export import COMMAND
from ccnn_torch.compensation.targets.onnx_export import export_onnx


def run(quick: bool, model: Path | None = None) -> Iterator[Row]:
    """Eager torch beside ONNX Runtime in double and single precision."""
    assert model is not None
    compensator = load_model(model / "model.safetensors").compensator
    assert compensator is not None
    point, n = compensator.domain.centre.unsqueeze(0), len(compensator.joints)
    tensors = (point[:, :n].clone(), point[:, n:].clone())[: 2 if compensator.covariates else 1]
    feeds = dict(zip(("joints", "covariates"), (t.numpy() for t in tensors), strict=False))
    single = {name: value.astype(np.float32) for name, value in feeds.items()}
    double_session, single_session = session(model / "model.onnx"), session(model / "model.float32.onnx")
    alone = session(export_onnx(compensator, "{}", COMMAND))

    def eager() -> Any:
        with torch.inference_mode():
            return compensator(*tensors)

    yield from compare(
        f"one command, {model.name}",
        1,
        "command",
        eager,
        {
            "ONNX Runtime, float64": lambda: double_session.run(None, feeds),
            "ONNX Runtime, float64, the command alone": lambda: alone.run(None, feeds),
            "ONNX Runtime, float32": lambda: single_session.run(None, single),
        },
        note="single calls of ONNX Runtime, float64, the command alone: p50 {:.0f} µs, p99 {:.0f} µs".format(
            *percentiles(lambda: alone.run(None, feeds), 1000 if quick else 10_000)
        ),
    )


def percentiles(call: Callable[[], Any], calls: int) -> tuple[float, float]:
    """p50 and p99 of single calls by the clock [µs]."""
    times = []
    for _ in range(calls):
        start = time.perf_counter_ns()
        call()
        times.append((time.perf_counter_ns() - start) / 1e3)
    cut = statistics.quantiles(times, n=100)
    return cut[49], cut[98]


def session(path: Path | bytes) -> onnxruntime.InferenceSession:
    """ONNX Runtime on one thread, as a controller would run it."""
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    return onnxruntime.InferenceSession(path, options)
