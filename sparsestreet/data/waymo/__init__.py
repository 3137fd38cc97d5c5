"""Waymo's Open Dataset as it is shipped: version 1 (TFRecord) and version 2 (parquet).

segment   the values that both versions hold, and what a segment offers
v1, v2    a segment from the files of either version
find      which version a folder holds, and the wanted segment
images    pose and motion of a camera while its image is read out
lidar     points from range images
boxes     boxes at their instants
pixels    images, and masks from panoptic labels
spool     what was decoded once, in a temporary file
reader    the recording
"""

from sparsestreet.data.waymo.reader import WaymoReader

__all__ = ["WaymoReader"]
