"""Loss terms; each is one file and knows only the rendering and the frame."""

from sparsestreet.training.losses.base import Loss
from sparsestreet.training.losses.depth import InverseDepth
from sparsestreet.training.losses.mask_sparsity import MaskSparsity
from sparsestreet.training.losses.photometric import Photometric
from sparsestreet.training.losses.sky import SkyMask

__all__ = ["InverseDepth", "Loss", "MaskSparsity", "Photometric", "SkyMask"]
