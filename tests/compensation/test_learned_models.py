"""The network of every learner, variance included, goes through a compensator into model files and back."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from stand_ins import fields, tripod_joints
from torch import Tensor, nn

from ccnn_torch.compensation import fit_compensator, load_model, save_model
from ccnn_torch.compensation.networks import describe_network, network_from_description
from ccnn_torch.coordinates import Coordinate
from ccnn_torch.learners import Learner, TrainingData
from ccnn_torch.learners.bp_lm import BPLM, BPLMSettings
from ccnn_torch.learners.constant import Constant
from ccnn_torch.learners.enn import ENN, ENNSettings
from ccnn_torch.learners.gp import GaussianProcess, GPSettings
from ccnn_torch.learners.grnn import GRNN, GRNNSettings
from ccnn_torch.training import Scaling, train

LEARNERS: dict[str, Callable[[], Learner]] = {
    "constant": Constant,
    "bp_lm": lambda: BPLM(BPLMSettings(hidden=(4,), restarts=2, iterations=6)),
    "gp": lambda: GaussianProcess(GPSettings(steps=20, variance_rows=40)),
    "enn": lambda: ENN(ENNSettings(hidden=(4,), population=12, generations=10)),
    "grnn": lambda: GRNN(GRNNSettings(iterations=4, candidates=9)),
}


def variance_of(network: nn.Module) -> Callable[[Tensor], Tensor]:
    found: Callable[[Tensor], Tensor] = getattr(network, "variance")  # noqa: B009 - no method of Module
    return found


@pytest.mark.parametrize("name", LEARNERS)
def test_a_trained_model_goes_into_files_and_back(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # Torch's compiler, 1.5 s of a process to load, is not needed.
    monkeypatch.setitem(sys.modules, "torch._dynamo", None)
    joints = tripod_joints(60)
    generator = torch.Generator().manual_seed(4)
    deviations = 1e-4 * torch.sin(8 * joints) + 1e-5 * torch.randn(joints.shape, generator=generator).double()
    rows = torch.ones(1, len(joints), dtype=torch.float64)
    scaling = Scaling.fit(joints[None], deviations[None], rows, torch.zeros(3, dtype=torch.bool))
    data = TrainingData(
        scaling.features(joints[None]), scaling.standardise(deviations[None]), rows, torch.arange(1000, 1001)
    )
    learner = LEARNERS[name]()
    train(learner, data)
    network = learner.network(0)
    names = [Coordinate(f"q{i}", "m") for i in (1, 2, 3)]
    compensator = fit_compensator(network, scaling.repeat(0), joints, deviations, names)
    # Each file is compared with the eager model as it is written; masked networks have their own tests of all forms.
    forms = ("safetensors", "onnx", "float32.onnx") if name == "grnn" else ("safetensors", "onnx")
    paths = save_model(tmp_path, compensator, fields(), forms=forms)
    assert set(paths) == {*forms, "card"}
    master = load_model(paths["safetensors"])
    expected = compensator.solve(joints)
    np.testing.assert_allclose(master(joints.numpy())["command"], expected.command.detach().numpy(), rtol=0, atol=1e-15)
    # The variance too, which the graph computes in double.
    graph = load_model(paths["onnx"])(joints.numpy())
    np.testing.assert_allclose(graph["deviation_sd"], expected.deviation_sd.detach().numpy(), rtol=1e-9)
    # The description and the tensors alone give the same module, variance included.
    again = network_from_description(describe_network(network))
    again.load_state_dict(network.state_dict())
    features = data.inputs[0] * 1.3
    assert torch.equal(again(features), network(features))
    assert torch.equal(variance_of(again)(features), variance_of(network)(features))
