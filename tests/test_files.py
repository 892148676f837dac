"""Files are written whole or not at all, and a folder belongs to one process at a time."""

from __future__ import annotations

import os
import re
import resource
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
import torch
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from ccnn_torch.calibration.callbacks import EventFile, TensorBoardCallback
from ccnn_torch.errors import InputError, WriteError
from ccnn_torch.files.write import write_whole
from ccnn_torch.records import write_table
from ccnn_torch.run_folder.folder import RunFolder, locked

ROOT = Path(__file__).parent.parent
Cli = Callable[..., tuple[int, str, str]]


@contextmanager
def full_disk(left: int) -> Iterator[None]:
    """No file may grow beyond `left` bytes, which to a program is the same as a full disk: a part fits, then none."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (left, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def test_a_file_that_does_not_fit_leaves_the_old_one(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    write_whole(path, "old")
    with full_disk(1000), pytest.raises(WriteError, match=r"a\.txt: cannot be written \(File too large\)"):
        write_whole(path, b"x" * 5000)
    assert path.read_text() == "old" and list(tmp_path.iterdir()) == [path]
    with pytest.raises(WriteError, match=r"\(Is a directory\)"):
        write_whole(tmp_path, "new")
    with pytest.raises(WriteError, match=r"\(File name too long\)"):
        write_whole(tmp_path / ("a" * 300), "new")
    with pytest.raises(WriteError, match=r"\(Not a directory\)"):
        write_whole(path / "b.txt", "new")
    assert path.read_text() == "old" and list(tmp_path.iterdir()) == [path]


def test_what_is_replaced_keeps_its_place_and_rights(tmp_path: Path) -> None:
    path, link, long = tmp_path / "far" / "a.txt", tmp_path / "link.txt", tmp_path / ("a" * 255)
    write_whole(path, "old")
    path.chmod(0o640)
    link.symlink_to(path)
    write_whole(link, "new")
    assert link.is_symlink() and path.read_text() == "new" and path.stat().st_mode & 0o777 == 0o640
    write_whole(long, b"")
    assert long.is_file()
    # What is no file is written to, and stays what it is.
    with pytest.raises(WriteError, match="No space left"):
        write_whole("/dev/full", "new")
    assert Path("/dev/full").is_char_device()


def test_nothing_in_the_package_writes_files_in_another_way() -> None:
    ways = re.compile(
        r"""\.write_(text|bytes)\(|open\((.*, ?)?["'][wax]|\bto_csv\(|save_file\(|torch\.save\(|"""
        r"""savefig\((?!content\b)|savetxt\((?!buffer\b)|FileIO\("""
    )
    package = ROOT / "ccnn_torch"
    found = {str(p.relative_to(package)) for p in package.rglob("*.py") if ways.search(p.read_text(encoding="utf-8"))}
    # A private key is made with its own rights, and never in the place of another.
    assert found == {"files/write.py", "calibration/callbacks.py", "compensation/model_files/signature.py"}


def test_a_full_disk_keeps_the_old_commands(cli: Cli, tmp_path: Path) -> None:
    ideal, out = tmp_path / "ideal.csv", tmp_path / "out.csv"
    write_table(ideal, {f"q{k}[m]": np.linspace(1.1, 1.13, 60) for k in (1, 2, 3)})
    out.write_text("precious")
    with full_disk(4000):
        code, _, told = cli("compensate", ROOT / "checkpoints" / "tripod" / "model.safetensors", ideal, out)
    assert code == 2 and "out.csv: cannot be written" in told and len(told.splitlines()) == 1
    assert out.read_text() == "precious" and sorted(tmp_path.iterdir()) == [ideal, out]


def test_a_run_on_a_full_disk_says_so_and_goes_on_when_there_is_room(cli: Cli, tmp_path: Path) -> None:
    words = ("run", ROOT / "experiments" / "tripod.yaml", "save_models=false", "save_report=false")
    # Not even the first checkpoint fits.
    with full_disk(6000):
        code, _, told = cli(*words, f"out={tmp_path / 'a'}")
    assert code == 2 and f"ccnn run --resume {tmp_path / 'a'} resumes" in told and len(told.splitlines()) == 1
    assert [p.name for p in (tmp_path / "a").rglob("*") if p.is_file()] == ["config.yaml"]
    # The training fits, what comes after it does not: the figures are shown, and the checkpoint is kept.
    out = tmp_path / "b"
    with full_disk(12_000):
        code, shown, told = cli(*words, "methods=[constant]", f"out={out}")
    assert code == 2 and "arrays.safetensors: cannot be written" in told and "Joint error" in shown
    assert [p.name for p in (out / "checkpoints").iterdir()] == ["constant-fit.safetensors"]
    assert cli("run", "--resume", out)[0] == 0 and (out / "results.json").is_file()


def test_a_diagnosis_on_a_full_disk_is_told(cli: Cli, tmp_path: Path) -> None:
    rows = tmp_path / "rows.csv"
    words = ("--mechanism", "five_bar", "--effect", "backlash", "--rows", "60", "--noise", "1e-5", "--quiet")
    assert cli("simulate", *words, "--out", rows)[0] == 0
    words = ("--records", rows, "--mechanism", "five_bar", "--effects", "backlash,joint_offset", "--no-network")
    with full_disk(3000):
        code, shown, told = cli("diagnose", *words, "--out", tmp_path / "found", "--quiet")
    assert code == 2 and "diagnosis.json: cannot be written" in told and len(told.splitlines()) == 1
    assert "What is wrong: Backlash" in " ".join(shown.split())


def test_curves_end_where_the_disk_is_full_and_the_run_goes_on(tmp_path: Path) -> None:
    told: list[str] = []
    callback = TensorBoardCallback(tmp_path / "t", tell=told.append)
    callback.on_start(None, None, 0)
    with full_disk(400):
        for step in range(1, 40):
            callback.on_step(step, {"error_train": torch.tensor([1.0 / step])})
        callback.on_end()
    assert len(told) == 1 and "File too large" in told[0]
    steps = [e.step for e in EventAccumulator(str(tmp_path / "t")).Reload().Scalars("error/train")]
    assert 0 < len(steps) < 39 and steps == list(range(1, len(steps) + 1))
    (tmp_path / "file").write_text("")
    events = EventFile(tmp_path / "file" / "t")
    events.add_scalars({"a": 1.0}, 1)
    events.close()
    assert events.failed == "Not a directory"


HOLD = """
import os, signal, sys
from pathlib import Path
from ccnn_torch.run_folder.folder import locked
with locked(Path(sys.argv[1])):
    sys.stdout.write("held")
    sys.stdout.flush()
    signal.pause()
"""


def test_a_folder_is_held_by_one_process_until_it_ends_or_is_killed(cli: Cli, tmp_path: Path) -> None:
    taken = pytest.raises(InputError, match=rf"in use by another run \(process {os.getpid()}\)")
    with locked(tmp_path), taken, locked(tmp_path):
        raise AssertionError
    assert list(tmp_path.iterdir()) == []
    other = subprocess.Popen([sys.executable, "-c", HOLD, str(tmp_path)], stdout=subprocess.PIPE)
    assert other.stdout is not None and other.stdout.read(4) == b"held"
    (tmp_path / "config.yaml").write_text("case: tripod\n")
    for words in (("run", "--resume", tmp_path), ("run", ROOT / "experiments" / "tripod.yaml", f"out={tmp_path}")):
        code, _, told = cli(*words)
        assert code == 2 and f"process {other.pid}" in told
    other.send_signal(signal.SIGKILL)
    other.communicate()
    assert (tmp_path / ".lock").is_file()
    with locked(tmp_path):
        pass
    assert [p.name for p in tmp_path.iterdir()] == ["config.yaml"]


def test_a_kill_before_the_first_file_stood_is_no_dead_end(tmp_path: Path) -> None:
    path = tmp_path / "run"
    path.mkdir()
    (path / ".lock").write_text("1")
    (path / ".ccnn-0123.part").write_text("seed: ")
    with pytest.raises(InputError, match="repeat the command that started it"), RunFolder.existing(path):
        raise AssertionError
    with RunFolder.fresh(str(path), "name") as folder:
        folder.write("config.yaml", "seed: 0\n")
    assert [p.name for p in path.iterdir()] == ["config.yaml"]
    (path / "plots").mkdir()
    (path / "plots" / ".ccnn-4567.part").write_text("")
    with RunFolder.existing(path):
        assert list((path / "plots").iterdir()) == []
    with pytest.raises(InputError, match=r"that run: ccnn run --resume \S+$"), RunFolder.fresh(str(path), "name"):
        raise AssertionError
    # One that nothing was written into goes away again.
    shutil.rmtree(path)
    with pytest.raises(InputError, match="of no use"), RunFolder.fresh(str(path), "name"):
        raise InputError("of no use")
    assert not path.exists()
