"""Pointing runs of telescopes that were made with the formulas of astronomers, which share none with the package."""

from __future__ import annotations

import math
import re
from pathlib import Path

import numpy as np
import pytest

from ccnn_torch.diagnosis import Diagnosis, diagnose
from ccnn_torch.mechanisms import load_mechanism
from ccnn_torch.records import load_records

ARCSECOND = math.radians(1) / 3600
MOUNT = """robot: mount
dof: 2
convention: standard Denavit-Hartenberg
units: {{length: m, angle: deg}}
a: [0, 1]
alpha: [90, 0]
d: [0, 0]
theta: [0, 0]
base_frame: unknown
tool_offset: [0, 0, 0]
{groups}
"""
NOISE = 1.0


def night(seed: int, stars: int, **terms: float) -> np.ndarray:
    """Azimuth counted counter-clockwise and elevation by the encoders [deg], and the unit vector to the star.

    terms: IA, IE, CA, NPAE, AN, AW, TF, TX ["]; what the encoders lack in azimuth and elevation of the true place.
    """
    rng = np.random.default_rng(seed)
    azimuth, elevation = rng.uniform(-np.pi, np.pi, stars), np.arcsin(rng.uniform(0.3, 0.99, stars))
    v = {name: terms.get(name, 0.0) * ARCSECOND for name in ("IA", "IE", "CA", "NPAE", "AN", "AW", "TF", "TX")}
    cosine, slope = np.cos(elevation), np.tan(elevation)
    tilt_azimuth = (v["AW"] * np.cos(azimuth) - v["AN"] * np.sin(azimuth)) * slope
    tilt_elevation = -v["AN"] * np.cos(azimuth) - v["AW"] * np.sin(azimuth)
    across = v["CA"] / cosine + v["NPAE"] * slope + NOISE * ARCSECOND * rng.normal(size=stars) / cosine
    true_azimuth = azimuth + v["IA"] + across + tilt_azimuth
    bent = v["TF"] * cosine + v["TX"] / slope
    true_elevation = elevation + v["IE"] + tilt_elevation + bent + 1.5 * NOISE * ARCSECOND * rng.normal(size=stars)
    sight = [
        np.cos(true_elevation) * np.cos(true_azimuth),
        np.cos(true_elevation) * np.sin(true_azimuth),
        np.sin(true_elevation),
    ]
    return np.stack([np.degrees(azimuth), np.degrees(elevation), *sight], -1)


def diagnosed(folder: Path, nights: dict[int, np.ndarray], groups: str = "") -> Diagnosis:
    mechanism, records = folder / "mount.yaml", folder / "records.csv"
    mechanism.write_text(MOUNT.format(groups=groups))
    rows = [f"{name},{','.join(f'{v:.12f}' for v in row)}" for name, own in nights.items() for row in own]
    records.write_text("\n".join(["night[1],q1[deg],q2[deg],x[m],y[m],z[m]", *rows]) + "\n")
    mount = load_mechanism(str(mechanism))
    return diagnose(load_records(records, mount, learns=False), mount)


def values(said: Diagnosis, effect: str) -> dict[str, tuple[float, float]]:
    """Value and standard deviation by name ["]."""
    found = next(e for e in said.effects if e["name"] == effect)["parameters"]
    return {n: (b["value"] / ARCSECOND, (b["sd"] or 0.0) / ARCSECOND) for n, b in found.items()}


def arcseconds(said: Diagnosis, beginning: str) -> list[float]:
    """The numbers of a note ["]."""
    note = next(note for note in said.notes if beginning in note)
    return [float(number.replace("−", "-")) for number in re.findall(r"([-−]?[0-9.]+)\"", note)]


TERMS = {"IA": -900.0, "IE": 6.0, "CA": 30.0, "NPAE": -20.0, "AN": 8.0, "AW": -12.0, "TF": -25.0, "TX": 4.0}


def test_tube_and_axes_of_a_telescope_are_told_and_what_is_left_is_the_noise(tmp_path: Path) -> None:
    said = diagnosed(tmp_path, {1: night(4, 90, **TERMS)})
    assert set(said.verdict["effects"]) == {"flexure", "geometry"} and not said.verdict["outside_library"]
    assert said.gap["after"] == pytest.approx(math.sqrt(1 + 1.5**2) * NOISE * ARCSECOND, rel=0.15)
    bent, built = values(said, "flexure"), values(said, "geometry")
    for found, name in ((bent, "TF"), (bent, "TX"), (built, "theta2"), (built, "alpha1"), (built, "d2")):
        wanted = TERMS[{"theta2": "IE", "alpha1": "NPAE", "d2": "CA"}.get(name, name)]
        # Signs of the two axes are those of the model's file.
        assert abs(abs(found[name][0]) - abs(wanted)) < 4 * found[name][1] + 0.5, (name, found[name])
    by_name = next(e for e in said.effects if e["name"] == "geometry")["parameters"]
    assert {name: by_name[name]["sense"] for name in ("alpha1", "d2", "theta2")} == {
        "alpha1": "NPAE",
        "d2": "CA",
        "theta2": "IE",
    }
    assert arcseconds(said, "the first axis") == pytest.approx([TERMS[name] for name in ("AN", "AW", "IA")], abs=1.0)


def test_what_is_set_anew_each_night_is_told(tmp_path: Path) -> None:
    moved = TERMS | {"AN": -2.0, "AW": 5.0, "IA": -880.0, "TF": 3.0, "TX": 0.0}
    nights = {20210821: night(5, 80, **TERMS), 20230702: night(6, 80, **moved)}
    said = diagnosed(tmp_path, nights, "frame_per: [night]")
    assert "flexure by night" in said.verdict["effects"] and not said.verdict["outside_library"]
    bent = values(said, "flexure by night")
    for name, wanted in (("20210821: TF", -25.0), ("20230702: TF", 3.0)):
        assert abs(bent[name][0] - wanted) < 4 * bent[name][1]
    assert said.gap["after"] == pytest.approx(math.sqrt(1 + 1.5**2) * NOISE * ARCSECOND, rel=0.15)
    assert arcseconds(said, "from one night") == pytest.approx([10.0, 17.0, 20.0], abs=1.0)


def test_a_mount_has_no_causes_of_positions_and_is_seen_across_and_along(tmp_path: Path) -> None:
    said = diagnosed(tmp_path, {1: night(7, 60, IA=50.0, IE=10.0)})
    assert set(said.where["outputs"]) == {"across", "along"}
    assert not {"gravity", "tool", "instrument"} & ({e["name"] for e in said.effects} | set(said.not_seen))
