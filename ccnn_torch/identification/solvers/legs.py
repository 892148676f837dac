"""Divide and conquer: each leg's parameters from that leg's channels alone (the divide-and-conquer paper, eq. 5)."""

from __future__ import annotations

import dataclasses

import torch
from torch import Tensor

from ccnn_torch.errors import InputError
from ccnn_torch.identification.problems.linear import WeightedRows
from ccnn_torch.identification.problems.problem import Channel, Problem, check_equations

_DEPENDS = 1e-9  # Relative size of a derivative below which it is rounding.


def split_by_leg(problem: Problem) -> list[Problem]:
    """One problem for each leg that has free parameters, in the order of the legs.

    Which channel depends on which leg is read off the Jacobian at the start, not off names.

    Args:
        problem: built with `per_leg=True`: its channels are not decorrelated against each other.

    Raises:
        InputError: a free parameter belongs to no leg, a channel depends on several legs' parameters, a leg's
            parameters move no channel, or a leg has fewer equations than parameters.
    """
    common = [p.name for p in problem.parameters if p.leg is None]
    if common:
        raise InputError(
            f"parameter '{common[0]}' belongs to no single leg, so that the legs cannot be identified apart; fix it, "
            "or identify all legs jointly"
        )
    moved = _moved(problem)
    legs = [p.leg for p in problem.parameters]
    of_channel: list[int | None] = []
    for channel, row in zip(problem.channels, moved.tolist(), strict=True):
        found = sorted({leg for leg, m in zip(legs, row, strict=True) if m and leg is not None})
        if len(found) > 1:
            raise InputError(
                f"channel '{channel.name}' depends on the parameters of legs {', '.join(map(str, found))}, so that the "
                "legs cannot be identified apart; identify them jointly (or, if the noise ties the channels, build the "
                "problem per leg)"
            )
        of_channel.append(found[0] if found else None)
    problems = []
    for leg in sorted({leg for leg in legs if leg is not None}):
        rows = [i for i, found_leg in enumerate(of_channel) if found_leg == leg]
        columns = [i for i, own in enumerate(legs) if own == leg]
        if not rows:
            names = ", ".join(problem.parameters[i].name for i in columns)
            raise InputError(f"no channel depends on the free parameters of leg {leg} ({names}); fix them")
        problems.append(_part(problem, leg, rows, columns))
        check_equations(problems[-1])
    return problems


def _moved(problem: Problem) -> Tensor:
    """Which channels depend on which parameters, at the start of the first machine: `c x k`, bool."""
    rows = WeightedRows(problem)
    slope = rows.jacobian(problem.start[:1, None], torch.zeros(1, dtype=torch.long, device=problem.start.device))[1]
    size = slope.reshape(-1, len(problem.channels), slope.shape[-1]).abs().amax(0)
    return size > _DEPENDS * size.max()


def _part(problem: Problem, leg: int, rows: list[int], columns: list[int]) -> Problem:
    """The problem of some channels and parameters; the other parameters, which do not matter there, stay at a start."""
    pick = torch.zeros(len(columns), len(problem.parameters), dtype=problem.start.dtype, device=problem.start.device)
    pick[torch.arange(len(columns)), columns] = 1
    rest = problem.start[0] * (1 - pick.sum(0))
    whole = problem.residual

    def residual(values: Tensor, *data: Tensor) -> Tensor:
        return whole(values @ pick + rest, *data)[..., rows]

    return dataclasses.replace(
        problem,
        parameters=tuple(problem.parameters[i] for i in columns),
        start=problem.start[:, columns],
        scale=problem.scale[columns],
        prior_sd=problem.prior_sd[columns],
        residual=residual,
        channels=tuple(Channel(problem.channels[i].name, leg) for i in rows),
    )
