"""PandaSet as it is shipped.

frames   columns out of pickled tables of pandas, without pandas, and without running anything in them
tables   poses and stamps of the cameras, the points of a sweep, the cuboids of an instant
spin     when the spinning lidar passed a direction
layout   where a sequence lies, and what every car of the data set has
reader   all of it as a recording
"""

from sparsestreet.data.pandaset.reader import PandaSetReader

__all__ = ["PandaSetReader"]
