"""Reader of Argoverse 2's sensor data set, as it is shipped.

feather  columns of numbers and text out of feather files, their sizes checked before memory is taken
layout   where a log lies: its sweeps, its images, which image belongs to which sweep
tables   the vehicle's path, the calibration, the boxes
reader   all of it as a recording
"""

from sparsestreet.data.argoverse2.reader import Argoverse2Reader

__all__ = ["Argoverse2Reader"]
