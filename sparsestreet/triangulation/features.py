"""SIFT features of an image (Lowe 2004) by OpenCV, compared by Hellinger distance."""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Float64, UInt8

SIFT_WIDTH = 640
"""Width, pixels, below which images are doubled before SIFT, which doubles them again: small ones have few features."""

CONTRAST = 0.01
"""SIFT's contrast threshold; OpenCV's 0.04 finds nothing on evenly painted walls and asphalt."""

EDGE = 20.0
"""SIFT's limit of the ratio of curvatures; OpenCV's 10 drops elongated things such as window frames from the side."""


@dataclass(frozen=True)
class Features:
    """Positions in pixels, the top left pixel's center at (0.5, 0.5), and descriptors of unit length."""

    pixels: Float64[np.ndarray, "n 2"]
    descriptors: Float32[np.ndarray, "n 128"]

    def __len__(self) -> int:
        return len(self.pixels)

    def where(self, mask: Bool[np.ndarray, " n"]) -> "Features":
        return Features(self.pixels[mask], self.descriptors[mask])


def find_features(image: UInt8[np.ndarray, "h w 3"], limit: int) -> Features:
    """Returns at most ``limit`` features, those of the strongest contrast."""
    gray = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    zoom = 2 if gray.shape[1] < SIFT_WIDTH else 1
    if zoom > 1:
        gray = cv2.resize(gray, None, fx=zoom, fy=zoom, interpolation=cv2.INTER_CUBIC)
    sift = cv2.SIFT.create(nfeatures=limit, contrastThreshold=CONTRAST, edgeThreshold=EDGE)
    points, descriptors = sift.detectAndCompute(gray, None)
    if not points:
        return Features(np.zeros((0, 2)), np.zeros((0, 128), np.float32))
    # OpenCV counts from the top left pixel's center.
    pixels = (np.array([point.pt for point in points], np.float64) + 0.5) / zoom
    return Features(pixels, _hellinger(descriptors))


def _hellinger(descriptors: Float32[np.ndarray, "n 128"]) -> Float32[np.ndarray, "n 128"]:
    """Square roots of the normalized histograms (Arandjelovic and Zisserman 2012), which have unit length."""
    total = descriptors.sum(1, keepdims=True)
    return np.sqrt(descriptors / np.maximum(total, np.float32(1e-12)))
