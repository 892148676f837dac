"""A diagnoser of the right signature that needs no library: it answers from a table, or always the same."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from ccnn_torch.effects import Effect
from ccnn_torch.mechanisms import Mechanism
from ccnn_torch.records import Records


@dataclass
class Said:
    """One answer."""

    effects: Sequence[str] = ()
    driver: str | None = None
    probability: float = 0.97
    shrink: tuple[float, float, float] | None = None

    def to_json(self) -> dict[str, Any]:
        shrink = self.shrink or (None, None, None)
        return {
            "effects": [{"name": name, "indistinguishable_from": []} for name in self.effects],
            "verdict": {
                "effects": list(self.effects),
                "probability": self.probability,
                "shrink": shrink[0],
                "shrink_ci95": None if self.shrink is None else list(shrink[1:]),
                "none": not self.effects and self.driver is None,
                "outside_library": self.driver is not None,
                "driver": self.driver,
                "text": "",
            },
        }


@dataclass
class StandIn:
    """Answers by the number of the case, else `otherwise`; remembers what it was asked."""

    answers: Mapping[int, Said] = field(default_factory=dict)
    otherwise: Said = field(default_factory=Said)
    asked: list[tuple[int, tuple[str, ...] | None]] = field(default_factory=list)

    def __call__(
        self,
        records: Records,
        mechanism: Mechanism,
        *,
        noise: Mapping[str, float] | None = None,
        effects: Sequence[Effect] | None = None,
    ) -> Said:
        number = int(records.path.rsplit("/", 1)[-1].removesuffix(".csv"))
        self.asked.append((number, None if effects is None else tuple(e.name for e in effects)))
        assert noise is None or set(noise) == {c.name for c in mechanism.pose}
        return self.answers.get(number, self.otherwise)
