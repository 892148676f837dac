"""A graph with lengths inside that are multiples of the batch runs in ONNX Runtime, for any batch."""

from __future__ import annotations

import numpy as np
import onnxruntime
import pytest
import torch

from ccnn_torch.compensation.export.to_onnx import to_onnx


class _Wide(torch.nn.Module):
    """Lengths inside that are the batch, and 24 times the batch."""

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        size = torch.linalg.vector_norm(x, dim=-1)
        wide = (x + torch.arange(24, dtype=x.dtype)[:, None, None]).flatten(0, 1)
        sizes = torch.linalg.vector_norm(wide * size.repeat(24)[:, None], dim=-1).reshape(24, -1)
        return torch.linalg.vector_norm(x + 1, dim=-1) * size + sizes.sum(0)


def test_lengths_inside_a_graph_are_not_taken_for_each_other(capfd: pytest.CaptureFixture[str]) -> None:
    rows = torch.export.Dim("s", min=2)
    traced = torch.export.export(_Wide(), (torch.rand(5, 2).double(),), dynamic_shapes=({0: rows},))
    session = onnxruntime.InferenceSession(to_onnx(traced, None, ["y"], 20, "{}").SerializeToString())
    points = torch.rand(488, 2, generator=torch.Generator().manual_seed(1)).double()
    (found,) = session.run(None, {session.get_inputs()[0].name: points.numpy()})
    np.testing.assert_allclose(found, _Wide()(points).numpy(), rtol=1e-12)
    assert "mismatch" not in capfd.readouterr().err
