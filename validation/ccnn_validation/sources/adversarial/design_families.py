"""Families of designs: one ordinary cause on rows, or beside covariates, that make it hard to tell from others."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ccnn_validation.sources.adversarial.effect import Effect, measured, scaled
from ccnn_validation.sources.adversarial.finish import Builder, finish, plain_case, single
from ccnn_validation.sources.adversarial.machine import ARM
from ccnn_validation.sources.adversarial.ordinary import ORDINARY, ordinary, pick
from ccnn_validation.sources.adversarial.rig import ALL, draw_rig
from ccnn_validation.sources.case import SourceCase, Truth

__all__ = ["DESIGN_FAMILIES"]

_STRENGTHS = (5.0, 10.0, 30.0)
_NO_PERIODS = ("backlash", "compliance", "thermal")
# Where forward kinematics is a closed form: quick with many rows.
_QUICK = ("five_bar", "delta", "delta_linear", "arm")
_LENGTHS = tuple(m for m in ALL if m != "tripod")


def _on_design(
    design: str = "spread",
    rows: tuple[int, int] = (80, 400),
    days: tuple[int, int] = (1, 1),
    causes: Sequence[str] = ORDINARY,
    machines: Sequence[str] = ALL,
    strengths: Sequence[float] = _STRENGTHS,
) -> Builder:
    """One ordinary cause on rows of a design; few places show no period of a drive."""

    def build(family: str, rng: np.random.Generator) -> SourceCase:
        rig = draw_rig(rng, machines, rows, design, int(rng.integers(days[0], days[1] + 1)))
        effect = ordinary(rig, causes[int(rng.integers(len(causes)))])
        if days[1] > 1:
            rig.show("time", "temperature")
        return plain_case(family, rig, effect, float(rng.choice(strengths)))

    return build


def _collinear(family: str, rng: np.random.Generator) -> SourceCase:
    """The temperature rises in proportion to the time: growth of all lengths without a lag, or joints that drift.

    Growth changes with the place, a drift of some joints does not: on rows all over the workspace, at ten times the
    noise, they can be told apart. A drift may be called thermal all the same: mounts that move joints with the
    temperature.
    """
    rig = draw_rig(rng)
    rig.temperature = 20.0 + rng.uniform(4.0, 9.0) * rig.time / rig.time[-1]
    rig.show("time", "temperature")
    strength = float(rng.choice(_STRENGTHS[1:]))
    if rng.random() < 0.5:
        lengths = np.zeros_like(rig.machine.nominal)
        sized = rig.machine.parameters_like()
        lengths[sized] = rig.machine.nominal[sized]
        effect = Effect("thermal", parameters=(rig.temperature - 20.0)[:, None] * lengths)
        return plain_case(family, rig, effect, strength)
    rate = np.zeros(rig.machine.count)
    which = pick(rig, int(rng.integers(1, 3)))
    rate[which] = rng.choice([-1.0, 1.0], len(which)) * rng.uniform(0.5, 1.5, len(which))
    effect = Effect("drift", joints=(rig.time / rig.time[-1])[:, None] * rate)
    # The first joint of an arm turns the whole of it about a fixed axis: a frame that creeps does the very same.
    creeps = rig.machine.name == ARM and which == [0]
    accepted = (frozenset({n}) for n in ("drift", "thermal", *(["frame_drift"] if creeps else [])))
    return plain_case(family, rig, effect, strength, Truth("single", ("drift",), tuple(accepted)))


def _decoys(cause: str) -> Builder:
    """Loads, directions, temperature and time are all there and have nothing to do with it."""

    def build(family: str, rng: np.random.Generator) -> SourceCase:
        rig = draw_rig(rng, _LENGTHS if cause == "geometry" else ALL)
        rig.show("time", "temperature", "load", "direction")
        return plain_case(family, rig, ordinary(rig, cause), float(rng.choice(_STRENGTHS)))

    return build


def _noisy_temperature(family: str, rng: np.random.Generator) -> SourceCase:
    """A thermometer with 0.5 K of noise; what it adds to the prediction may be called outside, by the temperature."""
    rig = draw_rig(rng)
    effect = ordinary(rig, "thermal")
    strength = float(rng.choice(_STRENGTHS))
    clean = measured(rig, scaled(rig, effect, strength))
    rig.temperature = rig.temperature + rng.normal(size=rig.rows) * 0.5
    truth = single(effect, strength, None if strength > 5 else False, ("temperature", "time"))
    return finish(family, rig, truth, clean)


def _noisy_loads(family: str, rng: np.random.Generator) -> SourceCase:
    """Loads measured to 3 N and 0.3 N m beside 60 N and 6 N m: 5 % of the error is not in the column."""
    rig = draw_rig(rng)
    effect = ordinary(rig, "compliance", textbook=True)
    strength = float(rng.choice(_STRENGTHS))
    clean = measured(rig, scaled(rig, effect, strength))
    size = np.where(np.array(rig.machine.pose_units) == "m", 3.0, 0.3)
    rig.load = rig.load + rng.normal(size=rig.load.shape) * size
    return finish(family, rig, single(effect, strength, None if strength > 5 else False), clean)


DESIGN_FAMILIES: dict[str, Builder] = {
    "rows_on_a_line": _on_design("line"),
    "cube_with_repeats": _on_design("cube", causes=_NO_PERIODS),
    "one_cluster": _on_design("cluster", causes=_NO_PERIODS),
    "rows_35": _on_design(rows=(35, 35), strengths=_STRENGTHS[1:]),
    "rows_5000": _on_design(rows=(5000, 5000), machines=_QUICK),
    "several_days": _on_design(days=(2, 4)),
    "collinear_temperature": _collinear,
    "decoys_transmission": _decoys("transmission"),
    "decoys_geometry": _decoys("geometry"),
    "noisy_temperature": _noisy_temperature,
    "noisy_loads": _noisy_loads,
}
