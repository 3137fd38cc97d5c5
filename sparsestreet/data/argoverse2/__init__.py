"""Reader of Argoverse 2's sensor data set, as it is shipped."""

from sparsestreet.data.argoverse2.reader import Argoverse2Reader

__all__ = ["Argoverse2Reader"]
