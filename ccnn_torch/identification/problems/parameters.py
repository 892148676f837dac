"""Which geometric parameters an identification may change: free, fixed, tied together, or held by a prior."""

from __future__ import annotations

import dataclasses
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor

from ccnn_torch.coordinates import Parameter, plausible_error
from ccnn_torch.errors import InputError
from ccnn_torch.spelling import hint, matching


@dataclass(frozen=True)
class ParameterChoice:
    """A choice among a mechanism's parameters, each by name or by pattern.

    A pattern is a name with `*`, `?` or `[…]` (`A*`, `tool_?`), or `leg1.PATTERN`: those of leg 1 that match.

    Attributes:
        free: what is identified; everything that is not held when None.
        fixed: what is left at its start, also where `free` names it.
        tied: groups that share one value; a group is a list of names and patterns, or one pattern. Those of the
            mechanism's own where there are none.
        prior: standard deviation of a Gaussian prior around the start, by name or pattern [SI].
    """

    free: Sequence[str] | None = None
    fixed: Sequence[str] = ()
    tied: Sequence[Sequence[str] | str] = ()
    prior: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Selection:
    """The free parameters of a choice, and the way back from their values to the whole geometry.

    Attributes:
        parameters: the `k` free ones; a tied group has its first name, with no leg if it spans several.
        groups: names of the parameters that each free one sets.
        start: `r x k` [SI].
        scale: plausible errors, `k` [SI].
        prior_sd: `k` [SI]; inf where there is no prior.
        fixed: the whole geometry with zeros where a free parameter sets it, `r x K` [SI].
        spread: `k x K`, 0 or 1: which parameters each free one sets.
    """

    parameters: tuple[Parameter, ...]
    groups: tuple[tuple[str, ...], ...]
    start: Tensor
    scale: Tensor
    prior_sd: Tensor
    fixed: Tensor
    spread: Tensor

    def full(self, values: Tensor) -> Tensor:
        """All `K` parameters; values `r x k` (or `k`) of the free ones, returns the same with `K` [SI]."""
        fixed = self.fixed[0] if values.dim() == 1 else self.fixed
        return values @ self.spread + fixed

    def free(self, whole: Tensor) -> Tensor:
        """Values of the free ones, `... x k`, out of all, `... x K` [SI]."""
        return whole[..., self.spread.argmax(-1)]

    def places(self, parameters: Sequence[Parameter]) -> list[int]:
        """Numbers of some free parameters among all free ones."""
        names = [p.name for p in self.parameters]
        return [names.index(p.name) for p in parameters]


def select_parameters(
    geometry: Sequence[Parameter], choice: ParameterChoice | None = None, start: Tensor | None = None
) -> Selection:
    """Resolve the names and patterns of a choice.

    Args:
        geometry: all `K` parameters of a mechanism.
        choice: everything free when None.
        start: `K` or `r x K` [SI]; the nominal values when None.

    Raises:
        InputError: a name or pattern that fits nothing (with the nearest name), nothing left free, a parameter tied
            twice, tied parameters that start apart or are in part fixed, a prior that is not positive.
    """
    choice = ParameterChoice() if choice is None else choice
    names = [g.name for g in geometry]
    nominal = torch.tensor([g.nominal for g in geometry], dtype=torch.float64)
    whole = (nominal if start is None else start.detach()).reshape(-1, len(names))
    free = (
        {g.name for g in geometry if not g.held}
        if choice.free is None
        else match_parameters(geometry, choice.free, "free")
    )
    free -= match_parameters(geometry, choice.fixed, "fixed")
    if not free:
        raise InputError("parameters: nothing is left free; name at least one in free, or fix fewer")
    if not choice.tied:
        own = {g.tied: [other.name for other in geometry if other.tied == g.tied] for g in geometry if g.tied}
        choice = dataclasses.replace(choice, tied=[group for group in own.values() if free.issuperset(group)])
    groups = _groups(geometry, choice, free, whole)
    spread = torch.zeros(len(groups), len(names), dtype=torch.float64, device=whole.device)
    for row, group in enumerate(groups):
        spread[row, [names.index(n) for n in group]] = 1
    firsts = [names.index(group[0]) for group in groups]
    parameters = tuple(_merged([geometry[names.index(n)] for n in group]) for group in groups)
    return Selection(
        parameters,
        groups,
        whole[:, firsts],
        torch.tensor([plausible_error(p) for p in parameters], dtype=torch.float64, device=whole.device),
        _prior(geometry, choice.prior, groups).to(whole.device),
        whole * (1 - spread.sum(0)),
        spread,
    )


def match_parameters(geometry: Sequence[Parameter], patterns: Sequence[str], key: str) -> set[str]:
    """Names that any of the patterns fits."""
    found: set[str] = set()
    for pattern in [patterns] if isinstance(patterns, str) else patterns:
        of_leg = re.fullmatch(r"leg(\d+)\.(.*)", pattern)
        if of_leg:
            leg, inner = int(of_leg[1]), of_leg[2]
            fits = matching([g.name for g in geometry if g.leg == leg], [inner])
        else:
            fits = matching([g.name for g in geometry], [pattern])
        if not fits:
            names = [g.name for g in geometry] + [f"leg{g.leg}.{g.name}" for g in geometry if g.leg is not None]
            raise InputError(f"parameters.{key}: '{pattern}' fits no parameter; {hint(pattern, names, 'known:')}")
        found.update(fits)
    return found


def _groups(
    geometry: Sequence[Parameter], choice: ParameterChoice, free: set[str], start: Tensor
) -> tuple[tuple[str, ...], ...]:
    """Tied groups and single names, in the order of the geometry."""
    names = [g.name for g in geometry]
    leader: dict[str, list[str]] = {}
    for tie in choice.tied:
        group = sorted(match_parameters(geometry, [tie] if isinstance(tie, str) else tie, "tied"), key=names.index)
        again = [n for n in group if n in leader]
        if again:
            raise InputError(f"parameters.tied: '{again[0]}' is in two groups; name it in one")
        if 0 < len(set(group) & free) < len(group):
            held = next(n for n in group if n not in free)
            raise InputError(f"parameters.tied: '{held}' is fixed but tied to {group[0]}; fix the whole group or none")
        values = start[:, [names.index(n) for n in group]]
        apart = torch.nonzero((values != values[:, :1]).any(0))
        if len(apart):
            raise InputError(
                f"parameters.tied: {group[int(apart[0])]} and {group[0]} start at different values, "
                "but tied parameters share one; tie only parameters of equal nominal value"
            )
        leader.update(dict.fromkeys(group, group))
    groups = [tuple(leader.get(n, [n])) for n in names if n in free and leader.get(n, [n])[0] == n]
    return tuple(groups)


def _merged(members: Sequence[Parameter]) -> Parameter:
    """One parameter for a tied group."""
    legs = {m.leg for m in members}
    return members[0] if len(legs) == 1 else dataclasses.replace(members[0], leg=None)


def _prior(geometry: Sequence[Parameter], prior: Mapping[str, float], groups: tuple[tuple[str, ...], ...]) -> Tensor:
    """Standard deviation per free parameter; the last pattern that fits counts."""
    sd = dict.fromkeys((g.name for g in geometry), math.inf)
    for pattern, value in prior.items():
        if not float(value) > 0:
            raise InputError(f"parameters.prior: '{pattern}' has the standard deviation {value}; give a positive one")
        sd.update(dict.fromkeys(match_parameters(geometry, [pattern], "prior"), float(value)))
    return torch.tensor([min(sd[n] for n in group) for group in groups], dtype=torch.float64)
