"""Points that images give: features, matched along the epipolar lines of known poses, and triangulated.

``features`` finds them in one image; ``pairs`` says which images to compare; ``matches`` compares two; ``rays`` is
about where the rays of a point meet; ``points`` is the way from views to points; ``street`` keeps what stands still
apart from what is in the boxes; ``cache`` remembers the points on disk.
"""

from sparsestreet.triangulation.cache import cached_street_points
from sparsestreet.triangulation.points import TriangulatedPoints
from sparsestreet.triangulation.settings import ImagePointSettings
from sparsestreet.triangulation.street import StreetPoints, street_points

__all__ = ["ImagePointSettings", "StreetPoints", "TriangulatedPoints", "cached_street_points", "street_points"]
