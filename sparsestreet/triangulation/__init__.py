"""Points from images: features are matched along the epipolar lines of known poses, and triangulated.

``matches`` finds features, chooses images to compare, and compares two. ``points`` computes where the rays of a point
meet, and turns views into points. ``street`` separates what stands still from what is in boxes, and keeps the points on
disk.
"""

from sparsestreet.triangulation.points import ImagePointSettings, TriangulatedPoints
from sparsestreet.triangulation.street import StreetPoints, kept_street_points, street_points

__all__ = ["ImagePointSettings", "StreetPoints", "TriangulatedPoints", "kept_street_points", "street_points"]
