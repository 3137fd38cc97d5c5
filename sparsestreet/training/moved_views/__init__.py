"""Views beside the recorded path, compared with what lidar returned from there.

A recorded view is rendered once more from a camera that stands sideways of the recorded one. Nobody recorded an image
there, but the returns of this sweep and of those before and after it, in the colors of the recorded images, say what
many of its pixels show. Fused lidar as a target beside the path follows LiDAR-EVS (arXiv 2603.14763) and FlexDrive
(arXiv 2502.21093) in idea; the form is ours.

``returns`` has the settings, the colored returns of the street and of cars, and what they say of the pixels of a
camera; ``term`` the terms of a step, and the way from a log to them.
"""

from sparsestreet.training.moved_views.returns import MovedViews
from sparsestreet.training.moved_views.term import MovedViewTerm, moved_view_term

__all__ = ["MovedViewTerm", "MovedViews", "moved_view_term"]
