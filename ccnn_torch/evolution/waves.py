"""What repeats over a joint's range: periodic nodes that feed the outputs, and harmonics of a turning joint's gear.

A gear or a screw repeats its error many times over a joint's range. Sigmoids cannot follow that, and no descent finds
the frequency, since the error has a minimum at each of them. So frequencies are found by search: matching pursuit
(Mallat and Zhang, IEEE Trans. Signal Process. 41(12), 1993) in what the network leaves, one input and one frequency at
a time, each with the amplitudes of all found so far fitted anew (Pati, Rezaiifar and Krishnaprasad 1993). Refinement
then moves frequencies and amplitudes together with all other weights, and its prior switches off what is not needed.

A gear repeats its error with the turns of its shafts, so that the deviation of a joint holds harmonics of that joint's
own angle; those of a harmonic drive reach far up (past the fortieth on a UR10). Sigmoids cannot follow them, and one
frequency at a time is a poor way to find dozens. But the map is linear in the amplitudes, so all of them are fitted at
once, each with a prior precision that the evidence sets (MacKay, "Bayesian interpolation", Neural Computation 4, 1992):
a harmonic of which nothing is known is switched off. Where the rows do not cover an angle the prior rules, so that the
deviation goes to zero there instead of anywhere.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

# Inputs span 2, so that a wave of frequency pi has one period. Slower ones are left to the sigmoids.
_SLOWEST, _FASTEST = 4.0, 130.0
# Width of a spectral line is pi over the span; a quarter of its half finds every line near its top.
_SPACING = math.pi / 8
# An input with fewer values than this is a state (a direction, a load case), not a motion.
_FEWEST_VALUES = 8
# Keeps the normal equations regular where sine and cosine are nearly the same on the rows.
_RIDGE = 1e-9


class Waves(NamedTuple):
    """`k` slots for periodic nodes; a slot that is not in use has the frequency 0 and no connection.

    Attributes:
        source: which input a node reads, `... x k` int64.
        frequency: in rad per unit of the scaled input, `... x k`.
    """

    source: Tensor
    frequency: Tensor


def no_waves(leading: tuple[int, ...], slots: int, like: Tensor) -> Waves:
    """Slots that are all free."""
    frequency = torch.zeros(*leading, slots, dtype=like.dtype, device=like.device)
    return Waves(torch.zeros_like(frequency, dtype=torch.int64), frequency)


def wave_signal(waves: Waves, inputs: Tensor) -> Tensor:
    """Sines, then cosines, `... x s x 2k`. inputs: `... x s x i`, the leading dimensions broadcast."""
    phase = wave_inputs(waves.source, inputs) * waves.frequency.unsqueeze(-2)
    return torch.cat([torch.sin(phase), torch.cos(phase)], -1)


def wave_inputs(source: Tensor, inputs: Tensor) -> Tensor:
    """The input that each node reads, `... x s x k`."""
    leading = np.broadcast_shapes(source.shape[:-1], inputs.shape[:-2])
    rows = inputs.shape[-2]
    index = source.unsqueeze(-2).expand(*leading, rows, source.shape[-1])
    return inputs.expand(*leading, *inputs.shape[-2:]).gather(-1, index)


def find_waves(waves: Waves, residual: Tensor, inputs: Tensor, rows: Tensor, readable: Tensor, passes: int) -> Waves:
    """Fill free slots with the periodic nodes that explain most of a residual.

    Each pass takes, for every output, the input and frequency of the largest share of squares explained, where that
    share is more than the best of so many candidates has by chance: of noise, -s/2 log(1 - share) is distributed
    exponentially, so that its largest of n has passed log n + 2 one time in eight.

    Args:
        waves: slots so far, `b x k`.
        residual: `b x s x o`.
        inputs: `b x s x i`, about in [-1, 1].
        rows: row weights, `b x s`.
        readable: which inputs may be read, `i` bool.
        passes: how often to look, each time at what the nodes found before leave.
    """
    there = (rows > 0).unsqueeze(-1)
    root = rows.sqrt().unsqueeze(-1)
    inputs, residual = inputs.masked_fill(~there, 0), residual.masked_fill(~there, 0) * root
    frequencies = torch.arange(_SLOWEST, _FASTEST, _SPACING, dtype=inputs.dtype, device=inputs.device)
    moving = _values(inputs, there)
    candidates = torch.nonzero(readable & moving.any(0)).flatten().tolist()
    left = residual
    count = rows.sum(-1, keepdim=True)
    enough = math.log(max(1, int(readable.sum())) * residual.shape[-1] * len(frequencies)) + 2
    found = Waves(waves.source.clone(), waves.frequency.clone())
    for _ in range(passes):
        gain, source, frequency = _best(left, inputs, root, frequencies, candidates, moving)
        good = -count / 2 * torch.log1p(-gain.clamp(0, 1 - 1e-12)) > enough
        if not bool(good.any()):
            break
        found = _filled(found, source, frequency, good)
        left = _left(found, residual, inputs, root)
    return found


def _best(
    left: Tensor, inputs: Tensor, root: Tensor, frequencies: Tensor, candidates: list[int], moving: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Largest share of the squares of each output that one node explains, its input and frequency: `b x o` each."""
    total = left.square().sum(-2).clamp_min(1e-300)
    shape = total.shape
    best = (torch.zeros_like(total), torch.zeros(shape, dtype=torch.int64, device=left.device), torch.zeros_like(total))
    for source in candidates:
        phase = inputs[..., source, None] * frequencies
        sine, cosine = torch.sin(phase) * root, torch.cos(phase) * root
        ss, cc, sc = ((a * b).sum(-2).unsqueeze(-1) for a, b in ((sine, sine), (cosine, cosine), (sine, cosine)))
        determinant = ss * cc - sc * sc
        along, across = sine.mT @ left, cosine.mT @ left
        explained = (cc * along.square() - 2 * sc * along * across + ss * across.square()) / determinant.clamp_min(
            _RIDGE
        )
        distinct = (determinant > 1e-3 * ss * cc) & moving[:, source, None, None]
        share = torch.where(distinct, explained / total.unsqueeze(-2), 0.0)
        top = share.max(-2)
        better = top.values > best[0]
        best = (
            torch.where(better, top.values, best[0]),
            torch.where(better, source, best[1]),
            torch.where(better, frequencies[top.indices], best[2]),
        )
    return best


def _filled(waves: Waves, source: Tensor, frequency: Tensor, good: Tensor) -> Waves:
    """Nodes put into the first free slots, output by output, unless they are there already."""
    for output in range(source.shape[-1]):
        own, line = source[:, output, None], frequency[:, output, None]
        same = (waves.source == own) & ((waves.frequency - line).abs() < _SPACING)
        free = waves.frequency == 0
        wanted = good[:, output, None] & ~same.any(-1, keepdim=True) & free.any(-1, keepdim=True)
        first = torch.zeros_like(free).scatter(-1, free.to(torch.int8).argmax(-1, keepdim=True), True) & wanted
        waves = Waves(torch.where(first, own, waves.source), torch.where(first, line, waves.frequency))
    return waves


def _left(waves: Waves, residual: Tensor, inputs: Tensor, root: Tensor) -> Tensor:
    """What the nodes leave of a residual with their amplitudes fitted by least squares; `root` has the row weights."""
    basis = wave_signal(waves, inputs) * (waves.frequency != 0).repeat(1, 2).unsqueeze(-2) * root
    eye = torch.eye(basis.shape[-1], dtype=basis.dtype, device=basis.device)
    # A little more than nothing: two nodes of nearly the same frequency must not cancel each other.
    normal = basis.mT @ basis + (1e-6 * basis.shape[-2] + _RIDGE) * eye
    amplitudes: Tensor = torch.linalg.solve(normal, basis.mT @ residual)
    return residual - basis @ amplitudes


def _values(inputs: Tensor, there: Tensor) -> Tensor:
    """Whether an input takes more than a few values, `b x i` bool."""
    ordered = inputs.masked_fill(~there, torch.inf).sort(-2).values
    steps = (ordered[:, 1:] > ordered[:, :-1] + 1e-9) & ordered[:, 1:].isfinite()
    return steps.sum(-2) + 1 >= _FEWEST_VALUES


# Rows that a harmonic of one joint needs, and each turning joint at least: with fewer the harmonics follow everything
# else there is, which the network then does not see. On simulated six-joint arms with compliance or backlash, 140 rows,
# the error was 1.5 to 1.8 times as large with them, with everything at once and 280 rows 1.5 times; on a UR10 with 350
# rows half as large.
_ROWS_EACH, _ROWS_A_JOINT = 8, 50
_ITERATIONS = 30
_VAGUE = 1e-6
_PRECISION_RANGE = (1e-8, 1e12)
# Of its rows' freedom a channel keeps at least this share, however many amplitudes look determined.
_LEAST_FREEDOM = 0.1
# Directions of the amplitudes' covariance that a model keeps of each joint, the widest ones.
_DIRECTIONS = 32
# A harmonic that the evidence switched off keeps some 1e-6 of the deviations' scale; below this it is none, and costs a
# command nothing.
_SWITCHED_OFF = 1e-4


class Harmonics(nn.Module):
    """Fourier series of `a` turning joints, `k` harmonics each; their angles are the last `a` features.

    Attributes:
        step: angle of the first harmonic per unit of the feature, `... x a` [rad].
        amplitude: of the sines, then of the cosines, in the joint's own output, `... x a x 2k` [1].
        factors: `F` with `F F^T` the covariance of the amplitudes, `... x a x 2k x q` [1].
        owner: the output that is the deviation of each joint, as ones in `a x o`.
    """

    step: Tensor
    amplitude: Tensor
    factors: Tensor
    owner: Tensor

    def __init__(self, step: Tensor, amplitude: Tensor, factors: Tensor, owner: Tensor) -> None:
        super().__init__()
        for name, values in (("step", step), ("amplitude", amplitude), ("factors", factors), ("owner", owner)):
            self.register_buffer(name, values.clone())

    def repeat(self, index: int) -> Harmonics:
        """Those of one repeat, without the leading dimension."""
        return Harmonics(self.step[index], self.amplitude[index], self.factors[index], self.owner)

    def forward(self, inputs: Tensor) -> Tensor:
        """The deviation. inputs: `... x s x i` [1]; returns `... x s x o` [1]."""
        # Sums as products: engines with a narrow operator list have no other reduction.
        each = self._basis(inputs) @ self.amplitude.unsqueeze(-3).unsqueeze(-1)
        return each[..., 0, 0] @ self.owner

    def variance(self, inputs: Tensor) -> Tensor:
        """As the amplitudes are known. inputs: `... x s x i` [1]; returns `... x s x o` [1]."""
        scatter = (self._basis(inputs) @ self.factors.unsqueeze(-4))[..., 0, :]
        ones = scatter.new_ones(scatter.shape[-1], 1)
        return ((scatter * scatter) @ ones)[..., 0] @ self.owner

    def _basis(self, inputs: Tensor) -> Tensor:
        """`... x s x a x 1 x 2k`."""
        angles = inputs[..., inputs.shape[-1] - self.step.shape[-1] :]
        return _basis(self.step, angles, self.amplitude.shape[-1] // 2).unsqueeze(-2)


def harmonic_count(most: int, rows: int, joints: int) -> int:
    """Harmonics of each turning joint that so many rows can determine, at most `most`; 0 with too few rows."""
    return min(most, rows // _ROWS_EACH) if rows >= _ROWS_A_JOINT * joints else 0


def fit_harmonics(
    inputs: Tensor,
    step: Tensor,
    targets: Tensor,
    rows: Tensor,
    owners: Sequence[int],
    metric: Tensor | None,
    count: int,
) -> Harmonics:
    """Fit all amplitudes of all joints at once.

    Args:
        inputs: `r x s x i` [1], the angles last.
        step: their size, `r x a` [rad].
        targets: `r x s x o` [1].
        rows: row weights, `r x s`; 0 leaves a row out, even with NaN.
        owners: the output that is the deviation of each turning joint, `a`.
        metric: channels in which errors are judged, `r x s x c x o`, as in refinement; None = the outputs.
        count: harmonics of a joint.
    """
    outputs = targets.shape[-1]
    owner = torch.eye(outputs, dtype=targets.dtype, device=targets.device)[list(owners)]
    if metric is None:
        metric = torch.eye(outputs, dtype=targets.dtype, device=targets.device).expand(*targets.shape, outputs)
    angles = inputs[..., inputs.shape[-1] - len(owners) :]
    # A repeat at a time: the normal matrices of many harmonics are large, and the work is all in their products.
    found = [
        _fit(*one, owner, count)
        for one in zip(angles.unbind(), step.unbind(), targets.unbind(), rows.unbind(), metric.unbind(), strict=True)
    ]
    amplitude, factors = (torch.stack(part) for part in zip(*found, strict=True))
    return Harmonics(step, amplitude, factors, owner)


def _basis(step: Tensor, angles: Tensor, count: int) -> Tensor:
    """Sines, then cosines, `... x s x a x 2k`."""
    order = torch.arange(1, count + 1, dtype=angles.dtype, device=angles.device)
    phase = (angles * step.unsqueeze(-2)).unsqueeze(-1) * order
    return torch.cat([torch.sin(phase), torch.cos(phase)], -1)


def _fit(
    angles: Tensor, step: Tensor, targets: Tensor, rows: Tensor, metric: Tensor, owner: Tensor, count: int
) -> tuple[Tensor, Tensor]:
    """Amplitudes `a x 2k` and the factors of their covariance `a x 2k x q` of one repeat."""
    there = rows > 0
    angles, targets, rows, metric = angles[there], targets[there], rows[there], metric[there]
    joints, outputs = owner.shape
    basis = _basis(step, angles, count).flatten(-2)
    spread = (metric @ owner.mT).repeat_interleave(2 * count, -1)
    wanted = (metric @ targets.unsqueeze(-1)).squeeze(-1)
    # The means of the outputs are fitted as well, so that no harmonic replaces them; they are not kept.
    grams, moments = [], []
    for channel in range(wanted.shape[-1]):
        design = torch.cat([spread[:, channel] * basis, metric[:, channel]], -1)
        grams.append(design.mT @ (design * rows.unsqueeze(-1)))
        moments.append(design.mT @ (wanted[:, channel] * rows))
    gram, moment = torch.stack(grams), torch.stack(moments)
    energy = (wanted.square() * rows.unsqueeze(-1)).sum(0)
    # Sine and cosine of one harmonic of one joint share a precision.
    harmonic = torch.arange(joints * count, device=rows.device).reshape(joints, count).repeat(1, 2).flatten()
    amplitude, covariance = _evidence(gram, moment, energy, rows.sum(), harmonic, outputs)
    waves = amplitude.reshape(joints, 2, count)
    own = torch.where(waves.norm(dim=1, keepdim=True) < _SWITCHED_OFF, 0.0, waves).flatten(1)
    blocks = covariance.reshape(joints, 2 * count, joints, 2 * count)
    blocks = torch.stack([blocks[joint, :, joint] for joint in range(joints)])
    values, vectors = torch.linalg.eigh(blocks)
    widest = min(_DIRECTIONS, 2 * count)
    factors = vectors[..., -widest:] * values[..., None, -widest:].clamp_min(0).sqrt()
    return own, factors


def _evidence(
    gram: Tensor, moment: Tensor, energy: Tensor, count: Tensor, group: Tensor, free: int
) -> tuple[Tensor, Tensor]:
    """Posterior mean `d` and covariance `d x d` of the amplitudes under the precisions of highest evidence.

    Args:
        gram, moment, energy: of each channel, `c x (d + free) x (d + free)`, `c x (d + free)`, `c`.
        count: rows.
        group: amplitudes that share a precision, `d` int64.
        free: columns behind the amplitudes that nothing holds back.
    """
    size, groups = len(group), int(group.max()) + 1
    prior = gram.new_ones(groups)
    noise = count / energy.clamp_min(1e-300)
    # Loose means keep the matrix regular.
    loose = gram.new_full((free,), _PRECISION_RANGE[0])
    for _ in range(_ITERATIONS):
        precision = torch.cat([prior[group], loose])
        matrix = (noise[:, None, None] * gram).sum(0) + torch.diag(precision)
        root = torch.linalg.cholesky(matrix)
        mean = torch.cholesky_solve((noise.unsqueeze(-1) * moment).sum(0).unsqueeze(-1), root).squeeze(-1)
        covariance = torch.cholesky_inverse(root)
        determined = 1 - precision * covariance.diagonal()
        effective = mean.new_zeros(groups).index_add(0, group, determined[:size]).clamp_min(0)
        squares = mean.new_zeros(groups).index_add(0, group, mean[:size].square())
        prior = ((effective + _VAGUE) / (squares + _VAGUE * 1e-6)).clamp(*_PRECISION_RANGE)
        left = energy - 2 * moment @ mean + torch.einsum("i,cij,j->c", mean, gram, mean)
        known = determined.sum() / len(energy)
        noise = (torch.maximum(count - known, count * _LEAST_FREEDOM) / left.clamp_min(1e-300)).clamp(*_PRECISION_RANGE)
    return mean[:size], covariance[:size, :size]
