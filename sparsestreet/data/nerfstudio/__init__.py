"""Reader of nerfstudio's ``transforms.json``: posed images, lenses, masks and sparse points."""

from sparsestreet.data.nerfstudio.reader import NerfstudioReader

__all__ = ["NerfstudioReader"]
