"""Effects that records can show, before a diagnosis."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

from torch import Tensor

from ccnn_torch.diagnosis.checks.cautions import row_cautions
from ccnn_torch.diagnosis.engine import UNSHOWN, candidates, drawn_rows, usable_rows, why_set_aside
from ccnn_torch.diagnosis.search.analysis import analyse
from ccnn_torch.diagnosis.verdict.blocks import span_of
from ccnn_torch.diagnosis.verdict.text import lacking_text
from ccnn_torch.effects import Effect, Situation

# Cosine of the angle between what two effects can do beyond which these data do not distinguish them.
_ALIKE = 0.95


@dataclass(frozen=True)
class Check:
    """What rows can show.

    Attributes:
        rows: how many.
        aside: rows that no fit can use: near-singular ones, outliers, rows out of reach.
        noise: standard deviation of each moving channel [m, rad], `c`, by the channel's name.
        covariates: that were measured and vary.
        missing: by effect, what the records lack for it.
        weak: by effect, its plausible size in units of the noise where that is below 1: it could hide.
        confusable: pairs of effects with the share of the first that the second can take over (cosine), largest first.
        condition: largest condition number of the Jacobian over the rows that count.
        why_aside: the reason for each of the rows in `aside`.
        lines_aside: the line of each of them in the file, the header being line 1; empty for rows of no file.
        noise_given: whether the noise was given, and not estimated from the rows.
        remarks: what else to know, such as covariates that a simulator takes and the records lack, one sentence each.
        cautions: signs that the rows and the model do not fit each other, one sentence each.
    """

    rows: int
    aside: list[int]
    noise: dict[str, float]
    covariates: list[str]
    missing: dict[str, str]
    weak: dict[str, float]
    confusable: list[tuple[str, str, float]]
    condition: float
    remarks: list[str] = field(default_factory=list)
    cautions: list[str] = field(default_factory=list)
    why_aside: list[str] = field(default_factory=list)
    lines_aside: list[int] = field(default_factory=list)
    noise_given: bool = False


def check_rows(
    situation: Situation, measured: Tensor, noise: Tensor | None = None, effects: Sequence[Effect | str] | None = None
) -> Check:
    """Look at rows as `diagnose_rows` does, and say what they can and cannot show; arguments as there."""
    rows = usable_rows(situation, measured)
    situation, measured, chosen = drawn_rows(situation, measured, rows.fine, 0)
    usable, lacking = candidates(situation, effects)
    analysis = analyse(situation, measured, usable, noise)
    white = analysis.whitening
    keep = white.keep()
    spans: dict[str, Tensor] = {}
    weak = {}
    for i, atom in enumerate(analysis.atoms):
        if atom.is_discrepancy or atom.name in spans:
            continue
        x = analysis.dictionary.columns[..., analysis.dictionary.groups[i]].flatten(0, 1)
        spans[atom.name] = x
        size = float(x.square().sum(-1).mean().sqrt())
        if size < 1:
            weak[atom.name] = size
    why = why_set_aside(analysis, rows, chosen)
    condition = situation.mechanism.condition_number(situation.joints[keep], parameters=situation.parameters)
    return Check(
        rows=len(rows.fine),
        aside=sorted(why),
        noise=dict(zip(white.names, white.sigma.tolist(), strict=True)),
        covariates=[n for n, v in situation.covariates.items() if float(v.max() - v.min()) > 0],
        missing=lacking | dict.fromkeys(analysis.rows.idle, UNSHOWN),
        weak=weak,
        confusable=_confusable(spans),
        condition=float(condition.max()),
        noise_given=noise is not None,
        why_aside=[why[row] for row in sorted(why)],
        remarks=[
            lacking_text(situation.mechanism.name, c) for c in situation.mechanism.lacking([*situation.covariates])
        ],
        cautions=[caution.text for caution in row_cautions(analysis, rows)],
    )


def _confusable(spans: dict[str, Tensor]) -> list[tuple[str, str, float]]:
    """For every ordered pair how much of what the first is likely to do the second can do as well."""
    found = []
    basis = {n: span_of(x) for n, x in spans.items()}
    for first, x in spans.items():
        total = x.square().sum()
        if float(total) <= 0:
            continue
        for second, q in basis.items():
            share = float(((q.mT @ x).square().sum() / total).clamp(0, 1).sqrt()) if first != second else 0.0
            if share > _ALIKE:
                found.append((first, second, share))
    return sorted(found, key=lambda f: -f[2])
