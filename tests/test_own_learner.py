"""A learner of one's own file: from a run to a model file that commands, and what cannot be stored before training."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from ccnn_torch import load_model
from ccnn_torch.compensation import register_network
from ccnn_torch.errors import InputError
from ccnn_torch.learners.constant import ConstantNetwork

Cli = Callable[..., tuple[int, str, str]]
ROOT = Path(__file__).parent.parent
EXAMPLE = ROOT / "experiments" / "my_learner.py"
RUN = ("run", ROOT / "experiments" / "tripod.yaml", "repeats=1")


def test_the_example_gives_a_model_file_that_is_read_again(cli: Cli, tmp_path: Path) -> None:
    code, shown, told = cli(*RUN, f"methods=[{EXAMPLE}:Ridge]", "save_report=false", f"out={tmp_path / 'r'}")
    assert code == 0 and told == "" and "Ridge removes" in shown
    joints = np.array([[0.4, 0.4, 0.4]])
    answers = [load_model(tmp_path / "r" / f"model.{form}")(joints)["command"] for form in ("safetensors", "onnx")]
    np.testing.assert_allclose(*answers, rtol=0, atol=1e-15)


@pytest.mark.parametrize(
    ("removed", "sentence"),
    [
        ('register_network("my_ridge", RidgeNetwork)', "networks of kind 'other' are unknown; call "),
        ("describe", "the network RidgeNetwork cannot be stored: give it describe() and from_description()"),
    ],
)
def test_a_network_that_cannot_be_stored_is_refused_before_training(
    cli: Cli, tmp_path: Path, removed: str, sentence: str
) -> None:
    text = EXAMPLE.read_text(encoding="utf-8")
    assert removed in text
    (tmp_path / "own.py").write_text(text.replace(removed, "stored_by").replace('"my_ridge"', '"other"')
                                     .replace("\nstored_by\n", "\n"), encoding="utf-8")  # fmt: skip
    learner = f"methods=[constant,{tmp_path / 'own.py'}:Ridge]"
    code, _, told = cli(*RUN, learner, f"out={tmp_path / 'r'}")
    assert code == 2 and sentence in told and told.endswith("or write no model files: save_models=false\n")
    assert told.startswith(f"methods: {tmp_path / 'own.py'}:Ridge: ") and not (tmp_path / "r").exists()
    assert cli(*RUN, learner, f"out={tmp_path / 'r'}", "save_models=false", "save_report=false")[0] == 0


def test_a_kind_of_another_class_is_taken() -> None:
    with pytest.raises(InputError, match="a network of kind 'gp' is registered already"):
        register_network("gp", ConstantNetwork)
