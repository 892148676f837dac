"""Engines by name, as executors of `concurrent.futures`: one interface for loky and for Dask."""

from __future__ import annotations

import importlib
import re
from collections.abc import Iterator
from concurrent.futures import Executor
from contextlib import contextmanager
from typing import Annotated, Any

from pydantic import AfterValidator

from ccnn_torch.errors import InputError

_NAMES = ("local", "processes", "dask")
_ADDRESS = re.compile(r"(tcp|tls)://.+:\d+")
# Seconds to wait for a scheduler that is not there, as one that is started again.
_PATIENCE = 60


def check_engine(engine: str) -> str:
    """The name itself.

    Raises:
        ValueError: it names no engine.
    """
    if engine not in _NAMES and not _ADDRESS.fullmatch(engine):
        raise ValueError(f"is '{engine}'; write {', '.join(_NAMES)}, or a scheduler's address as tcp://HOST:8786")
    return engine


Engine = Annotated[str, AfterValidator(check_engine)]


@contextmanager
def open_engine(engine: str) -> Iterator[Executor]:
    """An executor of an engine other than `local`; it is closed at the end, and what runs there is stopped.

    Raises:
        InputError: joblib or Dask is not installed, or its scheduler does not answer.
    """
    if engine == "processes":
        # Fresh processes, which inherit no threads; as many as this process may use processors.
        pool = _needed("joblib.externals.loky", engine).ProcessPoolExecutor(_needed("joblib", engine).cpu_count())
        try:
            yield pool
        finally:
            pool.shutdown(kill_workers=True)
        return
    distributed = _needed("distributed", engine)
    if engine == "dask":
        cluster = distributed.LocalCluster(threads_per_worker=1, dashboard_address=None)
        with cluster, distributed.Client(cluster, set_as_default=False) as client:
            yield client.get_executor(pure=False)
        return
    try:
        client = distributed.Client(engine, timeout=_PATIENCE, set_as_default=False)
    except (OSError, TimeoutError) as problem:
        raise InputError(f"engine={engine}: no scheduler answers there ({problem})") from None
    with client:
        yield client.get_executor(pure=False)


def _needed(module: str, engine: str) -> Any:
    try:
        return importlib.import_module(module)
    except ImportError:
        package = module.partition(".")[0]
        raise InputError(f"engine={engine} needs {package}: pip install 'ccnn-torch[cluster]'") from None
