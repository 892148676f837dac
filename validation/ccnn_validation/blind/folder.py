"""Files of a blind check, and what each side may read.

`settings.json` defines the cases; `machines/NAME.yaml` are the nominal machines, `cases/NNNN.csv` the records and
`cases.json` what goes with them: all that the diagnosing side reads. `seal.json` binds the generating side to the truth
before the first diagnosis. `diagnoses/NNNN.json` are the answers, `truth.json` is what was sealed, `withheld/NNNN.json`
the answers of a library without the effect that was there, `judged.json` the comparison of answers and truth; then
`blind.json`, `blind.csv`, `blind.md`.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

__all__ = ["BlindFolder"]


@dataclass(frozen=True)
class BlindFolder:
    """Paths in the folder of a blind check."""

    path: Path

    @property
    def settings(self) -> Path:
        """The settings of the check."""
        return self.path / "settings.json"

    @property
    def public(self) -> Path:
        """What the diagnosing side may read of every case."""
        return self.path / "cases.json"

    @property
    def seal(self) -> Path:
        """Digests of every case's truth and records."""
        return self.path / "seal.json"

    @property
    def truth(self) -> Path:
        """What was sealed, opened."""
        return self.path / "truth.json"

    @property
    def judged(self) -> Path:
        """Truth and judgement of every answer."""
        return self.path / "judged.json"

    @property
    def result(self) -> Path:
        """Figures."""
        return self.path / "blind.json"

    def machine(self, name: str) -> Path:
        """Nominal machine."""
        return self.path / "machines" / f"{name}.yaml"

    def records(self, number: int) -> Path:
        """Of a case."""
        return self.path / "cases" / f"{number:04}.csv"

    def diagnosis(self, number: int, withheld: bool = False) -> Path:
        """Of a case, with the whole library or without the effect that is there."""
        return self.path / ("withheld" if withheld else "diagnoses") / f"{number:04}.json"
