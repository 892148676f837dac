"""The arrays of a run that its pictures need, as safetensors files in the run folder.

`arrays.safetensors` holds one repeat of the best method (the repeat that was exported):

| name | shape | unit |
| --- | --- | --- |
| `commanded` | s x n | joint's SI unit |
| `measured`, `predicted` | s x n | joint's SI unit; pseudoerror measured and by the model |
| `noise` | s x n | joint's SI unit; the noise in `measured`, where it is known |
| `place` | s x d | SI; where in the workspace: the position x, y, z, or the pose itself where a machine mostly turns |
| `position_before`, `position_after` | s | m; norm of the position error |
| `rotation_before`, `rotation_after` | s | rad; geodesic angle, where there is an orientation |
| `test` | s, bool | true = held out |
| `map_place` | g x d | SI; a denser map of the workspace, where the machine is simulated |
| `map_before`, `map_after` | g | m |
| `drawn.place`, `drawn.before` … | | the held-out rows of the machine's picture, see `report.machine` |

Rows are in the order of the records. `history-METHOD.safetensors` holds the training curves: `step` (t, int64), and
every metric as t x r or t x r x k; among them `seconds` (one repeat's share of the time inside the learner, the one
array that differs from run to run) and, where the learner counts them, `evaluations`.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

from ccnn_torch.coordinates import Coordinate
from ccnn_torch.errors import InputError
from ccnn_torch.files.write import write_whole

ARRAYS_FILE = "arrays.safetensors"
Array = NDArray[np.float64]


@dataclass(frozen=True)
class RunArrays:
    """What the pictures of a run show; names, shapes and units as at the top of this file."""

    joints: tuple[Coordinate, ...]
    commanded: Array
    measured: Array
    predicted: Array
    test: NDArray[np.bool_]
    place: Array
    position_before: Array
    position_after: Array
    rotation_before: Array | None = None
    rotation_after: Array | None = None
    noise: Array | None = None
    map_place: Array | None = None
    map_before: Array | None = None
    map_after: Array | None = None
    axes: tuple[Coordinate, ...] = (Coordinate("x", "m"), Coordinate("y", "m"), Coordinate("z", "m"))
    """Names and units of the `d` columns of `place`."""
    drawn: dict[str, Array] = field(default_factory=dict)
    """What `machine_plot` takes."""
    labels: dict[str, str] = field(default_factory=dict)
    """Words for the pictures, for example `{"method": "ccnn", "repeat": "3", "mechanism": "tripod"}`."""

    @property
    def pose_errors(self) -> list[tuple[str, str, Array, Array]]:
        """Title, unit, before and after of the position and, where there is one, of the orientation."""
        pairs = [("position error", "m", self.position_before, self.position_after)]
        if self.rotation_before is not None and self.rotation_after is not None:
            pairs.append(("rotation error", "rad", self.rotation_before, self.rotation_after))
        return pairs

    def __post_init__(self) -> None:
        rows, joints = self.commanded.shape
        wanted = {
            **dict.fromkeys(("commanded", "measured", "predicted", "noise"), (rows, joints)),
            **dict.fromkeys(
                ("test", "position_before", "position_after", "rotation_before", "rotation_after"), (rows,)
            ),
            "place": (rows, len(self.axes)),
        }
        for name, shape in wanted.items():
            value = getattr(self, name)
            if value is not None and value.shape != shape:
                raise InputError(f"Array {name!r} must have the shape {shape}, not {value.shape}.")
        if joints != len(self.joints):
            raise InputError(f"{joints} columns of joints do not fit {len(self.joints)} named ones.")


def save_arrays(folder: str | Path, arrays: RunArrays) -> Path:
    """Write `arrays.safetensors` into a run folder; returns its path."""
    tensors: dict[str, ArrayLike] = {}
    for entry in fields(arrays):
        value = getattr(arrays, entry.name)
        if isinstance(value, np.ndarray):
            tensors[entry.name] = value
    tensors |= arrays.drawn
    about = {
        "axes": [[axis.name, axis.unit] for axis in arrays.axes],
        "joints": [[joint.name, joint.unit] for joint in arrays.joints],
        "labels": arrays.labels,
    }
    path = Path(folder) / ARRAYS_FILE
    save_tensors(path, tensors, about)
    return path


def load_arrays(folder: str | Path) -> RunArrays:
    """Read `arrays.safetensors` of a run folder.

    Raises:
        InputError: the file is not there, is damaged, or lacks an array.
    """
    path = Path(folder) / ARRAYS_FILE
    tensors, about = load_tensors(path)
    known = {entry.name for entry in fields(RunArrays)} - {"drawn"}
    needed = ("commanded", "measured", "predicted", "test", "place", "position_before", "position_after")
    missing = [name for name in needed if name not in tensors]
    if missing or not {"axes", "joints"} <= about.keys():
        raise InputError(f"{path} lacks {', '.join(missing) or 'the joint names'}; it is not of a finished run.")
    return RunArrays(
        joints=tuple(Coordinate(str(name), str(unit)) for name, unit in about["joints"]),
        axes=tuple(Coordinate(str(name), str(unit)) for name, unit in about["axes"]),
        drawn={name: value.astype(np.float64) for name, value in tensors.items() if name.startswith("drawn.")},
        labels={str(k): str(v) for k, v in about.get("labels", {}).items()},
        **{name: value for name, value in tensors.items() if name in known},  # type: ignore[arg-type]
    )


def save_history(folder: str | Path, method: str, history: Mapping[str, ArrayLike]) -> Path:
    """Write `history-METHOD.safetensors`.

    Args:
        folder: the run folder.
        method: a learner's name.
        history: `step`: `t`, and each metric `t x r` or `t x r x k`.
    """
    path = Path(folder) / f"history-{method}.safetensors"
    save_tensors(path, history)
    return path


def save_tensors(path: Path, tensors: Mapping[str, ArrayLike], about: Mapping[str, object] | None = None) -> None:
    """Write arrays by name, and what is to be said about them."""
    arrays = {}
    for name in sorted(tensors):
        value = tensors[name]
        if isinstance(value, torch.Tensor):
            value = value.detach().cpu().numpy()
        arrays[name] = np.ascontiguousarray(value)
    write_whole(path, save(arrays, metadata={"about": json.dumps(about or {}, sort_keys=True)}))


def load_tensors(path: Path) -> tuple[dict[str, NDArray[np.float64]], dict[str, Any]]:
    """Read back what `save_tensors` wrote: arrays by name, and what is said about them.

    Raises:
        InputError: the file is not there or damaged.
    """
    if not path.is_file():
        raise InputError(f"{path} is not there; give the folder of a finished run.")
    try:
        with safe_open(path, framework="numpy") as file:
            about = json.loads((file.metadata() or {}).get("about", "{}"))
            return {name: file.get_tensor(name) for name in file.keys()}, about  # noqa: SIM118
    except (SafetensorError, ValueError) as error:
        raise InputError(f"{path} is damaged or no safetensors file: {error}.") from None
