"""PandaSet as it is shipped: read and written.

frames   columns out of pickled tables of pandas, without pandas, and without running anything in them
tables   poses and stamps of the cameras, the points of a sweep, the cuboids of an instant
spin     when the spinning lidar passed a direction
layout   where a sequence lies, and what every car of the data set has
reader   all of it as a recording
labels   names of classes
pickled  tables as pandas pickles them, written without pandas
sequence a log at the instants of its front camera
writer   the files of that
"""

from sparsestreet.data.pandaset.reader import PandaSetReader
from sparsestreet.data.pandaset.writer import PandaSetWriter

__all__ = ["PandaSetReader", "PandaSetWriter"]
