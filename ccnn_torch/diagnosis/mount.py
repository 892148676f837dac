"""How the mount of a machine that shows directions stands, in each group of rows."""

from __future__ import annotations

import math
from collections.abc import Mapping
from itertools import combinations

import torch
from torch import Tensor

from ccnn_torch.diagnosis.residual.rows import in_groups
from ccnn_torch.diagnosis.result import Diagnosis
from ccnn_torch.display import number_text

SET_ANEW = ("geometry", "joint_offset", "flexure")
"""Effects that may be others after a mount was set up anew."""
_ARCSECOND = math.radians(1) / 3600


def mount_notes(said: Diagnosis, mounts: Mapping[str, Tensor], word: str) -> list[str]:
    """Tilts and zero of the first axis as fitted beside the verdict's effects, and by how much they change; [] for
    other machines.

    Args:
        said: the diagnosis.
        mounts: base frame by which the rows of each group were evaluated, `6`.
        word: what a group is called.
    """
    found = {name: _turn(said, frame) for name, frame in mounts.items()}
    notes = [
        f"{f'{word} {name}: ' if name else ''}the first axis is tilted by AN {_arc(turn[1])} towards x and AW "
        f"{_arc(-turn[0])} towards y, and its zero is off by IA {_arc(turn[2])}"
        for name, turn in found.items()
    ]
    if len(found) < 2:
        return notes
    most = torch.stack([(a - b).abs() for a, b in combinations(found.values(), 2)]).amax(0)
    moved = f"from one {word} to another AN changes by up to {_arc(most[1])}, AW by {_arc(most[0])}, IA by "
    return [*notes, moved + _arc(most[2])]


def _turn(said: Diagnosis, frame: Tensor) -> Tensor:
    """Rotation vector of a base frame with what the rows ask for beside the verdict's effects, `3` [rad]."""
    analysis, found = said.analysis, said.judgement.found
    left, white = analysis.residual, analysis.whitening
    for i, mean in zip(found.members, found.mean, strict=True):
        left = left - analysis.atoms[i].columns @ mean
    keep = white.keep()
    x, y = white(analysis.fitted)[keep].flatten(0, 1), white(left)[keep].flatten()
    change = torch.linalg.lstsq(x, y, driver="gelsd").solution
    values = analysis.situation.mechanism.resolve(analysis.situation.parameters).expand(len(left), -1)[:, :6]
    row = int((values == frame).all(-1).nonzero()[0])
    turned: Tensor = (frame + in_groups(analysis.situation)[row] @ change)[3:]
    return turned


def _arc(angle: Tensor) -> str:
    return f'{number_text(float(angle) / _ARCSECOND, 3)}"'
