"""Synthetic streets: a ray-traced drive with exact truth, written as a log on disk."""

from sparsestreet.data.synthetic.open import open_street
from sparsestreet.data.synthetic.settings import StreetSettings
from sparsestreet.data.synthetic.street import make_street

__all__ = ["StreetSettings", "make_street", "open_street"]
