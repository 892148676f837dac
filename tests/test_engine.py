"""Jobs on every engine: what a worker takes with it is run again, and the others keep what they have.

The marked tests start clusters and take a minute: `pytest -n 0 -m cluster tests/test_engine.py`.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import pytest
import torch
from typer.testing import CliRunner

from ccnn_torch.cli.application import app
from ccnn_torch.engine import Job, check_engine, open_engine, run_jobs
from ccnn_torch.errors import InputError, MethodFailedError

distributed = pytest.importorskip("distributed", reason="needs pip install 'ccnn-torch[cluster]'")
# Dask's own: it closes sockets when the process ends.
pytestmark = pytest.mark.filterwarnings("ignore")
cluster = pytest.mark.cluster


def _square(path: Path, number: int, seconds: float = 0.0) -> str:
    time.sleep(seconds)
    path.write_text(f"{number * number} {os.getpid()} {torch.get_num_threads()}")
    return f"{number} squared"


def _killed_once(path: Path, number: int, seconds: float = 0.0) -> str:
    """Takes its process along the first time."""
    if not path.with_suffix(".seen").exists():
        path.with_suffix(".seen").touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return _square(path, number, seconds)


def _refused(path: Path) -> str:
    with path.with_suffix(".tries").open("a") as file:
        file.write("x")
    raise MethodFailedError("nothing can be learned here")


def _wrong(path: Path) -> str:
    raise InputError(f"{path.name} is no record")


def _idle(path: Path) -> str:
    return "did nothing"


def _bug(path: Path) -> str:
    return str({}[path])


def squares(folder: Path, count: int, seconds: float = 0.0) -> list[Job]:
    paths = [folder / f"{n}.txt" for n in range(count)]
    return [Job(str(n), path, partial(_square, path, n, seconds)) for n, path in enumerate(paths)]


def found(jobs: list[Job]) -> list[int]:
    return [int(job.result.read_text().split()[0]) for job in jobs]


@pytest.mark.parametrize(("engine", "module"), [("processes", "joblib.externals.loky"), ("dask", "distributed")])
def test_what_is_not_installed_is_one_sentence(engine: str, module: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(InputError, match=f"needs {module.partition('.')[0]}: pip install 'ccnn-torch"):
        open_engine(engine).__enter__()


def test_one_failure_keeps_no_other_job_from_its_result(tmp_path: Path) -> None:
    jobs = squares(tmp_path, 2)
    for name, call in (("refused", _refused), ("wrong", _wrong), ("idle", _idle)):
        path = tmp_path / f"{name}.txt"
        jobs.insert(0, Job(name, path, partial(call, path)))
    lines: list[str] = []
    failed = run_jobs(jobs, "local", lines.append)
    assert {name: (problem.text, problem.input) for name, problem in failed.items()} == {
        "refused": ("nothing can be learned here", False),
        "wrong": ("wrong.txt is no record", True),
        "idle": (f"it ended without {tmp_path / 'idle.txt'}", False),
    }
    assert found(jobs[3:]) == [0, 1] and lines[-1] == "[5/5] 1: 1 squared"
    # Finished jobs are not run again; what failed is.
    before = jobs[4].result.stat().st_mtime_ns
    assert set(run_jobs(jobs, "local", lines.append)) == set(failed)
    assert jobs[4].result.stat().st_mtime_ns == before
    with pytest.raises(KeyError):
        run_jobs([Job("bug", tmp_path / "b", partial(_bug, tmp_path / "b"))], "local", lines.append)


def test_names_of_engines() -> None:
    for name in ("local", "processes", "dask", "tcp://10.0.0.5:8786", "tls://host:1"):
        assert check_engine(name) == name
    for name in ("cloud", "tcp://host", "http://host:80", ""):
        with pytest.raises(ValueError, match=r"write local, processes, dask, or a scheduler's address"):
            check_engine(name)


def test_a_worker_that_is_killed_is_replaced_and_its_job_run_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # One process at a time: two take longer to start.
    monkeypatch.setenv("LOKY_MAX_CPU_COUNT", "1")
    jobs = squares(tmp_path, 3)
    path = tmp_path / "killed.txt"
    refused = tmp_path / "refused.txt"
    jobs[1:1] = [
        Job("killed", path, partial(_killed_once, path, 7)),
        Job("refused", refused, partial(_refused, refused)),
    ]
    lines: list[str] = []
    failed = run_jobs(jobs, "processes", lines.append)
    assert list(failed) == ["refused"] and refused.with_suffix(".tries").read_text() in ("x", "xx")
    assert found([jobs[0], jobs[1], *jobs[3:]]) == [0, 49, 1, 4]
    _, process, threads = path.read_text().split()
    assert int(process) != os.getpid() and threads == "1"
    assert any("was lost" in line for line in lines) and any("tried again" in line for line in lines)


def test_a_scheduler_by_its_address(tmp_path: Path) -> None:
    """Over a real connection, with a worker that is a thread of this process."""
    with distributed.LocalCluster(
        n_workers=1, threads_per_worker=1, processes=False, protocol="tcp", dashboard_address=None
    ) as here:
        jobs = squares(tmp_path, 3)
        path = tmp_path / "bug.txt"
        bug = Job("bug", path, partial(_bug, path))
        failed = run_jobs([bug, *jobs], here.scheduler_address, lambda _: None)
    assert found(jobs) == [0, 1, 4] and failed["bug"].text.startswith("KeyError: ")


@contextmanager
def process(*words: str, folder: Path) -> Iterator[subprocess.Popen[bytes]]:
    """A command of Dask in a process of its own, which sees the tests' modules."""
    here = Path(__file__).parent
    paths = os.pathsep.join([str(here), str(here.parent), os.environ.get("PYTHONPATH", "")])
    started = subprocess.Popen(
        [sys.executable, "-m", "distributed.cli.dask_" + words[0], *words[1:]],
        env=os.environ | {"PYTHONPATH": paths, "OMP_NUM_THREADS": "1"},
        cwd=folder,
        stderr=(folder / f"{words[0]}-{time.monotonic_ns()}.log").open("wb"),
    )
    try:
        yield started
    finally:
        if started.poll() is None:
            started.terminate()
            started.wait(20)


def scheduler(folder: Path, port: int) -> object:
    return process("scheduler", "--host", "127.0.0.1", "--port", str(port), "--no-dashboard", folder=folder)


def worker(folder: Path, port: int, *words: str) -> object:
    address = f"tcp://127.0.0.1:{port}"
    return process("worker", address, "--nthreads", "1", "--no-dashboard", *words, folder=folder)


@cluster
def test_a_dask_worker_killed_in_the_middle(tmp_path: Path) -> None:
    jobs = squares(tmp_path, 4, 0.2)
    path = tmp_path / "killed.txt"
    jobs.insert(1, Job("killed", path, partial(_killed_once, path, 7)))
    with scheduler(tmp_path, 18786), worker(tmp_path, 18786), worker(tmp_path, 18786):
        assert run_jobs(jobs, "tcp://127.0.0.1:18786", print) == {}
    assert found(jobs) == [0, 49, 1, 4, 9]


@cluster
def test_a_scheduler_started_again(tmp_path: Path) -> None:
    jobs = squares(tmp_path, 8, 1.0)
    first, second = scheduler(tmp_path, 18787), scheduler(tmp_path, 18787)
    said: dict[str, object] = {}
    lines: list[str] = []

    def run() -> None:
        said["failed"] = run_jobs(jobs, "tcp://127.0.0.1:18787", lines.append)

    thread = threading.Thread(target=run)
    with first as one:  # type: ignore[attr-defined]
        with worker(tmp_path, 18787):
            thread.start()
            deadline = time.monotonic() + 60
            while not jobs[1].result.exists() and time.monotonic() < deadline:
                time.sleep(0.05)
            one.send_signal(signal.SIGKILL)
            one.wait()
        with second, worker(tmp_path, 18787):  # type: ignore[attr-defined]
            thread.join(180)
    assert said["failed"] == {} and found(jobs) == [n * n for n in range(8)]
    assert any("tried again" in line for line in lines)


@cluster
def test_two_clients_get_the_figures_of_one_process_bit_for_bit(tmp_path: Path) -> None:
    """Two sweeps at once on one cluster."""
    (tmp_path / "c.yaml").write_text(
        "case: tripod\nsave_models: false\nsave_report: false\n"
        "ccnn: {hidden: [4], population: 12, generations: 4, members: 2, refinement_iterations: 5, wave_searches: 1}\n"
    )
    base = ("sweep", str(tmp_path / "c.yaml"), "methods=ccnn,bp_lm", "--quiet", "--out")
    changes = (("seed=0,3",), ("seed=0,3", "repeats=2"))

    def call(*words: str) -> None:
        done = CliRunner().invoke(app, words, catch_exceptions=False)
        assert done.exit_code == 0

    for n, words in enumerate(changes):
        call(*base, str(tmp_path / f"here{n}"), *words)
    with scheduler(tmp_path, 18788), worker(tmp_path, 18788), worker(tmp_path, 18788):
        command = [sys.executable, "-m", "ccnn_torch", *base]
        started = [
            subprocess.Popen([*command, str(tmp_path / f"there{n}"), *words, "--engine", "tcp://127.0.0.1:18788"])
            for n, words in enumerate(changes)
        ]
        assert [one.wait(300) for one in started] == [0, 0]
    for n in range(2):
        paths = sorted((tmp_path / f"here{n}").rglob("results.json"))
        assert len(paths) == 4
        for path in paths:
            one, other = (
                json.loads(p.read_text())
                for p in (path, tmp_path / f"there{n}" / path.relative_to(tmp_path / f"here{n}"))
            )
            for results in (one, other):
                results.pop("reach")
                for block in results["methods"].values():
                    block.pop("seconds")
            assert one == other
