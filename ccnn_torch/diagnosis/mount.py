"""How the mount of a machine that shows directions stands, by group of rows; what an arm's fitted frames took."""

from __future__ import annotations

import math
from collections.abc import Mapping
from itertools import combinations

import torch
from torch import Tensor

from ccnn_torch.diagnosis.residual.rows import in_groups
from ccnn_torch.diagnosis.result import Diagnosis
from ccnn_torch.display import number_text
from ccnn_torch.mechanisms import Mechanism, SerialArm, fit_unknown, sees_directions
from ccnn_torch.numerics.rotations import matrix_to_rotation_vector, rotation_vector_to_matrix

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


def machine_as_told(said: Diagnosis) -> Mechanism | None:
    """The machine with the verdict's numbers in it and its unknown frames fitted again; None with frames by group."""
    situation = said.analysis.situation
    mechanism, frames = situation.mechanism, situation.parameters
    if frames is not None and frames.dim() > 1:
        return None
    named = [e["parameters"] for e in said.effects if e["name"] in said.verdict["effects"]]
    found = {n: b["value"] for parameters in named for n, b in parameters.items() if b.get("nominal") is not None}
    change = torch.tensor([found.get(p.name, 0.0) for p in mechanism.geometry], dtype=torch.float64)
    machine = mechanism.with_nominal(mechanism.nominal + change)
    fitted = fit_unknown(machine, situation.joints, said.analysis.measured)
    return machine if fitted is None else machine.with_nominal(fitted)


def frames_taken(said: Diagnosis) -> dict[str, list[float]]:
    """Of an arm's fitted base and tool frame how far it is from the model's: shift [m] and rotation vector [rad]."""
    arm = said.analysis.situation.mechanism
    if not isinstance(arm, SerialArm) or not arm.unknown_frames or sees_directions(arm):
        return {}
    machine, taken = machine_as_told(said), {}
    if machine is None:
        return {}
    for name in arm.unknown_frames:
        part = slice(0, 6) if name == "base" else slice(-6, None)
        before, after = arm.nominal[part], machine.nominal[part]
        turn = rotation_vector_to_matrix(after[3:]) @ rotation_vector_to_matrix(before[3:]).mT
        taken[name] = [*(after - before)[:3].tolist(), *matrix_to_rotation_vector(turn).tolist()]
    return taken
