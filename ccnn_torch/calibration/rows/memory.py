"""Memory that a run will need, checked before it begins."""

from __future__ import annotations

import os

from ccnn_torch.calibration.config import RunConfig, method_names
from ccnn_torch.errors import InputError

# Bytes for a row of a repeat, measured on runs of the tripod: rows, deviations and Jacobians of all kinds; and, of the
# one method that keeps a population, for each individual.
_ROW, _INDIVIDUAL = 10_000, 2_500
# And of the figures of a repeat in the results of all.
_FIGURES = 10_000


def memory_of_run(config: RunConfig, rows: int, joints: int) -> int:
    """About what a run takes at its peak, in bytes; the methods come one after the other."""
    methods = method_names(config)
    of_row = _ROW + (_INDIVIDUAL * config.ccnn.population if "ccnn" in methods else 0)
    # A Gaussian process has a matrix of all rows by all rows for each joint, its factor and its gradient.
    squared = 3 * 8 * joints * rows if "gp" in methods else 0
    return config.repeats * rows * (of_row + squared)


class TooManyRepeatsError(InputError):
    """All repeats at once take more memory than a run may have; `block` of them do not."""

    def __init__(self, sentence: str, block: int, limit: int) -> None:
        super().__init__(sentence)
        self.block, self.limit = block, limit


def check_memory(config: RunConfig, rows: int, joints: int) -> list[str]:
    """Sentences for who starts a run that takes more than half of the free memory.

    A run may take `max_bytes`, by default a quarter of what is free; one repeat may take all that is free.

    Raises:
        TooManyRepeatsError: it takes more, and some of its repeats would not.
        InputError: a repeat alone takes more, or the figures of all; names the keys to lower.
    """
    needed, free = memory_of_run(config, rows, joints), free_memory()
    limit = config.max_bytes if config.max_bytes is not None else None if free is None else free // 4
    if limit is None or needed <= limit:
        return []
    keys = [f"repeats ({config.repeats})"] if config.repeats > 1 else []
    keys += [f"ccnn.population ({config.ccnn.population})"] if "ccnn" in method_names(config) else []
    there = f"max_bytes={config.max_bytes}" if config.max_bytes is not None else f"{free or 0:,} are free"
    told = (
        f"{config.repeats} x {rows} rows (repeats x rows) take about {needed:,} bytes of memory "
        f"({needed / 1e9:,.1f} GB), and {there}; lower {' or '.join([*keys, 'the number of rows'])}"
    )
    each = needed // config.repeats
    most = limit if config.max_bytes is not None or free is None else free
    if each > most or config.repeats * _FIGURES > limit:
        raise InputError(told)
    if config.repeats > 1:
        raise TooManyRepeatsError(f"{told}, or take block=…", max(1, limit // each), max(limit, each))
    return [f"{told} if the run is stopped by the system."] if free is not None and needed > free / 2 else []


def free_memory() -> int | None:
    """Bytes that a new process could have; None where the system does not report it."""
    try:
        with open("/proc/meminfo", encoding="ascii") as about:
            lines = dict(line.split(":", 1) for line in about)
        return int(lines["MemAvailable"].split()[0]) * 1024
    except (OSError, KeyError, ValueError):
        pass
    try:
        # All of it: not every system reports what is free.
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (AttributeError, OSError, ValueError):
        return None
