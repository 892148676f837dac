"""What numba compiles where it is installed, and Python and numpy run where it is not."""

from __future__ import annotations

import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar, cast

import numpy as np

F = TypeVar("F", bound=Callable[..., Any])
# Files of the functions that are compiled.
_SOURCES: set[str] = {__file__}

try:
    import numba
    from numba.extending import overload, register_jitable
    from numba.np.unsafe.ndarray import to_fixed_tuple
except ImportError:
    numba = None  # type: ignore[assignment]


def compilable(function: F) -> F:
    """The function itself, of numbers or arrays; what calls it may be compiled."""
    _SOURCES.add(function.__code__.co_filename)
    if numba is None:
        return function
    found: F = register_jitable(forceinline=True)(function)
    return found


def is_compiled() -> bool:
    """Whether numba is installed."""
    return numba is not None


def loop(function: F) -> F:
    """The function, compiled at its first call; later processes find it on the disk, until its source changes."""
    if numba is None:
        return function
    # Numba looks at the file of the function alone, not at those of what it calls, which are imported before it.
    sources = b"".join(Path(path).read_bytes() for path in sorted({*_SOURCES, function.__code__.co_filename}))
    function.__qualname__ += f"_{zlib.crc32(sources):08x}"
    return cast(F, numba.njit(cache=True, nogil=True, error_model="numpy")(function))


def pick(which: Any, a: Any, b: Any) -> Any:
    """`a` where that is true, else `b`."""
    return np.where(which, a, b)


if numba is not None:
    # Of numbers numpy's makes arrays.
    overload(pick)(lambda which, a, b: lambda which, a, b: a if which else b)


def some(which: Any) -> Any:
    """Whether that is true, of an array anywhere."""
    return np.any(which)


if numba is not None:
    overload(some)(lambda which: lambda which: which)


def fixed_tuple(values: Any, count: int) -> tuple[Any, ...]:
    """The first `count` values; compiled, their number is a constant."""
    return tuple(values[:count])


if numba is not None:
    overload(fixed_tuple)(lambda values, count: lambda values, count: to_fixed_tuple(values, count))  # type: ignore[call-arg]
