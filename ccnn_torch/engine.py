"""Where jobs run: in this process, in processes of this machine, or on a Dask cluster.

A job is done when its result file is there, and by nothing else: what a worker took with it, and what a scheduler
forgot, is run again. Every job runs with one thread of torch in every engine, since sums in another order have other
last digits: the figures are then the same, bit for bit.
"""

from __future__ import annotations

import importlib
import re
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import BrokenExecutor, CancelledError, Executor, Future, as_completed
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import torch
from pydantic import AfterValidator

from ccnn_torch.errors import CcnnError, InputError

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


# How often a job is tried whose worker is lost, and seconds between, twice as many each time.
_TRIES, _PAUSE = 3, 2.0
# What may go wrong in a worker beside a sentence of ours; it is told by its name, and the other jobs go on.
_FAILURES = (ArithmeticError, LookupError, OSError, RuntimeError, TypeError, ValueError, MemoryError, AttributeError)


@dataclass(frozen=True)
class Job:
    """One job.

    Attributes:
        name: how it is called on the screen.
        result: the file that it writes last; on a cluster all machines see it under this path.
        call: does it, and returns a line to show; it goes to other processes, as a `partial` of a module's function.
    """

    name: str
    result: Path
    call: Callable[[], str]


@dataclass(frozen=True)
class Failure:
    """Why a job has no result, in one sentence; `input`: because of what the user gave."""

    text: str
    input: bool = False
    final: bool = False


def run_jobs(jobs: Sequence[Job], engine: str, tell: Callable[[str], None]) -> dict[str, Failure]:
    """Run the jobs whose result file is not there; a failure keeps no other job from its result.

    Args:
        jobs: of different names.
        engine: `local`, `processes`, `dask` or a scheduler's address.
        tell: gets a line for each job that ends.

    Returns:
        What failed, by the job's name; the others have their result file.

    Raises:
        InputError: the engine is not to be had.
    """
    left = [job for job in jobs if not job.result.is_file()]
    failed: dict[str, Failure] = {}
    total = len(left)
    ended = 0
    for attempt in range(_TRIES):
        if attempt:
            tell(f"{len(left)} of {total} jobs are tried again")
            time.sleep(_PAUSE * attempt)
            left = [job for job in left if not job.result.is_file()]
        again = []
        for job, told in _ended(left, engine):
            last = isinstance(told, str) or told.final or attempt == _TRIES - 1
            ended += last
            tell(f"[{ended}/{total}] {job.name}: {told if isinstance(told, str) else told.text}")
            if isinstance(told, Failure):
                failed[job.name] = told
            if not last:
                again.append(job)
        left = again
        if not left:
            break
    # By the files: a worker that was given up for lost may have ended after all.
    lost = {job.name for job in jobs if not job.result.is_file()}
    return {name: problem for name, problem in failed.items() if name in lost}


def _ended(jobs: Sequence[Job], engine: str) -> Iterator[tuple[Job, str | Failure]]:
    """Jobs as they end."""
    if engine == "local":
        for job in jobs:
            yield job, _here(job)
    elif jobs:
        with open_engine(engine) as executor:
            yield from _elsewhere(jobs, executor)


def _elsewhere(jobs: Sequence[Job], executor: Executor) -> Iterator[tuple[Job, str | Failure]]:
    futures: dict[Future[str | Failure], Job] = {executor.submit(_there, job): job for job in jobs}
    for future in as_completed(futures):
        told: str | Failure
        try:
            told = future.result()
        except (CancelledError, BrokenExecutor, *_FAILURES) as problem:
            told = Failure(f"its worker was lost ({type(problem).__name__})")
        yield futures[future], told


def _here(job: Job) -> str | Failure:
    """Do a job in this process; to do it again would give the same."""
    with _one_thread():
        try:
            text = job.call()
        except CcnnError as problem:
            return Failure(str(problem), isinstance(problem, InputError), final=True)
    return text if job.result.is_file() else Failure(f"it ended without {job.result}", final=True)


def _there(job: Job) -> str | Failure:
    """Do a job in a worker, which goes on to the next one whatever happens."""
    try:
        told = _here(job)
    except _FAILURES as problem:
        return Failure(f"{type(problem).__name__}: {problem}")
    # A folder may be in use by a worker that was given up for lost: such a refusal is not the last word.
    return replace(told, final=False) if isinstance(told, Failure) and told.input else told


@contextmanager
def _one_thread() -> Iterator[None]:
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)
