"""The array files of a run folder come back as they were written, and a bad one is named."""

from __future__ import annotations

from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
from safetensors.numpy import save_file

from ccnn_torch.errors import InputError
from ccnn_torch.report.arrays import ARRAYS_FILE, RunArrays, load_arrays, load_tensors, save_arrays, save_history


def test_arrays_come_back(arrays: RunArrays, tmp_path: Path) -> None:
    save_arrays(tmp_path, arrays)
    again = load_arrays(tmp_path)
    for entry in fields(RunArrays):
        wrote, read = getattr(arrays, entry.name), getattr(again, entry.name)
        if isinstance(wrote, np.ndarray):
            assert np.array_equal(wrote, read) and wrote.dtype == read.dtype
        else:
            assert wrote == read
    save_arrays(tmp_path, again)
    assert sorted(p.name for p in tmp_path.iterdir()) == [ARRAYS_FILE]


def test_equal_arrays_give_equal_bytes(arrays: RunArrays, tmp_path: Path) -> None:
    (tmp_path / "a").mkdir()
    (tmp_path / "b").mkdir()
    assert save_arrays(tmp_path / "a", arrays).read_bytes() == save_arrays(tmp_path / "b", arrays).read_bytes()


def test_optional_arrays_stay_away(arrays: RunArrays, tmp_path: Path) -> None:
    save_arrays(tmp_path, replace(arrays, noise=None, rotation_before=None))
    again = load_arrays(tmp_path)
    assert again.noise is None and again.rotation_before is None


def test_history_comes_back(history: dict[str, np.ndarray], tmp_path: Path) -> None:
    again, _ = load_tensors(save_history(tmp_path, "ccnn", history))
    assert set(again) == set(history)
    assert all(np.array_equal(again[name], history[name]) for name in history)


def test_bad_files_are_named(arrays: RunArrays, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="not there"):
        load_arrays(tmp_path)
    whole = save_arrays(tmp_path, arrays).read_bytes()
    (tmp_path / ARRAYS_FILE).write_bytes(whole[:-100])
    with pytest.raises(InputError, match="damaged"):
        load_arrays(tmp_path)
    save_file({"commanded": np.zeros((2, 3))}, tmp_path / ARRAYS_FILE)
    with pytest.raises(InputError, match="lacks measured"):
        load_arrays(tmp_path)


def test_shapes_that_do_not_fit_are_refused(arrays: RunArrays) -> None:
    with pytest.raises(InputError, match="'predicted' must have the shape"):
        replace(arrays, predicted=arrays.predicted[:-1])
    with pytest.raises(InputError, match="named ones"):
        replace(arrays, joints=arrays.joints[:2])
