import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation, Slerp
from torch import Tensor

from sparsestreet.geometry import quaternions as quat

# Rotation vectors up to two turns, and tiny ones, where sines and norms are delicate.
components = st.one_of(st.floats(-12, 12), st.floats(-1e-6, 1e-6))
vectors = st.tuples(components, components, components).map(lambda v: torch.tensor(v, dtype=torch.float64))
examples = settings(max_examples=60, deadline=None)


def scipy_of(quaternion: Tensor) -> Rotation:
    return Rotation.from_quat(quaternion.roll(-1, -1).numpy())  # scipy is xyzw


def assert_same_rotation(a: Tensor, b: Tensor, tolerance: float = 1e-9) -> None:
    """Unit quaternions up to their sign."""
    assert min(float((a - b).abs().max()), float((a + b).abs().max())) < tolerance


@examples
@given(vectors)
def test_exponential_map_is_scipys(vector: Tensor):
    quaternion = quat.from_rotation_vector(vector)
    assert_same_rotation(quaternion, torch.from_numpy(Rotation.from_rotvec(vector.numpy()).as_quat()).roll(1))
    assert abs(float(quaternion.norm()) - 1) < 1e-12


@examples
@given(vectors, st.floats(1e-3, 1e3))
def test_matrix_is_scipys_for_any_length(vector: Tensor, length: float):
    quaternion = quat.from_rotation_vector(vector)
    expected = torch.from_numpy(scipy_of(quaternion).as_matrix())
    torch.testing.assert_close(quat.to_matrix(length * quaternion), expected, atol=1e-12, rtol=0)


@examples
@given(vectors)
def test_matrix_and_back(vector: Tensor):
    quaternion = quat.from_rotation_vector(vector)
    back = quat.from_matrix(quat.to_matrix(quaternion))
    assert_same_rotation(back, quaternion)
    assert back[0] >= 0


@pytest.mark.parametrize("axis", [(1, 0, 0), (0, 1, 0), (0, 0, 1), (1, 1, 0), (0, -1, 1), (1, 1, 1)])
@pytest.mark.parametrize("offset", [0.0, 1e-9, -1e-9, 1e-4])
def test_matrix_and_back_near_half_turns(axis: tuple[int, int, int], offset: float):
    """The trace is -1 there and w nearly 0: the formula that divides by w fails."""
    unit = torch.nn.functional.normalize(torch.tensor(axis, dtype=torch.float64), dim=0)
    quaternion = quat.from_rotation_vector((math.pi + offset) * unit)
    assert_same_rotation(quat.from_matrix(quat.to_matrix(quaternion)), quaternion)


@examples
@given(vectors, vectors, vectors)
def test_products_are_those_of_matrices_and_associate(u: Tensor, v: Tensor, w: Tensor):
    a, b, c = (quat.from_rotation_vector(vector) for vector in (u, v, w))
    product = quat.to_matrix(quat.multiply(a, b))
    torch.testing.assert_close(product, quat.to_matrix(a) @ quat.to_matrix(b), atol=1e-12, rtol=0)
    left, right = quat.multiply(quat.multiply(a, b), c), quat.multiply(a, quat.multiply(b, c))
    torch.testing.assert_close(left, right, atol=1e-12, rtol=0)
    inverse = a * torch.tensor([1.0, -1.0, -1.0, -1.0], dtype=torch.float64)
    assert_same_rotation(quat.multiply(a, inverse), torch.tensor([1.0, 0.0, 0.0, 0.0], dtype=torch.float64))


@examples
@given(vectors, vectors, st.floats(0, 1), st.booleans())
def test_slerp_is_scipys_whatever_the_sign(u: Tensor, v: Tensor, fraction: float, flip: bool):
    a, b = quat.from_rotation_vector(u), quat.from_rotation_vector(v)
    if abs(float((a * b).sum())) < 1e-6:  # half a turn apart: both ways are equally short
        return
    rotations = Rotation.concatenate([scipy_of(a), scipy_of(b)])
    expected = torch.from_numpy(Slerp([0, 1], rotations)(fraction).as_quat()).roll(1)
    result = quat.slerp(a, -b if flip else b, torch.tensor(fraction, dtype=torch.float64))
    # Below 1.8 degrees (half angle) a normalized lerp stands in, which differs by less than 1e-6.
    assert_same_rotation(result, expected, 1e-6)
    assert abs(float(result.norm()) - 1) < 1e-12


@pytest.mark.parametrize("size", [0.0, 1e-12, 1e-4, 1e-3, 0.5, 3.0])
def test_gradients_of_the_exponential_map(size: float):
    vector = size * torch.tensor([[0.6, -0.64, 0.48]], dtype=torch.float64)
    assert torch.autograd.gradcheck(quat.from_rotation_vector, [vector.requires_grad_()])


@pytest.mark.parametrize("angle", [0.0, 1e-8, 0.01, 0.1, 2.0, 3.1])
def test_gradients_of_slerp(angle: float):
    a = quat.from_rotation_vector(torch.tensor([[0.1, 0.2, 0.3]]).double())
    b = quat.multiply(quat.from_rotation_vector(torch.tensor([[0.0, angle, 0.0]]).double()), a)
    fraction = torch.tensor([0.3], dtype=torch.float64)
    assert torch.autograd.gradcheck(lambda p, q: quat.slerp(p, q, fraction), [a.requires_grad_(), b.requires_grad_()])


def test_gradients_of_matrix_and_product():
    generator = torch.Generator().manual_seed(0)
    a, b = (torch.randn(3, 4, generator=generator, dtype=torch.float64, requires_grad=True) for _ in range(2))
    assert torch.autograd.gradcheck(quat.to_matrix, [a])
    assert torch.autograd.gradcheck(quat.multiply, [a, b])


def test_a_zero_quaternion_is_the_identity_without_gradient():
    for dtype in (torch.float32, torch.float64):
        quaternion = torch.zeros(2, 4, dtype=dtype, requires_grad=True)
        matrix = quat.to_matrix(quaternion)
        assert torch.equal(matrix, torch.eye(3, dtype=dtype).expand(2, 3, 3))
        generator = torch.Generator().manual_seed(0)
        (gradient,) = torch.autograd.grad(matrix, quaternion, torch.randn(2, 3, 3, generator=generator, dtype=dtype))
        assert (gradient == 0).all()


@pytest.mark.parametrize("length", [1e-44, 1e-30, 1e-15, 1e15, 1e30, 3e38])
def test_tiny_and_huge_quaternions_normalize(length: float):
    """In float32, from its last subnormals to its end."""
    quaternion = length * torch.tensor([[1.0, -1.0, 1.0, 1.0]])
    torch.testing.assert_close(quat.normalized(quaternion), torch.tensor([[0.5, -0.5, 0.5, 0.5]]))


@pytest.mark.parametrize("length", [1e-250, 1e-30, 1.0, 1e30, 1e250])
def test_gradient_of_a_normalized_quaternion(length: float):
    """Central differences of relative step 1e-6 are good to 1e-9 of the gradient."""
    generator = torch.Generator().manual_seed(0)
    unit, cotangent = torch.randn(2, 3, 4, generator=generator, dtype=torch.float64)
    quaternion = (length * unit).requires_grad_()
    (gradient,) = torch.autograd.grad(quat.normalized(quaternion), quaternion, cotangent)
    for place in np.ndindex(3, 4):
        step = torch.zeros_like(unit)
        step[place] = 1e-6 * length
        ends = [(quat.normalized(quaternion.detach() + side) * cotangent).sum() for side in (step, -step)]
        expected = float(ends[0] - ends[1]) / 2e-6
        assert float(gradient[place]) * length == pytest.approx(expected, abs=1e-8)


def test_gradients_of_the_shortest_quaternions_end_growing():
    """At tiny / eps, 9.9e-32 in float32, so that they stay finite; longer ones are not touched."""
    cotangent = torch.tensor([0.0, 100.0, 0.0, 0.0])
    for length, expected in ((1e-44, 100 / 2**-103), (1e-31, 1e33)):
        quaternion = torch.tensor([length, 0.0, 0.0, 0.0], requires_grad=True)
        (gradient,) = torch.autograd.grad(quat.normalized(quaternion), quaternion, cotangent)
        assert gradient.tolist() == pytest.approx([0.0, expected, 0.0, 0.0], rel=1e-6)


def test_batches_and_empty_batches():
    assert quat.to_matrix(torch.ones(2, 0, 4)).shape == (2, 0, 3, 3)
    assert quat.from_matrix(torch.eye(3).expand(4, 5, 3, 3)).shape == (4, 5, 4)
    np.testing.assert_array_equal(quat.from_matrix(torch.eye(3)[None]).numpy(), [[1, 0, 0, 0]])


@examples
@given(vectors)
def test_logarithm_is_scipys_and_undoes_the_exponential_map(vector: Tensor):
    quaternion = quat.from_rotation_vector(vector)
    found = quat.to_rotation_vector(quaternion)
    assert float(found.norm()) <= math.pi + 1e-12
    assert_same_rotation(quat.from_rotation_vector(found), quaternion)
    if float(found.norm()) < math.pi - 1e-6:  # of a half turn either axis is right
        assert np.abs(found.numpy() - scipy_of(quaternion).as_rotvec()).max() < 1e-9


@pytest.mark.parametrize("angle", [0.0, 1e-12, 1e-8, 3e-8, 1e-4])
def test_logarithm_of_small_turns_is_exact(angle: float):
    vector = angle * torch.tensor([0.6, 0.0, -0.8], dtype=torch.float64)
    found = quat.to_rotation_vector(quat.from_rotation_vector(vector))
    torch.testing.assert_close(found, vector, atol=0, rtol=1e-12)
