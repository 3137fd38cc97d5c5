"""Distances of sets of features against matrix roots, double loops and closed forms."""

import numpy as np
import pytest
from scipy.linalg import sqrtm

from sparsestreet.metrics.distances import frechet_distance, kernel_distance


def features(count, width, seed, shift=0.0):
    """Correlated, with deviations from 0.1 to 2."""
    generator = np.random.default_rng(seed)
    mixed = generator.normal(size=(count, width)) * np.linspace(0.1, 2.0, width)
    return mixed @ np.linalg.qr(np.random.default_rng(99).normal(size=(width, width)))[0] + shift


@pytest.mark.parametrize(("n", "m"), [(50, 50), (40, 61)])
def test_frechet_is_the_one_of_matrix_roots(n, m):
    a, b = features(n, 12, 0), features(m, 12, 1, shift=0.3)
    s, t = np.cov(a, rowvar=False), np.cov(b, rowvar=False)
    expected = ((a.mean(0) - b.mean(0)) ** 2).sum() + np.trace(s + t - 2 * np.real(np.asarray(sqrtm(s @ t))))
    # Roots of eigenvalues lose half of float64's digits at worst.
    assert frechet_distance(a, b) == pytest.approx(expected, rel=1e-7)


def test_frechet_where_covariances_have_no_full_rank():
    """Fewer images than features, as always here: through the roots of the symmetric S1^(1/2) S2 S1^(1/2)."""
    a, b = features(5, 20, 0), features(7, 20, 1)
    s, t = np.cov(a, rowvar=False), np.cov(b, rowvar=False)
    values, vectors = np.linalg.eigh(s)
    root = vectors * np.sqrt(values.clip(0)) @ vectors.T
    trace = np.sqrt(np.linalg.eigvalsh(root @ t @ root).clip(0)).sum()
    expected = ((a.mean(0) - b.mean(0)) ** 2).sum() + np.trace(s) + np.trace(t) - 2 * trace
    # The roots of eigenvalues that should be 0, and are 1e-16.
    assert frechet_distance(a, b) == pytest.approx(expected, abs=1e-6)


def test_frechet_of_moved_and_stretched_sets():
    """Moved by v: |v|^2. Stretched by 3 about the mean: tr(S) (1 - 3)^2."""
    a = features(30, 8, 0)
    assert frechet_distance(a, a) == pytest.approx(0, abs=1e-12)
    assert frechet_distance(a, a + 0.5) == pytest.approx(8 * 0.25, abs=1e-10)
    stretched = a.mean(0) + 3 * (a - a.mean(0))
    assert frechet_distance(a, stretched) == pytest.approx(4 * np.trace(np.cov(a, rowvar=False)), rel=1e-10)


@pytest.mark.parametrize(("n", "m"), [(2, 2), (6, 9)])
def test_kernel_distance_is_the_double_loop(n, m):
    a, b = features(n, 5, 0), features(m, 5, 1, shift=0.3)

    def mean(x, y, own):
        pairs = [(i, j) for i in range(len(x)) for j in range(len(y)) if not (own and i == j)]
        return sum((float(x[i] @ y[j]) / 5 + 1) ** 3 for i, j in pairs) / len(pairs)

    expected = mean(a, a, True) + mean(b, b, True) - 2 * mean(a, b, False)
    assert kernel_distance(a, b) == pytest.approx(expected, rel=1e-10, abs=1e-12)


@pytest.mark.lengthy
def test_kernel_distance_of_samples_of_one_law_is_zero_on_average():
    values = [kernel_distance(features(8, 5, 2 * seed), features(8, 5, 2 * seed + 1)) for seed in range(200)]
    spread = np.std(values) / 200**0.5
    assert abs(np.mean(values)) < 3 * spread
    assert min(values) < 0


@pytest.mark.parametrize("distance", [frechet_distance, kernel_distance])
def test_features_of_32_bits_are_summed_in_64(distance):
    """Around a mean of 100 the sums of float32 would be off by 1e-3."""
    a, b = (features(20, 6, seed, shift=100.0).astype(np.float32) for seed in (0, 1))
    assert distance(a, b) == distance(a.astype(np.float64), b.astype(np.float64))


@pytest.mark.parametrize("distance", [frechet_distance, kernel_distance])
def test_few_images(distance):
    """Two have a covariance, of rank 1; one has none."""
    pair = features(2, 6, 0)
    assert np.isfinite(distance(pair, features(2, 6, 1)))
    for few in (pair[:1], pair[:0]):
        for sets in ((few, pair), (pair, few)):
            with pytest.raises(ValueError, match=f"at least two images a set, got {len(few)}"):
                distance(*sets)
    broken = pair.copy()
    broken[1, 2] = np.nan
    with pytest.raises(ValueError, match="finite features"):
        distance(pair, broken)
