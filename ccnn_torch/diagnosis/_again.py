"""Whether it is worth while to look at the rows again about what was found, and which shapes to look for again."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from ccnn_torch.diagnosis._atoms import Atom
from ccnn_torch.diagnosis._dictionary import Dictionary, Found
from ccnn_torch.diagnosis._whitening import Whitening

__all__ = ["known_shapes", "settled"]

# Another look is spared where the noise of the channels changed among each other by less than this (logarithm), the fit
# by such a share of the noise's square, and no more of the rows are set aside or taken back.
_SAME_NOISE, _SAME_FIT, _SAME_ROWS = 0.2, 0.01, 0.01
# An effect is out of play where the sets that it takes part in are so far behind the best (log odds), and by such a
# share of what the best explains: shapes found beside something else may be that much worse.
_BEHIND, _SHARE = 20.0, 0.05


def settled(dictionary: Dictionary, y: Tensor, best: Found, old: Whitening, new: Whitening, left: Tensor) -> bool:
    """Whether to look again would change little: next to no other rows are set aside, the channels' noise is in the
    same proportion, and what the best set leaves of every row by the machine itself is what the linear model says.

    Args:
        dictionary: candidates.
        y: what they explained, whitened, `s x c`; rows that count.
        best: the set.
        old, new: noise and weights then, and with what the fits leave.
        left: what the set leaves by the machine itself, `s x c0` [m, rad].
    """
    change = (new.sigma / old.sigma).log()
    rows = int(((new.weight > 0) != (old.weight > 0)).sum())
    if rows > _SAME_ROWS * len(new.weight) or float((change - change.mean()).abs().max()) > _SAME_NOISE:
        return False
    linear = y
    for i, mean in zip(best.members, best.mean, strict=True):
        linear = linear - dictionary.columns[..., dictionary.groups[i]] @ mean
    return float((old(torch.nan_to_num(left))[old.keep()] - linear).square().mean()) < _SAME_FIT


def known_shapes(dictionary: Dictionary, found: Sequence[Found], best: Found, same: bool) -> dict[str, list[Atom]]:
    """Effects whose shapes are not looked for again, by name, with the atoms whose shapes they keep: those out of play
    with the most probable one; and, where the same effects act as before, those in play with all that they have.

    Args:
        dictionary: candidates.
        found: sets that were tried, most probable first.
        best: the most probable one of the library; shapes of what acts in it are looked for.
        same: whether its effects are those beside which the shapes were found.
    """
    atoms, tried = dictionary.atoms, {f.members: f.log_posterior for f in found}
    acting = {atoms[i].name for i in best.members}
    least = best.log_posterior - _BEHIND - _SHARE * max(best.log_posterior - tried[()], 0.0)
    likeliest: dict[str, Atom] = {}
    in_play: set[str] = set()
    for one in found:
        for k, atom in enumerate(atoms[i] for i in one.members):
            if atom.effect is None or not atom.shape.numel() or atom.name in acting:
                continue
            likeliest.setdefault(atom.name, atom)
            # Beside a set that is as probable without it an effect takes no part.
            without = tried.get(one.members[:k] + one.members[k + 1 :], math.inf)
            if one.log_posterior > max(least, without):
                in_play.add(atom.name)
    known = {name: [atom] for name, atom in likeliest.items() if name not in in_play}
    if same:
        known |= {name: [a for a in atoms if a.name == name and a.effect is not None] for name in in_play}
    return known
