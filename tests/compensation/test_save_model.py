"""What cannot be saved is refused before anything is written."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import torch
from stand_ins import fields

from ccnn_torch.compensation import Compensator, export_model, load_model, save_model
from ccnn_torch.errors import InputError
from ccnn_torch.mechanisms import load_mechanism


def test_fields_are_checked(tmp_path: Path, tripod: Compensator) -> None:
    with pytest.raises(InputError, match="lack seed"):
        save_model(tmp_path, tripod, {k: v for k, v in fields().items() if k != "seed"})
    with pytest.raises(InputError, match="must be JSON"):
        save_model(tmp_path, tripod, fields() | {"metrics": {"mse": float("nan")}})
    assert not list(tmp_path.iterdir())


def test_the_card_of_a_model_serves_the_next_one(tmp_path: Path, tripod: Compensator) -> None:
    save_model(tmp_path / "a", tripod, fields() | {"method": "ccnn"}, forms=())
    card = load_model(tmp_path / "a" / "model.safetensors").card
    save_model(tmp_path / "b", tripod, card | {"limits": 3, "machine": {"kind": "forward"}}, forms=())
    again = load_model(tmp_path / "b" / "model.safetensors").card
    assert again["method"] == "ccnn" and again["limits"] == card["limits"] and "machine" not in again


def test_an_exported_card_keeps_how_the_records_were_read(tmp_path: Path, tripod: Compensator) -> None:
    read = {"columns": {"A1": "q1[mm]"}, "joint_map": {"q3": "J3 - J2"}}
    save_model(tmp_path, tripod, fields() | read | {"method": "ccnn"}, forms=())
    files = export_model(tmp_path / "model.safetensors", "onnx", tmp_path / "out")
    model = load_model(files["model.onnx"])
    assert (model.columns, model.joint_map, model.card["method"]) == (*read.values(), "ccnn")
    tripod_yaml: dict[str, Any] = {"mechanism": "tripod", "keys": {}, "columns": read["columns"], "parameters": {}}
    geometry = load_mechanism("tripod")
    for p, value in zip(geometry.geometry, geometry.nominal.tolist(), strict=True):
        tripod_yaml["parameters"][p.name] = {"value": value + 1e-5, "nominal": value, "unit": p.unit}
    (tmp_path / "identified.yaml").write_text(json.dumps(tripod_yaml))
    files = export_model(tmp_path / "identified.yaml", "onnx", tmp_path / "geometry")
    assert load_model(files["model.onnx"]).columns == read["columns"]


def test_a_network_without_description_is_refused(tmp_path: Path, tripod: Compensator) -> None:
    bare = Compensator(
        torch.nn.Identity(), tripod.scaling, tripod.domain, tripod.limit, tripod.safe, tripod.joints, (), 0.0, 1
    )
    with pytest.raises(InputError, match="Identity cannot be stored"):
        save_model(tmp_path, bare, fields())
