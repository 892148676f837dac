"""A diagnosis from files, and what is written and shown of it."""

from __future__ import annotations

from pathlib import Path

from ccnn_torch.diagnosis import Diagnosis, diagnose, noise_of, situation_of
from ccnn_torch.diagnosis.check import Check, check_rows
from ccnn_torch.effects import Effect, make_effect
from ccnn_torch.errors import InputError
from ccnn_torch.mechanisms import Mechanism, load_mechanism
from ccnn_torch.records import Records, load_records
from ccnn_torch.report.json_files import write_json
from ccnn_torch.report.table_form import Table
from ccnn_torch.runs.diagnose_config import DiagnoseConfig

__all__ = [
    "check_table",
    "check_text",
    "diagnosis_table",
    "parse_noise",
    "run_check",
    "run_diagnosis",
    "write_diagnosis",
]


def parse_noise(text: str) -> str:
    """`--noise` as an override: one number, or `NAME=S,…`.

    Raises:
        InputError: it is neither.
    """
    parts = [p.strip() for p in text.split(",") if p.strip()]
    pairs = [p.partition("=") for p in parts]
    try:
        if len(parts) == 1 and not pairs[0][1]:
            return f"noise={float(parts[0])!r}"
        return "noise={" + ", ".join(f"{n.strip()}: {float(v)!r}" for n, _, v in pairs) + "}"
    except ValueError:
        raise InputError(
            f"--noise: '{text}' is neither a number nor NAME=S,NAME=S,… (standard deviation of the pose in SI)"
        ) from None


def run_diagnosis(config: DiagnoseConfig) -> Diagnosis:
    """Load and diagnose.

    Raises:
        InputError: something is missing or wrong in the files or keys, or the rows carry no verdict.
    """
    records, mechanism, effects = _loaded(config)
    return diagnose(records, mechanism, noise=config.noise, effects=effects, gravity=config.gravity, seed=config.seed)


def run_check(config: DiagnoseConfig) -> Check:
    """Load and look at what the records can show; raises as `run_diagnosis`."""
    records, mechanism, effects = _loaded(config)
    situation = situation_of(records, mechanism, config.gravity)
    return check_rows(situation, records.pose, noise_of(config.noise, situation), effects)


def write_diagnosis(folder: Path, diagnosis: Diagnosis) -> Path:
    """Write `diagnosis.json`.

    Raises:
        InputError: the folder cannot be written.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as reason:
        raise InputError(f"{folder}: cannot be made: {reason.strerror}") from None
    path = folder / "diagnosis.json"
    write_json(path, diagnosis.to_json())
    return path


def diagnosis_table(diagnosis: Diagnosis, most: int = 8) -> Table:
    """The most probable candidates."""
    rows = []
    for effect in diagnosis.effects[:most]:
        low, high = effect["shrink_ci95"] or (None, None)
        shrink = "" if low is None else f"{100 * effect['shrink']:.0f} % [{100 * low:.0f}, {100 * high:.0f}]"
        same = ", ".join(effect["indistinguishable_from"])
        rows.append((effect["name"], f"{effect['probability']:.3f}", shrink, f"{effect['gap_after']:.3g}", same))
    unit = diagnosis.gap["unit"]
    return Table(
        "Candidates",
        ("effect", "probability", "shrink alone", f"gap after, {unit}", "not told from"),
        tuple(rows),
        "Gaps are root mean squares over rows that the fit has not seen; shrink is the share of the reducible gap.",
    )


def check_text(check: Check) -> list[str]:
    """What the records can and cannot show, one sentence a line."""
    noise = ", ".join(f"{n} {s:.2g}" for n, s in check.noise.items())
    lines = [
        f"{check.rows} rows, {len(check.aside)} of them set aside; Jacobian's condition number up to "
        f"{check.condition:.3g}.",
        f"Noise (m, rad): {noise}.",
        f"Covariates: {', '.join(check.covariates) or 'none'}.",
    ]
    lines += [f"{name} cannot be seen without {why}." for name, why in check.missing.items()]
    lines += [f"{name} could hide: its plausible size is {size:.2g} of the noise." for name, size in check.weak.items()]
    return lines


def check_table(check: Check) -> Table:
    """Pairs that these rows do not tell apart."""
    rows = tuple((a, b, f"{share:.3f}") for a, b, share in check.confusable)
    note = "Share of what the first is likely to do that the second can do as well (cosine)."
    return Table("Confusable", ("effect", "taken over by", "share"), rows, note)


def _loaded(config: DiagnoseConfig) -> tuple[Records, Mechanism, list[Effect] | None]:
    for key in ("records", "mechanism"):
        if getattr(config, key) is None:
            raise InputError(f"{key}: is missing; give --{key}, or the key in a config")
    mechanism = load_mechanism(str(config.mechanism), **config.mechanism_keys)
    records = load_records(str(config.records), mechanism, config.covariates)
    effects = None if config.effects is None else [make_effect(name) for name in config.effects]
    return records, mechanism, effects
