"""Rotations against scipy's."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings, strategies as st
from scipy.spatial.transform import Rotation

from ccnn_torch.numerics import rotations

_vectors = st.lists(st.floats(-3, 3, allow_subnormal=False), min_size=3, max_size=3)


@settings(max_examples=60, deadline=None)
@given(_vectors)
def test_against_scipy(vector):
    theirs = Rotation.from_rotvec(vector)
    matrix = rotations.rotation_vector_to_matrix(torch.tensor(vector, dtype=torch.float64))
    np.testing.assert_allclose(matrix.numpy(), theirs.as_matrix(), atol=2e-15)
    back = rotations.matrix_to_rotation_vector(matrix)
    np.testing.assert_allclose(rotations.rotation_vector_to_matrix(back).numpy(), matrix.numpy(), atol=1e-14)
    assert float(back.norm()) <= math.pi + 1e-12
    quaternion = rotations.matrix_to_quaternion(matrix)
    assert quaternion[0] >= 0 and float(quaternion.norm()) == pytest.approx(1)
    expected = theirs.as_quat(scalar_first=True)
    np.testing.assert_allclose(np.abs(quaternion.numpy() @ expected), 1, atol=1e-14)


@settings(max_examples=40, deadline=None)
@given(st.floats(-3, 3), st.floats(-1.5, 1.5) | st.sampled_from([-math.pi / 2, math.pi / 2]), st.floats(-3, 3))
def test_euler_is_intrinsic_zyx(yaw, pitch, roll):
    angles = torch.tensor([yaw, pitch, roll], dtype=torch.float64)
    matrix = rotations.euler_zyx_to_matrix(angles)
    np.testing.assert_allclose(matrix.numpy(), Rotation.from_euler("ZYX", [yaw, pitch, roll]).as_matrix(), atol=1e-14)
    back = rotations.matrix_to_euler_zyx(matrix)
    np.testing.assert_allclose(rotations.euler_zyx_to_matrix(back).numpy(), matrix.numpy(), atol=1e-14)
    if abs(pitch) <= 1.5:
        np.testing.assert_allclose(back.numpy(), angles.numpy(), atol=1e-9)


@pytest.mark.parametrize("angle", [0.0, 1e-12, 1e-9, 1e-4, 1.0, 3.0])
def test_geodesic_angle_is_right_at_every_size(angle):
    axis = torch.tensor([0.6, 0.0, 0.8], dtype=torch.float64)
    first = rotations.rotation_vector_to_matrix(torch.tensor([0.3, -0.2, 1.0], dtype=torch.float64))
    second = first @ rotations.rotation_vector_to_matrix(angle * axis)
    assert float(rotations.geodesic_angle(first, second)) == pytest.approx(angle, rel=1e-6, abs=2e-16)


def test_nearest_rotation_and_slopes_at_no_rotation():
    noisy = torch.randn(40, 3, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    expected = np.stack([Rotation.align_vectors(m.mT.numpy(), np.eye(3))[0].inv().as_matrix() for m in noisy])
    found = rotations.nearest_rotation(noisy)
    assert torch.linalg.det(found).allclose(torch.ones(40, dtype=torch.float64))
    # Both maximise the trace of the product; compared by what they reach.
    reached, best = ((noisy * r).sum((-1, -2)) for r in (found, torch.as_tensor(expected)))
    assert bool((reached >= best - 1e-12).all())
    zero = torch.zeros(3, dtype=torch.float64)
    slope = torch.autograd.functional.jacobian(rotations.rotation_vector_to_matrix, zero)
    torch.testing.assert_close(slope.permute(2, 0, 1), rotations.skew(torch.eye(3, dtype=torch.float64)))
    back = torch.autograd.functional.jacobian(rotations.matrix_to_rotation_vector, torch.eye(3, dtype=torch.float64))
    torch.testing.assert_close(torch.einsum("kij,ijl->kl", back, slope), torch.eye(3, dtype=torch.float64))


def test_skew_vee_and_wrap():
    a, b = torch.randn(2, 5, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    product = (rotations.skew(a) @ b[..., None])[..., 0]
    torch.testing.assert_close(product, torch.linalg.cross(a, b))
    torch.testing.assert_close(rotations.vee(rotations.skew(a)), a)
    angles = torch.tensor([0.1, -3.0, 3.5, 7.0, -40.0], dtype=torch.float64)
    wrapped = rotations.wrap_angle(angles)
    assert (wrapped.abs() <= math.pi).all() and torch.equal(wrapped[:2], angles[:2])
    torch.testing.assert_close(torch.sin(wrapped), torch.sin(angles))
