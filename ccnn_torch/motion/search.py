"""The search over sets of effects: forward with a screen of every effect, then replacements and removals.

All axes go side by side, each with its own sets: they share the simulated time steps.
"""

from __future__ import annotations

import math
from collections.abc import Container, Sequence
from dataclasses import replace
from itertools import islice
from typing import NamedTuple

import torch
from torch import Tensor

from ccnn_torch.evidence.priors import EFFECT, OUTSIDE, crowd
from ccnn_torch.motion.descent import sensitivities, white_residual
from ccnn_torch.motion.fit import fit_many, form_errors, products, side_by_side, unseen_errors, weighed
from ccnn_torch.motion.library import Library, Variant
from ccnn_torch.motion.problem import Problem
from ccnn_torch.motion.ripples import left_ripples
from ccnn_torch.motion.servo import TORQUES
from ccnn_torch.motion.spec import Fit, Spec, nothing, started, without
from ccnn_torch.motion.whiten import Whitening, fitted_whitening, white_noise

# What a loop and a rigid body may have wrong.
_COMMON = ("servo_gain", "feedforward", "joint_gain", "inertia", "coulomb", "flexible_joint")
# Sets that are extended, effects that are fitted for each of them after the screen, and members at most.
_BEAM, _FITTED, _MOST = 2, 4, 9
# Decimals of a log evidence up to which sets do the same.
_DIGITS = 3
# Log posterior that a level must bring.
_GAINED = 1.0
# Stretches in which sets are looked for, at first and then.
_FIRST, _SCREENED = 8, 16
# Sets that are fitted anew under another noise; and to all stretches, with log posteriors within so much.
_KEPT, _LIKELY, _WITHIN = 6, 16, 30.0
_LONG, _SHORT, _FEW = 8, 5, 3
# Ways to begin up to which an effect alone is fitted from each.
_STARTS = 4
# Difference quotients, for numbers that begin at 0 [plausible sizes].
_STEP = 0.1


Members = tuple[int, ...]


class Search(NamedTuple):
    """What was fitted.

    Attributes:
        problem: the data.
        whitening: of the residual of each axis.
        found: of each axis the fits of all sets, most probable first.
        largest: residual of each axis under the largest model, of white noise, `n x b x s` [rad or m].
        form: variance of the form errors of each axis, as of `form_errors`.
        nuisance: as of `fit_many`.
    """

    problem: Problem
    whitening: Whitening
    found: tuple[tuple[Fit, ...], ...]
    largest: Tensor
    form: tuple[float, ...]
    nuisance: Tensor


def log_posterior(fit: Fit) -> float:
    """Log evidence with the prior of the set, not normalised."""
    return fit.log_evidence + prior_of(fit.spec)


def prior_of(spec: Spec, drivers: int = 0) -> float:
    """Log prior of a set, beside so many drivers of something outside the library."""
    count = len(spec.members)
    return spec.log_prior + EFFECT * count + OUTSIDE * drivers + crowd(count + drivers)


def search(problem: Problem) -> Search:
    """Find the probable sets of every axis."""
    n, count = len(problem.axes), len(problem.data.run)
    # Sets are looked for in some of the stretches, and fitted to all.
    fewest, few = (
        problem.of(torch.linspace(0, count - 1, some).round().long()) if count > some else problem
        for some in (_FIRST, _SCREENED)
    )
    plain = _Pool(fewest, white_noise(n))
    # Before it is whitened a residual has the fewest local optima.
    plain.forward()
    plain.backward()
    plain.forward()
    largest = problem.residual(torch.stack([f.spec.theta for f in plain.best()]), problem.axes)
    library = _repeating(problem, largest)
    problem, few, fewest = (replace(one, library=library) for one in (problem, few, fewest))
    pool = _Pool(fewest, fitted_whitening(problem.pooled(largest), problem.judged))
    pool.again(plain)
    pool.forward()
    # The noise of what is left by what is most probable now.
    theta = torch.stack([f.spec.theta for f in pool.best()])
    left = problem.residual(theta, problem.axes)
    near = _Pool(few, fitted_whitening(problem.pooled(left), problem.judged), theta)
    near.again(pool)
    likely = near.explored()
    final = near
    if few is not problem:
        final = _Pool(problem, near.whitening, theta)
        final.fit(likely, _LONG)
    final.reduced()
    unseen = final.weigh_forms()
    form = form_errors(problem, final.whitening, final.nuisance, final.tied(), unseen)
    final.variance = None
    final.reduced()
    return Search(
        problem, final.whitening, tuple(tuple(p) for p in final.ranked()), largest, tuple(form), final.nuisance
    )


def _repeating(problem: Problem, left: Tensor) -> Library:
    """The library with waves as they repeat in what a model leaves, `n x b x s`."""
    data = problem.data
    each = zip(*(v[:, data.judged] for v in (left, data.position, data.speed)), strict=True)
    return problem.library.repeating([left_ripples(*own) for own in each])


def _best_variants(found: Sequence[tuple[float, Variant]]) -> dict[int, tuple[float, Variant]]:
    """Of each effect the variant that promises most, with what it does."""
    best: dict[int, tuple[float, Variant]] = {}
    for score, variant in found:
        if variant.effect not in best or _level(score) > _level(best[variant.effect][0]):
            best[variant.effect] = (score, variant)
    return best


def _level(score: float) -> float:
    """A log evidence so that those of sets that do the same are equal, whatever the last digit is."""
    return round(score, _DIGITS) if math.isfinite(score) else score


class _Pool:
    """Fits of each axis by their members, under one noise."""

    def __init__(self, problem: Problem, whitening: Whitening, about: Tensor | None = None) -> None:
        self.problem, self.whitening = problem, whitening
        # Nothing, as long as each set has the noise that it leaves.
        self.axes, followed = len(problem.axes), problem.driven.followed
        nuisance = followed.new_zeros(0, *followed.shape) if about is None else problem.nuisance(about)
        white = problem.whitened(nuisance.flatten(0, 1), problem.axes.repeat(len(nuisance)), whitening)
        self.nuisance = white.reshape(len(nuisance), self.axes, white.shape[-1]).transpose(0, 1)
        self.library: Library = problem.library
        # Of noise and form errors of each axis; None: the noise that each set leaves.
        self.variance: list[float] | None = None
        self.scores: list[dict[tuple[float, Members], tuple[float, Fit]]] = [{} for _ in range(self.axes)]
        self.found: list[dict[tuple[int, ...], Fit]] = [{} for _ in range(self.axes)]
        self.fit([[nothing(self.library)] for _ in range(self.axes)], 0)

    def best(self) -> list[Fit]:
        return [self.scored(i)[0][1] for i in range(self.axes)]

    def tied(self) -> list[list[Fit]]:
        """The most probable sets of each axis, those that are nearly as probable included."""
        return [[f for s, f in ranked if s >= ranked[0][0] - _GAINED] for ranked in map(self.scored, range(self.axes))]

    def ranked(self) -> list[list[Fit]]:
        return [[fit for _, fit in self.scored(i)] for i in range(self.axes)]

    def leading(self, axis: int) -> list[Fit]:
        """The most probable sets of an axis; of those that do the same one."""
        apart: dict[float, Fit] = {}
        for score, fit in self.scored(axis):
            apart.setdefault(_level(score), fit)
        return list(apart.values())[:_BEAM]

    def noise_of(self, axis: int) -> float | None:
        return None if self.variance is None else self.variance[axis]

    def scored(self, axis: int) -> list[tuple[float, Fit]]:
        """Log posterior of every set of an axis under the noise that counts, the most probable first."""
        fits, variance, old = list(self.found[axis].values()), self.noise_of(axis), self.scores[axis]
        new = [
            fit for fit in fits if variance is not None and old.get((variance, fit.members), (0.0, None))[1] is not fit
        ]
        if variance is not None and new:
            weighed_new = weighed(
                side_by_side([f.grams for f in new]), self.nuisance.shape[1], [f.spec.groups for f in new], variance
            )
            for fit, evidence in zip(new, weighed_new.log_evidence.tolist(), strict=True):
                old[variance, fit.members] = evidence + prior_of(fit.spec), fit
        found = [(log_posterior(fit), fit) if variance is None else old[variance, fit.members] for fit in fits]
        return sorted(found, key=lambda one: (-_level(one[0]), one[1].members))

    def fit(self, wanted: Sequence[Sequence[Spec]], steps: int) -> None:
        """Fit sets of each axis; one that was fitted before stays if it was better, and is left alone where that
        fit has come to rest."""
        settled = [{id(fit.spec) for fit in own.values() if fit.settled} for own in self.found]
        pairs = [(i, spec) for i, own in enumerate(wanted) for spec in own if id(spec) not in settled[i]]
        best = [min((f.rss for f in own.values()), default=math.inf) for own in self.found]
        reached = torch.tensor(best, dtype=torch.float64)
        fits = fit_many(self.problem, self.whitening, pairs, steps, nuisance=self.nuisance, reached=reached)
        for (i, _), fit in zip(pairs, fits, strict=True):
            old = self.found[i].get(fit.members)
            if old is None or log_posterior(fit) > log_posterior(old):
                self.found[i][fit.members] = fit

    def again(self, other: _Pool) -> None:
        """Fit the most probable sets of another pool under this noise, those of each size, and every effect alone."""
        wanted = []
        for fits in other.ranked():
            by_size = {len(f.members): f.spec for f in reversed(fits) if len(f.members) > 1}
            several = [*(f.spec for f in fits[:_KEPT] if len(f.members) > 1), *by_size.values()]
            wanted.append([*{spec.members: spec for spec in several}.values()])
        self.fit(wanted, _LONG)
        self.fit([[f.spec for f in fits if len(f.members) == 1] for fits in other.ranked()], _FEW)

    def forward(self, beam: int = _BEAM, steps: int = _SHORT, fitted: int = _FITTED) -> None:
        """Add effects one after the other, as long as that brings evidence.

        Args:
            beam: so many of the most probable sets are extended.
            steps: as of `fit_many`.
            fitted: effects that are fitted beside each, those that promise most.
        """
        done: list[set[tuple[int, ...]]] = [set() for _ in range(self.axes)]
        gains = [True] * self.axes
        for _ in range(_MOST):
            before = [self.scored(i)[0][0] for i in range(self.axes)]
            bases = [
                [f for f in self.leading(i)[:beam] if gains[i] and f.members not in done[i] and len(f.members) < _MOST]
                for i in range(self.axes)
            ]
            for d, own in zip(done, bases, strict=True):
                d |= {f.members for f in own}
            # Alone, where its own share of the gap is told, and beside one other every effect is fitted.
            small = all(len(f.members) < 2 for own in bases for f in own)
            self.fit(self.screened(bases, len(self.library.names) if small else fitted), steps)
            leading = [self.leading(i)[:beam] if own else [] for i, own in enumerate(bases)]
            self.fit([[f.spec for f in own if f.members] for own in leading], steps)
            after = [self.scored(i)[0][0] for i in range(self.axes)]
            gains = [a >= b + _GAINED for a, b in zip(after, before, strict=True)]
            if not any(gains):
                return

    def backward(self) -> None:
        """From the most probable set with all beside it that a loop may have wrong, less and less, as long as that
        brings evidence: where two of these are nothing without each other, one after the other finds neither."""
        begin = [(i, f.spec) for i, f in enumerate(self.best())]
        variances = [self.noise_of(i) for i in range(self.axes)]
        now = []
        promised = promises(self.problem, self.whitening, begin, self.nuisance, variances)
        for (i, spec), found in zip(begin, promised, strict=True):
            for _, variant in _best_variants(found).values():
                if self.library.names[variant.effect] in _COMMON:
                    spec = started(spec, variant, i)
            now.append(spec)
        self.fit([[s] for s in now], _LONG)
        fits, going = [self.found[i][s.members] for i, s in enumerate(now)], [True] * self.axes
        while any(going):
            less = self.fewer(
                [f.spec if on else nothing(self.library) for f, on in zip(fits, going, strict=True)], _SHORT
            )
            best = [max(own, key=log_posterior, default=f) for own, f in zip(less, fits, strict=True)]
            going = [_level(log_posterior(b)) > _level(log_posterior(f)) for b, f in zip(best, fits, strict=True)]
            fits = [b if on else f for b, f, on in zip(best, fits, going, strict=True)]

    def explored(self) -> list[list[Spec]]:
        """The likely sets of each axis, and every effect alone: sets near those that are the most probable."""
        self.reduced()
        likely = self.likely()
        # Sets that are probable although forms are wrong are smaller than those above.
        self.weigh_forms()
        # No screen is sure: beside the best one every effect is fitted.
        self.forward(1, _SHORT, len(self.library.names))
        self.neighbours([True] * self.axes)
        before = self.best()
        self.twins()
        self.neighbours([a.members != b.members for a, b in zip(before, self.best(), strict=True)])
        for own, more, found in zip(likely, self.likely(), self.found, strict=True):
            own |= more | {members: fit.spec for members, fit in found.items() if len(members) == 1}
        self.variance = None
        return [list(own.values()) for own in likely]

    def likely(self) -> list[dict[Members, Spec]]:
        """The most probable sets of each axis, by their members."""
        return [
            {f.members: f.spec for s, f in ranked[:_LIKELY] if s >= ranked[0][0] - _WITHIN}
            for ranked in map(self.scored, range(self.axes))
        ]

    def weigh_forms(self) -> list[float]:
        """From now on sets count under noise and form errors; returns `unseen_errors`."""
        ranked = self.ranked()
        unseen = unseen_errors([fits[:_KEPT] for fits in ranked])
        for _ in range(2):
            form = form_errors(self.problem, self.whitening, self.nuisance, self.tied(), unseen)
            self.variance = [own[0].noise + more for own, more in zip(ranked, form, strict=True)]
        return unseen

    def neighbours(self, going: list[bool]) -> None:
        """The most probable set without each of its members, and with another effect in the place of each, of some
        axes."""
        for _ in range(3):
            if not any(going):
                return
            before = self.best()
            now = [f.spec if on else nothing(self.library) for f, on in zip(before, going, strict=True)]
            self.fit(self.screened(self.fewer(now, _SHORT)), _SHORT)
            # What does the same as a member needs the numbers that the others have beside that.
            pairs = [(i, without(s, k)) for i, s in enumerate(now) for k in range(len(s.members))]
            less = fit_many(self.problem, self.whitening, pairs, 0, nuisance=self.nuisance)
            bases = [[fit for (j, _), fit in zip(pairs, less, strict=True) if j == i] for i in range(self.axes)]
            self.fit(self.screened(bases, 1, [{f.members} for f in before]), _SHORT)
            self.fit([[f.spec for f in self.leading(i) if on] for i, on in enumerate(going)], _LONG)
            going = [a.members != b.members for a, b in zip(before, self.best(), strict=True)]

    def twins(self) -> None:
        """The most probable sets with another gain in the place of an inertia."""
        if self.problem.known.get("gain") == 0:
            return
        wanted = []
        for i, ranked in enumerate(self.ranked()):
            twins = [t for f in ranked[:_KEPT] if (t := with_gain(self.library, i, f.spec)) is not None]
            # Friction that was too large by as much as the inertia is none beside the gain.
            wanted.append([*twins, *(without(t, k) for t in twins for k in range(len(t.members)))])
        self.fit(wanted, _LONG)

    def reduced(self) -> None:
        """The most probable set of each axis without its least members, one after the other, down to none."""
        now = [f.spec for f in self.best()]
        while any(s.members for s in now):
            less = self.fewer(now, _SHORT)
            now = [min(own, key=lambda f: f.left).spec if own else s for s, own in zip(now, less, strict=True)]

    def fewer(self, sets: Sequence[Spec], steps: int) -> list[list[Fit]]:
        """The set of each axis without each of its members, fitted anew: it may have been tried from farther away."""
        less = [[without(s, k) for k in range(len(s.members))] for s in sets]
        self.fit(less, steps)
        return [[self.found[i][s.members] for s in own] for i, own in enumerate(less)]

    def screened(
        self, bases: Sequence[Sequence[Fit]], most: int = _FITTED, old: Sequence[Container[Members]] | None = None
    ) -> list[list[Spec]]:
        """For each base the effects that promise most, by what a difference quotient of each explains.

        Args:
            bases: of each axis.
            most: so many for each base.
            old: sets of each axis that are not wanted; None = those that were fitted.
        """
        old = self.found if old is None else old
        wanted: list[dict[tuple[int, ...], Spec]] = [{} for _ in bases]
        pairs = [(i, fit) for i, own in enumerate(bases) for fit in own]
        variances = [self.noise_of(i) for i, _ in pairs]
        promised = promises(self.problem, self.whitening, [(i, fit.spec) for i, fit in pairs], self.nuisance, variances)
        for (i, fit), found in zip(pairs, promised, strict=True):
            if not fit.members:
                # Alone an effect is tried from wherever it may begin: limits are far from linear.
                more = [started(fit.spec, v, i) for _, v in found if len(self.library.variants[v.effect]) <= _STARTS]
                wanted[i] |= {(*spec.members, k): spec for k, spec in enumerate(more)}
            ranked = (
                v
                for _, v in sorted(_best_variants(found).values(), key=lambda item: (-_level(item[0]), item[1].effect))
            )
            specs = (started(fit.spec, variant, i) for variant in ranked)
            new = (spec for spec in specs if spec.members not in old[i])
            for spec in islice(new, most):
                wanted[i].setdefault(spec.members, spec)
        return [list(w.values()) for w in wanted]


def with_gain(library: Library, axis: int, spec: Spec) -> Spec | None:
    """The same machine with another gain in the place of another inertia, since all torques are over the gain; None
    where that cannot be said."""
    names, known = library.names, library.nominal.get("inertia")
    effects = [names.index(name) if name in names else -1 for name in ("inertia", "servo_gain")]
    inertia, gain = effects
    if min(effects) < 0 or inertia not in spec.members or gain in spec.members or known is None or not known[axis]:
        return None
    of_axis = library.numbers[axis]
    place = library.places[inertia][0]
    times = 1 + float(spec.theta[place]) * of_axis[place].scale / float(known[axis])
    variant = next(v for v in library.variants[gain] if of_axis[v.active[0]].acts[0].how == "factor")
    if times <= 0:
        return None
    other = started(without(spec, spec.members.index(inertia)), variant, axis)
    other.theta[variant.active[0]] = -math.log(times) / of_axis[variant.active[0]].scale
    for j in other.flat:
        name, factor, how = of_axis[j].acts[0]
        if how == "add" and name in TORQUES and factor:
            size, nominal = of_axis[j].scale * factor, float(library.nominal.get(name, {axis: 0.0})[axis])
            other.theta[j] = ((nominal + float(other.theta[j]) * size) / times - nominal) / size
    return other


def promises(
    problem: Problem,
    whitening: Whitening,
    bases: Sequence[tuple[int, Spec]],
    nuisance: Tensor,
    variances: Sequence[float | None],
) -> list[list[tuple[float, Variant]]]:
    """For every variant of an effect that an axis can show and a set lacks, the evidence of both together.

    Args:
        problem: the data.
        whitening: of the residual.
        bases: axis and set of each.
        nuisance: as of `fit_many`.
        variances: for each base, of noise and form errors; None: the noise that each set leaves.
    """
    library = problem.library
    variants = [
        [
            v
            for own in library.variants
            for v in own
            if v.effect not in spec.members and bool(library.there[i, v.effect])
        ]
        for i, spec in bases
    ]
    if not bases:
        return []
    axis, theta = torch.tensor([i for i, _ in bases]), torch.stack([spec.theta for _, spec in bases])
    residual, own = sensitivities(problem, whitening, theta, axis, [spec.flat for _, spec in bases])
    # A row for every number of every variant.
    rows, moved, steps = [], [], []
    for b, (i, spec) in enumerate(bases):
        for variant, a, j in ((v, a, j) for v in variants[b] for a, j in enumerate(v.active)):
            changed, value = spec.theta.clone(), float(variant.values[i, a])
            steps.append(value if abs(value) > 1e-6 else _STEP)
            changed[j] += steps[-1]
            changed[list(variant.held)] = variant.shapes[i]
            moved.append(changed)
            rows.append(b)
    if not moved:
        return [[] for _ in bases]
    at = torch.tensor(rows)
    left = white_residual(problem, whitening, torch.stack(moved), axis[at])
    new = (residual[at] - left) / left.new_tensor(steps)[:, None]
    found = []
    for b, (i, spec) in enumerate(bases):
        flat = list(spec.flat)
        x = torch.cat([own[b, : len(flat)], new[at == b]])
        grams = products(nuisance[i], x, residual[b] + theta[b, flat] @ x[: len(flat)], problem.values)
        widths = torch.tensor([len(v.active) for v in variants[b]], dtype=torch.int64)
        ends = (widths.cumsum(0) + len(flat)).tolist()
        sets = [
            [*spec.groups, torch.arange(end - len(v.active), end)] for v, end in zip(variants[b], ends, strict=True)
        ]
        scores = weighed(grams, len(nuisance[i]), sets, variances[b]).log_evidence.tolist() if sets else []
        found.append(
            [(s + v.log_prior if math.isfinite(s) else -math.inf, v) for s, v in zip(scores, variants[b], strict=True)]
        )
    return found
