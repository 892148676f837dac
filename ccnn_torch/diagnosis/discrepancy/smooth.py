"""Discrepancy terms: what no effect of the library describes, one candidate for each driver it may follow.

A discrepancy term lets the joints deviate by a smooth function of its driver, alone and times the pose: physical causes
act through the joints, and the Jacobian then carries most of the dependence on the pose. What follows time, temperature
or a load may also move the platform as a whole, equally at every pose, and faster than a smooth function.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from ccnn_torch.coordinates import is_temperature
from ccnn_torch.diagnosis.candidates.atom import Atom, discrepancy
from ccnn_torch.effects import Situation
from ccnn_torch.effects.columns import shown_columns
from ccnn_torch.effects.constant import frame_columns
from ccnn_torch.evidence.priors import OUTSIDE
from ccnn_torch.mechanisms import Instrument
from ccnn_torch.mechanisms.pose import CHANNELS
from ccnn_torch.records.commanded import SECOND

# Log odds of one that holds most of what a library effect does beside those of the others.
_NEAR_LIBRARY = math.log(1e-2)
# Of one form with an effect that is a candidate, it has to be better than that by as much again.
_TWIN = 2 * OUTSIDE
# A joint or the platform may be off by this much for unforeseen reasons [m], [rad].
_SCALE = {"m": 3e-4, "rad": 5e-4}
PLACE = "workspace"
"""The driver of what follows the pose."""
ANY = "*"
"""Stands in a driver's name for all of its kind; a verdict names the one that explains most alone."""
SPEED = "speed"
"""Begins the names of discrepancy terms that follow a joint's velocity: a verdict knows no such driver."""
# What bends with a driver against what is proportional to it.
_BEND = 0.5
_MOST, _MOST_PLACES = 28, 60
_WAVES = 18
# Bumps: fewest and most along a driver, rows for each; the same in the workspace; rows for each fine one of a joint.
_FEWEST, _FEW, _ROWS_A_BUMP = 4, 8, 12
_FEWEST_PLACES, _PLACES, _ROWS_A_PLACE = 6, 24, 8
_ROWS_A_FINE_BUMP = 6
# Rows for each principal column beyond the least number of them; rows for two waves.
_ROWS_A_COLUMN, _ROWS_FOR_TWO_WAVES = 4, 5
# Prior size of a driver times the place against the driver alone.
_TIMES_PLACE = 0.7
# Lags of a temperature, as shares of the time of all rows.
_LAGS = (0.05, 0.2)
# Width of a bump, in distances to the next one.
_WIDTH = 1.5


def smooth_discrepancies(situation: Situation, beside: Sequence[str], rows: int) -> list[Atom]:
    """One or two atoms for each driver that the records hold; beside: names of the library effects that are candidates;
    rows: how many were measured, for which there may be several places here.

    Drives of one kind have errors of one kind, each along its own track. A transmission's are of a form that holds
    elsewhere, too, so where that is a candidate no discrepancy term of all drives at once takes them from it.
    """
    mechanism = situation.mechanism
    place = unit_range(situation.place)
    one = torch.ones_like(place[:, :1])
    few = max(_FEWEST, min(_FEW, rows // _ROWS_A_BUMP))
    around = torch.cat([one, place, _bumps(place, min(_PLACES, max(_FEWEST_PLACES, rows // _ROWS_A_PLACE)))], -1)
    most = min(_MOST_PLACES, max(_MOST, rows // _ROWS_A_COLUMN))
    found = [_atom(situation, PLACE, around, most=most)]
    found.append(
        _atom(situation, PLACE, torch.cat([one, *_configuration(situation)], -1), most=most, log_odds=_NEAR_LIBRARY)
    )
    own: list[Tensor] = []
    for i, joint in enumerate(mechanism.joints):
        q = unit_range(situation.joints[..., i : i + 1])
        found.append(_atom(situation, f"joint {joint.name}", torch.cat([one, q, _BEND * _bumps(q, few)], -1)))
        fine = torch.cat([one, q, _bumps(q, min(_MOST, rows // _ROWS_A_FINE_BUMP))], -1)
        own.append(fine)
        found.append(_atom(situation, f"joint {joint.name}", fine, only=i))
    if "transmission" not in beside:
        found.append(_atom(situation, f"joint {ANY}", torch.stack(own, 1), most=most))
    together: dict[str, list[Tensor]] = {}
    for name, value in situation.covariates.items():
        driver = driver_of(name)
        if driver is None or float(value.max() - value.min()) <= 0:
            continue
        d = unit_range(value.unsqueeze(-1))
        features = [one, d, _TIMES_PLACE * d * place]
        if driver.startswith("direction"):
            # Of anything but a joint it tells no load.
            which = [i for i in range(len(mechanism.joints)) if driver == f"direction {i + 1}"]
            features += [_BEND * d * _load_on_joint(situation, i) for i in which]
        elif driver.startswith(SPEED):
            pass
        else:
            features.append(_BEND * _bumps(d, few))
            found.append(
                _platform_atom(situation, driver, _waves(d, max(_FEWEST, min(_WAVES, 2 * rows // _ROWS_FOR_TWO_WAVES))))
            )
        if driver.startswith("load"):
            # The torque of a load follows the Jacobian, which is not linear over the workspace.
            features.append(_BEND * d * _products(place))
            found.append(
                _atom(situation, driver, _load_features(_under(situation, name)), most=most, log_odds=_NEAR_LIBRARY)
            )
        if is_temperature(name) and "time" in situation.covariates:
            features += [_lagged(value, situation.covariates["time"], k) for k in _LAGS]
        found.append(_atom(situation, driver, torch.cat(features, -1)))
        if " " in driver:
            together.setdefault(driver.partition(" ")[0], []).extend(features[1:])
    for kind, features in together.items():
        # One cause may follow all loads, or all directions, at once.
        if sum(a.name.startswith(kind) for a in found) > 1:
            found.append(_atom(situation, f"{kind} {ANY}", torch.cat([one, *features], -1)))
            if kind == "load":
                found.append(
                    _atom(situation, f"{kind} {ANY}", _load_features(situation), most=most, log_odds=_NEAR_LIBRARY)
                )
    return found


def driver_of(name: str) -> str | None:
    """What a covariate is called as a driver; None for one that is none, or that is another's in the second place."""
    if name.endswith(SECOND):
        return None
    if name.startswith("load_"):
        return f"load {name.removeprefix('load_')}"
    if name.startswith("direction"):
        return f"direction {name.removeprefix('direction').removeprefix('_')}"
    if name.startswith(SPEED):
        return f"{SPEED} {name.removeprefix(SPEED)}"
    if is_temperature(name):
        return name.replace("_", " ", 1)
    return name if name == "time" else None


def unit_range(values: Tensor) -> Tensor:
    """Each column brought to [-1, 1] over the rows."""
    low, high = values.amin(-2, keepdim=True), values.amax(-2, keepdim=True)
    return (2 * values - low - high) / (high - low).clamp_min(1e-300)


def _products(place: Tensor) -> Tensor:
    """Squares and products of the coordinates, `s x (p + 1) p / 2`."""
    first, second = torch.triu_indices(place.shape[-1], place.shape[-1])
    return place[:, first] * place[:, second]


def _bumps(points: Tensor, count: int) -> Tensor:
    """A constant-free set of Gaussian bumps about rows far from each other, `s x count`."""
    centres = spread_out(points, count)
    distance = torch.cdist(points, centres)
    apart = torch.cdist(centres, centres) + 1e9 * torch.eye(len(centres), dtype=points.dtype)
    width = _WIDTH * apart.amin(-1).median().clamp_min(1e-6)
    features = torch.exp(-0.5 * (distance / width).square())
    return features - features.mean(-2, keepdim=True)


def spread_out(points: Tensor, count: int) -> Tensor:
    """Rows, each as far as possible from those before (farthest-point sampling)."""
    chosen = [int((points - points.mean(0)).square().sum(-1).argmin())]
    nearest = (points - points[chosen[0]]).square().sum(-1)
    for _ in range(min(count, len(points)) - 1):
        chosen.append(int(nearest.argmax()))
        nearest = torch.minimum(nearest, (points - points[chosen[-1]]).square().sum(-1))
    return points[chosen]


def _lagged(value: Tensor, time: Tensor, share: float) -> Tensor:
    """First-order lag by a share of the time that the records span, `s x 1`, brought to [-1, 1]."""
    span = (time.max() - time.min()).clamp_min(1e-300) * share
    weight = torch.exp(-(time[:, None] - time[None, :]) / span) * (time[:, None] >= time[None, :])
    return unit_range(((weight @ value) / weight.sum(-1)).unsqueeze(-1))


def _configuration(situation: Situation) -> list[Tensor]:
    """What repeats with the turns of the joints, and the torque of the machine's weight on them, `s x …` each."""
    turning = [i for i, j in enumerate(situation.mechanism.joints) if j.unit == "rad"]
    angles = situation.joints[:, turning]
    return [torch.sin(angles), torch.cos(angles), _over_largest(situation.own_weight_torque)]


def _under(situation: Situation, load: str) -> Situation:
    """The rows with one load alone."""
    return situation.with_covariates({load: situation.covariates[load]})


def _load_features(situation: Situation) -> Tensor:
    """Force or torque of the load on the joints, and its square with the sign, `s x 2n`, the largest 1."""
    torque = _over_largest(situation.load_torque)
    return torch.cat([torque, _BEND * torque * torque.abs()], -1)


def _over_largest(values: Tensor) -> Tensor:
    return values / values.abs().amax().clamp_min(1e-300)


def _load_on_joint(situation: Situation, joint: int) -> Tensor:
    """Torques of load and weight on a joint, absolute, `s x 2 or less`: what holds it where it came from."""
    torques = torch.stack([t[:, joint].abs() for t in (situation.load_torque, situation.own_weight_torque)], -1)
    return unit_range(torques[:, (torques.amax(0) - torques.amin(0)) > 1e-9 * torques.amax().clamp_min(1e-300)])


def _waves(values: Tensor, count: int) -> Tensor:
    """Half waves over the range of values `s x 1` in [-1, 1], the faster the smaller, `s x count`."""
    k = torch.arange(1, count + 1, dtype=values.dtype)
    waves = torch.cos(0.5 * math.pi * k * (values + 1)) / k.sqrt()
    return waves - waves.mean(-2, keepdim=True)


def joint_moves(situation: Situation, jacobian: Tensor) -> Tensor:
    """What the joints' derivatives, `s x c x n`, make of each joint being as far off as is to be expected."""
    joints = situation.mechanism.joints
    return jacobian * torch.tensor([_SCALE.get(j.unit, _SCALE["rad"]) for j in joints], dtype=jacobian.dtype)


def platform_moves(situation: Situation) -> Tensor:
    """Shifts and turns of the platform as far as they are seen, each as large as is to be expected, `s x c x c`.

    Of what instruments show each reading by itself.
    """
    return situation.visible * torch.tensor([_SCALE[c.unit] for c in situation.mechanism.channels]).double()


def frame_moves(situation: Situation) -> Tensor:
    """What is seen of shifts and turns of the measuring frame, about the middle of the workspace, `s x c x 6` or fewer;
    of rows of two places of the platform."""
    if len(situation.places) > 1:
        return platform_moves(situation)
    sizes = torch.tensor([_SCALE["m"]] * 3 + [_SCALE["rad"]] * 3, dtype=torch.float64)
    shown = shown_columns(situation, frame_columns)
    return torch.nan_to_num(frame_columns(situation) * sizes)[..., shown]


def carried_moves(situation: Situation) -> Tensor:
    """What is seen of shifts and turns of the platform in space, `s x c x 3` or `s x c x 6`; sizes alike."""
    if not isinstance(situation.mechanism, Instrument):
        return platform_moves(situation)
    return situation.by_place * torch.tensor([_SCALE[c.unit] for c in CHANNELS]).double()


def _platform_atom(situation: Situation, driver: str, features: Tensor) -> Atom:
    """features: `s x f`; columns = shifts and turns of the platform, alike in all poses, times the features."""
    columns = (platform_moves(situation).unsqueeze(-1) * features[:, None, None, :]).flatten(-2)
    shown = columns.abs().amax((0, 1)) > 0
    return discrepancy(driver, columns[..., shown])


def _atom(
    situation: Situation,
    driver: str,
    features: Tensor,
    most: int = _MOST,
    log_odds: float = 0.0,
    only: int | None = None,
) -> Atom:
    """What the joints do by features that all of them go by, `s x f`, or each by its own, `s x n x f`.

    Reduced to the directions that matter. only: of one joint, counted from 0.
    """
    moves = joint_moves(situation, situation.jacobian)
    moves = moves if only is None else moves[..., only : only + 1]
    if features.dim() == 2:
        features = _principal(features, most)[:, None].expand(-1, moves.shape[-1], -1)
    return discrepancy(driver, _reduced(moves, features, most), log_odds)


def _principal(features: Tensor, most: int) -> Tensor:
    """The leading principal features, where there are more than of all that joints make of them will be kept."""
    if features.shape[-1] <= most:
        return features
    _, vectors = torch.linalg.eigh(features.mT @ features)
    principal: Tensor = features @ vectors[:, -most:]
    return principal


def _reduced(moves: Tensor, features: Tensor, most: int) -> Tensor:
    """The leading principal columns of each joint's moves, `s x c x n`, times each of its features, `s x n x f`.

    With one prior scale for all, the rest is the least of what the prior allows. The columns themselves, n times f of
    them, are never made.
    """
    n, f = features.shape[1:]
    square = (moves.square() * features.square().sum(-1)[:, None]).mean((0, 2), keepdim=True) / f
    # A load that moves no joint has no features.
    scaled = torch.where(square > 0, moves / square.sqrt(), 0.0)
    inner = scaled.mT @ scaled
    gram = [features[:, i].mT @ (inner[:, i, :, None] * features).flatten(1) for i in range(n)]
    _, vectors = torch.linalg.eigh(torch.cat(gram))
    kept = vectors[:, -most:].reshape(n, f, -1)
    columns: Tensor = moves @ (features.transpose(0, 1) @ kept).transpose(0, 1)
    return columns


def linear_discrepancies(situation: Situation, beside: Sequence[str]) -> list[Atom]:
    """What acts through the drives, what is between base and measurement, and what the platform carries.

    Through the drives: each by its own track, or all by the place of all. Most are nearly of one form with an effect of
    the library; where that is a candidate it takes much to call the same something else.

    Args:
        situation: `s` rows.
        beside: names of the library effects that are candidates.
    """
    from_middle = situation.from_middle
    own = from_middle / from_middle.abs().amax(0).clamp_min(1e-300)
    place = unit_range(situation.joints)
    planes = torch.cat([torch.ones_like(place[:, :1]), place], -1)
    curves = torch.cat([planes, _BEND * _products(place)], -1)
    still = torch.eye(3, dtype=place.dtype).expand(len(place), 3, 3)
    found = {
        "joint_gain": _driven(situation, f"joint {ANY}", torch.stack([own, _BEND * own.square()], -1)),
        "coupling": _driven(situation, "workspace", _by_all(planes, own)),
        "geometry": _driven(situation, "workspace", _by_all(curves, own)),
        "instrument": _carried(situation, still),
    }
    turned = situation.platform[1]
    if turned is not None and float((turned - turned[:1]).abs().max()) > 1e-6:
        found["tool"] = _carried(situation, turned)
    found = {twin: atom for twin, atom in found.items() if atom.columns.shape[-1]}
    return [replace(atom, log_prior=_TWIN) if twin in beside else atom for twin, atom in found.items()]


def _by_all(features: Tensor, joints: Tensor) -> Tensor:
    """The same features for every joint, `s x n x f`."""
    return features[:, None].expand(-1, joints.shape[-1], -1)


def _driven(situation: Situation, driver: str, features: Tensor) -> Atom:
    """Joints that are off by features of their own, `s x n x f`."""
    columns = _reduced(joint_moves(situation, situation.jacobian), features, _MOST_PLACES)
    return discrepancy(driver, columns, plain=True)


def _carried(situation: Situation, axes: Tensor) -> Atom:
    """Shifts along axes, `s x 3 x 3`, by a plane over the workspace, and turns about them."""
    place = unit_range(situation.place[:, situation.lengths])
    features = torch.cat([torch.ones_like(place[:, :1]), place], -1)
    moves = carried_moves(situation)
    shifts = ((moves[..., :3] @ axes)[..., None] * features[:, None, None]).flatten(-2)
    turns = moves[..., 3:] @ axes if moves.shape[-1] == 6 else moves[..., :0]
    columns = torch.cat([shifts, turns], -1)
    shown = columns.abs().amax((0, 1)) > 1e-9 * columns.abs().max().clamp_min(1e-300)
    return discrepancy("workspace", columns[..., shown], plain=True)
