"""What cannot be saved is refused before anything is written."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from stand_ins import fields

from ccnn_torch.compensation import Compensator, save_model
from ccnn_torch.errors import InputError


def test_fields_are_checked(tmp_path: Path, tripod: Compensator) -> None:
    with pytest.raises(InputError, match="lack seed"):
        save_model(tmp_path, tripod, {k: v for k, v in fields().items() if k != "seed"})
    with pytest.raises(InputError, match="must be JSON"):
        save_model(tmp_path, tripod, fields() | {"metrics": {"mse": float("nan")}})
    with pytest.raises(InputError, match="may not be named 'limits'"):
        save_model(tmp_path, tripod, fields() | {"limits": 3})
    assert not list(tmp_path.iterdir())


def test_a_network_without_description_is_refused(tmp_path: Path, tripod: Compensator) -> None:
    bare = Compensator(
        torch.nn.Identity(), tripod.scaling, tripod.domain, tripod.limit, tripod.safe, tripod.joints, (), 0.0, 1
    )
    with pytest.raises(InputError, match="Identity cannot be stored"):
        save_model(tmp_path, bare, fields())
