"""On a machine with a CUDA card: a whole run there writes its files, and says what the processor says."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from ccnn_torch import load_model
from ccnn_torch.calibration.config import RunConfig
from ccnn_torch.calibration.job import RUN

DATA = Path(__file__).parent.parent / "experiments" / "data"
SHORT = {"hidden": [4], "rival_hidden": [], "population": 12, "generations": 4, "members": 2, "kept": 2}
SHORT |= {"refinement_iterations": 4, "wave_searches": 1}
TRIPOD = {"case": "tripod", "repeats": 2, "methods": ["ccnn", "bp_lm", "enn", "grnn", "gp", "constant"]}
ARM = {"records": str(DATA / "ur10_b_500.csv"), "mechanism": str(DATA / "ur10.yaml"), "covariates": []}


def run_on(device: str, out: Path, **keys: Any) -> tuple[dict[str, float], np.ndarray]:
    """Held-out errors by method, and a command of the model."""
    RUN.start(RunConfig.from_keys(ccnn=SHORT, device=device, out=str(out), **keys), quiet=True)
    results = json.loads((out / "results.json").read_text(encoding="utf-8"))
    model = load_model(out / "model.safetensors")
    errors = {name: said["test"]["all"]["mse"]["median"] for name, said in results["methods"].items()}
    return errors, model.run(np.full((1, len(model.joints)), 0.3), None)["command"]


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA card")
@pytest.mark.parametrize("keys", [TRIPOD, TRIPOD | {"training": {"folds": 2}}, ARM], ids=["tripod", "folds", "arm"])
def test_a_run_on_a_card_says_what_the_processor_says(keys: dict[str, Any], tmp_path: Path) -> None:
    expected, command = run_on("cpu", tmp_path / "a", **keys)
    errors, there = run_on("cuda", tmp_path / "b", **keys)
    assert errors == pytest.approx(expected, rel=1e-2)
    np.testing.assert_allclose(there, command, rtol=0, atol=1e-5)
