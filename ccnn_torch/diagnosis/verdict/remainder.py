"""Is what a verdict leaves noise? A test of the whole answer against everything that the rows record.

What the named effects leave, in units of a robust noise of each channel and clipped, is compared with functions of each
driver: smooth ones, in every channel, in one, and through every joint; own ones of a joint; products of two; steps at a
row. The order of the rows is drawn anew for what would be found in noise (a permutation test; Freedman and Lane 1983),
and the smallest probability counts for as many families as were tried.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from itertools import combinations
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from ccnn_torch.diagnosis.candidates.atom import scaled_signature, scales
from ccnn_torch.diagnosis.discrepancy.local import CROSS
from ccnn_torch.diagnosis.discrepancy.smooth import PLACE, driver_of, unit_range
from ccnn_torch.diagnosis.residual.whitening import MAD
from ccnn_torch.diagnosis.search.analysis import Analysis
from ccnn_torch.evidence.dictionary import FittedSet
from ccnn_torch.evidence.form_error import is_unexplained

# Values beyond this many robust standard deviations count as this many: tails are no structure.
_CLIP, _SCALINGS = 2.5, 3
# Degree of smooth functions, waves of a joint's own in its range, and parts that the order of the rows is cut into.
_DEGREE, _WAVES, _PARTS = 5, (2, 3, 4, 5, 6, 7), 8
_ORDERS = 199
# Values that the test needs beyond those that its own functions take, and that it takes at most.
_FEWEST, _MOST = 12, 3000
# Share of a column that what is fitted leaves, from which it is one of its own; and of a block's largest direction.
_OWN, _INDEPENDENT = 1e-6, 1e-8
# Step in a shape, as a share of it, for what its error changes.
_STEP = 1e-4


class Remainder(NamedTuple):
    """The strongest structure in what is left.

    Attributes:
        probability: of as strong a one in noise.
        driver: what it follows, as a discrepancy term is called.
        excess: its squares over those that errors of the effects' forms may have, in the channel where it is largest.
    """

    probability: float
    driver: str
    excess: float


class _Block(NamedTuple):
    """Functions of a driver, `s x m`, in every channel, through every joint, or through one.

    Attributes:
        driver: what they follow.
        family: those among which the strongest counts.
        values: `s x m`.
        through: "channel" or "joint".
        which: of them; None = each.
    """

    driver: str
    family: str
    values: Tensor
    through: str
    which: int | None = None


# Probability below which a remainder is no noise, where it is more than the form errors of the effects would be along
# so many directions.
_UNLIKELY, _DIRECTIONS = 0.003, 20
# So many times a known noise is not a noise that was stated a little too small.
_MANY_TIMES = 2.0


def rest_of(analysis: Analysis, found: FittedSet) -> tuple[str, ...] | None:
    """What the remainder of a set follows; () where it is far more than a known noise and follows nothing; None where
    it is noise, or nothing tells."""
    rest = remainder_of(analysis, found)
    if rest and rest.probability < _UNLIKELY and rest.excess > 1:
        return (rest.driver,)
    return () if analysis.noise_is_known and times_the_noise(analysis, found) > _MANY_TIMES else None


def times_the_noise(analysis: Analysis, found: FittedSet) -> float:
    """Standard deviation of what a set leaves, over that of the noise; 1 where it is no clearly more than that."""
    return _times(analysis, found) if is_unexplained(analysis.dictionary, found, analysis.floor) else 1.0


def _times(analysis: Analysis, found: FittedSet) -> float:
    free = max(analysis.dictionary.grams.values - found.effective, 1.0)
    return float((found.rss / free / max(analysis.floor, 1e-300)) ** 0.5)


def times_as_scatter(analysis: Analysis, found: FittedSet) -> float:
    """As `times_the_noise` without an allowance for form errors: these follow what their effects follow.

    1 where what is left may be a form error, since it follows something, and where it is not many times the noise.
    """
    times = _times(analysis, found)
    rest = remainder_of(analysis, found) if times > _MANY_TIMES else None
    return 1.0 if rest is None or rest.probability < _UNLIKELY else times


class _Left(NamedTuple):
    """What is left in units of a robust noise.

    Attributes:
        basis: orthonormal directions of what was fitted, `s c x k`.
        target: what was to be explained, `s c`.
        every: what is left, clipped and as it is, then orders of its rows, `s c x p`.
        form: squares that errors of the effects' forms may have in each channel, `c`.
        jacobian: by the joints, `s x c x n`.
    """

    basis: Tensor
    target: Tensor
    every: Tensor
    form: Tensor
    jacobian: Tensor


def remainder_of(analysis: Analysis, found: FittedSet) -> Remainder | None:
    """Test what a set leaves of the rows that count; None where they are too few.

    Args:
        analysis: of the rows.
        found: the set.
    """
    channels, order = analysis.dictionary.y.shape[1], torch.Generator().manual_seed(0)
    seen, keep = analysis.whitening.seen, analysis.whitening.keep()
    # Rows in which a part was not measured are none to exchange.
    whole = torch.arange(len(keep)) if seen is None else torch.nonzero(seen[keep].all(-1))[:, 0]
    taken = whole[torch.randperm(len(whole), generator=order)[: max(_MOST // channels, 1)].sort().values]
    rest = _left(analysis, found, taken, order) if len(taken) > 1 else None
    if rest is None:
        return None
    free = len(rest.basis) - rest.basis.shape[1]
    total = rest.every.square().sum(0) - (rest.basis.mT @ rest.every).square().sum(0)
    best: dict[str, Tensor] = {}
    strongest: tuple[float, _Block] | None = None
    for alike, explained, count in _explained(_blocks(_drivers(analysis, keep[taken]), channels), rest):
        spare = (free - count).clamp_min(1.0)
        unexplained = (total - explained).clamp_min(1e-300)
        score = _surprise(explained / count.clamp_min(1.0) * spare / unexplained, count, spare)
        # Of many drivers that go together the one that needs least for it (Schwarz 1978).
        evidence = (free * (total / unexplained)[:, :1].log() - count * math.log(free)) / 2
        for i in torch.nonzero((count > 0) & (free - count >= _FEWEST))[:, 0].tolist():
            block = alike[i]
            best[block.family] = torch.maximum(score[i], best.get(block.family, score[i]))
            if strongest is None or float(evidence[i]) > strongest[0]:
                strongest = float(evidence[i]), block
    if strongest is None:
        return None
    block = strongest[1]
    smallest = min(_tail(float(score[0]), score[2:]) for score in best.values())
    parts = dict.fromkeys(PLACE if part.startswith(PLACE) else part for part in block.driver.split(CROSS))
    return Remainder(min(1.0, len(best) * smallest), CROSS.join(parts), _excess(block, rest))


def _excess(block: _Block, rest: _Left) -> float:
    """As in `Remainder`: in units of a channel's own noise, since one may be far noisier than the others."""
    channels = rest.jacobian.shape[1]
    own = _basis(_columns(block, rest))
    left = rest.every[:, 1]
    found = own @ (own.mT @ left)
    noise = (left - found).square().sum() / max(len(left) - rest.basis.shape[1] - own.shape[1], 1)
    by_channel = (found.square() - noise * own.square().sum(-1)).reshape(-1, channels).sum(0)
    most = int(by_channel.argmax())
    return float(by_channel[most] / rest.form[most].clamp_min(1e-300))


def _left(analysis: Analysis, found: FittedSet, taken: Tensor, order: torch.Generator) -> _Left | None:
    """What a set leaves of the rows taken, `t`; None where nearly all was fitted. order: of the rows, is drawn from."""
    own = [analysis.fitted, *_of_effects(analysis, found), analysis.situation.jacobian]
    target, *columns, jacobian = _whitened(analysis, [analysis.residual[..., None], *own], taken)
    rows, channels = target.shape[:2]
    scale = torch.ones(channels, dtype=torch.float64)
    for _ in range(_SCALINGS):
        basis = _basis(torch.cat([c * scale[:, None] for c in columns], -1).flatten(0, 1))
        free = rows * channels - basis.shape[1]
        if free < _FEWEST:
            return None
        y = (target[..., 0] * scale).flatten()
        left = y - basis @ (basis.mT @ y)
        used, spread = scale, MAD * left.reshape(rows, channels).abs().median(0).values
        scale = used / (spread / (free / (rows * channels)) ** 0.5).clamp_min(1e-12)
    clipped = left.clamp(-_CLIP, _CLIP)
    by_row = (clipped - basis @ (basis.mT @ clipped)).reshape(rows, channels)
    drawn = [by_row[torch.randperm(rows, generator=order)].flatten() for _ in range(_ORDERS)]
    every = torch.stack([by_row.flatten(), left, *drawn], -1)
    form = torch.zeros(channels, dtype=torch.float64)
    for i, mean in zip(found.members, found.mean, strict=True):
        (done,) = _whitened(analysis, [analysis.atoms[i].columns @ mean[:, None]], taken)
        squares = torch.minimum((done[..., 0] * used).square().sum(0), y.reshape(rows, channels).square().sum(0))
        form += _DIRECTIONS * analysis.atoms[i].form_error * squares
    return _Left(basis, y, every, form, jacobian * used[:, None])


def _drivers(analysis: Analysis, keep: Tensor) -> Mapping[str, Tensor]:
    """Drivers in some rows, each `t` in [-1, 1]: joints, place, order of the rows, covariates, directions."""
    situation = analysis.situation
    found = {f"joint {j.name}": situation.joints[keep, i] for i, j in enumerate(situation.mechanism.joints)}
    place = situation.place[keep]
    found |= {f"{PLACE} {i}": place[:, i] for i in range(place.shape[-1])}
    found["time"] = torch.arange(len(keep), dtype=torch.float64)
    named = {driver_of(name): value[keep] for name, value in situation.covariates.items()}
    found |= {name: value for name, value in named.items() if name and not name.startswith("speed") and name != "time"}
    if not any(name.startswith("direction") for name in found):
        step = situation.joints[keep].diff(dim=0, prepend=situation.joints[keep][:1])
        found |= {f"direction {i + 1}": torch.where(step[:, i] < 0, -1.0, 1.0).double() for i in range(step.shape[-1])}
    return {n: unit_range(v[:, None].double())[:, 0] for n, v in found.items() if float(v.max() - v.min()) > 1e-9}


def _blocks(drivers: Mapping[str, Tensor], channels: int) -> Iterator[_Block]:
    joints = [name for name in drivers if name.startswith("joint ")]
    for name, value in drivers.items():
        smooth = _polynomials(value, _DEGREE) if _is_many(value) else value[:, None]
        yield from (_Block(name, "smooth", smooth, through) for through in ("channel", "joint"))
        yield from (_Block(name, "channel", smooth, "channel", k) for k in range(channels))
    for i, name in enumerate(joints):
        waves = drivers[name][:, None] * torch.pi * torch.tensor(_WAVES)
        shapes = torch.cat([_polynomials(drivers[name], _DEGREE), waves.sin(), waves.cos()], -1)
        yield _Block(name, "own", shapes, "joint", i)
    for name in (n for n in drivers if n.startswith("direction ") and n[10:].isdigit()):
        i, value = int(name[10:]) - 1, drivers[name][:, None]
        if i >= len(joints):
            continue
        own = torch.cat([torch.ones_like(value), _polynomials(drivers[joints[i]], 4)], -1)
        yield _Block(name, "direction", value * own, "joint", i)
        for other in (n for n, v in drivers.items() if n != name and _is_many(v)):
            both = value * _polynomials(drivers[other], 2)
            yield _Block(name + CROSS + other, "direction pair", both, "joint", i)
    rows = len(next(iter(drivers.values())))
    steps = (torch.arange(rows) >= (k * rows) // (2 * _PARTS) for k in range(1, 2 * _PARTS))
    for step in steps:
        yield from (_Block("time", "step", step.double()[:, None], way) for way in ("channel", "joint"))
    for one, other in combinations(drivers, 2):
        both = (drivers[one] * drivers[other])[:, None]
        yield from (_Block(one + CROSS + other, "pair", both, way) for way in ("channel", "joint"))


def _explained(blocks: Iterable[_Block], rest: _Left) -> Iterator[tuple[list[_Block], Tensor, Tensor]]:
    """Blocks of one shape, the squares of what is left and of every order drawn that each explains beside what was
    fitted, `b x p`, and by how many directions, `b x 1`.

    A column is the product of a function of the rows and of a map to the channels. Its scalar products are taken
    through the map first, so that no column is formed.
    """
    rows, channels, _ = rest.jacobian.shape
    fitted, along = rest.basis.shape[1], rest.basis.mT @ rest.every
    every = torch.cat([rest.basis, rest.every], -1).reshape(rows, channels, -1)
    maps = {kind: _map(kind, None, rest) for kind in ("channel", "joint")}
    mapped = {kind: (m.mT @ m, m.mT @ every) for kind, m in maps.items()}
    kinds: dict[tuple[str, int | None, int], list[_Block]] = {}
    for block in blocks:
        kinds.setdefault((block.through, block.which, block.values.shape[-1]), []).append(block)
    for (through, which, _), alike in kinds.items():
        part = slice(None) if which is None else slice(which, which + 1)
        values, squares, seen = torch.stack([b.values for b in alike]), *mapped[through]
        gram = torch.einsum("bsm,bsn,svw->bmvnw", values, values, squares[:, part, part]).flatten(3).flatten(1, 2)
        products = torch.einsum("bsm,svp->bmvp", values, seen[:, part]).flatten(1, 2)
        size = (gram.diagonal(dim1=-2, dim2=-1) / (rows * channels)).clamp_min(1e-300).sqrt()[..., None]
        on_fitted, on_left = (products / size).tensor_split([fitted], -1)
        gram = gram / size / size.mT - on_fitted @ on_fitted.mT
        own = gram.diagonal(dim1=-2, dim2=-1)[..., None] > _OWN * rows * channels
        gram, on_left = gram * own * own.mT, (on_left - on_fitted @ along) * own
        values_of, vectors = torch.linalg.eigh(gram)
        kept = values_of > _INDEPENDENT * values_of.amax(-1, keepdim=True).clamp_min(1e-300)
        explained = (vectors.mT @ on_left).square() / values_of.clamp_min(1e-300)[..., None]
        kept &= values_of.amax(-1, keepdim=True) > 0
        yield alike, torch.where(kept[..., None], explained, 0.0).sum(1), kept.sum(-1, keepdim=True).double()


def _map(through: str, which: int | None, rest: _Left) -> Tensor:
    """Of a block to the channels, `s x c x w`."""
    rows, channels, _ = rest.jacobian.shape
    found = rest.jacobian if through == "joint" else torch.eye(channels, dtype=torch.float64).expand(rows, -1, -1)
    return found if which is None else found[..., [which]]


def _columns(block: _Block, rest: _Left) -> Tensor:
    """What a block does beside what was fitted, `(s c) x m`; 0 where that is next to nothing."""
    columns = _map(block.through, block.which, rest)[..., None, :] * block.values[:, None, :, None]
    columns = columns.flatten(2).flatten(0, 1)
    columns = columns / columns.square().mean(0).sqrt().clamp_min(1e-300)
    columns = columns - rest.basis @ (rest.basis.mT @ columns)
    kept: Tensor = columns * (columns.square().mean(0) > _OWN)
    return kept


def _of_effects(analysis: Analysis, found: FittedSet) -> Iterator[Tensor]:
    """Columns of a set's members, and what errors of their shapes change, `s x c0 x m` each."""
    situation = analysis.situation
    for i, mean in zip(found.members, found.mean, strict=True):
        atom = analysis.atoms[i]
        yield atom.columns
        if atom.effect is None:
            continue
        size = scales(atom.effect.coefficients(situation), situation.joints)
        spread = atom.spread(situation, mean) / size
        for k in range(len(atom.shape)):
            step = torch.zeros_like(atom.shape)
            step[k] = _STEP * float(atom.shape[k].abs().clamp_min(1e-12))
            more, less = (scaled_signature(situation, atom.effect, atom.shape + s * step) @ spread for s in (1, -1))
            yield torch.nan_to_num((more - less)[..., None])


def _whitened(analysis: Analysis, values: list[Tensor], taken: Tensor) -> list[Tensor]:
    """Raw values `s x c0 x m` in the rows that are taken of those that count, without what rows share, `t x c x m`."""
    keep = analysis.whitening.keep()
    return [analysis.correlation(analysis.whitening(v)[keep])[taken] for v in values]


def _basis(columns: Tensor) -> Tensor:
    """Orthonormal directions of columns, `n x k`."""
    if not columns.shape[-1]:
        return columns
    columns = columns / columns.square().mean(0).sqrt().clamp_min(1e-300)
    u, s, _ = torch.linalg.svd(columns, full_matrices=False)
    found: Tensor = u[:, s > 1e-6 * s.max().clamp_min(1e-300)]
    return found


def _is_many(values: Tensor) -> bool:
    """Whether there are more than two different ones."""
    return bool(((values != values.amin()) & (values != values.amax())).any())


def _polynomials(value: Tensor, degree: int) -> Tensor:
    """Chebyshev polynomials of degrees 1 to `degree` of values in [-1, 1], `s x degree`."""
    values: Tensor = torch.from_numpy(np.polynomial.chebyshev.chebvander(value.numpy(), degree)[:, 1:])
    return values


def _surprise(ratio: Tensor, first: Tensor, second: Tensor) -> Tensor:
    """Minus the logarithm of the probability of a larger F ratio (Paulson 1942)."""
    a, b, root = 2 / (9 * first.clamp_min(1.0)), 2 / (9 * second), ratio.clamp_min(0).pow(1 / 3)
    score: Tensor = -torch.special.log_ndtr(((1 - a) - (1 - b) * root) / (a + b * root.square()).sqrt())
    return score


def _tail(score: float, drawn: Tensor) -> float:
    """Probability of a larger score than this among the orders drawn, by the Gumbel distribution of their moments."""
    width = max(float(drawn.std()), 1e-12) * 6**0.5 / np.pi
    return float(-np.expm1(-np.exp(-(score - float(drawn.mean()) + 0.5772 * width) / width)))
