"""Functions of the joints as polynomials."""

from __future__ import annotations

import pytest
import torch
from machines import arm
from module_graph import to_onnx
from torch import Tensor

from ccnn_torch.compensation import expand
from ccnn_torch.compensation.model_files.metadata import check_graph, open_onnx
from ccnn_torch.errors import InputError, MethodFailedError


def test_the_deviation_runs_in_onnx_in_double() -> None:
    joints = arm().joints
    module = expand(lambda q: 1e-3 * q * q.roll(1, -1), joints)
    model = to_onnx(module, {"joints": joints}, ["deviation"])
    check_graph(model)
    session = open_onnx(model.SerializeToString())
    (found,) = session.run(None, {session.get_inputs()[0].name: joints.numpy()})
    torch.testing.assert_close(torch.from_numpy(found), module(joints), rtol=0, atol=1e-14)


def test_an_expansion_says_when_it_does_not_fit() -> None:
    joints = torch.rand(100, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    with pytest.raises(MethodFailedError, match="no polynomial"):
        expand(lambda q: 1e-3 * torch.sign(q - 0.5), joints)
    with pytest.raises(InputError, match="joints"):
        expand(lambda q: q, torch.rand(30, 12, dtype=torch.float64))
    nothing = expand(torch.zeros_like, joints)
    assert bool((nothing(joints) == 0).all())


def test_a_polynomial_is_expanded_exactly() -> None:
    joints = torch.rand(200, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)

    def cubic(q: Tensor) -> Tensor:
        return torch.stack([q[:, 0] ** 3, q[:, 0] * q[:, 1] * q[:, 2], 1 + q[:, 2] ** 2], -1)

    module = expand(cubic, joints)
    assert module.degree == 4
    torch.testing.assert_close(module(joints), cubic(joints), rtol=0, atol=1e-7)
