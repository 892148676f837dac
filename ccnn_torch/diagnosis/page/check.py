"""The text and the table of `ccnn check`."""

from __future__ import annotations

from ccnn_torch.diagnosis.checks.identifiable import Check
from ccnn_torch.diagnosis.verdict.text import aside_text
from ccnn_torch.display import display_unit, number_text
from ccnn_torch.report.table import Table

# Confusable effects shown for each effect.
_LIKEST = 3


def check_text(check: Check) -> list[str]:
    """What the records can and cannot show, one sentence a line."""
    noise = ", ".join(f"{n} {_in_unit(s, 'rad' if n.startswith('r') else 'm')}" for n, s in check.noise.items())
    lines = [
        f"{check.rows} rows, {len(check.aside)} of them set aside; Jacobian's condition number up to "
        f"{check.condition:.3g}.",
        f"Noise, {'as given' if check.noise_given else 'estimated'}: {noise}.",
        f"Covariates: {', '.join(check.covariates) or 'none'}.",
    ]
    lines += [aside_text(check.aside, check.why_aside, check.lines_aside)] if check.aside else []
    lines += [f"{remark}." for remark in check.remarks]
    lines += [f"Caution: {caution}." for caution in check.cautions]
    lines += [f"{name} cannot be seen without {why}." for name, why in check.missing.items()]
    lines += [f"{name} could hide: its plausible size is {size:.2g} of the noise." for name, size in check.weak.items()]
    return lines


def _in_unit(value: float, unit: str) -> str:
    scale, shown = display_unit(unit, value)
    return f"{number_text(value / scale, 2)} {shown}"


def check_table(check: Check) -> Table:
    """What could take over each effect on these rows, the closest first."""
    found: dict[str, list[str]] = {}
    for first, second, share in check.confusable:
        found.setdefault(first, []).append(f"{second} {share:.3f}")
    rows = tuple(
        (name, ", ".join(others[:_LIKEST]) + (f" and {more} more" if (more := len(others) - _LIKEST) > 0 else ""))
        for name, others in found.items()
    )
    note = (
        "Cosine between what an effect is likely to do and what another can do. A diagnosis still distinguishes them "
        "where the other one needs implausible or more coefficients; all pairs are in check.json (--out)."
    )
    return Table("Confusable", ("effect", "taken over by"), rows, note, ("taken over by",))
