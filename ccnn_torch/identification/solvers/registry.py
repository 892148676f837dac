"""The solvers by name."""

from __future__ import annotations

import functools
import importlib
import inspect
from collections.abc import Callable
from typing import Any

from ccnn_torch.errors import InputError
from ccnn_torch.identification.problems.problem import Fit, Problem, Progress, Solver
from ccnn_torch.spelling import nearest

# Module and name of each. Imported when asked for: pymoo alone takes half a second.
_WHERE = {
    "lm": ("lm", "solve_lm"),
    "hga": ("hga", "HybridGenetic"),
    "tikhonov": ("tikhonov", "solve_tikhonov"),
    "ga": ("peers", "solve_ga"),
    "sa": ("peers", "solve_sa"),
    "pso": ("peers", "solve_pso"),
}

_PER_LEG = "_per_leg"

# What every solver is called with; not settings.
_CALL = ("self", "problem", "seed", "progress")


def _make(name: str, **settings: Any) -> Solver:
    module, what = _WHERE[name]
    maker = getattr(importlib.import_module(f"ccnn_torch.identification.solvers.{module}"), what)
    known = [key for key in inspect.signature(maker).parameters if key not in _CALL]
    for key in settings:
        if key not in known:
            near = nearest(key, known, 0.6)
            hint = f"did you mean '{near}'?" if near else f"it takes {', '.join(known) or 'none'}"
            raise InputError(f"solver '{name}' has no setting '{key}'; {hint}")
    made: Any = maker(**settings) if inspect.isclass(maker) else functools.partial(maker, **settings)
    solver: Solver = made
    return solver


SOLVERS: dict[str, Callable[..., Solver]] = {name: functools.partial(_make, name) for name in _WHERE}
"""Name -> what makes the solver from its settings; Levenberg-Marquardt (`lm`) is the one to use, the others compare."""


def get_solver(name: str, **settings: Any) -> Solver:
    """A solver by name; `NAME_per_leg` identifies each leg's parameters on their own (paper 004).

    Args:
        name: `lm`, `hga`, `tikhonov`, `ga`, `sa` or `pso`, with or without `_per_leg`.
        settings: as the solver's class or function has them.

    Raises:
        InputError: unknown name or setting, with the nearest one.
    """
    plain = name.removesuffix(_PER_LEG)
    if plain not in SOLVERS:
        near = nearest(name, [*SOLVERS, *(other + _PER_LEG for other in SOLVERS)], 0.6)
        hint = f"did you mean '{near}'?" if near else f"known: {', '.join(SOLVERS)}, each also as NAME{_PER_LEG}"
        raise InputError(f"there is no solver '{name}'; {hint}")
    solver = SOLVERS[plain](**settings)
    if plain == name:
        return solver
    legs = importlib.import_module("ccnn_torch.identification.solvers.legs")

    def by_leg(problem: Problem, seed: int, progress: Progress | None = None) -> Fit:
        found: Fit = legs.solve_per_leg(solver, problem, seed, progress)
        return found

    return by_leg
