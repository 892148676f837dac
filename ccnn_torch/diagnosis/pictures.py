"""The arrays behind the pictures of a diagnosis: what gives each effect away, and what is left of every row."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from ccnn_torch.coordinates import Coordinate
from ccnn_torch.diagnosis._analysis import Analysis
from ccnn_torch.diagnosis._shrink import held_out
from ccnn_torch.diagnosis.result import Diagnosis

__all__ = ["picture_arrays"]

# Quantile bins of a driver; the one whose bins hold most of an effect's variance is what gives the effect away.
_BINS = 12
_UNITS = {"time": "s", "temperature": "K"}
# A driver outside the library that is one column by its name.
_COLUMN = {"temperature": "temperature", "time": "time"}


def picture_arrays(diagnosis: Diagnosis, seed: int = 0) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """What the report draws.

    Args:
        diagnosis: with its analysis.
        seed: of the folds, as in the diagnosis.

    Returns:
        Arrays by name (`s` rows, `c` pose channels, SI): `place` `s x 3`, `joints` `s x n`, `residual` and `remainder`
        `s x c`, `noise` `c`, `held_out` and `set_aside` `s`, `covariate.NAME` `s`, and for each effect of the verdict
        and the driver outside the library `signature.NAME.x`, `.y` and `.fit` `s`. The remainder of each row is that
        of a fit to other rows. And the names and units of the signatures' axes, `{NAME: {"x": {"name", "unit"}, …}}`.
    """
    analysis = diagnosis.analysis
    situation = analysis.situation
    found = diagnosis.judgement.found
    keep = analysis.whitening.keep()
    held = torch.zeros(len(situation.joints), dtype=torch.float64)
    held[keep] = 1.0
    place = situation.mechanism.frame(analysis.measured)[0]
    arrays = {
        "place": torch.nan_to_num(place),
        "joints": situation.joints,
        "residual": analysis.residual,
        "remainder": _remainder(analysis, found.members, seed),
        "noise": _spread(analysis, (analysis.whitening.sigma * analysis.floor**0.5)[None])[0],
        "held_out": held,
        "set_aside": 1 - held,
    }
    arrays |= {f"covariate.{name}": value for name, value in situation.covariates.items()}
    labels: dict[str, Any] = {}
    parts = [analysis.library.atoms[i].columns @ mean for i, mean in zip(found.members, found.mean, strict=True)]
    columns = _drivers(analysis, place)
    shown = set(diagnosis.verdict["effects"]) | {diagnosis.verdict["driver"]}
    # What the whole set leaves, catch-all and all: the signature of one cause is drawn with all others taken off.
    left = _remainder(analysis, found.members, seed, catch_alls=True)
    for i, part in zip(found.members, parts, strict=True):
        name = analysis.library.atoms[i].name
        if name not in shown or not bool((part[keep] != 0).any()):
            continue
        effect = analysis.library.atoms[i].effect
        drivers = columns
        if effect is not None and effect.kind == "joints":
            joint, fit, rest = _in_joints(analysis, part, left)
            y_axis = {"name": f"deviation of {joint.name}", "unit": joint.unit}
            drivers = [*columns, *_torques(analysis, joint)]
        else:
            direction, unit = _direction(part[keep])
            fit, rest = part @ direction, left @ direction
            y_axis = {"name": _direction_words(direction), "unit": unit}
        x_name, x_unit, x = _telling(drivers, fit, keep, name)
        arrays |= {f"signature.{name}.x": x, f"signature.{name}.y": fit + rest, f"signature.{name}.fit": fit}
        labels[name] = {"x": {"name": x_name, "unit": x_unit}, "y": y_axis}
    return {name: value.to(torch.float64) for name, value in arrays.items()}, labels


def _spread(analysis: Analysis, values: Tensor) -> Tensor:
    """Values of the channels that count, `s x c`, among all channels, `s x c0`; the others are 0."""
    out = values.new_zeros(len(values), analysis.residual.shape[-1])
    out[:, analysis.whitening.channels] = values
    return out


def _remainder(analysis: Analysis, members: tuple[int, ...], seed: int, *, catch_alls: bool = False) -> Tensor:
    """What a set's effects leave of each row by a fit to others, `s x c0`; the residual where a row is set aside."""
    atoms = analysis.library.atoms
    chosen = [i for i in members if catch_alls or not atoms[i].catch_all]
    out = analysis.residual.clone()
    keep = analysis.whitening.keep()
    out[keep] = _spread(analysis, held_out(analysis, [chosen], seed)[0].left)
    return out


def _in_joints(analysis: Analysis, part: Tensor, left: Tensor) -> tuple[Coordinate, Tensor, Tensor]:
    """What an effect does to the joint that it moves most, and what is left there, `s`; 0 where a row is set aside.

    A deviation of the joints looks the same everywhere in the workspace, what it does to the pose does not.
    """
    keep, channels, sigma = analysis.whitening.keep(), analysis.whitening.channels, analysis.whitening.sigma
    slope = analysis.situation.jacobian[keep][:, channels] / sigma[:, None]
    both = torch.stack([part, left], -1)[keep][:, channels] / sigma[:, None]
    found = part.new_zeros(len(part), slope.shape[-1], 2).index_copy(0, keep, torch.linalg.lstsq(slope, both).solution)
    # Joints of several units are weighed by what a unit of each does to the pose.
    reach = slope.square().sum(1).mean(0).sqrt()
    joint = int((found[..., 0].square().mean(0).sqrt() * reach).argmax())
    return analysis.situation.mechanism.joints[joint], found[:, joint, 0], found[:, joint, 1]


def _torques(analysis: Analysis, joint: Coordinate) -> list[tuple[str, str, Tensor]]:
    """What load and weight ask of a joint, as further things that may give an effect on it away."""
    situation = analysis.situation
    i = [c.name for c in situation.mechanism.joints].index(joint.name)
    turns = joint.unit == "rad"
    found = [(f"pull of the weight on {joint.name}", "m" if turns else "1", situation.weight_torque[:, i])]
    if situation.loaded:
        name = f"{'torque' if turns else 'force'} of the load on {joint.name}"
        found.append((name, "N*m" if turns else "N", situation.load_torque[:, i]))
    return found


def _direction(part: Tensor) -> tuple[Tensor, str]:
    """The direction in which an effect moves the pose most, `c0`: in position, or in rotation where only that moves."""
    moving = part[:, :3].abs().amax() > 0
    block = part[:, :3] if moving else part[:, 3:]
    main = torch.linalg.svd(block, full_matrices=False)[2][0]
    main = main * torch.sign(main[main.abs().argmax()])
    direction = torch.zeros_like(part[0])
    direction[: 3 if moving else None] = main if moving else 0.0
    if not moving:
        direction[3:] = main
    return direction, "m" if moving else "rad"


def _direction_words(direction: Tensor) -> str:
    kind, values = ("residual", direction[:3]) if bool(direction[:3].any()) else ("turn", direction[3:])
    near = int(values.abs().argmax())
    if float(values.abs()[near]) > 0.99:
        return f"{kind} along {'xyz'[near]}"
    return f"{kind} along ({', '.join(f'{float(v):.2f}' for v in values)})"


def _drivers(analysis: Analysis, place: Tensor) -> list[tuple[str, str, Tensor]]:
    """What may give an effect away: covariates, joints, place; name, unit and values of each."""
    situation = analysis.situation
    found = [(name, _unit(name), value) for name, value in situation.covariates.items()]
    found += [(c.name, c.unit, situation.joints[:, i]) for i, c in enumerate(situation.mechanism.joints)]
    return [*found, *(("xyz"[i], "m", place[:, i]) for i in range(3))]


def _unit(name: str) -> str:
    if name.startswith("load_"):
        return "N*m" if name.startswith("load_r") else "N"
    return _UNITS.get(name, "1")


def _telling(columns: list[tuple[str, str, Tensor]], fit: Tensor, keep: Tensor, cause: str) -> tuple[str, str, Tensor]:
    """The column that a cause follows: the one that its name says, else whose bins hold most of its variance."""
    kind, _, which = cause.partition(" ")
    wanted = {"joint": which, "load": f"load_{which}", "direction": f"direction{which}"}.get(kind, _COLUMN.get(cause))
    named = [c for c in columns if c[0] == wanted]
    return named[0] if named else max(columns, key=lambda c: _share(c[2][keep], fit[keep]))


def _share(x: Tensor, fit: Tensor) -> float:
    """Share of the variance of `fit` between quantile bins of `x`, both `s`."""
    known = torch.isfinite(x + fit)
    x, fit = x[known], fit[known]
    values = torch.unique(x)
    if len(values) < 2:
        return 0.0
    edges = (
        values[1:] if len(values) <= _BINS else torch.quantile(x, torch.linspace(0, 1, _BINS + 1, dtype=x.dtype))[1:-1]
    )
    bins = torch.bucketize(x.contiguous(), edges, right=True)
    count = torch.zeros(_BINS + 1, dtype=x.dtype).index_add(0, bins, torch.ones_like(x))
    total = torch.zeros(_BINS + 1, dtype=x.dtype).index_add(0, bins, fit - fit.mean())
    between = float((total.square() / count.clamp_min(1)).sum())
    # A bin takes up some of any variance by chance: each costs its share.
    whole = float((fit - fit.mean()).square().sum())
    return between / whole - len(edges) / len(x) if whole > 0 else 0.0
