"""Lens models: the pixel that shows a direction.

A direction is a vector of any length in the camera's frame (x right, y down, z forward). Pixels are those of the
recorded images, in float64, centers at +0.5; a calibration that counts from the center of the first pixel (OpenCV, MEI,
f-theta) has 0.5 added to its principal point by whoever reads it.

The splat op simulates Brown-Conrady (``geometry.distortion``). The other models are for images that are resampled to a
pinhole. A model images the directions up to ``reach``: farther from the optical axis its polynomials fold back, or were
never fitted.
"""

from sparsestreet.geometry.lenses.f_theta import FTheta
from sparsestreet.geometry.lenses.lens import Lens, angles_from_axis
from sparsestreet.geometry.lenses.mei import Mei
from sparsestreet.geometry.lenses.opencv import BrownConrady, Fisheye, Rational

__all__ = ["BrownConrady", "FTheta", "Fisheye", "Lens", "Mei", "Rational", "angles_from_axis"]
