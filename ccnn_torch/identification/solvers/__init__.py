"""The solvers by name."""

from __future__ import annotations

import functools
import inspect
from typing import Any

from ccnn_torch.errors import InputError
from ccnn_torch.identification.problems.problem import Solver
from ccnn_torch.identification.solvers.hga import HybridGenetic
from ccnn_torch.identification.solvers.lm import solve_lm
from ccnn_torch.identification.solvers.tikhonov import solve_tikhonov
from ccnn_torch.spelling import hint, nearest

SOLVERS: dict[str, Any] = {"lm": solve_lm, "hga": HybridGenetic, "tikhonov": solve_tikhonov}
"""Name -> solver, or the class that makes it of its settings; Levenberg-Marquardt (`lm`) is the one to use."""

# What every solver is called with; not settings.
_CALL = ("self", "problem", "seed", "progress")


def get_solver(name: str, **settings: Any) -> Solver:
    """A solver by name.

    Args:
        name: of `SOLVERS`.
        settings: as the solver's class or function has them.

    Raises:
        InputError: unknown name or setting, with the nearest one.
    """
    if name not in SOLVERS:
        raise InputError(unknown_solver(name))
    maker = SOLVERS[name]
    known = [key for key in inspect.signature(maker).parameters if key not in _CALL]
    for key in settings:
        if key not in known:
            raise InputError(f"solver '{name}' has no setting '{key}'; {hint(key, known, 'it takes')}")
    made: Any = maker(**settings) if inspect.isclass(maker) else functools.partial(maker, **settings)
    solver: Solver = made
    return solver


def unknown_solver(name: str, ending: str = "") -> str:
    """The sentence on a name that is none; `ending` may follow a solver's name."""
    if name.removesuffix(ending) in ("ga", "sa", "pso"):
        return f"'{name}' is no method any more; `python -m benchmarks.global_searches` compares ga, sa and pso"
    near = nearest(name, [*SOLVERS, *(other + ending for other in SOLVERS)])
    if near:
        return f"there is no method '{name}'; did you mean '{near}'?"
    legs = f", each also as NAME{ending}, and all" if ending else ""
    return f"there is no method '{name}'; known are {', '.join(SOLVERS)}{legs}"
