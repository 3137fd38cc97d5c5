"""Synthetic streets: a ray-traced drive with exact truth, written as a log on disk. In reading order:

1. what is asked for: ``settings``, with the lidar's ``sensor``; ``reader`` makes a street when it is first needed,
   ``street`` writes it whole or not at all;
2. the world: what stands where and who moves how (``world``, ``layout``, ``motion``), things built from parts
   (``models``, ``parts``), convex solids (``shapes``);
3. how it looks: ``textures`` with ``coverage`` and ``noise``, light (``sky``, ``shading``);
4. one instant: parts as arrays (``scene``), first hits of rays (``tracer``), the rig and the lidar (``cameras``,
   ``lidar``), all of it to pictures and truth (``render``), frames to disk (``write``), and whatever a camera beside
   the path would have seen (``truth``).
"""

from sparsestreet.data.synthetic.reader import StreetReader
from sparsestreet.data.synthetic.sensor import LidarSensor
from sparsestreet.data.synthetic.settings import StreetSettings
from sparsestreet.data.synthetic.street import make_street

__all__ = ["LidarSensor", "StreetReader", "StreetSettings", "make_street"]
