"""Make synthetic streets: ray-traced drives with exact truth, written as logs on disk.

In reading order: ``settings``, ``world`` (built from ``models``, ``shapes``, ``textures``), ``tracer``, ``capture``,
``render``, ``street``, ``reader``.
"""

from sparsestreet.data.synthetic.reader import StreetReader
from sparsestreet.data.synthetic.settings import LidarSensor, StreetSettings
from sparsestreet.data.synthetic.street import make_street

__all__ = ["LidarSensor", "StreetReader", "StreetSettings", "make_street"]
