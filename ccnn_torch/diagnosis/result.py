"""The result of a diagnosis, of poses or of a motion, and the parts of `diagnosis.json` that both fill alike."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Self

from ccnn_torch.diagnosis.search.analysis import Analysis
from ccnn_torch.diagnosis.verdict.judgement import Judgement
from ccnn_torch.diagnosis.verdict.text import verdict_text
from ccnn_torch.effects import Acting
from ccnn_torch.evidence.shrink import Gap

# Of a result what has no meaning there, or was not asked for.
_NOTHING: dict[str, Any] = {
    **dict.fromkeys(("gap_rotation", "by_block", "network")),
    **{name: [] for name in ("missing_covariates", "rows_set_aside", "why_set_aside")},
    "frames": {},
}


@dataclass(frozen=True)
class Said:
    """What a diagnosis says.

    Attributes:
        content: of `diagnosis.json`; its entries, which `DiagnosisResults` documents, are attributes as well.
    """

    content: dict[str, Any]

    def __getattr__(self, name: str) -> Any:
        content = vars(self).get("content", {})
        if name not in content:
            raise AttributeError(f"a diagnosis has no '{name}'; it has {', '.join(content)}")
        return content[name]

    def with_entries(self, **entries: Any) -> Self:
        """The same with other entries of `diagnosis.json`."""
        return replace(self, content=self.content | entries)

    def to_json(self) -> Mapping[str, Any]:
        """The content of `diagnosis.json` (`DiagnosisResults`)."""
        return self.content


@dataclass(frozen=True)
class Diagnosis(Said):
    """Which effect, where, how far, from poses.

    Attributes:
        acting: the verdict's effects with their numbers, to be simulated or compensated.
        analysis, judgement: everything that was evaluated.
        lines: line of every row in the file that it came from, the header being line 1; () for rows of no file.
        inferred: covariates that were not recorded and were taken from the order of the rows.
    """

    acting: tuple[Acting, ...] = field(repr=False)
    analysis: Analysis = field(repr=False)
    judgement: Judgement = field(repr=False)
    lines: tuple[int, ...] = field(default=(), repr=False)
    inferred: tuple[str, ...] = field(default=(), repr=False)


def content_of(**entries: Any) -> dict[str, Any]:
    """The content of `diagnosis.json`, the text of its verdict as well; entries: all that are something."""
    content = _NOTHING | entries
    content["verdict"]["text"] = verdict_text(content)
    return content


def gap_block(gap: Gap, unit: str) -> dict[str, Any]:
    """`gap` of diagnosis.json."""
    share = max(0.0, 1 - (gap.floor / gap.before) ** 2) if gap.before > 0 else 0.0
    sizes = {"before": gap.before, "after": gap.after, "noise_floor": gap.floor}
    return {"unit": unit, **sizes, "reducible_share": share}


def verdict_block(
    names: Sequence[str], probability: float, together: Gap, outside: bool, drivers: Sequence[str]
) -> dict[str, Any]:
    """`verdict` of diagnosis.json, still without its text; together: the gap with all the names in the model."""
    return {
        "effects": [*names],
        "probability": probability,
        **_shrink(together),
        "none": not names and not outside,
        "outside_library": outside,
        "driver": drivers[0] if drivers else None,
        "drivers": [*drivers],
    }


def effect_block(
    name: str,
    probability: float,
    parameters: Mapping[str, Any],
    alone: Gap,
    like: Iterable[str],
    signatures: Mapping[str, Any],
) -> dict[str, Any]:
    """An entry of `effects` of diagnosis.json; alone: the gap with it alone in the model."""
    return {
        "name": name,
        "probability": probability,
        "parameters": parameters,
        "gap_before": alone.before,
        "gap_after": alone.after,
        **_shrink(alone),
        "indistinguishable_from": [*like],
        "signatures": signatures,
    }


def order_block(names: Sequence[str], gaps: Sequence[Gap]) -> list[dict[str, Any]]:
    """`in_order` of diagnosis.json: the verdict's effects added one after the other, each step refitted."""
    return [{"name": n, "gap_after": gap.after, **_shrink(gap)} for n, gap in zip(names, gaps, strict=True)]


def _shrink(gap: Gap) -> dict[str, Any]:
    return {"shrink": gap.shrink, "shrink_ci95": None if gap.interval is None else [*gap.interval]}
