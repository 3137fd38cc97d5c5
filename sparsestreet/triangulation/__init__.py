"""Points from images: features are matched along the epipolar lines of known poses, and triangulated.

``matches`` finds features, chooses images to compare, and compares two. ``points`` computes where the rays of a point
meet, and turns views into points. ``sweep`` finds the depth of pixels far ahead, where features are few. ``street``
separates what stands still from what is in boxes, and keeps the points on disk.
"""

from sparsestreet.triangulation.points import TriangulatedPoints
from sparsestreet.triangulation.settings import ImagePointSettings, SweepSettings
from sparsestreet.triangulation.street import StreetPoints, kept_street_points, street_points

__all__ = [
    "ImagePointSettings",
    "StreetPoints",
    "SweepSettings",
    "TriangulatedPoints",
    "kept_street_points",
    "street_points",
]
