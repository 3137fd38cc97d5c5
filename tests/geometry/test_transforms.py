import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from sparsestreet.geometry.quaternions import from_rotation_vector, to_matrix
from sparsestreet.geometry.transforms import inverse, rigidity_error, transform_points

seeds = st.integers(0, 2**31)
examples = settings(max_examples=40, deadline=None)


def random_transform(seed: int) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    matrix = torch.eye(4, dtype=torch.float64)
    matrix[:3, :3] = to_matrix(from_rotation_vector(3 * torch.randn(3, generator=generator, dtype=torch.float64)))
    matrix[:3, 3] = 100 * torch.randn(3, generator=generator, dtype=torch.float64)
    return matrix


@examples
@given(seeds)
def test_inverse_is_that_of_linear_algebra(seed: int):
    a_from_b = random_transform(seed)
    torch.testing.assert_close(inverse(a_from_b), torch.linalg.inv(a_from_b), atol=1e-10, rtol=0)


@examples
@given(seeds, seeds)
def test_chains_of_transforms(first: int, second: int):
    a_from_b, b_from_c = random_transform(first), random_transform(second)
    points = torch.randn(5, 3, generator=torch.Generator().manual_seed(first), dtype=torch.float64)
    stepwise = transform_points(a_from_b, transform_points(b_from_c, points))
    torch.testing.assert_close(stepwise, transform_points(a_from_b @ b_from_c, points), atol=1e-9, rtol=0)
    torch.testing.assert_close(transform_points(inverse(a_from_b), transform_points(a_from_b, points)), points)


def test_batched_inverse():
    batch = torch.stack([random_transform(seed) for seed in range(3)])
    assert torch.equal(inverse(batch)[1], inverse(batch[1]))
    assert inverse(batch[:0]).shape == (0, 4, 4)


def test_rigidity_error():
    assert rigidity_error(random_transform(0)) < 1e-12
    scaled = random_transform(0)
    scaled[:3, :3] *= 1.1
    assert rigidity_error(scaled) == pytest.approx(0.21)
    reflected = torch.diag(torch.tensor([1.0, 1.0, -1.0, 1.0], dtype=torch.float64))
    assert rigidity_error(reflected) == 1.0
    projective = random_transform(0)
    projective[3, 0] = 0.5
    assert rigidity_error(projective) == pytest.approx(0.5)
