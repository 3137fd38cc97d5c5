"""PandaSet as it is shipped.

frames   columns out of pickled tables of pandas, without running anything in them
tables   where a sequence lies, poses and stamps of the cameras, the points of a sweep, the cuboids of an instant
reader   when the spinning lidar passed a direction, and all of it as a recording
"""

from sparsestreet.data.pandaset.reader import PandaSetReader

__all__ = ["PandaSetReader"]
