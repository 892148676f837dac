"""Signs that records and model do not fit each other, or that a verdict rests on what was not recorded."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch

from ccnn_torch._display import number_text
from ccnn_torch.diagnosis._analysis import Analysis
from ccnn_torch.diagnosis._belonging import Belonging, distance, size_of
from ccnn_torch.diagnosis._verdict import Judgement
from ccnn_torch.effects import Situation

__all__ = ["DOUBTED", "cautions", "row_cautions"]

DOUBTED = 0.9
"""Beside a caution nothing is claimed more surely than this."""
# Plausible sizes: sealed machines whose gap was 30 times the noise had up to 185 of them; a wrong prefix makes 1000.
_IMPLAUSIBLE = 250.0
# Size of the machine, of which no calibration is so far off.
_LARGE = 0.1
# Standard deviation left, of that which was given; heavy tails left 0.7 of it in sealed machines.
_QUIET = 0.5
_MANY = 0.1
# A workshop, with something to spare [K].
_COLDEST, _HOTTEST = 213.15, 423.15


def cautions(
    analysis: Analysis, judgement: Judgement, rows: Belonging, missing: Sequence[Mapping[str, Any]]
) -> list[str]:
    """One sentence each, without a full stop; none where all is as it should be.

    Args:
        analysis: of the rows.
        judgement: what is stood by.
        rows: which of them are of the machine at all.
        missing: as in diagnosis.json.
    """
    return [
        *row_cautions(analysis, rows),
        *_of_noise(analysis, judgement),
        *_of_sizes(analysis, judgement),
        *_of_inputs(analysis, missing),
    ]


def row_cautions(analysis: Analysis, rows: Belonging) -> list[str]:
    """Those of them that need no verdict."""
    return [*_of_model(analysis, rows), *_of_temperature(analysis.situation)]


def _of_model(analysis: Analysis, rows: Belonging) -> list[str]:
    situation, said = analysis.situation, []
    if rows.lost > _MANY:
        said.append(
            f"{100 * rows.lost:.0f} % of the rows are far from where their joints put them and were left out: "
            + (rows.mistake or "look at their units, and at what they have in common")
        )
    usual = float(distance(situation, analysis.measured, size_of(situation)).nanmedian())
    if usual > _LARGE:
        said.append(
            f"the gap is {usual:.2g} times the spread of the machine's poses over its workspace, more than any "
            "calibration takes away: check the units, the frames, and that this is the machine"
        )
    return said


def _of_noise(analysis: Analysis, judgement: Judgement) -> list[str]:
    """Whether what was given is far more than even the verdict's effects leave."""
    best = judgement.found
    left = (best.rss / max(analysis.dictionary.grams.values - best.effective, 1.0)) ** 0.5
    if analysis.whitening.known == 0 or left > _QUIET:
        return []
    return [
        f"the rows scatter by {number_text(left, 2)} times the noise that was given: with less of it smaller causes "
        "would show"
    ]


def _of_sizes(analysis: Analysis, judgement: Judgement) -> list[str]:
    """Causes of the verdict that would have to be hundreds of times as large as in any machine."""
    said = []
    for i, mean in zip(judgement.found.members, judgement.found.mean, strict=True):
        atom = analysis.dictionary.atoms[i]
        coefficients = atom.coefficients(analysis.situation)
        if atom.name not in judgement.names or not coefficients:
            continue
        size = torch.where(torch.tensor([c.secondary for c in coefficients]), 0.0, mean.abs())
        worst = int(size.argmax())
        if float(size[worst]) > _IMPLAUSIBLE:
            said.append(
                f"{atom.name} would have to be {float(size[worst]):.0f} times as large as is plausible "
                f"({coefficients[worst].name}): check the units of the columns that it goes by"
            )
    return said


def _of_temperature(situation: Situation) -> list[str]:
    temperature = situation.covariates.get("temperature")
    if temperature is None or _COLDEST < float(temperature.median()) < _HOTTEST:
        return []
    return [
        f"the temperature is about {float(temperature.median()) - 273.15:.0f} °C: check the unit of its column, K or "
        "degC"
    ]


def _of_inputs(analysis: Analysis, missing: Sequence[Mapping[str, Any]]) -> list[str]:
    """What the nominal machine itself takes and nobody recorded, where that may be more than the noise."""
    situation = analysis.situation
    lacking = situation.mechanism.lacking([*situation.covariates])
    sizes = {c.partition("[")[0]: e["effects"] for e in missing for c in e["columns"]}
    noise = float(analysis.whitening.sigma.min())
    name = situation.mechanism.name
    return [
        f"{name} takes {c.name}, which was not recorded: what it does counts as noise, or goes to another cause"
        for c in lacking
        if sizes.get(c.name, {}).get(name, noise) >= noise
    ]
