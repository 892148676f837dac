"""The judge of motion logs: what it takes for right."""

from __future__ import annotations

from typing import Any

import pytest
from ccnn_validation.motion_logs import NAMED, OUTSIDE, grade


def verdict(names: list[str], driver: str | None = None) -> dict[str, Any]:
    return {"effects": names, "outside_library": driver is not None, "driver": driver}


@pytest.mark.parametrize(
    ("family", "names", "driver", "grades"),
    [
        ("coulomb", ["coulomb"], None, "right"),
        ("coulomb", ["stribeck"], None, "class"),
        ("coulomb", ["coulomb", "dead_band"], None, "wrong"),
        ("none", [], None, "right"),
        ("none", [], "time", "outside"),
        ("free:gravity", ["gravity", "delay"], None, "right"),
        ("q3+coulomb", ["coulomb"], "position", "right"),
        ("q3+coulomb", ["gravity"], "position", "partly"),
        ("v3", ["viscous"], None, "wrong"),
    ],
)
def test_a_verdict_is_graded_by_what_was_drawn(family: str, names: list[str], driver: str | None, grades: str) -> None:
    effects = [{"name": n, "indistinguishable_from": ["coulomb"] if n == "stribeck" else []} for n in names]
    assert family in (*OUTSIDE, *NAMED) and grade(family, verdict(names, driver), effects) == grades
