"""Model files and their cards that went wrong, and inputs of every kind of model."""

from __future__ import annotations

import json
import math
import shutil
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, strategies as st

from ccnn_torch import calibrate, identify
from fuzz.mutate import (
    TOKENS,
    bytes_changes,
    change_bytes,
    change_table,
    change_text as change,
    table_changes,
    text_changes,
)
from fuzz.oracle import columns, judged

pytestmark = pytest.mark.fuzz
CASES = 8
FORMS = ["model.safetensors", "model.onnx"]
SHIPPED = Path(__file__).parents[2] / "checkpoints" / "tripod"
OPTIONS = [[], ["--pose"], ["--back"], ["--sd"]]


@pytest.fixture(scope="session")
def models(bases, tmp_path_factory):
    """Folders of models by kind, each with files of its own and the cells of a valid IN.csv."""
    home = tmp_path_factory.mktemp("models")
    for name, cells in bases.items():
        (home / f"{name}.csv").write_text("\n".join(",".join(row) for row in cells))
    # A compensator as it is shipped, one with covariates, and one with identified geometry.
    (home / "plain").mkdir()
    for name in ("card.json", *FORMS):
        shutil.copy(SHIPPED / name, home / "plain")
    rows = {"mechanism": "five_bar", "records": home / "five_bar.csv", "geometry": "none", "effects": "none"}
    with_covariates = calibrate(**rows, methods=["gp"], gp={"steps": 3}, covariates=["time", "temperature"])
    with_covariates.save(home / "covariates", forms=["safetensors", "onnx"])
    rows = {"mechanism": "tripod", "records": home / "tripod.csv", "geometry": "identify", "effects": "none"}
    calibrate(**rows, methods=["constant"], covariates=[]).save(home / "geometry", forms=["safetensors", "onnx"])
    found = {
        kind: (home / kind, FORMS, bases[name])
        for kind, name in (("plain", "tripod"), ("covariates", "five_bar"), ("geometry", "tripod"))
    }
    identify(mechanism="tripod", records=home / "tripod.csv", methods=["lm"], save_report=False).save(
        home / "identified"
    )
    found["identified"] = (home / "identified", ["identified.yaml"], bases["tripod"])
    return found


def compensated(folder: Path, model: str, words: list[str]) -> None:
    """OUT.csv of exit 0 holds finite commands and deviations within the card's limits."""
    outcome = judged(["compensate", model, "IN.csv", "OUT.csv", *words], folder)
    if outcome.code != 0:
        return
    card = folder / "card.json"
    limits = json.loads(card.read_text()).get("limits", {}) if card.is_file() else {}
    for name, values in columns(folder / "OUT.csv").items():
        if name.startswith(("command_", "ideal_q", "deviation_", "inside_", "status")):
            assert all(map(math.isfinite, values)), name
        joint = name.removeprefix("deviation_")
        if joint != name and joint in limits:
            assert max(map(abs, values)) <= limits[joint]["most_deviation"] * (1 + 1e-6), name


VALUES = st.sampled_from([*TOKENS, 0, -1, 1e300, 0.5, None, True, [], {}, [1.0]])
KINDS = st.sampled_from(["plain", "covariates", "geometry", "identified"])


@given(kind=KINDS, which=st.integers(0, 1), options=st.sampled_from(OPTIONS), changes=bytes_changes)
def test_model_bytes(models, fresh, kind, which, options, changes) -> None:
    source, files, cells = models[kind]
    model = files[which % len(files)]
    with fresh() as folder:
        if (source / "card.json").is_file():
            shutil.copy(source / "card.json", folder)
        (folder / model).write_bytes(change_bytes((source / model).read_bytes(), changes))
        (folder / "IN.csv").write_text("\n".join(",".join(row) for row in cells))
        compensated(folder, model, options)


@given(kind=KINDS, which=st.integers(0, 1), options=st.sampled_from(OPTIONS), changes=text_changes)
def test_cards(models, fresh, kind, which, options, changes) -> None:
    source, files, cells = models[kind]
    model = files[which % len(files)]
    text = "identified.yaml" if kind == "identified" else "card.json"
    with fresh() as folder:
        shutil.copy(source / model, folder)
        (folder / text).write_text(change((source / text).read_text(), changes), encoding="utf-8", errors="replace")
        (folder / "IN.csv").write_text("\n".join(",".join(row) for row in cells))
        judged(["compensate", model, "IN.csv", "OUT.csv", *options], folder)


@given(kind=KINDS, which=st.integers(0, 1), path=st.lists(st.integers(0, 50), min_size=1, max_size=5), value=VALUES)
def test_forged_cards(models, fresh, kind, which, path, value) -> None:
    """One value of the card is another, with the card still JSON."""
    source, files, cells = models[kind]
    if kind == "identified":
        return
    card = json.loads((source / "card.json").read_text())
    node: Any = card
    for deeper, step in enumerate(path, 1):
        key = list(node)[step % len(node)] if isinstance(node, dict) else step % len(node)
        if deeper == len(path) or not isinstance(node[key], dict | list) or not node[key]:
            node[key] = value
            break
        node = node[key]
    with fresh() as folder:
        (folder / "card.json").write_text(json.dumps(card))
        shutil.copy(source / files[which % len(files)], folder)
        (folder / "IN.csv").write_text("\n".join(",".join(row) for row in cells))
        judged(["compensate", files[which % len(files)], "IN.csv", "OUT.csv"], folder)


@given(kind=KINDS, which=st.integers(0, 1), options=st.sampled_from(OPTIONS), changes=table_changes)
def test_inputs(models, fresh, kind, which, options, changes) -> None:
    source, files, cells = models[kind]
    with fresh() as folder:
        shutil.copytree(source, folder, dirs_exist_ok=True)
        text = "\n".join(",".join(row) for row in change_table(cells, changes))
        (folder / "IN.csv").write_text(text, encoding="utf-8", errors="replace")
        compensated(folder, files[which % len(files)], options)
