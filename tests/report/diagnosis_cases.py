"""Made-up diagnoses in the form of the contract: results, arrays and labels of one effect, two, none, outside …"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch

Case = tuple[dict[str, Any], dict[str, torch.Tensor], dict[str, Any]]
ROWS = 200
_TRIED = ("geometry", "joint_offset", "backlash", "compliance", "thermal", "drift", "frame")


def _gap(unit: str, before: float, after: float, floor: float) -> dict[str, Any]:
    share = max(0.0, 1 - floor**2 / before**2)
    return {"unit": unit, "before": before, "after": after, "noise_floor": floor, "reducible_share": share}


def _effects(gap: dict[str, Any], known: dict[str, dict[str, Any]]) -> list[dict[str, Any]]:
    found = []
    for name in _TRIED:
        shrink = known.get(name, {}).get("shrink", 0.02)
        left = gap["noise_floor"] ** 2 + (1 - shrink) * (gap["before"] ** 2 - gap["noise_floor"] ** 2)
        entry = {
            "name": name,
            "probability": 1e-4,
            "parameters": {},
            "gap_before": gap["before"],
            "gap_after": float(np.sqrt(left)),
            "shrink": shrink,
            "shrink_ci95": [max(0.0, shrink - 0.02), min(1.0, shrink + 0.02)],
            "indistinguishable_from": [],
        }
        found.append(entry | known.get(name, {}))
    return sorted(found, key=lambda e: -e["probability"])


def _verdict(effects: list[str], probability: float, shrink: float | None, **other: Any) -> dict[str, Any]:
    interval = None if shrink is None else [shrink - 0.02, shrink + 0.02]
    plain = {"none": False, "outside_library": False, "driver": None, "text": ""}
    return {"effects": effects, "probability": probability, "shrink": shrink, "shrink_ci95": interval} | plain | other


def _where(covariates: dict[str, Any]) -> dict[str, Any]:
    regions = [
        {"center": {"x": x, "y": y}, "half_width": {"x": 0.05, "y": 0.05}, "share": share, "rows": 50}
        for (x, y), share in zip(
            ((-0.05, 0.25), (0.05, 0.25), (-0.05, 0.35), (0.05, 0.35)), (0.1, 0.2, 0.3, 0.4), strict=True
        )
    ]
    return {
        "outputs": {"x": 0.7, "y": 0.3},
        "joints": {"q1": 0.55, "q2": 0.45},
        "legs": {"1": 0.6, "2": 0.4},
        "regions": regions,
        "covariates": covariates,
    }


def _arrays(floor: float, causes: dict[str, tuple[np.ndarray, np.ndarray]], rotation: float = 0.0) -> dict[str, Any]:
    """Rows over a plane with the given causes (driver, effect on x) and noise; the fit is a little off the truth."""
    generator = np.random.default_rng(3)
    place = np.stack([*generator.uniform([-0.1, 0.2], [0.1, 0.4], (ROWS, 2)).T, np.zeros(ROWS)], axis=1)
    width = 6 if rotation else 3
    noise = generator.normal(0, 1, (ROWS, width)) * floor / np.sqrt(2)
    noise[:, 2] = 0
    residual = noise + 0
    for _, effect in causes.values():
        residual[:, 0] += effect
        residual[:, 1] -= 0.4 * effect
    if rotation:
        noise[:, 3:] *= 5
        residual[:, 3:] = noise[:, 3:] + rotation * generator.normal(0, 0.5, (ROWS, 3))
    held = (np.arange(ROWS) % 5 == 0).astype(float)
    aside = np.zeros(ROWS)
    aside[[17, 90]] = 1
    residual[[17, 90], 0] += 12e-3
    arrays = {
        "place": place,
        "joints": generator.uniform(0.4, 1.6, (ROWS, 2)),
        "residual": residual,
        "remainder": noise,
        "noise": np.full(width, floor),
        "held_out": held,
        "set_aside": aside,
    }
    kept = place + np.where(aside, np.nan, 0.0)[:, None]
    arrays |= {"drawn.place": kept, "drawn.before": residual[:, :3] + 0, "drawn.after": noise[:, :3] + 0}
    for name, (driver, effect) in causes.items():
        arrays |= {f"signature.{name}.x": driver, f"signature.{name}.y": effect + noise[:, 0] + 12e-3 * aside}
        arrays[f"signature.{name}.fit"] = 0.97 * effect
    return {name: torch.as_tensor(value, dtype=torch.float64) for name, value in arrays.items()}


def _compliance() -> tuple[np.ndarray, np.ndarray]:
    load = np.random.default_rng(5).uniform(0, 120, ROWS)
    return load, 4e-6 * load + 8e-9 * load**2


def _parameters(**values: tuple[float, float | None, str]) -> dict[str, Any]:
    return {name: {"value": v, "sd": sd, "unit": unit} for name, (v, sd, unit) in values.items()}


def _label(x: str, x_unit: str) -> dict[str, Any]:
    return {"x": {"name": x, "unit": x_unit}, "y": {"name": "residual along x", "unit": "m"}}


_LOADS = {"load_z": [{"from": 0.0, "to": 60.0, "share": 0.15}, {"from": 60.0, "to": 120.0, "share": 0.85}]}


def one_effect() -> Case:
    gap = _gap("m", 4.2e-4, 1.13e-4, 2.1e-5)
    parameters = _parameters(q1=(4.1e-6, 2e-7, "rad/(N*m)"), q2=(3.2e-6, 3e-7, "rad/(N*m)"))
    known = {
        "compliance": {"probability": 0.983, "shrink": 0.93, "parameters": parameters},
        "thermal": {"probability": 0.014, "shrink": 0.3},
    }
    results = {
        "gap": gap,
        "gap_rotation": None,
        "where": _where(_LOADS),
        "effects": _effects(gap, known),
        "verdict": _verdict(["compliance"], 0.983, 0.93),
        "next_measurements": [
            {
                "joints": {"q1": 0.6, "q2": 1.4},
                "covariates": {"load_z": 100.0, "temperature": 298.15},
                "separates": ["compliance", "thermal"],
                "gain": 0.42,
            },
            {"joints": {"q1": 1.2, "q2": 0.8}, "covariates": {"load_z": 0.0}, "separates": [], "gain": 0.21},
        ],
        "rows_set_aside": [17, 90],
        "notes": ["latency cannot be seen without time[s]", "a note of its own"],
        "in_order": [{"name": "compliance", "gap_after": 1.13e-4, "shrink": 0.93, "shrink_ci95": [0.91, 0.95]}],
        "by_block": {
            "unit": "m",
            "before": 4.1e-4,
            "after": 1.31e-4,
            "noise_floor": 1e-4,
            "shrink": 0.91,
            "shrink_ci95": [0.88, 0.94],
            "blocks": [{"rows": 40, "before": 4.1e-4, "after": 1.31e-4}] * 5,
        },
        "network": {
            "unit": "m",
            "rows": 198,
            "gap_before": 1.13e-4,
            "gap_after": 6e-5,
            "gap_after_ci95": [5e-5, 8e-5],
            "gain": 5.3e-5,
            "gain_ci95": [3e-5, 7e-5],
            "reason": "",
        },
        "not_seen": {"latency": "time[s]"},
        "missing_covariates": [{"columns": ["speed1[rad/s]"], "effects": {"latency": 4.2e-5}, "unit": "m"}],
        "where_ci95": {
            "outputs": {"x": [0.66, 0.74], "y": [0.26, 0.34]},
            "joints": {"q1": [0.45, 0.6], "q2": [0.4, 0.55]},
            "legs": {"1": [0.5, 0.7], "2": [0.3, 0.5]},
            "covariates": {"load_z": [[0.1, 0.2], [0.8, 0.9]]},
            "regions": [[0.05, 0.15], [0.15, 0.25], [0.25, 0.35], [0.34, 0.46]],
        },
        "why_set_aside": ["next to a singularity", "far from what any fit to the other rows says"],
    }
    labels = {
        "compliance": _label("load_z", "N"),
        "about": {
            "name": "Five-bar of the workshop",
            "mechanism": "five_bar",
            "records": "records.csv",
            "noise": "The noise was given (--noise).",
            "units": {"q1": "rad", "q2": "rad"},
            "notes": ["The column operator was ignored."],
        },
    }
    return results, _arrays(2.1e-5, {"compliance": _compliance()}), labels


def two_effects() -> Case:
    gap = _gap("m", 1.3e-3, 6e-5, 4.5e-5)
    known = {
        "compliance": {"probability": 0.97, "shrink": 0.8},
        "backlash": {
            "probability": 0.96,
            "shrink": 0.18,
            "parameters": _parameters(q1=(3e-4, 2e-5, "rad"), edge=(2e-5, None, "1")),
        },
    }
    results = {
        "gap": gap,
        "gap_rotation": None,
        "where": _where({"direction1": [{"from": v, "to": v, "share": 0.5} for v in (-1.0, 1.0)]}),
        "effects": _effects(gap, known),
        "verdict": _verdict(["compliance", "backlash"], 0.95, 0.995, shrink_ci95=[0.98, 1.0]),
        "next_measurements": [],
        "rows_set_aside": [17, 90],
        "notes": [],
    }
    direction = np.where(np.random.default_rng(8).uniform(size=ROWS) > 0.5, 1.0, -1.0)
    load, bend = _compliance()
    causes = {"compliance": (load, 2 * bend), "backlash": (direction, 2.4e-4 * direction)}
    labels = {"compliance": _label("load_z", "N"), "backlash": _label("direction1", "1")}
    return results, _arrays(4.5e-5, causes), labels


def none() -> Case:
    gap = _gap("m", 2.14e-5, 2.14e-5, 2.1e-5)
    results = {
        "gap": gap,
        "gap_rotation": None,
        "where": _where({}),
        "effects": [e | {"shrink": None, "shrink_ci95": None} for e in _effects(gap, {})],
        "verdict": _verdict([], 0.992, None, none=True),
        "next_measurements": [],
        "rows_set_aside": [],
        "notes": [],
    }
    arrays = _arrays(2.1e-5, {})
    arrays["set_aside"].zero_()
    arrays["residual"] = arrays["remainder"]
    return results, arrays, {}


def outside() -> Case:
    gap = _gap("m", 6e-4, 4e-4, 3e-5)
    known = {"joint_offset": {"probability": 0.9, "shrink": 0.55}}
    results = {
        "gap": gap,
        "gap_rotation": None,
        "where": _where({"temperature": [{"from": 288.15, "to": 298.15, "share": 1.0}]}),
        "effects": _effects(gap, known),
        "verdict": _verdict(["joint_offset"], 0.97, 0.55, outside_library=True, driver="temperature"),
        "next_measurements": [],
        "rows_set_aside": [17, 90],
        "notes": [],
    }
    temperature = np.sort(np.random.default_rng(9).uniform(288.15, 298.15, ROWS))
    step = 5e-4 * (np.tanh((temperature - 294) / 0.4) + 0.3 * np.sin(temperature))
    causes = {"temperature": (temperature, step), "joint_offset": (np.linspace(0.4, 1.6, ROWS), np.full(ROWS, 3e-4))}
    labels = {"temperature": _label("temperature", "K"), "joint_offset": _label("q1", "rad")}
    return results, _arrays(3e-5, causes), labels


def outlier() -> Case:
    results, arrays, labels = none()
    results["gap"] = _gap("m", 5e-5, 2.1e-5, 2.1e-5)
    results["verdict"] = _verdict(["outlier"], 0.96, 0.98)
    results["rows_set_aside"] = [17, 90]
    arrays["set_aside"][[17, 90]] = 1
    return results, arrays, labels


def indistinguishable() -> Case:
    results, arrays, labels = one_effect()
    known = {
        "joint_offset": {
            "probability": 0.52,
            "shrink": 0.93,
            "indistinguishable_from": ["geometry", "frame"],
            "signatures": {
                "geometry": {"angle": 0.03, "separation": 1.25},
                "frame": {"angle": 0.2, "separation": 2.5},
            },
        },
        "geometry": {"probability": 0.31, "shrink": 0.93},
        "frame": {"probability": 0.13, "shrink": 0.9},
    }
    results["effects"] = _effects(results["gap"], known)
    results["verdict"] = _verdict(["joint_offset"], 0.96, 0.93)
    results["next_measurements"][0]["separates"] = ["joint_offset", "geometry"]
    arrays = {name.replace("compliance", "joint_offset"): value for name, value in arrays.items()}
    return results, arrays, {"joint_offset": _label("q1", "rad"), "about": labels["about"]}


def with_rotation() -> Case:
    results, _, labels = one_effect()
    results["gap_rotation"] = _gap("rad", 9e-4, 2e-4, 1.1e-4)
    results["where"]["outputs"] |= {"z": 0.1, "rx": 0.3, "ry": 0.4, "rz": 0.3}
    results["where"]["legs"] = {str(i): 1 / 6 for i in range(1, 7)}
    arrays = _arrays(2.1e-5, {"compliance": _compliance()}, rotation=1e-3)
    generator = np.random.default_rng(1)
    arrays["place"] = torch.as_tensor(generator.uniform([-0.2, -0.2, 0.5], [0.2, 0.2, 0.7], (ROWS, 3)))
    arrays["drawn.place"] = arrays["place"]
    return results, arrays, labels


def bare() -> Case:
    """Nothing but what the contract demands."""
    results, arrays, _ = one_effect()
    told = ("in_order", "by_block", "network", "not_seen", "missing_covariates", "where_ci95", "why_set_aside")
    results = {name: value for name, value in results.items() if name not in told}
    results |= {"rows_set_aside": [], "notes": []}
    results["where"] = {"outputs": {}, "joints": {}, "legs": {}, "regions": [], "covariates": {}}
    results["effects"] = [e | {"shrink_ci95": None} for e in results["effects"]]
    results["verdict"]["shrink_ci95"] = None
    return results, {name: arrays[name] for name in ("place", "joints", "residual", "remainder")}, {}


CASES: dict[str, Callable[[], Case]] = {
    f.__name__: f for f in (one_effect, two_effects, none, outside, outlier, indistinguishable, with_rotation, bare)
}
