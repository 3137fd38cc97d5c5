"""Reader of COLMAP's sparse models, in text and binary."""

from sparsestreet.data.colmap.reader import ColmapReader

__all__ = ["ColmapReader"]
