"""Searches that ask for one point at a time, run side by side so that each round is one batched evaluation.

SciPy's searches call a function and wait for its answer. Here each search has a thread that does little but wait; when
all have asked, the points of all machines are evaluated in one call. A search sees the same numbers, whatever else runs
beside it, and the rounds are the same in every run, so the result does not depend on the threads' order.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from queue import SimpleQueue
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


class _EndedError(Exception):
    """Ends a search whose function values will not be computed any more."""


def run_side_by_side(
    search: Callable[[int, Callable[[Array], Any]], Array],
    evaluate: Callable[[Array], list[Any]],
    start: Array,
) -> Array:
    """Run one search each machine.

    Args:
        search: `(machine, ask) -> k`: the search of one machine; `ask(point)`, point `k`, returns what `evaluate` has
            for it. It must not use the global state of torch or numpy.
        evaluate: `r x k` -> one answer each machine. Machines that are done are evaluated where they last asked.
        start: points to evaluate for machines that have not asked yet, `r x k`.

    Returns:
        What the searches returned, `r x k`. An exception in a search or in `evaluate` ends all of them.
    """
    count = len(start)
    asked: SimpleQueue[tuple[int, Array | None]] = SimpleQueue()
    answers: list[SimpleQueue[Any]] = [SimpleQueue() for _ in range(count)]

    def run(machine: int) -> Array:
        def ask(point: Array) -> Any:
            asked.put((machine, np.array(point, dtype=np.float64)))
            answer = answers[machine].get()
            if answer is _EndedError:
                raise _EndedError
            return answer

        return search(machine, ask)

    def report(machine: int) -> Callable[[Future[Array]], None]:
        return lambda _: asked.put((machine, None))

    points, found, running = start.copy(), start.copy(), count
    with ThreadPoolExecutor(max_workers=count) as pool:
        try:
            futures = [pool.submit(run, machine) for machine in range(count)]
            for machine, future in enumerate(futures):
                future.add_done_callback(report(machine))
            while running:
                waiting = []
                for _ in range(running):
                    machine, point = asked.get()
                    if point is None:
                        found[machine] = futures[machine].result()
                        running -= 1
                    else:
                        points[machine] = point
                        waiting.append(machine)
                if waiting:
                    replies = evaluate(points)
                    for machine in waiting:
                        answers[machine].put(replies[machine])
        finally:
            for queue in answers:
                queue.put(_EndedError)
    return found
