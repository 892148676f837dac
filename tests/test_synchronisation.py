"""How often the host waits for the device inside a generation and inside a refinement, counted on the CPU.

On a GPU each operation here would hold the host until the device has done everything before. Left are:

* one a trial of a damping in `step_refinement`, which says whether a network needs another;
* one an iteration of `refine`, which says which networks are still worked on;
* reads of the iteration's number, a tensor that lives on the host: they wait for nothing.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from typing import Any

import torch
from torch.profiler import ProfilerActivity, profile
from torch.utils._python_dispatch import TorchDispatchMode

from ccnn_torch.evolution import CCNNSettings
from ccnn_torch.evolution.coevolution import advance, make_task, start
from ccnn_torch.evolution.refinement import (
    finish_refinement,
    pose_refinement,
    refine,
    second_order,
    start_refinement,
    step_refinement,
)

# Operations whose result, or its size, the host has to know; of indexing those by a mask.
_WAITING = {"_local_scalar_dense", "nonzero", "is_nonzero", "item", "masked_select", "equal", "_unique2"}
_INDEXING = {"index", "index_put", "index_put_"}


class Waits(TorchDispatchMode):  # type: ignore[misc]
    """Counts them by name, reads of the iteration's number (the only 0-d int64) apart."""

    def __init__(self) -> None:
        super().__init__()
        self.found: Counter[str] = Counter()

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        name = func._schema.name.removeprefix("aten::")
        masked = name in _INDEXING and any(i is not None and i.dtype == torch.bool for i in args[1])
        counter = name == "_local_scalar_dense" and args[0].dtype == torch.int64
        if (name in _WAITING or masked) and not counter:
            self.found[name] += 1
        return func(*args, **(kwargs or {}))


def waits(call: Callable[[], object]) -> Counter[str]:
    with Waits() as seen:
        call()
    return seen.found


def factors(call: Callable[[], object]) -> int:
    """Cholesky factorisations: one a trial."""
    with profile(activities=[ProfilerActivity.CPU], acc_events=True) as seen:
        call()
    return sum(event.name == "aten::linalg_cholesky_ex" for event in seen.events() or [])


def rows() -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    x = torch.rand(2, 40, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    return x, torch.sin(3 * x), torch.ones(2, 40, dtype=torch.float64)


def test_it_counts() -> None:
    x = torch.ones(3)
    counted = waits(lambda: (float(x.sum()), bool((x > 0).all()), x[x > 0], torch.nonzero(x), x[[0, 1]]))
    assert counted["index"] == 1 and counted["nonzero"] == 1 and counted.total() == 4


def test_a_generation_waits_for_nothing() -> None:
    task, settings, seeds = make_task(*rows()), CCNNSettings(hidden=(4,), population=12), torch.arange(2)
    state = start((3, 4, 3), task, settings, seeds)
    assert not waits(lambda: advance(state, task, settings, seeds))


def test_a_refinement_waits_once_a_trial_and_once_an_iteration() -> None:
    x, y, ones = rows()
    masks = [torch.ones(2, 4, 3, dtype=torch.bool), torch.ones(2, 3, 4, dtype=torch.bool)]
    draw = torch.Generator().manual_seed(1)
    weights = [torch.randn(2, *shape, generator=draw, dtype=torch.float64) for shape in ((4, 4), (3, 5))]
    problem = pose_refinement(masks, weights, x, y, ones)
    state = start_refinement(problem, weights)
    assert not waits(lambda: finish_refinement(problem, state))
    known = second_order(problem, state)
    counted = waits(lambda: step_refinement(problem, state, known))
    assert counted.keys() == {"index"} and counted["index"] == factors(lambda: step_refinement(problem, state, known))
    few, more = (waits(lambda n=n: refine(masks, weights, x, y, ones, n)) for n in (5, 10))
    assert more["nonzero"] - few["nonzero"] == 5
    assert more["_local_scalar_dense"] == few["_local_scalar_dense"] <= 2
