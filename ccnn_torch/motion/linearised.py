"""The search with a simulator that is linearised in its own parameters, again about what was found.

A simulator need not be nearly linear: a limit that does not act has no slope, and one that oscillates any. What the
linear model finds is therefore simulated, and taken as far as it really leaves less; where no part of it does, the
simulator's parameters are no candidates. Where one of them is suspected all are fitted first, nothing else beside them:
other effects would stand for what is not linear in a parameter that is far off.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import torch
from torch import Tensor

from ccnn_torch.effects.constant import PARAMETER
from ccnn_torch.motion.effects.registry import OWN
from ccnn_torch.motion.fit import fit_many
from ccnn_torch.motion.log import Log
from ccnn_torch.motion.nominal import Nominal
from ccnn_torch.motion.problem import Problem
from ccnn_torch.motion.search import Search, search
from ccnn_torch.motion.spec import Spec
from ccnn_torch.motion.whiten import Whitening

# Searches about a simulator's parameters as found, fits of one set there, and halves of a step that are tried.
_SEARCHES, _FITS, _HALVES = 4, 8, 4
# A parameter changes its sign in no machine, nor its size by more.
_LARGEST = 5.0
# Shares of a value up to which a fit and a search stay where the simulator was linearised.
_SETTLED, _NEAR = 0.002, 0.02

Values = Mapping[str, float]


def searched(problem: Problem, logs: Sequence[Log], nominal: Nominal, without: Callable[[], Problem]) -> Search:
    """The search.

    Args:
        problem: linearised about the nominal values.
        logs: runs.
        nominal: the model.
        without: the problem whose candidates are not the simulator's parameters.
    """
    own = nominal.simulator.parameters if nominal.simulator is not None else {}
    about: Values = dict.fromkeys(own, 0.0)
    found = search(problem)
    if not own_values(problem, _best(found)):
        return found
    alone = _settled(problem, found.whitening, [_own_spec(problem)] * len(problem.axes), logs, nominal, about)
    if alone is not None:
        problem, about = alone
        found = search(problem)
    for _ in range(_SEARCHES):
        settled = _settled(problem, found.whitening, _best(found), logs, nominal, about)
        # Nothing is wrong with them, or no part of what is said to be is true: that is judged where the model is.
        if settled is None or (any(about.values()) and not own_values(problem, _best(found))):
            return search(without())
        if _is_near(own, settled[1], about, _NEAR):
            return found
        problem, about = settled
        found = search(problem)
    return found


def _settled(
    problem: Problem,
    whitening: Whitening,
    specs: Sequence[Spec],
    logs: Sequence[Log],
    nominal: Nominal,
    about: Values,
) -> tuple[Problem, Values] | None:
    """Where sets come to rest as the simulator is linearised about them; None where no step leaves less."""
    assert nominal.simulator is not None
    own, begin = nominal.simulator.parameters, about
    for _ in range(_FITS):
        specs = [fit.spec for fit in fit_many(problem, whitening, list(enumerate(specs)))]
        values = own_values(problem, specs)
        # A parameter that no set has goes back to its nominal value.
        wanted = {name: _plausible(value, values.get(name, 0.0)) for name, value in own.items()}
        if _is_near(own, wanted, about, _SETTLED):
            break
        now = _left(problem, specs, about)
        for k in range(_HALVES):
            tried = {n: about[n] + (v - about[n]) / 2**k for n, v in wanted.items()}
            driven = nominal.driven(logs, problem.data, tried)
            library = problem.library._replace(about=tried)
            nearer = replace(problem, library=library, driven=driven)
            if _left(nearer, specs, tried) < now:
                break
        else:
            return None if about is begin else (problem, about)
        about, problem = tried, nearer
    return problem, about


def _own_spec(problem: Problem) -> Spec:
    """All of the simulator's parameters, and nothing else."""
    library = problem.library
    own = (v[0] for name, v in zip(library.names, library.variants, strict=True) if name.startswith(PARAMETER))
    return Spec(torch.zeros(library.size, dtype=torch.float64), tuple(own))


def _best(found: Search) -> list[Spec]:
    return [fits[0].spec for fits in found.found]


def _is_near(own: Values, a: Values, b: Values, share: float) -> bool:
    return all(abs(a[n] - b[n]) <= share * (abs(value) or 1.0) for n, value in own.items())


def _plausible(nominal: float, added: float) -> float:
    if not nominal:
        return added
    ends = sorted((nominal / _LARGEST - nominal, nominal * _LARGEST - nominal))
    return min(max(added, ends[0]), ends[1])


def _left(problem: Problem, specs: Sequence[Spec], values: Values) -> float:
    """What sets leave with the simulator's parameters at values, in squares over those of the motion."""
    theta = torch.stack([spec.theta for spec in specs])
    for i, axis in enumerate(problem.library.numbers):
        for j, number in enumerate(axis):
            name = number.acts[0].parameter
            if name.startswith(OWN):
                theta[i, j] = values.get(name.removeprefix(OWN), 0.0) / number.scale
    judged = problem.data.judged
    left: Tensor = problem.residual(theta, problem.axes)[:, judged].square().mean(-1)
    return float((left / problem.data.position[:, judged].var(-1).clamp_min(1e-300)).sum())


def own_values(problem: Problem, specs: Sequence[Spec]) -> dict[str, float]:
    """What is added to those of a simulator's own parameters that some axis' set has: of each one value for all axes.

    Least squares of what all axes leave beside the other effects of their sets, each weighed by what its own set
    leaves: an axis that hardly shows a parameter has no say in it.
    """
    numbers, theta = problem.library.numbers[0], torch.stack([spec.theta for spec in specs])
    acts = {j: n.acts[0].parameter for j, n in enumerate(numbers) if n.acts}
    own = {j: name.removeprefix(OWN) for j, name in acts.items() if name.startswith(OWN)}
    named = [j for j in own if bool((theta[:, j] != 0).any())]
    if not named:
        return {}
    judged, sizes = problem.data.judged, theta.new_tensor([numbers[j].scale for j in named])
    noise = problem.residual(theta, problem.axes)[:, judged].square().mean(-1)
    unit = noise.clamp_min(1e-300).sqrt()[:, None]
    without = theta.index_fill(1, torch.tensor([*own]), 0.0)
    each = torch.stack([without, *(without.index_fill(1, torch.tensor([j]), 1.0) for j in named)])
    left = problem.residual(each.flatten(0, 1), problem.axes.repeat(len(each)))[:, judged]
    left = left.reshape(len(each), len(unit), -1) / unit
    x, y = (left[0] - left[1:]).flatten(1), left[0].flatten()
    low, high = (ends[0, named] for ends in problem.library.bounds)
    found = sizes * torch.linalg.solve(x @ x.mT + torch.eye(len(x), dtype=x.dtype), x @ y).clamp(low, high)
    return {own[j]: float(value) for j, value in zip(named, found, strict=True)}
