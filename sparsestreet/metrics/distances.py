"""Distances between two sets of images, computed on their features: the Frechet and the kernel distance.

Both compare sets, not pairs, so they need no ground truth. With few images the Frechet distance is mostly bias: a
street has 60 to 600 images against 2,048 features. Compare only runs on the same views, and read the kernel distance
first.
"""

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float
from torch import Tensor

from sparsestreet.metrics.lpips import Lpips

INCEPTION = "inception"
"""Name of the one extractor whose Frechet distance may be called FID."""


def distance_names(extractor: str) -> tuple[str, str]:
    """Return the names in records of the two distances of an extractor's features: "fid" and "kid" only for Inception.

    >>> distance_names("inception"), distance_names("alexnet")
    (('fid', 'kid'), ('frechet_alexnet', 'kernel_alexnet'))
    """
    return ("fid", "kid") if extractor == INCEPTION else (f"frechet_{extractor}", f"kernel_{extractor}")


def frechet_distance(first: Float[np.ndarray, "n d"], second: Float[np.ndarray, "m d"]) -> float:
    """|mean1 - mean2|^2 + tr(S1 + S2 - 2 (S1 S2)^(1/2)) of two sets of features, in float64.

    The trace of the root is the sum of the singular values of A B^T, where A and B are the centered features over
    sqrt(n - 1) and sqrt(m - 1). This is exact for covariances of any rank, and its matrix has the size of the sets, not
    of the features. Raises ValueError for fewer than two rows, which have no covariance, or values that are not finite.

    >>> first = np.array([[0.0, 0.0], [2.0, 0.0]])
    >>> frechet_distance(first, first + 3.0)  # equal covariances, means 3 apart in both features
    18.0...
    """
    a, b = _checked(first, "frechet"), _checked(second, "frechet")
    means = a.mean(axis=0), b.mean(axis=0)
    a, b = ((x - mean) / np.sqrt(len(x) - 1) for x, mean in zip((a, b), means, strict=True))
    root = np.linalg.svd(a @ b.T, compute_uv=False).sum()
    return float(np.square(means[0] - means[1]).sum() + np.square(a).sum() + np.square(b).sum() - 2 * root)


def kernel_distance(first: Float[np.ndarray, "n d"], second: Float[np.ndarray, "m d"]) -> float:
    """Squared maximum mean discrepancy under k(x, y) = (x . y / d + 1)^3 of two sets of features, in float64.

    The unbiased estimate (Binkowski et al. 2018) never compares a row with itself. Two samples of one distribution are
    0 apart on average, so a value may be slightly negative. Raises ValueError for fewer than two rows, or values that
    are not finite.

    >>> kernel_distance(np.zeros((2, 1)), np.ones((2, 1)))  # 1^3 + 2^3 - 2 * 1^3
    7.0
    """
    a, b = _checked(first, "kernel"), _checked(second, "kernel")

    def kernel(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return (x @ y.T / x.shape[1] + 1) ** 3

    def within(x: np.ndarray) -> float:
        values = kernel(x, x)
        return (values.sum() - values.trace()) / (len(x) * (len(x) - 1))

    return float(within(a) + within(b) - 2 * kernel(a, b).mean())


def _checked(features: Float[np.ndarray, "n d"], name: str) -> Float[np.ndarray, "n d"]:
    if len(features) < 2:
        raise ValueError(f"a {name} distance needs at least two images a set, got {len(features)}: compare more views")
    if not np.isfinite(features).all():
        raise ValueError(f"a {name} distance needs finite features, got NaN or infinity: look at the extractor")
    return features.astype(np.float64)


@runtime_checkable
class Extractor(Protocol):
    """Computes the features of an image. ``name`` is that of the network; "inception" is reserved for that of FID."""

    @property
    def name(self) -> str: ...

    def __call__(self, image: Float[Tensor, "h w 3"]) -> Float[np.ndarray, " d"]:
        """Return the features of an image in [0, 1]."""
        ...


@dataclass(frozen=True)
class LastLayer:
    """The last layer of an LPIPS network, averaged over the image."""

    name: str
    network: Lpips

    def __call__(self, image: Float[Tensor, "h w 3"]) -> Float[np.ndarray, " d"]:
        return self.network.features(image)[-1].double().mean((1, 2)).cpu().numpy()
