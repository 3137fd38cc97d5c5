"""Waymo's Open Dataset as it is shipped: version 1 (TFRecord) and version 2 (parquet)."""

from sparsestreet.data.waymo.reader import WaymoReader, segment_name

__all__ = ["WaymoReader", "segment_name"]
