"""Names of a set that rest on what does not make an effect what it is, or that are of a size that no cause has."""

from __future__ import annotations

import torch

from ccnn_torch.diagnosis.search.analysis import Analysis
from ccnn_torch.diagnosis.verdict.plausible import implausible_size
from ccnn_torch.evidence.dictionary import FittedSet
from ccnn_torch.evidence.form_error import Posterior

# Share of an effect's own squares that must not be borrowed from what other effects do.
_OWN = 0.1
# Or that must come from other coefficients than those that mend its form, where these are so many times as large, in
# plausible sizes.
_MAIN, _MENDED = 0.5, 15.0


def borrowed_names(analysis: Analysis, posterior: Posterior, found: FittedSet) -> frozenset[str]:
    """Names of a set that rest on what other effects do as well, or on what should only correct their form, or that
    would be of a size beside others that no cause has."""
    dictionary, names, most = posterior.dictionary, set(), implausible_size(analysis)
    for i, mean in zip(found.members, found.mean, strict=True):
        atom, group = analysis.atoms[i], dictionary.groups[i]
        if atom.is_discrepancy:
            continue
        coefficients = atom.coefficients(analysis.situation)
        main_sizes = [abs(float(v)) for c, v in zip(coefficients, mean, strict=True) if not c.secondary]
        if len(found.members) > 1 and max(main_sizes, default=0.0) > most:
            names.add(atom.name)
            continue
        if not any(c.borrowed or c.mends for c in coefficients):
            continue
        borrowed, corrections = (
            torch.tensor(flags, dtype=torch.bool)
            for flags in zip(*((c.borrowed, c.mends) for c in coefficients), strict=True)
        )
        gram = dictionary.grams.xx[group][:, group]
        parts = (mean * ~borrowed, mean * ~corrections, mean)
        alone, main, whole = (float(m @ gram @ m) for m in parts)
        largest, mended = (float((mean * kind).abs().max()) for kind in (~corrections, corrections))
        if alone < _OWN * whole or (main < _MAIN * whole and mended > _MENDED * largest):
            names.add(atom.name)
    return frozenset(names)
