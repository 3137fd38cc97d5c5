"""Synthetic streets: a ray-traced drive with exact truth, written as a log on disk. In reading order:

1. The request: ``settings``, with the lidar's ``sensor``. ``reader`` makes a street when it is first needed, and
   ``street`` writes it whole or not at all.
2. The world: places and motions of all things (``world``, ``layout``, ``motion``, ``tunnel``), things built from parts
   (``models``, ``parts``), and convex solids (``shapes``).
3. Its look: ``textures`` with ``coverage`` and ``noise``, and light (``sky``, ``shading``).
4. One ``instant``: parts as arrays (``scene``), first hits of rays (``tracer``), the rig and the lidar (``cameras``,
   ``lidar``). ``render`` makes pictures and truth, ``write`` writes frames to disk, and ``truth`` shows what a camera
   next to the path would have seen.
5. What a camera does to a recorded image: how rows are read (``capture``), its ``exposure``, and the ``hood`` in front
   of it. What the files say: the cameras' motion (``declared``), and ``errors`` of poses.
"""

from sparsestreet.data.synthetic.reader import StreetReader
from sparsestreet.data.synthetic.settings import LidarSensor, StreetSettings
from sparsestreet.data.synthetic.street import make_street

__all__ = ["LidarSensor", "StreetReader", "StreetSettings", "make_street"]
