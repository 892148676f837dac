"""The result of a diagnosis."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Any

from ccnn_torch.diagnosis.search.analysis import Analysis
from ccnn_torch.diagnosis.verdict.judgement import Judgement
from ccnn_torch.effects import Acting

_NOT_WRITTEN = ("acting", "analysis", "judgement", "lines", "inferred")


@dataclass(frozen=True)
class Diagnosis:
    """Which effect, where, how far.

    Attributes:
        noise: where its size is from: `given`, `columns` of the records, `repeats` of targets, or `estimated` from what
            the best explanation leaves, which may hold another cause.
        gap, gap_rotation: `{"unit", "before", "after", "noise_floor", "reducible_share"}`, held-out RMS; the rotation's
            is None without orientation.
        where: shares of the gap by `outputs`, `joints`, `legs`, `regions`, `covariates`.
        where_ci95: the same with `[low, high]` in the place of each share, regions and regimes as lists of them.
        effects: every candidate, most probable first; `signatures` says why one cannot be distinguished from another.
        in_order: the verdict's effects added one after the other, the largest first.
        by_block: gap and shrink where rows are held out in blocks, along the direction in which the joints vary most;
            None where the verdict names nothing.
        network: what a network on the remainder would still gain; None where it was not asked for.
        verdict: the conclusion and its certainty.
        next_measurements: rows that would distinguish the leading explanations.
        missing_covariates: columns that would bring more effects into sight, most promising first.
        not_seen: effects that these records cannot show, with what is missing for each.
        rows_set_aside: rows (0-based) that no fit saw: outliers, near-singular ones, rows outside the reach.
        why_set_aside: the reason for each of them.
        cautions: signs that records and model do not fit each other, one sentence each; beside one nothing is claimed
            more surely than 0.9.
        notes: what was left out and why, one sentence each.
        acting: the verdict's effects with their numbers, to be simulated or compensated.
        machine: with these, as a compensator takes it; None where a model can hold nothing of them.
        analysis, judgement: everything that was evaluated.
        lines: line of every row in the file that it came from, the header being line 1; () for rows of no file.
        inferred: covariates that were not recorded and were taken from the order of the rows.
    """

    noise: str
    gap: dict[str, Any]
    gap_rotation: dict[str, Any] | None
    where: dict[str, Any]
    where_ci95: dict[str, Any]
    effects: list[dict[str, Any]]
    in_order: list[dict[str, Any]]
    by_block: dict[str, Any] | None
    network: dict[str, Any] | None
    verdict: dict[str, Any]
    next_measurements: list[dict[str, Any]]
    missing_covariates: list[dict[str, Any]]
    not_seen: dict[str, str]
    rows_set_aside: list[int]
    why_set_aside: list[str]
    cautions: list[str]
    notes: list[str]
    acting: tuple[Acting, ...] = field(repr=False)
    analysis: Analysis = field(repr=False)
    judgement: Judgement = field(repr=False)
    lines: tuple[int, ...] = field(default=(), repr=False)
    inferred: tuple[str, ...] = field(default=(), repr=False)
    machine: dict[str, Any] | None = field(default=None, repr=False)

    def to_json(self) -> Mapping[str, Any]:
        """The content of `diagnosis.json` (`DiagnosisResults`)."""
        situation = self.analysis.situation
        machine = {
            "name": situation.mechanism.name,
            "joints": [joint.name for joint in situation.mechanism.joints],
            "gravity": situation.gravity.tolist(),
        }
        content = {f.name: getattr(self, f.name) for f in fields(self) if f.name not in _NOT_WRITTEN}
        return {"mechanism": machine} | content
