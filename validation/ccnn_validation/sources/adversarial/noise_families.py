"""Families of noise: nothing wrong with the machine, and the same with one ordinary cause."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ccnn_validation.sources.adversarial.effect import Effect, measured, scaled
from ccnn_validation.sources.adversarial.finish import Builder, finish, none, single, white
from ccnn_validation.sources.adversarial.machine import ARM, Array
from ccnn_validation.sources.adversarial.noise import (
    autoregressive,
    correlated,
    heavy_tails,
    heteroscedastic,
    shared_by_repeats,
    walking,
)
from ccnn_validation.sources.adversarial.ordinary import ORDINARY, ordinary
from ccnn_validation.sources.adversarial.rig import Rig, draw_rig
from ccnn_validation.sources.case import SourceCase, Truth

__all__ = ["NOISE_FAMILIES"]

_STRENGTHS = (5.0, 10.0, 30.0)


@dataclass(frozen=True)
class _Kind:
    """A kind of noise.

    Attributes:
        make: its values, `s x p`.
        outside: whether an answer may say outside (None) or not (False).
        drivers: drivers that are right then.
        design: of the rows.
        causes: that such rows can show.
        extra: names that are no error where nothing is wrong.
    """

    make: Callable[[Rig], Array]
    outside: bool | None = False
    drivers: tuple[str, ...] = ()
    design: str = "spread"
    causes: Sequence[str] = ORDINARY
    extra: tuple[str, ...] = ()


_KINDS = {
    "heteroscedastic": _Kind(heteroscedastic),
    "correlated": _Kind(correlated),
    # A slow error over rows is real, whatever made it.
    "autoregressive": _Kind(autoregressive, None, ("time",)),
    "walking": _Kind(walking, None, ("time",)),
    # An error that comes back at its target is real as well; few targets show no period.
    "shared_by_repeats": _Kind(
        shared_by_repeats, None, ("position", "time"), "repeats", ("backlash", "compliance", "thermal")
    ),
    "heavy_tails": _Kind(heavy_tails, extra=("outlier",)),
}


def _finish_with(family: str, rig: Rig, kind: _Kind, effect: Effect | None, strength: float) -> SourceCase:
    clean = measured(rig, None if effect is None else scaled(rig, effect, strength))
    beside = kind.outside, kind.drivers
    truth = none(*beside) if effect is None else single(effect, strength, *beside)
    with_extra = [a | {e} for a in truth.accepted for e in kind.extra]
    truth = replace(truth, accepted=(*truth.accepted, *with_extra))
    return finish(family, rig, truth, clean, kind.make(rig), kind=family.removeprefix("noise_").rsplit("_", 1)[0])


def _builder(kind: _Kind, with_cause: bool) -> Builder:
    def build(family: str, rng: np.random.Generator) -> SourceCase:
        rig = draw_rig(rng, design=kind.design)
        if "time" in kind.drivers:
            rig.show("time")
        effect = ordinary(rig, kind.causes[int(rng.integers(len(kind.causes)))]) if with_cause else None
        return _finish_with(family, rig, kind, effect, float(rng.choice(_STRENGTHS)))

    return build


def _quantised(with_cause: bool) -> Builder:
    """A device that shows steps of 10 um and 30 urad, on the arm of 40 um, over noise of a third of that."""

    def build(family: str, rng: np.random.Generator) -> SourceCase:
        rig = draw_rig(rng)
        scale = 4.0 if rig.machine.name == ARM else 1.0
        step = scale * np.where(np.array(rig.machine.pose_units) == "m", 1e-5, 3e-5)
        own = step / 3
        # What a user finds who repeats a measurement: noise and rounding together.
        rig.sigma = np.sqrt(own**2 + step**2 / 12)
        strength = float(rng.choice(_STRENGTHS))
        effect = ordinary(rig, ORDINARY[int(rng.integers(len(ORDINARY)))]) if with_cause else None
        clean = measured(rig, None if effect is None else scaled(rig, effect, strength))
        shown = np.round((clean + rng.normal(size=clean.shape) * own) / step) * step
        truth = none() if effect is None else single(effect, strength)
        return finish(family, rig, truth, clean, rig.machine.twist(shown, clean), "quantised")

    return build


def _doubled(with_cause: bool) -> Builder:
    """Every row twice in the file: one after the other, or the whole file appended to itself."""

    def build(family: str, rng: np.random.Generator) -> SourceCase:
        rig = draw_rig(rng, rows=(40, 200))
        strength = float(rng.choice(_STRENGTHS))
        effect = ordinary(rig, ORDINARY[int(rng.integers(len(ORDINARY)))]) if with_cause else None
        clean = measured(rig, None if effect is None else scaled(rig, effect, strength))
        case = finish(
            family, rig, none() if effect is None else single(effect, strength), clean, kind="every row twice"
        )
        rows = np.arange(rig.rows)
        order = np.repeat(rows, 2) if rng.random() < 0.5 else np.tile(rows, 2)
        twice = {h: np.asarray(v)[order] for h, v in case.columns.items()}
        return replace(case, columns=twice, clean={h: np.asarray(v)[order] for h, v in (case.clean or {}).items()})

    return build


def _misstated(with_cause: bool) -> Builder:
    """White noise of which the user states 0.3, 0.5, 2 or 5 times."""

    def build(family: str, rng: np.random.Generator) -> SourceCase:
        rig = draw_rig(rng)
        stated = float(rng.choice([0.3, 0.5, 2.0, 5.0]))
        # Five times the noise hides an error of five times the noise, but not a larger one.
        strength = float(rng.choice(_STRENGTHS if stated < 5 else _STRENGTHS[1:]))
        effect = ordinary(rig, ORDINARY[int(rng.integers(len(ORDINARY)))]) if with_cause else None
        clean = measured(rig, None if effect is None else scaled(rig, effect, strength))
        outside = None if stated < 1 else False
        truth: Truth = none(outside) if effect is None else single(effect, strength, outside)
        return finish(family, rig, truth, clean, white(rig), f"stated as {stated:g} times itself", stated, always=True)

    return build


NOISE_FAMILIES: dict[str, Builder] = {}
for _with_cause in (False, True):
    _end = "cause" if _with_cause else "none"
    for _name, _kind in _KINDS.items():
        NOISE_FAMILIES[f"noise_{_name}_{_end}"] = _builder(_kind, _with_cause)
    for _name, _make in {"quantised": _quantised, "doubled": _doubled, "misstated": _misstated}.items():
        NOISE_FAMILIES[f"noise_{_name}_{_end}"] = _make(_with_cause)
