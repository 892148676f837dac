"""Rows of the benchmarks' table: a task beside named peers and this machine's matrix product, in alternating rounds.

Times are of the processor, this process and its children, so that a busy machine disturbs little. A ratio is the median
over the rounds of peer / ours, both measured in the same round.
"""

from __future__ import annotations

import os
import statistics
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

import torch
from torch.utils.flop_counter import FlopCounterMode

__all__ = ["Row", "compare", "operations", "seconds_of"]

Call = Callable[[], Any]

# A round of a short task repeats it until it has taken so long [s]; the clock's own steps are far below.
_ROUND = 0.03
# A task so long is not run once more than its rounds say [s].
_LONG = 2.0
# Size of the product that the machine's limit is measured with: 100 ms at 20 GFLOP/s would disturb the rounds.
_GEMM = 512


@dataclass(frozen=True)
class Row:
    """One line of the table.

    Attributes:
        task: what was done, by this package and by the peer.
        size, of: how much of what, such as 1000 "rows".
        seconds: of this package, the median.
        peer: the other's name; "" where there is none.
        ratio: peer's seconds / ours; None where there is no peer.
        limit: share of the operations that a float64 matrix product of this machine makes in the same time; None where
            they are not counted.
        note: what else there is to know.
    """

    task: str
    size: int
    of: str
    seconds: float
    peer: str = ""
    ratio: float | None = None
    limit: float | None = None
    note: str = ""


def seconds_of(call: Call) -> float:
    """Processor seconds of one call, those of processes that it waited for included."""
    before, children = time.process_time(), os.times()
    call()
    after = os.times()
    own = time.process_time() - before
    return own + after.children_user - children.children_user + after.children_system - children.children_system


def _repeat(call: Call, often: int) -> None:
    for _ in range(often):
        call()


def operations(call: Call) -> int:
    """Floating point operations of one call: matrix products, factors and solutions of equations."""

    def factor(shape: torch.Size, *_: Any, **__: Any) -> int:
        return shape.numel() * shape[-1] // 3

    def triangular(shape: torch.Size, right: torch.Size, *_: Any, **__: Any) -> int:
        return right.numel() * shape[-1]

    def both(right: torch.Size, *_: Any, **__: Any) -> int:
        return 2 * right.numel() * right[-2]

    aten = torch.ops.aten
    known = {aten.linalg_cholesky_ex: factor, aten.linalg_solve_triangular: triangular, aten.cholesky_solve: both}
    with FlopCounterMode(display=False, custom_mapping=known) as counted:
        call()
    return int(counted.get_total_flops())


def compare(
    task: str,
    size: int,
    of: str,
    ours: Call,
    peers: Mapping[str, Call | tuple[Call, float]] | None = None,
    *,
    rounds: int = 5,
    flops: float = 0.0,
    note: str = "",
) -> list[Row]:
    """Measure one task: one row for each peer, or one.

    Args:
        peers: by name what they do; (call, share) where they do a share of the task only.
        rounds: in each, ours and every peer are measured once, one after the other.
        flops: floating point operations of the task, those in matrix products or all of `operations`; 0 = not counted.
    """
    calls: dict[str, tuple[Call, float]] = {"": (ours, 1.0)}
    for name, peer in (peers or {}).items():
        calls[name] = peer if isinstance(peer, tuple) else (peer, 1.0)
    if flops:
        square = torch.ones(_GEMM, _GEMM, dtype=torch.float64)
        calls["gemm"] = (lambda: square @ square, 1.0)
    # The first call of each fills caches and says how often to repeat; of a long task it is a round.
    first = {name: seconds_of(call) for name, (call, _) in calls.items()}
    often = {name: max(1, int(_ROUND / max(taken, 1e-6))) for name, taken in first.items()}
    times: dict[str, list[float]] = {name: [] for name in calls}
    if first[""] > _LONG:
        times = {name: [taken / calls[name][1]] for name, taken in first.items()}
        rounds -= 1
    for _ in range(rounds):
        for name, (call, share) in calls.items():
            taken = seconds_of(partial(_repeat, call, often[name]))
            times[name].append(taken / often[name] / share)
    limit = None
    if flops:
        limit = statistics.median(
            flops / own / (2 * _GEMM**3 / gemm) for own, gemm in zip(times[""], times["gemm"], strict=True)
        )
    own = statistics.median(times[""])
    rows = []
    for name in peers or ("",):
        ratio = statistics.median(t / o for t, o in zip(times[name], times[""], strict=True)) if name else None
        rows.append(Row(task, size, of, own, name, ratio, limit, note))
    return rows
