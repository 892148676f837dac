"""Plain numbers in code that is traced: the ONNX exporter rounds them to single precision, and tensors not."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import torch
from torch.overrides import TorchFunctionMode

_OPERATIONS = {
    *("add", "__add__", "__radd__", "sub", "__sub__", "__rsub__", "rsub"),
    *("mul", "__mul__", "__rmul__", "div", "__truediv__", "__rtruediv__", "__rdiv__"),
}
_CLAMPS = {"clamp_min": torch.maximum, "clamp_max": torch.minimum}


class _ExactNumbers(TorchFunctionMode):
    """Gives arithmetic its plain numbers as double tensors."""

    def __torch_function__(
        self,
        func: Callable[..., Any],
        types: Sequence[type],
        args: Sequence[Any] = (),
        kwargs: Mapping[str, Any] | None = None,
    ) -> Any:
        name = getattr(func, "__name__", "")
        if name in _OPERATIONS or name in _CLAMPS:
            args = tuple(torch.tensor(a, dtype=torch.float64) if isinstance(a, float) else a for a in args)
            func = _CLAMPS.get(name, func)
        return func(*args, **(kwargs or {}))


@contextmanager
def exact_numbers() -> Iterator[None]:
    """Within, code that is exported keeps its plain numbers in double; code that only runs is left as it is."""
    if not torch.compiler.is_exporting():
        yield
        return
    with _ExactNumbers():
        yield
