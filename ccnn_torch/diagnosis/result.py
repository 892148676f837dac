"""What a diagnosis says, in numbers and in words."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from ccnn_torch.diagnosis._analysis import Analysis
from ccnn_torch.diagnosis._verdict import Judgement
from ccnn_torch.effects import Acting

__all__ = ["Diagnosis"]


@dataclass(frozen=True)
class Diagnosis:
    """Which effect, where, how far.

    Attributes:
        gap, gap_rotation: `{"unit", "before", "after", "noise_floor", "reducible_share"}`, held-out RMS; the rotation's
            is None without orientation.
        where: shares of the gap by `outputs`, `joints`, `legs`, `regions`, `covariates`.
        effects: every candidate, most probable first.
        verdict: what is stood by.
        next_measurements: rows that would tell the leading explanations apart.
        rows_set_aside: rows (0-based) that no fit saw: outliers, near-singular ones, rows outside the reach.
        notes: what was left out and why, one sentence each.
        acting: the verdict's effects with their numbers, to be simulated or compensated.
        analysis, judgement: everything that was looked at.
    """

    gap: dict[str, Any]
    gap_rotation: dict[str, Any] | None
    where: dict[str, Any]
    effects: list[dict[str, Any]]
    verdict: dict[str, Any]
    next_measurements: list[dict[str, Any]]
    rows_set_aside: list[int]
    notes: list[str]
    acting: tuple[Acting, ...] = field(repr=False)
    analysis: Analysis = field(repr=False)
    judgement: Judgement = field(repr=False)

    def to_json(self) -> Mapping[str, Any]:
        """The form of `diagnosis.json` (schema `diagnosis`)."""
        situation = self.analysis.situation
        return {
            "mechanism": {
                "name": situation.mechanism.name,
                "joints": [joint.name for joint in situation.mechanism.joints],
                "gravity": situation.gravity.tolist(),
            },
            "gap": self.gap,
            "gap_rotation": self.gap_rotation,
            "where": self.where,
            "effects": self.effects,
            "verdict": self.verdict,
            "next_measurements": self.next_measurements,
            "rows_set_aside": self.rows_set_aside,
            "notes": self.notes,
        }
